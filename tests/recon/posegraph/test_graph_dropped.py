"""A pose graph with a bound, where vision breaks so often that whole segments must go."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from bench_graph import HEIGHT_M, legs
from flown_track import SPREAD, landed, publish, sensed

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Loop, Node
from recon.posegraph.thinning import moved_loops, over_gaps, surplus, thinned
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, Pose, PosePrior

FLOWN, COUNT, MOST, EACH = 200, 150, 50, 5
STEP_M, SCALE = 5.0, 1.3
UNITS = np.outer([1.0] * 3 + [1.0 / SCALE] * 3, [1.0] * 3 + [1.0 / SCALE] * 3)


@cache
def flight() -> tuple[list[F64], list[F64], list[PosePrior]]:
    rng = np.random.default_rng(11)
    truth = legs(rng, FLOWN, 50, STEP_M)
    return truth, *sensed(rng, truth, SPREAD, SCALE)


def fly(trajectory: Trajectory, first: int = 0, count: int = COUNT, fixes: bool = True) -> int:
    """Keyframes in segments of :data:`EACH`, each in a frame of its own; the most nodes seen."""
    _, odom, priors = flight()
    most = 0
    for i in range(first, count):
        segment = i // EACH
        T = se3.inverse(odom[EACH * segment]) @ odom[i]
        prior = priors[i] if fixes else PosePrior()
        height = HEIGHT_M / SCALE if fixes else None
        trajectory.add(Node(i, i * 10**9, segment, T, SPREAD * UNITS, prior, height))
        publish(trajectory, i)
        most = max(most, len(trajectory.graph))
    return most


def bounded() -> PoseGraph:
    return PoseGraph(MOST)


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """A flight with a bound, landed, and the first keyframe that was dropped with its segment."""

    trajectory: Trajectory
    most: int  # nodes
    poses: F64
    dropped: int
    published: Pose  # the dropped one's, before the landing
    is_looped: bool  # a loop with it was taken
    segments: tuple[int, int]  # of the nodes before and after it


@pytest.fixture(scope="module")
def flown() -> Flown:
    trajectory = Trajectory(graph=bounded())
    most, graph = fly(trajectory), trajectory.graph
    before, after = next((a, b) for a, b in pairwise(graph.seqs) if b - a > EACH)
    published = trajectory.pose(before + 1)
    segments = graph.node(before).segment, graph.node(after).segment
    is_looped = trajectory.add_loop(Loop(before + 1, COUNT - 1, np.eye(4), SPREAD))
    poses = landed(trajectory, COUNT)
    return Flown(trajectory, most, poses, before + 1, published, is_looped, segments)


@pytest.mark.slow
def test_many_short_segments_keep_to_the_bound_and_near_the_truth(flown: Flown) -> None:
    whole, trajectory = Trajectory(graph=PoseGraph()), flown.trajectory
    assert fly(whole) == COUNT
    assert flown.most <= MOST
    assert trajectory.graph.counts["keyframe dropped"] > COUNT // 4
    apart = [
        np.linalg.norm((poses - np.array(flight()[0][:COUNT]))[:, :3, 3], axis=1)
        for poses in (flown.poses, landed(whole, COUNT))
    ]
    rms = [float(np.sqrt(np.mean(a**2))) for a in apart]
    assert rms[0] < 1.5 * rms[1] < 1.5
    scales = [trajectory.pose(i).scale for i in range(COUNT)]
    assert np.median(np.abs(np.array(scales) / SCALE - 1.0)) < 0.05
    assert trajectory.moved(final=True) == {}


@pytest.mark.slow
def test_without_fixes_nothing_jumps_when_segments_go() -> None:
    """Dead reckoning over a gap is published once: what stays, stays where it was."""
    trajectory, worst = Trajectory(graph=bounded()), 0.0
    for i in range(FLOWN):
        before = {seq: trajectory.pose(seq).T_world_camera for seq in range(max(0, i - 30), i)}
        was = trajectory.graph.generation
        fly(trajectory, i, i + 1, fixes=False)
        if trajectory.graph.generation > was:
            shifts = [
                np.linalg.norm((trajectory.pose(seq).T_world_camera - T)[:3, 3])
                for seq, T in before.items()
            ]
            worst = max(worst, *map(float, shifts))
    assert trajectory.graph.generation > 10
    assert trajectory.graph.counts["keyframe dropped"] > 0
    assert worst < 0.01


@pytest.mark.slow
def test_dropped_keyframes_stay_as_published(flown: Flown) -> None:
    before, after = flown.segments
    assert after > before + 1
    published = flown.published.T_world_camera
    apart = np.linalg.norm((published - flight()[0][flown.dropped])[:3, 3])
    assert 0.0 < apart < 5.0
    assert not flown.is_looped
    assert flown.trajectory.graph.seqs[0] == 0
    found = flown.trajectory.pose(flown.dropped)
    np.testing.assert_array_equal(found.T_world_camera, published)
    assert found.scale == flown.published.scale


def nodes_of(sizes: list[int]) -> list[Node]:
    """Nodes a metre apart along x, in segments of these sizes."""
    segments = [segment for segment, size in enumerate(sizes) for _ in range(size)]
    return [
        Node(i, i, segment, se3.compose(np.eye(3), np.array([i, 0.0, 0.0])), np.eye(6),
             PosePrior())
        for i, segment in enumerate(segments)
    ]  # fmt: skip


def test_segments_go_whole_but_neither_the_first_nor_the_newest() -> None:
    nodes = nodes_of([2, 3, 2, 1, 2, 2, 2, 2, 2])
    gone = surplus(nodes)
    assert gone == {2, 3, 4, 7, 10, 11}  # inside the second; the one of one, and no two neighbours
    kept, marginalised = thinned(nodes, gone)
    assert not marginalised
    assert [n.key for n in kept] == list(range(len(kept)))
    poses = {n.seq: n.T_odom_camera for n in nodes}
    loops = [Loop(0, 7, np.eye(4), SPREAD, 1.0), Loop(0, 9, np.eye(4), SPREAD, 1.0)]
    assert [
        one.ends for one in moved_loops(loops, marginalised, gone - marginalised.keys(), 9)
    ] == [(0, 9)]
    found_over = {
        n.seq: n.T_prev_segment for n in over_gaps(kept, poses) if n.T_prev_segment is not None
    }
    assert found_over.keys() == {5, 8, 12, 14, 16}
    np.testing.assert_allclose(found_over[8][:3, 3], [2.0, 0.0, 0.0])  # over the seventh


@pytest.mark.slow
def test_unpublished_keyframes_of_a_dropped_segment_follow_the_node_before() -> None:
    trajectory, (_, odom, priors) = Trajectory(graph=bounded()), flight()
    for i in range(2 * MOST):
        T = se3.inverse(odom[i - i % EACH]) @ odom[i]
        trajectory.add(Node(i, i * 10**9, i // EACH, T, SPREAD * UNITS, priors[i]))
    before, after = next((a, b) for a, b in pairwise(trajectory.graph.seqs) if b - a > EACH)
    node, found = trajectory.pose(before), trajectory.pose(after - 1)
    np.testing.assert_array_equal(found.T_world_camera, node.T_world_camera)
    assert found.scale == node.scale


@pytest.mark.parametrize("fixes", [True, False])
def test_rounding_errors_do_not_grow_from_break_to_break(fixes: bool) -> None:
    """Each segment's pose is made of the last one's and of its inverse when all is built again."""
    trajectory, (_, odom, priors) = Trajectory(graph=PoseGraph()), flight()
    for i in range(0, FLOWN, 2):
        prior = priors[i] if fixes else PosePrior()
        T = np.eye(4) if i % 4 == 0 else se3.inverse(odom[i - 2]) @ odom[i]
        trajectory.add(Node(i, i * 10**9, i // 4, T, SPREAD * UNITS, prior))
    trajectory.graph.solve()
    R = trajectory.graph.poses()[:, :3, :3]
    eyes = np.tile(np.eye(3), (len(R), 1, 1))
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), eyes, atol=1e-9)
