"""The pose graph in a process of its own: same poses, no waiting, and it may be killed."""

from __future__ import annotations

import gc
import os
import signal
import time
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from flown_track import sensed

from recon import se3
from recon.backends.cpu import CpuBackend
from recon.graph.pose_graph import PoseGraph
from recon.graph.trajectory import Trajectory
from recon.types import F64, Camera, PosePrior
from service.config import Config
from service.onboard.graph_aside import GraphAside
from service.onboard.graph_figures import graph_figures
from service.onboard.stages import build_stages

STEP_M, HEIGHT_M, SCALE = 6.0, 60.0, 1.3
MOTION = np.diag([1e-4**2] * 3 + [0.01**2] * 3)
LOOP = np.diag([1e-3**2] * 3 + [0.05**2] * 3)


def _flight(count: int) -> tuple[list[F64], list[F64], list[PosePrior]]:
    """Truth, odometry of another scale that drifts, and priors: two legs to and fro."""
    rng = np.random.default_rng(4)
    truth, half = [], count // 2
    for i in range(count):
        x = STEP_M * (i if i < half else count - 1 - i)
        turn = se3.so3_exp(np.array([0.0, 0.0, np.pi * (i >= half)]))
        place = np.array([x, 0.0 if i < half else 20.0, HEIGHT_M]) + rng.normal(size=3) * 0.1
        truth.append(se3.compose(turn @ np.diag([1.0, -1.0, -1.0]), place))
    return truth, *sensed(rng, truth, MOTION, SCALE)


TRUTH, ODOM, PRIORS = _flight(40)


def _add(graph: PoseGraph | GraphAside | Trajectory, first: int, last: int) -> None:
    units = np.array([1.0] * 3 + [1.0 / SCALE] * 3)
    covariance, height = MOTION * np.outer(units, units), (HEIGHT_M / SCALE, 0.0)
    for i in range(first, last):
        if isinstance(graph, Trajectory):
            graph.add(i, 0, ODOM[i], PRIORS[i], height, i * 10**9, covariance)
        else:
            graph.add_keyframe(i, i * 10**9, 0, ODOM[i], covariance, PRIORS[i], height)


def _close_loops(graph: PoseGraph | GraphAside) -> None:
    graph.residuals()  # waits until the scale is known in which loops are measured
    for a, b in ((5, 34), (6, 33)):
        graph.add_loop(a, b, se3.inverse(TRUTH[a]) @ TRUTH[b], LOOP)


@pytest.fixture
def aside() -> Iterator[GraphAside]:
    graph = GraphAside(wait_s=0.01, again_s=0.0)
    yield graph
    graph.close()


@cache
def _same_in_one_process() -> PoseGraph:
    graph = PoseGraph()
    _add(graph, 0, 40)
    _close_loops(graph)
    graph.solve()
    return graph


@pytest.mark.parametrize("is_live", [True, False])
def test_a_live_flight_has_it_and_a_replay_has_not(is_live: bool) -> None:
    camera = Camera(np.array([[200.0, 0, 160], [0, 200, 90], [0, 0, 1]]), np.zeros(5), (320, 180))
    stages = build_stages(camera, Config(), CpuBackend(), live=is_live)
    with stages.resources:
        assert isinstance(stages.chain.graph, GraphAside if is_live else PoseGraph)


def test_its_result_is_that_of_the_graph_itself(aside: GraphAside) -> None:
    _add(aside, 0, 40)
    _close_loops(aside)
    aside.solve()
    graph = _same_in_one_process()
    np.testing.assert_allclose(aside.pose_array(), graph.pose_array(), atol=1e-3)
    np.testing.assert_allclose(aside.scales(), graph.scales(), rtol=1e-4)
    assert [aside.sources(i) for i in range(40)] == [graph.sources(i) for i in range(40)]
    np.testing.assert_allclose(aside.pose(20).covariance, graph.pose(20).covariance, rtol=0.05)
    assert [e.accepted for e in aside.loops] == [True, True]
    told, expected = graph_figures(aside), graph_figures(graph)
    assert told is not None and expected is not None
    assert told["loops"]["pairs"] == expected["loops"]["pairs"]
    assert told["residuals"].keys() == expected["residuals"].keys()


def test_while_it_is_busy_vision_carries_on_and_corrections_follow(aside: GraphAside) -> None:
    trajectory = Trajectory(graph=aside)
    _add(trajectory, 0, 20)
    aside.residuals()  # waits until all is weighed
    os.kill(aside.pid, signal.SIGSTOP)
    try:
        _add(trajectory, 20, 40)
        for i in range(40):
            trajectory.tell(trajectory.place(i))
        assert aside.behind == 20
        ahead = aside.pose_array()
        for i in range(20, 40):  # each step is vision's, in the scale known before
            step = se3.inverse(ahead[i - 1]) @ ahead[i]
            seen = se3.inverse(ODOM[i - 1]) @ ODOM[i]
            seen[:3, 3] *= aside.scale(19)
            np.testing.assert_allclose(step, seen, atol=1e-9)
        sigma = [float(np.trace(aside.pose(i).covariance)) for i in range(20, 40)]
        assert sigma == sorted(sigma)
        assert aside.sources(39) == ("vision",)
        assert not trajectory.moved()
    finally:
        os.kill(aside.pid, signal.SIGCONT)
    aside.residuals()
    moved = trajectory.moved()
    assert aside.behind == 0 and "gnss" in aside.sources(39)
    for placed in moved:
        np.testing.assert_allclose(placed.T_world_camera, aside.pose_array()[placed.seq])


def test_a_loop_measured_by_an_older_scale_is_taken_by_its_own(aside: GraphAside) -> None:
    """Metres of a loop are those of the scale known when it was seen; that may have changed."""
    _add(aside, 0, 40)
    os.kill(aside.pid, signal.SIGSTOP)
    try:
        for a, b in ((5, 34), (6, 33)):
            T = se3.inverse(TRUTH[a]) @ TRUTH[b]
            T[:3, 3] *= aside.scale(a) / SCALE  # as seen with a scale that may be off
            assert aside.add_loop(a, b, T, LOOP)  # it cannot answer yet
    finally:
        os.kill(aside.pid, signal.SIGCONT)
    found = aside.metric_loops()
    assert [loop.ends for loop in found] == [(6, 33), (5, 34)]
    for loop in found:
        units = loop.T_a_b[:3, 3] / aside.scale(loop.a)
        truth = (se3.inverse(TRUTH[loop.a]) @ TRUTH[loop.b])[:3, 3] / SCALE
        np.testing.assert_allclose(units, truth, rtol=0.01, atol=0.02)


def test_a_killed_process_costs_nothing_but_time(aside: GraphAside) -> None:
    _add(aside, 0, 20)
    for first in (20, 24):
        os.kill(aside.pid, signal.SIGKILL)
        time.sleep(0.05)
        _add(aside, first, first + 4)
    _add(aside, 28, 40)
    _close_loops(aside)
    os.kill(aside.pid, signal.SIGKILL)
    aside.solve()
    expected = _same_in_one_process().pose_array()
    np.testing.assert_allclose(aside.pose_array(), expected, atol=1e-3)


def test_without_any_process_the_graph_is_built_here(
    aside: GraphAside, monkeypatch: pytest.MonkeyPatch
) -> None:
    _add(aside, 0, 40)
    _close_loops(aside)
    monkeypatch.setattr("sys.executable", "/bin/false")
    os.kill(aside.pid, signal.SIGKILL)
    aside.solve()
    np.testing.assert_allclose(aside.pose_array(), _same_in_one_process().pose_array(), atol=1e-3)
    assert len(aside.metric_loops()) == 2


def test_its_process_ends_with_it_and_ignores_the_terminal() -> None:
    graph = GraphAside()
    _add(graph, 0, 3)
    graph.residuals()
    os.kill(graph.pid, signal.SIGINT)
    os.kill(graph.pid, signal.SIGTERM)
    assert len(graph.residuals()["vision"]) == 2
    pid = graph.pid
    graph.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_graph_that_nobody_closed_leaves_no_process() -> None:
    graph = GraphAside()
    pid = graph.pid
    del graph
    gc.collect()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_wrong_calls_are_refused(aside: GraphAside) -> None:
    _add(aside, 0, 3)
    with pytest.raises(ValueError, match="does not come after"):
        _add(aside, 2, 3)
    with pytest.raises(ValueError, match="not two of the graph"):
        aside.add_loop(0, 7, np.eye(4), LOOP)
