"""The first two frames: relative pose without a map, and the first landmarks.

A nearly flat ground makes the essential matrix ambiguous, so several candidates are refined
and compared: the attitude prior's rotation with the best translation direction, the
five-point essential matrix (Nister 2004, doi:10.1109/TPAMI.2004.17) and the homography's
decomposition (Malis and Vargas 2007, INRIA RR-6303).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.plane import plane_normal
from recon.tracking import bundle, robust_geometry
from recon.types import F64, Bool

MAX_ERROR_PX = 1.5  # error of a match that a motion explains, at most: some sigmas of two corners

MIN_PARALLAX_RAD, MIN_INLIERS = 2e-3, 20
"""Between the rays of a point, a pixel at a focal length of 500 px; and points that give a motion,
which has five numbers."""

AS_GOOD = 0.92  # of the most inliers: motions with as many explain pixels alike, the ground decides


@dataclass(frozen=True, slots=True, eq=False)
class TwoView:
    """Relative pose with a baseline of length one, and the points it gives."""

    T_b_a: F64  # (4, 4), |t| = 1
    points: F64  # (N, 3) in camera a, NaN for outliers
    inliers: Bool  # (N,)
    parallax_rad: float  # median over the inliers


def translation_direction(rays_a: F64, rays_b: F64, R_b_a: F64) -> F64:
    """(3,) unit translation t of ``x_b ~ R x_a + t / depth`` for a known rotation.

    Every match says that t lies in the plane of its two rays; the least-squares normal is
    re-weighted (Cauchy) against outliers. The sign is the one that puts most points in front.
    """
    turned = rays_a @ R_b_a.T
    normals = np.cross(rays_b, turned)
    weights = np.ones(len(normals))
    for _ in range(10):
        _, vectors = np.linalg.eigh((normals * weights[:, None]).T @ normals)
        t = vectors[:, 0]
        weights = robust_geometry.cauchy_weights(np.abs(normals @ t))
    moved = rays_b - turned * (rays_b[:, 2:] / turned[:, 2:])
    return np.asarray(t if float(np.median(moved @ t)) >= 0 else -t)


def _candidates(uv_a: F64, uv_b: F64, K: F64, R_b_a: F64 | None) -> list[tuple[F64, F64]]:
    out: list[tuple[F64, F64]] = []
    if R_b_a is not None:
        out.append((R_b_a, translation_direction(rays(K, uv_a), rays(K, uv_b), R_b_a)))
    by_essential = robust_geometry.relative_pose(uv_a, uv_b, K)
    if by_essential is not None and by_essential[2] > 8:
        out.append(by_essential[:2])
    by_plane = robust_geometry.homography(uv_a, uv_b, 3.0)
    if by_plane is not None:
        for R, t in robust_geometry.homography_motions(by_plane[0], K):
            length = float(np.linalg.norm(t))
            if length > 1e-3:
                out.append((R, t / length))
    return out


def _refine(R: F64, t: F64, uv_a: F64, uv_b: F64, K: F64) -> TwoView | None:
    """Bundle-adjusted candidate with the baseline set back to one, or None."""
    T_b_a = se3.compose(R, t)
    for _ in range(2):
        points, angle, _ = bundle.triangulate(np.eye(4), T_b_a, K, uv_a, uv_b)
        use = np.flatnonzero(np.isfinite(points[:, 0]) & (angle > MIN_PARALLAX_RAD))
        if use.size < MIN_INLIERS:
            return None
        index = np.arange(use.size)
        result = bundle.adjust(
            np.stack([np.eye(4), T_b_a]),
            points[use],
            np.concatenate([np.zeros_like(index), np.ones_like(index)]),
            np.concatenate([index, index]),
            np.concatenate([uv_a[use], uv_b[use]]),
            K,
            np.array([False, True]),
            iterations=20,
        )
        T_b_a = result.T_camera_world[1].copy()
        length = float(np.linalg.norm(T_b_a[:3, 3]))
        if not 1e-6 < length < 1e6:
            return None
        T_b_a[:3, 3] /= length
    points, angle, error = bundle.triangulate(np.eye(4), T_b_a, K, uv_a, uv_b)
    inliers = (error < MAX_ERROR_PX) & (angle > MIN_PARALLAX_RAD)
    if inliers.sum() < MIN_INLIERS:
        return None
    points[~inliers] = np.nan
    return TwoView(T_b_a, points, inliers, float(np.median(angle[inliers])))


def solve(
    uv_a: F64, uv_b: F64, K: F64, R_b_a: F64 | None, max_turn_rad: float, up_a: F64
) -> TwoView | None:
    """The relative pose of two frames and their points, or None when it is not certain.

    Args:
        uv_a, uv_b: (N, 2) matched undistorted pixels.
        R_b_a: (3, 3) rotation that telemetry gives, or None.
        max_turn_rad: largest plausible difference from ``R_b_a``.
        up_a: (3,) where up is expected in camera a (telemetry or the mount); among solutions
            that explain the pixels alike, the one whose ground is most level is taken.
    """
    if uv_a.shape[0] < 30 or not robust_geometry.span_a_plane(uv_a, uv_b):
        return None
    found: list[tuple[TwoView, float]] = []
    for R, t in _candidates(uv_a, uv_b, K, R_b_a):
        view = _refine(R, t, uv_a, uv_b, K)
        if view is None:
            continue
        if R_b_a is not None:
            turn = float(np.linalg.norm(se3.so3_log(view.T_b_a[:3, :3] @ R_b_a.T)))
            if turn > max_turn_rad:
                continue
        normal = plane_normal(view.points[view.inliers])
        found.append((view, -1.0 if normal is None else float(normal @ up_a)))
    if not found:
        return None
    most = max(int(view.inliers.sum()) for view, _ in found)
    if most < 0.5 * uv_a.shape[0]:
        return None
    good = [(view, level) for view, level in found if view.inliers.sum() > AS_GOOD * most]
    return max(good, key=lambda item: item[1])[0]
