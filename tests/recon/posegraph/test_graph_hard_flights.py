"""Flights as bad as they come: breaks in vision, outliers, sensors that are not there, few nodes.

The flights are drawn by chance, once for each seed; what they have in common is that no pose may
leave the site, and that good fixes keep the track near the truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from bench_graph import HEIGHT_M, legs
from flown_track import SPREAD, landed, publish, sensed

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Loop, Node
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, PosePrior

COUNT, ALL = 160, 100_000
LOOP = np.diag([5e-4**2] * 3 + [0.03**2] * 3)


@dataclass(frozen=True)
class Hard:
    """The faults of a flight."""

    seed: int
    leg: int  # keyframes
    step_m: float
    scale: float  # metres per unit of the odometry
    segment: float  # keyframes from break to break, about
    nodes: int = ALL
    attitude: bool = True
    every: int = 1  # so many keyframes a fix
    outliers: float = 0.0  # share of the fixes that are off by 200 m
    altitude: bool = True
    count: int = COUNT


def flown(hard: Hard) -> tuple[list[F64], Trajectory]:
    """The truth and what became of it."""
    rng = np.random.default_rng(hard.seed)
    units = np.array([1.0] * 3 + [1.0 / hard.scale] * 3)
    truth = legs(rng, hard.count, hard.leg, hard.step_m)
    odom, priors = sensed(rng, truth, SPREAD, hard.scale)
    trajectory = Trajectory(graph=PoseGraph(hard.nodes))
    segment, start, time_ns = 0, 0, 0
    for i, prior in enumerate(heard(hard, rng, truth, priors)):
        if i and rng.random() < 1.0 / hard.segment:
            segment, start = segment + 1, i
            time_ns += 2 * 10**9
        time_ns += 10**9
        T = se3.inverse(odom[start]) @ odom[i]
        height = HEIGHT_M / hard.scale
        trajectory.add(Node(i, time_ns, segment, T, SPREAD * np.outer(units, units), prior, height))
        a = int(rng.integers(0, i - 20)) if i > 30 else -1
        if rng.random() < 0.15 and a in trajectory:
            T = se3.inverse(truth[a]) @ truth[i]
            T[:3, 3] *= trajectory.scale(a) / hard.scale  # it is seen in units of the odometry
            trajectory.add_loop(Loop(a, i, T, LOOP))
        publish(trajectory, i)
    return truth, trajectory


def heard(
    hard: Hard, rng: np.random.Generator, truth: list[F64], priors: list[PosePrior]
) -> Iterator[PosePrior]:
    """The telemetry of each keyframe."""
    for i, prior in enumerate(priors):
        if i % hard.every:
            prior = replace(prior, position_m=None, sigma_position_m=None)
        elif rng.random() < hard.outliers and prior.position_m is not None:
            prior = replace(prior, position_m=prior.position_m + 200.0 * rng.normal(size=3))
        if not hard.attitude:
            prior = replace(prior, R_world_camera=None)
        if hard.altitude:
            z = float(truth[i][2, 3] + 0.5 * rng.normal())
            prior = replace(prior, altitude_m=z, sigma_altitude_m=1.0)
        yield prior


FLIGHTS = {
    "two breaks, no attitude, a straight first leg": (
        Hard(1, leg=80, step_m=12.0, scale=1.0, segment=60.0, nodes=50, attitude=False,
             count=100), 1.0),
    "the same with every node": (
        Hard(1, leg=80, step_m=12.0, scale=1.0, segment=60.0, attitude=False), 1.0),
    "a break every other keyframe": (Hard(2, leg=40, step_m=5.0, scale=1.3, segment=2.0), 2.0),
    "breaks and outliers in a small graph": (
        Hard(3, leg=40, step_m=5.0, scale=0.3, segment=15.0, nodes=50, outliers=0.1), 1.5),
    "outliers in a small graph": (
        Hard(4, leg=40, step_m=5.0, scale=4.0, segment=1e9, nodes=50, outliers=0.2), 1.0),
    "few fixes, breaks, no attitude": (
        Hard(25, leg=20, step_m=2.0, scale=1.3, segment=15.0, attitude=False, every=17), 60.0),
}  # fmt: skip


QUICK = "two breaks, no attitude, a straight first leg"


@pytest.mark.parametrize(
    "name", [QUICK, *(pytest.param(n, marks=pytest.mark.slow) for n in FLIGHTS if n != QUICK)]
)
def test_the_track_keeps_to_the_truth(name: str) -> None:
    hard, max_m = FLIGHTS[name]
    truth, trajectory = flown(hard)
    poses = landed(trajectory, hard.count)
    apart = np.linalg.norm((poses - np.array(truth))[:, :3, 3], axis=1)
    assert np.median(apart) < max_m
    assert apart.max() < 1000.0
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (hard.count, 1, 1)),
                               atol=1e-9)  # fmt: skip
    assert len(trajectory.graph) <= hard.nodes
