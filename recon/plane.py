"""Planes through points that mostly lie near one."""

from __future__ import annotations

import numpy as np

from recon.types import F64

ROUNDS = 8  # fits of a plane, each with the weights of the one before

MIN_WIDTH = 0.02
"""Of points across their longest side, of that; fewer are in a line, which is in many planes."""


def plane_normal(points: F64, max_thickness: float = np.inf) -> F64 | None:
    """(3,) unit normal, towards the origin, of the plane that most of the points (N, 3) lie near.

    None for fewer than three points, points in a line, and those that are thicker than a plane:
    ``max_thickness`` is their extent across it over their width.
    """
    if len(points) < 3:
        return None
    normal, size = plane_through(points)
    if not size[1] > MIN_WIDTH * size[0] or not size[2] < max_thickness * size[1]:
        return None
    return np.asarray(-normal if normal @ np.median(points, axis=0) > 0 else normal, np.float64)


def plane_through(points: F64) -> tuple[F64, F64]:
    """(3,) unit normal of the plane that most of three or more points (N, 3) lie near, and their
    extent along its three axes (3,), largest first. Weights are the inverse of the distance."""
    weight = np.ones(len(points))
    for _ in range(ROUNDS):
        about = points - weight @ points / weight.sum()
        _, size, rows = np.linalg.svd(about * np.sqrt(weight)[:, None], full_matrices=False)
        off = np.abs(about @ rows[2])
        weight = 1.0 / np.maximum(off, max(float(np.median(off)), 1e-6))
    return np.asarray(rows[2]), size
