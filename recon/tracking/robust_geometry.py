"""OpenCV's geometry on measured points: a result, or None where the points determine none.

OpenCV answers points that coincide, lie on one line, are too few or are not finite in three ways:
with an exception, with NaN or with a pose of no meaning. Here each of them is None. Call no such
function of OpenCV on measured points elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import cv2
import numpy as np

from recon import se3
from recon.types import F64, Array, Bool

MIN_SPREAD = {2: 1e-5, 3: 1e-8}
"""Least extent of pixels (2) and points (3) across their line, as a share of the extent along it.
Pixels are float32, which limits them; points may have wild outliers along the line of sight."""

MIN_RESOLUTION = 1e-12  # least extent of points over their largest coordinate: less is rounding
RELATIVE_POSE_PX = 1.0  # from its epipolar line, below which a match supports a relative pose

_T = TypeVar("_T")


def attempt(call: Callable[[], _T], *points: Array, least: int = 3) -> _T | None:
    """The result of ``call``; None when OpenCV rejects its input, and for points (N, 2 or 3) that
    span no plane or are fewer than ``least``."""
    if any(len(one) < least for one in points) or not span_a_plane(*points):
        return None
    try:
        return call()
    except (cv2.error, np.linalg.LinAlgError):
        return None


def span_a_plane(*arrays: Array) -> bool:
    """True when each (N, 2 or 3) array is finite, and neither one point nor one line."""
    return all(_spans_a_plane(np.asarray(points, np.float64)) for points in arrays)


def _spans_a_plane(points: F64) -> bool:
    if len(points) < 3 or not np.isfinite(points).all():
        return False
    largest = float(np.abs(points).max())
    if largest == 0.0:
        return False
    scaled = points / largest
    offsets = scaled - scaled.mean(axis=0)
    along, across = np.linalg.svd(offsets, compute_uv=False)[:2] / np.sqrt(len(points))
    return bool(across > max(MIN_SPREAD[points.shape[1]] * along, MIN_RESOLUTION))


def cauchy_weights(off: F64) -> F64:
    """(N,) weights of residuals (N,), which are not negative, by their own median."""
    scale = max(1.4826 * float(np.median(off)), 1e-9)
    return np.asarray(1.0 / (1.0 + (off / (2.0 * scale)) ** 2))


def pose_from_points(points_m: F64, uv_px: F64, K: F64, flags: int) -> F64 | None:
    """(4, 4) T_camera_points of (N, 3) points at (N, 2) pixels; N is 4 or more. ``flags`` is one of
    OpenCV's SOLVEPNP methods, such as EPnP."""
    solve = partial(cv2.solvePnP, points_m, uv_px, K, None, flags=flags)
    found = attempt(solve, points_m, uv_px, least=4)
    return None if found is None or not found[0] else _motion(found[1], found[2])


def consensus_pose(
    points_m: F64, uv_px: F64, K: F64, threshold_px: float, iterations: int, confidence: float
) -> F64 | None:
    """(4, 4) T_camera_points by EPnP on the largest consensus of RANSAC."""
    solve = partial(
        cv2.solvePnPRansac, points_m, uv_px, K, None, flags=cv2.SOLVEPNP_EPNP,
        reprojectionError=threshold_px, iterationsCount=iterations, confidence=confidence,
    )  # fmt: skip
    found = attempt(solve, points_m, uv_px, least=5)
    return None if found is None or not found[0] else _motion(found[1], found[2])


def _essential(uv_a: F64, uv_b: F64, K: F64, threshold_px: float) -> tuple[Array, Array] | None:
    """The essential matrix of (N, 2) matched pixels, and (N, 1) which of them agree with it."""
    find = partial(cv2.findEssentialMat, uv_a, uv_b, K, cv2.USAC_MAGSAC, 0.9999, threshold_px)
    E, mask = attempt(find, uv_a, uv_b, least=6) or (None, None)
    return None if E is None or mask is None or E.shape != (3, 3) else (E, mask)


def relative_pose(uv_a: F64, uv_b: F64, K: F64) -> tuple[F64, F64, int] | None:
    """(R_b_a, unit t of T_b_a, points in front of both cameras) of (N, 2) matched pixels. By the
    essential matrix. None also where no essential matrix explains the matches."""
    found = _essential(uv_a, uv_b, K, RELATIVE_POSE_PX)
    if found is None:
        return None
    E, mask = found
    split = attempt(lambda: cv2.recoverPose(E, uv_a, uv_b, K, mask=mask))
    if split is None or not _is_finite(split[1], split[2]):
        return None
    count, R, t, _ = split
    return np.asarray(R, np.float64), np.asarray(t, np.float64).ravel(), int(count)


def on_epipolar_lines(uv_a: F64, uv_b: F64, K: F64, threshold_px: float) -> Bool | None:
    """(N,) matches that agree with one essential matrix; None where there is none."""
    found = _essential(uv_a, uv_b, K, threshold_px)
    return None if found is None else np.asarray(found[1]).ravel().astype(bool)


def homography(uv_a: F64, uv_b: F64, threshold_px: float) -> tuple[F64, Bool] | None:
    """((3, 3) H with uv_b ~ H uv_a, (N,) inliers) of (N, 2) matched pixels; H is invertible."""
    find = partial(cv2.findHomography, uv_a, uv_b, cv2.USAC_MAGSAC, threshold_px)
    found = attempt(find, uv_a, uv_b, least=4)
    if found is None or found[0] is None or not _is_finite(found[0]):
        return None
    H, mask = found
    inliers = np.asarray(mask).ravel().astype(bool)
    if np.linalg.matrix_rank(H) < 3 or not span_a_plane(uv_a[inliers], uv_b[inliers]):
        return None
    return np.asarray(H, np.float64), inliers


def by_homography(H: F64, uv: F64) -> tuple[F64, F64]:
    """Where (N, 2) pixels ``uv`` go, and the warps (N, 2, 2) of offsets there."""
    there = cv2.perspectiveTransform(uv[:, None], H)[:, 0].astype(np.float64)
    return there, local_affine(H, uv, there)


def local_affine(H: F64, uv: F64, there: F64) -> F64:
    """(N, 2, 2) Jacobian of the homography at each pixel."""
    w = uv @ H[2, :2] + H[2, 2]
    return np.asarray((H[None, :2, :2] - there[:, :, None] * H[2, :2]) / w[:, None, None])


def homography_motions(H: F64, K: F64) -> list[tuple[F64, F64]]:
    """(R_b_a, t of T_b_a in units of the plane's distance) that ``H`` may stand for."""
    found = attempt(lambda: cv2.decomposeHomographyMat(H, K))
    if found is None:
        return []
    pairs = zip(found[1], found[2], strict=True)
    return [
        (np.asarray(R, np.float64), np.asarray(t, np.float64).ravel())
        for R, t in pairs
        if _is_finite(R, t)
    ]


def affine(a: F64, b: F64, threshold: float, is_similarity: bool = False) -> F64 | None:
    """(2, 3) affine map, or similarity, of (N, 2) points ``a`` to ``b`` by RANSAC."""
    estimate: Any = cv2.estimateAffinePartial2D if is_similarity else cv2.estimateAffine2D
    found = attempt(lambda: estimate(a, b, ransacReprojThreshold=threshold), a, b)
    if found is None or found[0] is None or not _is_finite(found[0]):
        return None
    return np.asarray(found[0], np.float64)


def _motion(rvec: Array, tvec: Array) -> F64 | None:
    if not _is_finite(rvec, tvec):
        return None
    w, t = (np.asarray(v, np.float64).ravel() for v in (rvec, tvec))
    return se3.compose(se3.so3_exp(w), t)


def _is_finite(*arrays: Array) -> bool:
    return all(bool(np.isfinite(a).all()) for a in arrays)
