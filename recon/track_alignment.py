"""The similarity between a camera's track in its own frame and position fixes in the world.

Umeyama 1991, doi:10.1109/34.88573, with robust weights, and an answer only when the track
flown supports it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.types import F64


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``world = scale R odom + t`` with the uncertainty of its heading and scale."""

    scale: float
    R: F64  # (3, 3)
    t: F64  # (3,) m
    sigma: float  # of heading (rad) and of log scale

    def pose(self, T_odom_camera: F64) -> F64:
        """(4, 4) T_world_camera in metres."""
        R, t = T_odom_camera[:3, :3], T_odom_camera[:3, 3]
        return se3.compose(self.R @ R, self.scale * self.R @ t + self.t)


def umeyama(source: F64, target: F64, weight: F64, level: bool) -> tuple[float, F64, F64]:
    """Scale, (3, 3) rotation and (3,) shift that best take ``source`` (N, 3) to ``target``.

    ``weight`` (N,) is relative. ``level``: the rotation is about z alone.
    """
    w = weight / weight.sum()
    ms, mt = w @ source, w @ target
    a, b = source - ms, target - mt
    cross = (b * w[:, None]).T @ a
    if level:
        yaw = np.arctan2(cross[1, 0] - cross[0, 1], cross[0, 0] + cross[1, 1])
        R = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    else:
        U, _, Vt = np.linalg.svd(cross)
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    power = float(w @ np.sum(a**2, axis=1))
    scale = float(np.sum(R * cross)) / max(power, 1e-12)
    return scale, R, np.asarray(mt - scale * R @ ms)


def align_track(
    odom_m: F64, fixes_m: F64, sigma_m: F64, level: bool, max_sigma: float
) -> Similarity | None:
    """The similarity of a track to its position fixes (N, 3), or None while it is not certain.

    ``sigma_m`` (N, 3) are the fixes' standard deviations. Robust: fixes that stay apart lose
    their weight. Not certain: the spread of the track does not fix heading and scale to
    ``max_sigma``, or (not ``level``) the track is a straight line.
    """
    if len(odom_m) < 4:
        return None
    weight = 1.0 / np.mean(sigma_m**2, axis=1)
    robust = np.ones(len(weight))
    for _ in range(10):
        scale, R, t = umeyama(odom_m, fixes_m, weight * robust, level)
        apart = np.linalg.norm((fixes_m - (scale * odom_m @ R.T + t)) / sigma_m, axis=1)
        limit = 2.5 * max(float(np.median(apart)) / 1.54, 0.3)
        robust = 1.0 / (1.0 + (apart / limit) ** 2) ** 2
    if scale <= 0:
        return None
    w = weight * robust
    middle = (w @ odom_m) / w.sum()
    axes = np.linalg.eigvalsh(((odom_m - middle) * w[:, None]).T @ (odom_m - middle) / w.sum())
    # Errors of fixes wander slowly, so all of them together count as a few.
    sigma = float(np.sqrt(np.mean(sigma_m[:, :2] ** 2)) / np.sqrt(min(len(w), 4.0)))
    spread = scale * float(np.sqrt(max(axes[2], 0.0)))
    across = scale * float(np.sqrt(max(axes[1], 0.0)))
    if not sigma < max_sigma * (spread if level else min(spread, 3 * across)):
        return None
    return Similarity(scale, R, t, sigma / spread)


def mean_rotation(rotations: F64) -> F64:
    """(3, 3) rotation nearest to all ``rotations`` (N, 3, 3), by the chordal mean."""
    U, _, Vt = np.linalg.svd(rotations.sum(axis=0))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
