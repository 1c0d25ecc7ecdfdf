"""Similarities: a rotation, a shift and one scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.types import F64


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``p -> scale * R @ p + t``."""

    scale: float
    R: F64  # (3, 3)
    t: F64  # (3,) m

    def points(self, xyz: F64) -> F64:
        """(N, 3) points, or a single one (3,), moved."""
        return np.asarray(xyz @ (self.scale * self.R).T + self.t)

    def pose(self, T: F64) -> F64:
        """(..., 4, 4) poses of cameras moved along; their depths grow by the scale."""
        out: F64 = T.copy()
        out[..., :3, :3] = self.R @ T[..., :3, :3]
        out[..., :3, 3] = self.points(T[..., :3, 3])
        return out


def lever(points: F64) -> F64:
    """(N, 3, 7) motion of ``points`` (N, 3) by a rotation, a shift and a logarithm of scale about
    the origin."""
    shift = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([-se3.hat(points), shift, points[:, :, None]], axis=2)


def umeyama(
    source: F64, target: F64, weight: F64 | None = None, is_level: bool = False
) -> Similarity | None:
    """The similarity that best takes ``source`` (N, 3) to ``target``, by relative ``weight`` (N,).

    ``is_level`` turns about z alone. Otherwise None for fewer than three points, points in a line
    and points in one place, which leave a turn open. Umeyama 1991, doi:10.1109/34.88573.
    """
    w = np.ones(len(source)) if weight is None else weight
    w = w / w.sum()
    ms, mt = w @ source, w @ target
    a, b = source - ms, target - mt
    cross = (b * w[:, None]).T @ a
    if is_level:
        yaw = np.arctan2(cross[1, 0] - cross[0, 1], cross[0, 0] + cross[1, 1])
        R = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    else:
        spread = np.linalg.svd(a, compute_uv=False)
        if len(source) < 3 or spread[1] <= 0.05 * spread[0]:
            return None
        R = se3.nearest_rotation(cross)
    scale = float(np.sum(R * cross)) / max(float(w @ np.sum(a**2, axis=1)), 1e-12)
    return Similarity(scale, R, np.asarray(mt - scale * R @ ms))
