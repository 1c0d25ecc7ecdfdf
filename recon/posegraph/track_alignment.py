"""Closed forms: the similarity between two tracks, and the mean of rotations."""

from __future__ import annotations

import numpy as np

from recon import se3
from recon.types import F64


def umeyama(source: F64, target: F64, weight: F64, level: bool) -> tuple[float, F64, F64]:
    """Scale, (3, 3) rotation and (3,) shift that best take ``source`` (N, 3) to ``target``.

    Umeyama 1991, doi:10.1109/34.88573.

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


def mean_rotation(rotations: F64) -> F64:
    """(3, 3) rotation nearest to all ``rotations`` (N, 3, 3), by the chordal mean."""
    U, _, Vt = np.linalg.svd(rotations.sum(axis=0))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
