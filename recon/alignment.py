"""From the odometry's own frame to the world: one similarity from all telemetry.

Vision alone leaves scale, heading, position and (weakly) tilt open. They are fitted over
the whole flown stretch at once, so that single bad fixes and compass errors average out;
GNSS is never forced on single poses (Umeyama 1991, doi:10.1109/34.88573, with attitude,
height and robust weights added, solved by Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.types import F64, PosePrior

WANDER_SHARE = 0.4
"""Of a fix's sigma, what differs between fixes of one flight; the rest is common to all."""

INDEPENDENT_HEIGHTS = 4.0
"""Heights of one flight count as so many: they share the ground's relief or an assumption."""

LEANING_SHARE = 2.0
"""Sigma of a height, as a share of it, per unit of (1 - cosine) off the vertical."""


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``x_world = scale * R @ x_odom + t``; covariance of (rotation, translation, log scale)."""

    scale: float
    R: F64  # (3, 3)
    t: F64  # (3,) m
    covariance: F64  # (7, 7)
    sources: tuple[str, ...] = ()

    @property
    def sigma_scale(self) -> float:
        """Relative 1-sigma uncertainty of the scale."""
        return float(np.sqrt(self.covariance[6, 6]))

    def pose(self, T_odom_camera: F64) -> F64:
        """(4, 4) T_world_camera in metres of a pose of the odometry."""
        return se3.compose(
            self.R @ T_odom_camera[:3, :3], self.scale * self.R @ T_odom_camera[:3, 3] + self.t
        )


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A keyframe of the odometry beside what telemetry says of it."""

    T_odom_camera: F64  # (4, 4)
    prior: PosePrior
    height: float | None  # of the camera above ground that it sees, in odometry units
    lean: float = 0.0  # 1 - cosine of how far off the vertical that ground is seen


def height_above(points: F64, up: F64) -> tuple[float, float] | None:
    """Height above the ground nearest below, and how far off the vertical that is seen.

    Args:
        points: (N, 3) ground in the camera's frame.
        up: (3,) unit vector upwards in that frame.

    The height is the median over the sixth of the points that lie most nearly below; the
    second number is 1 - cosine of their angle from the vertical. None under 12 points.
    """
    if len(points) < 12:
        return None
    drop = -(points @ up)
    cosine = drop / np.linalg.norm(points, axis=1)
    below = np.argsort(-cosine)[: max(12, len(points) // 6)]
    height = float(np.median(drop[below]))
    return (height, 1.0 - float(np.median(cosine[below]))) if height > 0 else None


def _residuals(R: F64, t: F64, log_scale: float, anchors: Sequence[Anchor]) -> tuple[F64, F64, F64]:
    """Whitened residuals (M,), Jacobian (M, 7) and the row's group for robust weights (M,)."""
    scale = float(np.exp(log_scale))
    heights = sum(a.prior.agl_m is not None and a.height is not None for a in anchors)
    thinned = min(1.0, (INDEPENDENT_HEIGHTS / max(heights, 1)) ** 0.5)
    rows: list[F64] = []
    jac: list[F64] = []
    group: list[int] = []
    for i, a in enumerate(anchors):
        p = a.prior
        if p.R_world_camera is not None:
            w = _turn(R @ a.T_odom_camera[:3, :3], p)
            info = 1.0 / np.array([p.sigma_tilt_rad, p.sigma_tilt_rad, p.sigma_yaw_rad])[: len(w)]
            J = np.zeros((len(w), 7))
            J[:, : len(w)] = np.diag(info)
            rows.append(w * info)
            jac.append(J)
            group += [3 * i] * len(w)
        if p.position_m is not None and p.sigma_position_m is not None:
            x = scale * R @ a.T_odom_camera[:3, 3]
            info = 1.0 / (WANDER_SHARE * p.sigma_position_m)
            J = np.zeros((3, 7))
            J[:, :3], J[:, 3:6], J[:, 6] = -se3.hat(x), np.eye(3), x
            rows.append((x + t - p.position_m) * info)
            jac.append(J * info[:, None])
            group += [3 * i + 1] * 3
        if p.agl_m is not None and a.height is not None and a.height > 0:
            # The height is measured straight below; ground seen elsewhere may lie otherwise.
            info_h = thinned * p.agl_m / (p.sigma_agl_m + LEANING_SHARE * a.lean * p.agl_m)
            J = np.zeros((1, 7))
            J[0, 6] = info_h
            rows.append(np.array([(log_scale + np.log(a.height / p.agl_m)) * info_h]))
            jac.append(J)
            group += [3 * i + 2]
    return np.concatenate(rows), np.concatenate(jac), np.asarray(group, np.float64)


def _turn(R_world_camera: F64, prior: PosePrior) -> F64:
    """(3,) world rotation from the prior's attitude to this one; (2,) tilt alone when the
    prior's heading is unknown (sigma over one rad)."""
    assert prior.R_world_camera is not None
    if prior.sigma_yaw_rad < 1.0:
        return se3.so3_log(R_world_camera @ prior.R_world_camera.T)
    up = R_world_camera @ prior.R_world_camera[2]  # where the prior's up points now
    return np.array([-up[1], up[0]])


def fit(anchors: Sequence[Anchor], iterations: int = 30) -> Similarity | None:
    """The similarity that brings the anchors onto their priors, or None without any prior.

    Residuals of one sensor over one flight are correlated (a GNSS fix wanders, a compass is
    off by a constant), so the covariance is inflated by the number of anchors: it never gets
    better than that of one reading, except for scale and heading, which are differences
    along the track. What all fixes have in common goes into the position's covariance.
    """
    usable = [
        a for a in anchors if a.prior.R_world_camera is not None or a.prior.position_m is not None
    ]
    if not usable:
        return None
    R, t, log_scale = _start(usable)
    H = np.eye(7)
    for _ in range(iterations):
        r, J, group = _residuals(R, t, log_scale, usable)
        norms = np.sqrt(np.bincount(group.astype(np.int64), weights=r**2))
        weight = np.minimum(1.0, 2.5 / np.maximum(norms, 1e-9))[group.astype(np.int64)]
        H = (J * weight[:, None]).T @ J + np.diag([1e-6] * 6 + [1e-4])
        step = np.linalg.solve(H, -(J * weight[:, None]).T @ r)
        step[:3] = np.clip(step[:3], -0.5, 0.5)
        step[6] = np.clip(step[6], -0.5, 0.5)
        R = se3.so3_exp(step[:3]) @ R
        t = t + step[3:6]
        log_scale += float(step[6])
        if np.abs(step).max() < 1e-7:
            break
    covariance = np.asarray(np.linalg.inv(H) * max(1.0, 0.2 * len(usable)), np.float64)
    common = [a.prior.sigma_position_m for a in usable if a.prior.sigma_position_m is not None]
    if common:
        covariance[3:6, 3:6] += np.diag(np.mean(np.square(common), axis=0))
    return Similarity(float(np.exp(log_scale)), R, t, covariance, _sources(usable))


def _start(anchors: Sequence[Anchor]) -> tuple[F64, F64, float]:
    """Rotation of the first attitude, position of the mean fix, scale one or from the spread."""
    R = np.eye(3)
    for a in anchors:
        if a.prior.R_world_camera is not None:
            R = a.prior.R_world_camera @ a.T_odom_camera[:3, :3].T
            break
    fixes = [a for a in anchors if a.prior.position_m is not None]
    if not fixes:
        return R, -R @ anchors[0].T_odom_camera[:3, 3], 0.0
    x = np.array([R @ a.T_odom_camera[:3, 3] for a in fixes])
    y = np.array([a.prior.position_m for a in fixes])
    R, x = _turn_to_fixes(R, x, y, anchors)
    return R, np.asarray(np.median(y - x, axis=0)), 0.0


def _turn_to_fixes(R: F64, x: F64, y: F64, anchors: Sequence[Anchor]) -> tuple[F64, F64]:
    """Heading from the track when no attitude tells it (sigma of yaw over one rad)."""
    yaws = [a.prior.sigma_yaw_rad for a in anchors if a.prior.R_world_camera is not None]
    if yaws and min(yaws) < 1.0:
        return R, x
    dx, dy = x[:, :2] - x[:, :2].mean(0), y[:, :2] - y[:, :2].mean(0)
    turn = np.arctan2(
        np.sum(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]),
        np.sum(dx[:, 0] * dy[:, 0] + dx[:, 1] * dy[:, 1]),
    )
    Rz = se3.so3_exp(np.array([0.0, 0.0, float(turn)]))
    return Rz @ R, x @ Rz.T


def _sources(anchors: Sequence[Anchor]) -> tuple[str, ...]:
    priors = [a.prior for a in anchors]
    out = []
    if any(p.R_world_camera is not None and p.sigma_yaw_rad < 1.0 for p in priors):
        out.append("attitude")
    if any(p.agl_m is not None for p in priors):
        out.append("altitude")
    if any(p.position_m is not None for p in priors):
        out.append("gnss")
    return tuple(out)
