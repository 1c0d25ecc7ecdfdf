"""A pose graph with a bound, where vision breaks often."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from bench_graph import HEIGHT_M, legs
from flown_track import SPREAD, landed, publish, sensed

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, PosePrior

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
        height = (HEIGHT_M / SCALE, 0.0) if fixes else None
        trajectory.add(i, segment, T, prior, height, i * 10**9, SPREAD * UNITS)
        publish(trajectory, i)
        most = max(most, len(trajectory.graph))
    return most


@pytest.mark.slow
def test_of_many_short_segments_the_ends_stay_and_keep_near_the_truth() -> None:
    whole, trajectory = Trajectory(graph=PoseGraph()), Trajectory(graph=PoseGraph(MOST))
    assert fly(whole) == COUNT
    assert fly(trajectory) < 0.8 * COUNT
    ends = {EACH * (i // EACH) + end for i in range(COUNT) for end in (0, EACH - 1)}
    assert ends <= set(trajectory.graph.seqs)
    apart = [
        np.linalg.norm((landed(one, COUNT) - np.array(flight()[0][:COUNT]))[:, :3, 3], axis=1)
        for one in (trajectory, whole)
    ]
    rms = [float(np.sqrt(np.mean(a**2))) for a in apart]
    assert rms[0] < 1.5 * rms[1] < 1.5
    scales = [trajectory.pose(i).scale for i in range(COUNT)]
    assert np.median(np.abs(np.array(scales) / SCALE - 1.0)) < 0.05
    assert trajectory.moved(final=True) == {}


@pytest.mark.parametrize("fixes", [True, False])
def test_rounding_errors_do_not_grow_from_break_to_break(fixes: bool) -> None:
    """Each segment's pose is made of the last one's and of its inverse when all is built again."""
    trajectory, (_, odom, priors) = Trajectory(graph=PoseGraph()), flight()
    for i in range(0, FLOWN, 2):
        prior = priors[i] if fixes else PosePrior()
        T = np.eye(4) if i % 4 == 0 else se3.inverse(odom[i - 2]) @ odom[i]
        trajectory.add(i, i // 4, T, prior, None, i * 10**9, SPREAD * UNITS)
    trajectory.graph.solve()
    R = trajectory.graph.poses()[:, :3, :3]
    eyes = np.tile(np.eye(3), (len(R), 1, 1))
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), eyes, atol=1e-9)
