"""The tilt of a camera by the ground that it sees, where no attitude is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from recon import se3
from recon.types import F64, PosePrior

ASSUMED_TILT_RAD = math.radians(6.0)
"""Sigma of the camera's tilt from its nominal mount without a known attitude."""

MAX_SLOPE_RAD = math.radians(20.0)
"""Few sites slope by more; a camera held by hand or by a kite line often does."""

LEVEL_SIGMA_RAD = math.radians(10.0)
"""How far sites that are taken as level slope."""

MAX_LEVELLED_SHARE = 0.2
"""Of the views; fewer see a slope, or are placed badly, and the assumed mount levels the flight."""

MIN_POINTS = 30
"""Landmarks that a plane needs, as single trees lie off it."""

MAX_THICKNESS = 0.2
"""Spread across a plane over its width; thicker ground has no normal."""

FAR = 3.0
"""Times the median distance from the middle; landmarks beyond are placed badly, and tilt a plane by
their long lever."""

ROUNDS = 8
"""Fits of a plane, each with the weights of the one before."""


def levelled(prior: PosePrior, points: F64) -> PosePrior:
    """The prior with the tilt that lays the ground level, where the assumed mount is far from it.

    ``points`` (N, 3) are ground in the camera's frame. A known attitude stays.
    """
    R = prior.R_world_camera
    if R is None or not prior.is_view_assumed:
        return prior
    normal = plane_normal(points)
    if normal is None or normal @ R[2] > math.cos(MAX_SLOPE_RAD):
        return prior
    up = R @ normal
    axis = np.array([up[1], -up[0], 0.0])
    turn = axis * (math.acos(np.clip(up[2], -1.0, 1.0)) / max(float(np.linalg.norm(axis)), 1e-9))
    return replace(
        prior, R_world_camera=se3.so3_exp(turn) @ R, sigma_tilt_rad=LEVEL_SIGMA_RAD,
        is_view_assumed=False,
    )  # fmt: skip


def plane_normal(points: F64) -> F64 | None:
    """(3,) unit normal, towards the origin, of the plane through points (N, 3); None for too few,
    or where they lie on no plane."""
    if len(points) >= MIN_POINTS:
        far = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        points = points[far <= FAR * np.median(far)]
    if len(points) < MIN_POINTS:
        return None
    normal, size = plane_through(points)
    if not size[2] < MAX_THICKNESS * size[1]:
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
