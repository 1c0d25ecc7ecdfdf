"""A pose graph with a bound: fewer nodes, the same track, and interpolated keyframes on it."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from bench_graph import HEIGHT_M, legs
from flown_track import SPREAD, landed, publish, sensed

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Loop, Node
from recon.posegraph.thinning import moved_loop, surplus, thinned
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, PosePrior

COUNT, MOST, LEG = 200, 60, 50
STEP_M, SCALE = 5.0, 1.3
LOOP = np.diag([5e-4**2] * 3 + [0.03**2] * 3)
UNITS = np.outer([1.0] * 3 + [1.0 / SCALE] * 3, [1.0] * 3 + [1.0 / SCALE] * 3)


@cache
def flight() -> tuple[list[F64], list[F64], list[PosePrior]]:
    """Truth of legs to and fro, an odometry of another scale that drifts, and priors."""
    rng = np.random.default_rng(7)
    truth = legs(rng, COUNT, LEG, STEP_M)
    return truth, *sensed(rng, truth, SPREAD, SCALE)


def bounded(most: int = MOST) -> PoseGraph:
    return PoseGraph(most)


def fly(trajectory: Trajectory, count: int = COUNT, first: int = 0) -> None:
    """Every keyframe entered and published, with loops between neighbouring legs."""
    truth, odom, priors = flight()
    for i in range(first, count):
        height = HEIGHT_M / SCALE
        trajectory.add(Node(i, i * 10**9, 0, odom[i], SPREAD * UNITS, priors[i], height))
        leg, along = divmod(i, LEG)
        if leg and 10 < along < LEG - 10 and i % 4 == 0:
            other = leg * LEG - 1 - along
            trajectory.add_loop(Loop(other, i, se3.inverse(truth[other]) @ truth[i], LOOP))
        publish(trajectory, i)


def rms_m(poses: F64) -> float:
    apart = poses[:, :3, 3] - np.array(flight()[0])[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


@cache
def whole() -> F64:
    trajectory = Trajectory(graph=PoseGraph())
    fly(trajectory)
    return landed(trajectory, COUNT)


@pytest.mark.slow
def test_a_thinned_graph_is_as_near_to_the_truth_as_the_whole_one() -> None:
    trajectory = Trajectory(graph=bounded())
    fly(trajectory)
    graph = trajectory.graph
    assert graph.generation > 5
    assert graph.entered == COUNT and len(graph) <= MOST
    poses = landed(trajectory, COUNT)
    assert rms_m(poses) < 1.2 * rms_m(whole()) + 0.05 < 0.6
    apart = np.linalg.norm((poses - whole())[:, :3, 3], axis=1)
    assert apart.max() < 0.6 and np.sqrt(np.mean(apart**2)) < 0.25
    turned = np.linalg.norm((poses - whole())[:, :3, :3], axis=(1, 2))
    assert turned.max() < 0.01
    assert 5 < len(graph.loops) <= MOST - len(graph.pending)


@cache
def thin() -> Trajectory:
    """The flight with a bound, before its landing; only to be read."""
    trajectory = Trajectory(graph=bounded())
    fly(trajectory)
    return trajectory


@pytest.mark.slow
def test_nodes_stand_evenly_and_the_newest_all_stay() -> None:
    seqs = np.array(thin().graph.seqs)
    assert seqs[0] == 0 and seqs[-1] == COUNT - 1
    assert np.all(np.diff(seqs[-MOST // 5 :]) == 1)
    assert np.diff(seqs).max() <= 5 * COUNT / MOST


@pytest.mark.slow
def test_interpolated_keyframes_lie_between_their_nodes_as_vision_saw_them() -> None:
    """By closed form: as seen from the node before and from the one after, weighed by nearness."""
    trajectory, odom = thin(), flight()[1]
    graph = trajectory.graph
    a, b = next((a, b) for a, b in pairwise(graph.seqs) if b - a >= 4)
    T_a = graph.pose(a).T_world_camera

    def by_vision(node: int, i: int) -> F64:
        step = se3.inverse(odom[node]) @ odom[i]
        step[:3, 3] *= graph.scale(node)
        return np.asarray(graph.pose(node).T_world_camera @ step)

    for i in range(a + 1, b):
        one, other, share = by_vision(a, i), by_vision(b, i), (i - a) / (b - a)
        turn = se3.so3_log(one[:3, :3].T @ other[:3, :3])
        expected = se3.compose(
            one[:3, :3] @ se3.so3_exp(share * turn), (1 - share) * one[:3, 3] + share * other[:3, 3]
        )
        found = trajectory.pose(i)
        np.testing.assert_allclose(found.T_world_camera, expected, atol=1e-9)
        assert min(graph.scale(a), graph.scale(b)) <= found.scale + 1e-12
        np.testing.assert_allclose(trajectory.odom_pose(i), odom[i])
    np.testing.assert_allclose(trajectory.places([a, a + 1])[0], T_a)
    with pytest.raises(KeyError):
        trajectory.pose(COUNT)


@pytest.mark.slow
def test_everything_published_is_corrected_at_the_end() -> None:
    trajectory = Trajectory(graph=bounded())
    fly(trajectory)
    before = trajectory.places(range(COUNT))
    corrected = trajectory.moved(final=True)
    assert trajectory.moved(final=True) == {}
    off_m = np.linalg.norm((trajectory.places(range(COUNT)) - before)[:, :3, 3], axis=1)
    assert set(np.flatnonzero(off_m > 0.01)) <= corrected.keys()


@pytest.mark.slow
def test_composed_motions_and_moved_loops_have_the_spread_of_many_trials() -> None:
    """Monte Carlo: perturb each motion, look at the composed one and at the moved loop."""
    rng = np.random.default_rng(3)
    steps = [se3.exp(rng.normal(size=6)) for _ in range(3)]
    spreads = [np.diag(rng.uniform(0.5, 2.0, 6) * 1e-3) ** 2 for _ in range(3)]
    chain = [np.eye(4)]
    for step in steps:
        chain.append(chain[-1] @ step)
    nodes = [Node(i, i, 0, T, spreads[max(i - 1, 0)], PosePrior()) for i, T in enumerate(chain)]
    kept, marginalised = thinned(nodes, {1})
    assert [n.key for n in kept] == [0, 1, 2] and kept[1].weight == 2
    noise = [rng.multivariate_normal(np.zeros(6), S, 4000) for S in spreads]
    whole_step = se3.inverse(steps[0] @ steps[1])
    errors = [
        se3.log(se3.exp(a) @ steps[0] @ se3.exp(b) @ steps[1] @ whole_step)
        for a, b in zip(noise[0], noise[1], strict=True)
    ]
    found = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    np.testing.assert_allclose(kept[1].covariance / scale, found / scale, atol=0.08)
    loop = Loop(1, 3, steps[1] @ steps[2], spreads[2], 1.0)
    moved = moved_loop(loop, marginalised)
    assert moved.ends == (0, 3)
    np.testing.assert_allclose(moved.T_a_b, chain[3], atol=1e-12)
    errors = [
        se3.log(se3.exp(a) @ steps[0] @ se3.exp(c) @ loop.T_a_b @ se3.inverse(chain[3]))
        for a, c in zip(noise[0], noise[2], strict=True)
    ]
    found = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    np.testing.assert_allclose(moved.covariance / scale, found / scale, atol=0.08)
    back = moved_loop(Loop(0, 1, steps[0], spreads[0], 1.0), marginalised)
    assert back.ends == (0, 0)


def test_a_loop_to_an_interpolated_keyframe_is_as_unsure_as_vision_on_the_way_to_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It begins at the node before: the way on to the node after has no part in it."""
    trajectory, (_, odom, priors) = Trajectory(graph=bounded(8)), flight()
    for i in range(16):
        trajectory.add(Node(i, i * 10**9, 0, odom[i], SPREAD * UNITS, priors[i]))
    graph = trajectory.graph
    before, after = next((a, b) for a, b in pairwise(graph.seqs) if b - a >= 3)
    taken: list[Loop] = []
    monkeypatch.setattr(graph, "add_loop", taken.append)
    units = np.outer(*[np.array([1.0] * 3 + [graph.scale(before)] * 3)] * 2)
    for i in (before + 1, before + 2):
        trajectory.add_loop(Loop(i, 15, np.eye(4), np.zeros((6, 6))))
        loop = taken.pop()
        share = (i - before) / (after - before)
        assert loop.ends == (before, 15)
        np.testing.assert_allclose(loop.covariance, share * units * graph.node(after).covariance)


def test_ends_of_segments_stay() -> None:
    nodes = [
        Node(i, i, i // 7, np.eye(4), np.eye(6), PosePrior()) for i in range(70)
    ]  # fmt: skip
    for _ in range(5):
        nodes, _ = thinned(nodes, surplus(nodes))
        for segment in {n.segment for n in nodes}:
            seqs = [n.seq for n in nodes if n.segment == segment]
            assert (seqs[0], seqs[-1]) == (7 * segment, 7 * segment + 6)


def test_of_short_segments_those_that_leave_the_smallest_holes_go_first() -> None:
    """Two views each, the segments closer and closer to each other; none goes beside a hole."""
    firsts = np.cumsum([40 - 3 * n for n in range(10)])
    nodes = [
        Node(int(firsts[i // 2]) + i % 2, i, i // 2, np.eye(4), np.eye(6), PosePrior())
        for i in range(20)
    ]
    gone = surplus(nodes)
    assert {node.segment for node in nodes if node.seq in gone} == {2, 4, 6}
    assert len(gone) == 6
