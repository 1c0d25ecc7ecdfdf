"""The tilt of a camera by the ground that it sees, where no attitude is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from recon import se3
from recon.plane import plane_normal
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


def levelled(prior: PosePrior, points: F64) -> PosePrior:
    """The prior with the tilt that lays the ground level, where the assumed mount is far from it.

    ``points`` (N, 3) are ground in the camera's frame. A known attitude stays.
    """
    R = prior.R_world_camera
    if R is None or not prior.is_view_assumed:
        return prior
    normal = _ground_normal(points)
    if normal is None or normal @ R[2] > math.cos(MAX_SLOPE_RAD):
        return prior
    up = R @ normal
    axis = np.array([up[1], -up[0], 0.0])
    turn = axis * (math.acos(np.clip(up[2], -1.0, 1.0)) / max(float(np.linalg.norm(axis)), 1e-9))
    return replace(
        prior, R_world_camera=se3.so3_exp(turn) @ R, sigma_tilt_rad=LEVEL_SIGMA_RAD,
        is_view_assumed=False,
    )  # fmt: skip


def _ground_normal(points: F64) -> F64 | None:
    """(3,) unit normal, upwards, of the ground through landmarks (N, 3); None where they are too
    few, or on no plane."""
    if len(points) < MIN_POINTS:
        return None
    far = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    near = points[far <= FAR * np.median(far)]
    return plane_normal(near, MAX_THICKNESS) if len(near) >= MIN_POINTS else None
