"""The ground that a camera sees: heights above it, by vision and by telemetry, and the tilt by it
where no attitude is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recon import se3
from recon.plane import plane_normal
from recon.posegraph.records import Node
from recon.types import F64, DepthMap, PosePrior

INDEPENDENT_HEIGHTS = 4.0  # heights of one flight count as so many: they share the ground's relief

UNMEASURED_HEIGHTS = 1.0
"""Heights above the take-off point, or assumed ones, count as so many: they share one offset."""

GUESSED_SHARE = 0.5  # relative sigma of an assumed height, which holds an otherwise unknown scale
EXACT_HEIGHTS = 16.0  # the same where the ground exactly below was measured: relief has no part
SLANT_SHARE = 2.0  # sigma of a height, as a share, per unit of (1 - cosine) off the vertical
MIN_EXACT = 4  # heights exactly below from which on no others count
MIN_SPREAD = 0.005  # share of a height by which readings of one flight may always differ
EDGE_SHARE = 0.03  # depths about the point below that differ by more belong to an edge


def guessed_at(height_m: float | None, prior: PosePrior) -> PosePrior:
    """The prior with another assumed height above ground; a known one stays."""
    agl, sigma = prior.agl_m, prior.sigma_agl_m
    if height_m is None or agl is None or prior.is_agl_measured or sigma < GUESSED_SHARE * agl:
        return prior
    return replace(prior, agl_m=height_m, sigma_agl_m=GUESSED_SHARE * height_m)


def height_above(points: F64, up: F64) -> tuple[float, float] | None:
    """Height above the ground nearest below, and the deviation of that ground from the vertical.

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


def height_below(depth: DepthMap, up: F64) -> float | None:
    """Height above the ground exactly below, in the depth map's unit; None where it is not seen.
    ``up`` (3,) is the unit vector upwards in the camera's frame. Edges and holes do not count."""
    down = -up
    if down[2] < 0.2:
        return None
    h, w = depth.depth_m.shape
    u = round(float(depth.K[0, 0] * down[0] / down[2] + depth.K[0, 2]))
    v = round(float(depth.K[1, 1] * down[1] / down[2] + depth.K[1, 2]))
    if not (2 <= u < w - 2 and 2 <= v < h - 2):
        return None
    window = depth.depth_m[v - 2 : v + 3, u - 2 : u + 3]
    known = window[np.isfinite(window)]
    if len(known) < 15 or float(np.ptp(known)) > EDGE_SHARE * float(np.median(known)):
        return None
    return float(np.median(known)) / float(down[2])


def height_ratio(node: Node) -> tuple[float, float] | None:
    """Log of height by telemetry over height by vision, and its sigma; None without both."""
    agl, height = node.prior.agl_m, node.height
    if agl is None or height is None or not height > 0:
        return None
    # The height is measured straight below; ground seen elsewhere may lie otherwise.
    sigma = node.prior.sigma_agl_m / agl + SLANT_SHARE * node.slant
    return float(np.log(agl / height)), sigma


def height_ratios(nodes: Sequence[Node]) -> tuple[list[tuple[float, float]], float]:
    """:func:`height_ratio` of the nodes that have one, and as how many independent ones they count.
    Measured heights stand in for all others, and heights of the ground exactly below for those."""
    known = [(h, n) for n in nodes if (h := height_ratio(n)) is not None]
    measured = [(h, n) for h, n in known if n.prior.is_agl_measured]
    if not measured:
        return [h for h, _ in known], UNMEASURED_HEIGHTS
    exact = [h for h, n in measured if n.slant == 0.0]
    if len(exact) < MIN_EXACT:
        return [h for h, _ in measured], INDEPENDENT_HEIGHTS
    # A rangefinder meets a tree where the image sees through it: single ones are far off.
    ratio = np.array([h[0] for h in exact])
    apart = np.abs(ratio - np.median(ratio))
    limit = max(3.0 * 1.48 * float(np.median(apart)), MIN_SPREAD)
    return [h for h, off in zip(exact, apart, strict=True) if off <= limit], EXACT_HEIGHTS


ASSUMED_TILT_RAD = math.radians(6.0)  # sigma of the tilt from the nominal mount, no attitude known
MAX_SLOPE_RAD = math.radians(20.0)  # few sites slope by more; a camera held by hand often does
LEVEL_SIGMA_RAD = math.radians(10.0)  # how far sites that are taken as level slope

MAX_LEVELLED_SHARE = 0.2
"""Of the views; fewer see a slope, or are placed badly, and the assumed mount levels the flight."""

MIN_POINTS = 30  # landmarks that a plane needs, as single trees lie off it
MAX_THICKNESS = 0.2  # spread across a plane over its width; thicker ground has no normal

FAR = 3.0
"""Times the median distance from the middle; landmarks beyond are placed badly, and tilt a plane by
their long lever."""


def levelled(prior: PosePrior, points: F64) -> PosePrior:
    """The prior with the tilt that lays the ground level, where the assumed mount is far from it.
    ``points`` (N, 3) are ground in the camera's frame. A known attitude stays."""
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
