"""Camera and autopilot readings of a known track, for the tests of the pose graph."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from recon import se3
from recon.posegraph.records import Node
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, PosePrior

SPREAD = np.diag([3e-4**2] * 3 + [0.02**2] * 3)
"""(6, 6) of a motion of the odometry, left, in metres."""


def sensed(
    rng: np.random.Generator, truth: list[F64], spread: F64, scale: float
) -> tuple[list[F64], list[PosePrior]]:
    """An odometry that drifts, in units of ``scale`` metres, and priors with fixes off by 1 m.

    ``truth`` are poses (4, 4), ``spread`` (6, 6) is of one motion, left, in metres.
    """
    odom = [np.eye(4)]
    for a, b in pairwise(truth):
        step = se3.exp(rng.multivariate_normal(np.zeros(6), spread)) @ se3.inverse(a) @ b
        step[:3, 3] /= scale
        odom.append(odom[-1] @ step)
    priors = [
        PosePrior(T[:3, :3], 0.01, 0.02, T[:3, 3] + rng.normal(size=3), np.ones(3)) for T in truth
    ]
    return odom, priors


def publish(trajectory: Trajectory, seq: int) -> None:
    """Publish a new keyframe, and those that have moved since they were."""
    trajectory.publish(seq, trajectory.pose(seq))
    trajectory.moved()


def landed(trajectory: Trajectory, count: int) -> F64:
    """(count, 4, 4) where all keyframes are after the last correction, which is published."""
    trajectory.moved(final=True)
    return np.array([trajectory.pose(i).T_world_camera for i in range(count)])


def node(
    T_odom_camera: F64, prior: PosePrior, height: float | None = None, slant: float = 0.0,
    time_s: float = 0.0,
) -> Node:  # fmt: skip
    """A keyframe with its telemetry, of no graph."""
    time_ns = round(1e9 * time_s)
    return Node(0, time_ns, 0, T_odom_camera, np.zeros((6, 6)), prior, height, slant)
