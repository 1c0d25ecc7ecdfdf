"""What the pose graph keeps of keyframes and loops, and its parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.track_alignment import mean_rotation
from recon.types import F64, PosePrior


@dataclass(frozen=True, slots=True)
class PoseGraphConfig:
    """Parameters of the pose graph."""

    sigma_scale: float = 0.1  # of a segment's scale after its alignment, before the readings
    sigma_step: float = 0.003  # of one vision motion's length: scale drifts step by step
    max_align_sigma: float = 0.04  # rad and share; the track must fix heading and scale this well
    correlation_s: float = 10.0  # readings of one sensor closer in time than this err together
    gate_sigmas: float = 5.0  # readings further from the prediction are left out
    huber_sigmas: float = 1.5
    sigma_scale_walk: float = 0.005  # change of the scale per twenty keyframes
    sigma_altitude_bias_m: float = 10.0
    sigma_altitude_walk_m: float = 0.3  # change of the bias per twenty keyframes
    sigma_link_m: float = 3.0  # per second without vision
    sigma_link_rad: float = 0.3
    loop_window: int = 15  # keyframes within which two loops support each other

    def __post_init__(self) -> None:
        """Raise ValueError when a parameter makes no sense."""
        for name in ("sigma_scale", "sigma_step", "max_align_sigma", "gate_sigmas", "huber_sigmas",
                     "sigma_altitude_bias_m", "sigma_link_m", "sigma_link_rad"):  # fmt: skip
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.correlation_s < 0 or self.loop_window < 1:
            raise ValueError("correlation_s must not be negative, loop_window at least 1")


@dataclass(slots=True, eq=False)
class Node:
    """One keyframe and what is known of it."""

    key: int  # in the graph
    time_ns: int
    segment: int
    T_odom_camera: F64
    covariance: F64  # (6, 6) of the motion since the node before, left, in that camera's frame
    prior: PosePrior
    altitude_m: float | None
    sigma_altitude_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A motion seen between two keyframes that are far apart in time."""

    a: int  # number of the earlier keyframe
    b: int
    T_a_b: F64  # (4, 4) m
    covariance: F64  # (6, 6) left perturbation in a's frame


def leveller(nodes: list[Node]) -> F64:
    """(3, 3) rotation of the odometry's frame by the mean of all attitudes."""
    return mean_rotation(
        np.array(
            [
                n.prior.R_world_camera @ n.T_odom_camera[:3, :3].T
                for n in nodes
                if n.prior.R_world_camera is not None
            ]
        )
    )


def loops_agree(one: Loop, other: Loop, T_a_a: F64, T_b_b: F64, limit: float) -> bool:
    """True when two loops, joined by the track between their ends, close on themselves.

    ``T_a_a`` takes the other's first camera to the one's, ``T_b_b`` the one's second to the
    other's. The track is trusted to 3 % of its length; ``limit`` is of chi-square.
    """
    circle = T_a_a @ other.T_a_b @ T_b_b @ se3.inverse(one.T_a_b)
    length = float(np.linalg.norm(T_a_a[:3, 3]) + np.linalg.norm(T_b_b[:3, 3]))
    A = se3.adjoint(T_a_a)
    slack = np.diag([0.01**2] * 3 + [(0.03 * length + 0.02) ** 2] * 3)
    covariance = one.covariance + A @ other.covariance @ A.T + slack
    error = se3.log(circle)
    return bool(error @ np.linalg.solve(covariance, error) < limit)
