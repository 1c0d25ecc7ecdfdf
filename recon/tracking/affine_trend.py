"""Compiled kernel of the trend that most matches follow; the edge is in ``matching``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, fastmath=True)
def affine_trend(uv: Any, moves: Any, first: Any, tolerance: float, trend: Any) -> None:
    """Fill ``trend`` (3, 2): ``moves`` (N, 2) as 1, u / 1000, v / 1000 times it, robustly.

    Reweighted from ``first`` (2,) with a tolerance that narrows from eightfold to itself.
    """
    trend[:] = 0.0
    trend[0, 0], trend[0, 1] = first[0], first[1]
    row = np.empty(3)
    for sharpness in (0.125, 0.25, 0.5, 1.0, 1.0):
        H, g = 1e-6 * np.eye(3), np.zeros((3, 2))
        for p in range(uv.shape[0]):
            row[0], row[1], row[2] = 1.0, uv[p, 0] / 1000, uv[p, 1] / 1000
            du, dv = moves[p, 0], moves[p, 1]
            for k in range(3):
                du -= row[k] * trend[k, 0]
                dv -= row[k] * trend[k, 1]
            share = (du * du + dv * dv) * (sharpness / tolerance) ** 2
            weight = 1.0 / ((1.0 + share) * (1.0 + share))
            for k in range(3):
                g[k, 0] += weight * row[k] * moves[p, 0]
                g[k, 1] += weight * row[k] * moves[p, 1]
                for m in range(3):
                    H[k, m] += weight * row[k] * row[m]
        trend[:] = np.linalg.solve(H, g)
