"""Records of the pose graph about keyframes and loops."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from recon import se3
from recon.types import F64, PosePrior


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """A keyframe of the graph, in units of the odometry."""

    seq: int
    time_ns: int
    segment: int  # keyframes tracked without interruption; each has an odometry frame of its own
    T_odom_camera: F64  # (4, 4) in the segment's chain
    covariance: F64  # (6, 6) of the motion since the node before, left, in that camera's frame
    prior: PosePrior  # telemetry at this moment; parts may be missing
    height: float | None = None  # above the ground that it sees
    slant: float = 0.0  # 1 - cosine of how far off the vertical that ground is seen
    key: int = -1  # in the graph, which gives it
    weight: int = 1  # keyframes since the node before, this one among them
    T_prev_segment: F64 | None = None  # (4, 4) m, since the node before, of another segment

    @property
    def time_s(self) -> float:
        return self.time_ns * 1e-9

    @property
    def place(self) -> F64:
        """(3,) of the camera, in the odometry."""
        return np.asarray(self.T_odom_camera[:3, 3])

    @property
    def place_of_fix(self) -> F64:
        """(3,) where the prior's position was, in the odometry."""
        return self.prior.place_of_fix(self.T_odom_camera)


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A motion between two keyframes: seen, where they are far apart in time, or composed.

    Lengths of a pose graph's loops are in units of the odometry at ``a``, so that a better scale
    moves them too; those between finished keyframes are in metres.
    """

    a: int  # number of the earlier keyframe
    b: int
    T_a_b: F64  # (4, 4)
    covariance: F64  # (6, 6) left perturbation in a's frame
    ratio: float = 1.0  # units of a's odometry in one of b's; in metres: b's depths grow by it

    @property
    def ends(self) -> tuple[int, int]:
        """Both keyframes, the earlier first."""
        return self.a, self.b

    def scaled(self, factor: float) -> Loop:
        T = self.T_a_b.copy()
        T[:3, 3] *= factor
        return replace(self, T_a_b=T, covariance=se3.in_units(self.covariance, factor))


FRAME_DRIFT = 0.003  # share of the path flown by which a track may leave the frame of its segment
SIGMA_STEP = 0.002  # sigma of one motion of vision, as a share of its length
LOOP_WINDOW = 15  # keyframes within which two loops support each other: vision is trusted there
CHI2_LIMIT = 22.5  # 99.9 % of chi-square with six degrees of freedom


def loops_agree(one: Loop, other: Loop, T_a_a: F64, T_b_b: F64) -> bool:
    """True when two loops, joined by the track between their ends, close on themselves.

    ``T_a_a`` takes the other's first camera to the one's, ``T_b_b`` the one's second to the
    other's. The track is trusted to 3 % of its length.
    """
    circle = T_a_a @ other.T_a_b @ T_b_b @ se3.inverse(one.T_a_b)
    length = float(np.linalg.norm(T_a_a[:3, 3]) + np.linalg.norm(T_b_b[:3, 3]))
    slack = np.diag([0.01**2] * 3 + [(0.03 * length + 0.02) ** 2] * 3)
    covariance = one.covariance + se3.left_covariance(T_a_a, other.covariance) + slack
    error = se3.log(circle)
    return bool(error @ np.linalg.solve(covariance, error) < CHI2_LIMIT)
