"""Virtual stereo: two frames of one flying camera made into a rectified stereo pair.

Sections 2.1 and 2.3 of the paper. DEVIATION: the paper takes neighbouring frames as
rectified already and searches 16 disparities from zero. Here the relative pose of the two
frames rectifies them in any flight direction, and the labels start at the disparity of the
ground plane, so that 16 of them cover relief instead of empty air.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numba import njit

from recon import se3
from recon.camera_model import rays, scaled_K
from recon.image_quality import halved, stretch
from recon.stereo.polar import axes_about, rectify_polar, view_rays
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.reprojection import LABEL_SIGMA_PX
from recon.types import (
    F32,
    F64,
    U8,
    Bool,
    DepthMap,
    DisparityMap,
    PolarPair,
    RectifiedPair,
    StereoPair,
)

BLURRED, UNLIKE = 0.016, 0.012
"""Sigma of a label by blur along the rows, over its length, and by two blurs that differ, over
the difference of their squares (1/px): measured on a textured plane
(docs/reports/rolling-shutter.md)."""

CELL = 8  # pixels between two places where the warp of a rolling shutter is computed


def check_pair(
    left: PosedImage, right: PosedImage, depth_m: float, config: VirtualStereoConfig
) -> str | None:
    """The reason why the views make no stereo pair, or None when they do. ``depth_m`` is the median
    distance of what the left view sees."""
    T_left_right = se3.inverse(left.T_odom_camera) @ right.T_odom_camera
    t = T_left_right[:3, 3]
    base = float(np.linalg.norm(t))
    if not depth_m > 0:
        return "depth unknown"
    if base < config.min_base_to_height * depth_m:
        return "baseline too short"
    if base > config.max_base_to_height * depth_m:
        return "baseline too long"
    H, W = left.gray.shape
    if _overlap(T_left_right, left.K, (W, H), depth_m) < config.min_overlap:
        return "too little overlap"
    return None


def is_along_the_view(left: PosedImage, right: PosedImage, config: VirtualStereoConfig) -> bool:
    """True where the epipole lies in or near one of the images: no plane holds both rectified."""
    T_left_right = se3.inverse(left.T_odom_camera) @ right.T_odom_camera
    t = T_left_right[:3, 3]
    H, W = left.gray.shape
    reach = np.hypot(W, H) / 2 / left.K[0, 0]
    return any(
        np.hypot(axis[0], axis[1]) < config.epipole_margin * reach * abs(axis[2])
        for axis in (t, T_left_right[:3, :3].T @ t)  # seen from the left and from the right view
    )


def _overlap(T_left_right: F64, K: F64, size: tuple[int, int], depth_m: float) -> float:
    """Share of the left image that the right one sees, for ground at one depth."""
    W, H = size
    u, v = np.meshgrid(np.linspace(0, W - 1, 12), np.linspace(0, H - 1, 8))
    ray = rays(K, np.column_stack([u.ravel(), v.ravel()]))
    P = se3.transform(se3.inverse(T_left_right), ray * depth_m)
    uv = P[:, :2] / P[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    inside = (P[:, 2] > 0) & np.all((uv > 0) & (uv < [W, H]), axis=1)
    return float(inside.mean())


def rectify(
    left: PosedImage,
    right: PosedImage,
    points_m: F64,
    config: VirtualStereoConfig,
    relief_m: tuple[float, float] = (0.0, 0.0),
) -> RectifiedPair | str:
    """The rectified pair of two views with its disparity window, or why there is none.

    Flown along the line of sight the pair is a polar one (:mod:`recon.stereo.polar`).

    Args:
        points_m: (N, 3) some points of the scene in the left camera; their disparities
            place the ground plane and the window (at least 8).
        relief_m: lowest and highest surface known, in metres towards the camera from the
            plane; widens the window.
    """
    if len(points_m) < 8:
        return "depth unknown"
    rejection = check_pair(left, right, float(np.median(points_m[:, 2])), config)
    if rejection is not None:
        return rejection
    if is_along_the_view(left, right, config):
        return _polar(left, right, points_m, config, relief_m)
    T_left_right = se3.inverse(left.T_odom_camera) @ right.T_odom_camera
    base = float(np.linalg.norm(T_left_right[:3, 3]))
    R_rect_left = _rectifying_rotation(T_left_right)
    K, size = _rectified_intrinsics(left, R_rect_left, config.width_px)
    window = _disparity_window(points_m @ R_rect_left.T, K, base, config, relief_m)
    if isinstance(window, str):
        return window
    plane, labels = window
    R_rect_right = R_rect_left @ T_left_right[:3, :3]
    shown, base = _row_baseline(left, right, T_left_right, points_m, R_rect_left, K, plane, base)
    left_gray, left_seen = _stereo_view(left, R_rect_left, K, size, None)
    right_gray, right_seen = _stereo_view(right, R_rect_right, K, size, plane)
    guide = None
    if config.guided and left.bgr is not None:
        guide = _warp(left.bgr, left, R_rect_left, K, size, 1.0)
    return StereoPair(
        left=left_gray,
        right=right_gray,
        baseline_m=base,
        K=K,
        labels=labels,
        plane=shown,
        slope=1.0 - float(plane[0]),
        R_left_keyframe=R_rect_left,
        guide=guide,
        left_seen=left_seen,
        right_seen=right_seen,
        noise=_noise(left, right, (R_rect_left[:2, :2], R_rect_right[:2, :2]), K[0, 0]),
    )


def _noise(left: PosedImage, right: PosedImage, axes: tuple[F64, F64], focal_px: float) -> float:
    """Sigma of a label over the usual one, by the views' motion blur.

    ``axes`` (..., 2, 2) are the directions of the pair's rows and columns in left and right, and
    ``focal_px`` its focal length.

    Blur along the rows leaves less gradient to match. Two blurs that differ shift what they show:
    to second order an image blurred by b gains ``b' I'' b / 24``, and where the gains differ this
    looks like a shift by their difference over the gradient.
    """
    if left.blur_px is None or right.blur_px is None:
        return 1.0
    a, b = (
        focal_px / view.K[0, 0] * at @ view.blur_px
        for view, at in zip((left, right), axes, strict=True)
    )
    along = 0.5 * (a[..., 0] ** 2 + b[..., 0] ** 2)
    squares = a[..., :, None] * a[..., None, :] - b[..., :, None] * b[..., None, :]
    unlike = (squares**2).sum(axis=(-2, -1))
    more = BLURRED**2 * along + UNLIKE**2 * unlike
    return float(np.sqrt(1.0 + np.mean(more) / LABEL_SIGMA_PX**2))


def _polar(
    left: PosedImage,
    right: PosedImage,
    points_m: F64,
    config: VirtualStereoConfig,
    relief_m: tuple[float, float],
) -> PolarPair | str:
    """The pair about its epipole, or why there is none; the ground is a plane through points."""
    points = points_m[points_m[:, 2] > 0]
    depth = float(np.median(points[:, 2]))
    xy = config.width_px * points[:, :2] / points[:, 2:]
    fitted, _ = _fit_plane(xy[:, 0], xy[:, 1], config.width_px * depth / points[:, 2])
    plane = fitted * [1.0, 1.0, 1.0 / config.width_px] / depth
    low, high = relief_m
    pair = rectify_polar(
        _still(left), _still(right), points, plane, config, (low / depth, high / depth)
    )
    if isinstance(pair, str):
        return pair
    T_left_right = se3.inverse(left.T_odom_camera) @ right.T_odom_camera
    axis = T_left_right[:3, 3]
    axes = (
        axes_about(view_rays(left), axis),
        axes_about(view_rays(right), T_left_right[:3, :3].T @ axis),
    )
    return replace(pair, noise=_noise(left, right, axes, pair.px_per_rad))


def _row_baseline(
    left: PosedImage, right: PosedImage, T_left_right: F64, points_m: F64, R_rect_left: F64, K: F64,
    plane: F64, base: float,
) -> tuple[F64, float]:  # fmt: skip
    """Disparity plane of label 0 and baseline of what two rolling shutters show.

    The images are warped to their middle rows as level ground. What lies off that ground is
    seen along the baseline between the rows themselves, which differs from ``base`` by
    ``more``: d' = f base w + f more (w - w0) for inverse depths w and w0 of the ground.
    """
    if left.rows is None or right.rows is None or left.scene is None:
        return plane, base
    T_right_left = se3.inverse(T_left_right)
    there = se3.transform(T_right_left, points_m)
    seen = (points_m[:, 2] > 0) & (there[:, 2] > 0)
    rays_left = points_m[seen] / points_m[seen, 2:]
    rays_right = there[seen] / there[seen, 2:]
    # To first order the camera of a row stands at minus the translation of its twist.
    apart = left.rows.twists(rays_left)[:, 3:]
    apart = apart - right.rows.twists(rays_right)[:, 3:] @ T_left_right[:3, :3].T
    more = float(np.median(apart @ R_rect_left[0]))
    ground = R_rect_left @ left.scene
    in_pixels = np.array([ground[0] / K[0, 0], ground[1] / K[1, 1], ground[2]])
    in_pixels[2] -= in_pixels[0] * K[0, 2] + in_pixels[1] * K[1, 2]
    return plane + K[0, 0] * more * in_pixels, base + more


def drop_unseen(labels: DisparityMap, pair: RectifiedPair) -> DisparityMap:
    """``labels`` (h, w) of the pair without those that rest on nothing in either image."""
    if pair.left_seen is None or pair.right_seen is None:
        return labels
    px, confidence = labels.px.copy(), labels.confidence.copy()
    _drop_unseen(pair.left_seen, pair.right_seen, px, confidence)
    return DisparityMap(px, confidence)


@njit(cache=True, nogil=True)
def _drop_unseen(left_seen: Any, right_seen: Any, px: Any, confidence: Any) -> None:
    height, width = px.shape
    for v in range(height):
        for u in range(width):
            if np.isnan(px[v, u]):
                confidence[v, u] = 0
                continue
            partner = int(np.rint(u - px[v, u]))
            seen = left_seen[v, u] and 0 <= partner < width
            if not (seen and right_seen[v, partner]):
                px[v, u] = np.nan
                confidence[v, u] = 0


def _rectifying_rotation(T_left_right: F64) -> F64:
    """(3, 3) R_rect_left: x along the baseline, z as near to both optical axes as can be."""
    x = T_left_right[:3, 3] / np.linalg.norm(T_left_right[:3, 3])
    mean_axis = np.array([0.0, 0.0, 1.0]) + T_left_right[:3, 2]
    z = mean_axis - (mean_axis @ x) * x
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _rectified_intrinsics(
    left: PosedImage, R_rect_left: F64, width_px: int
) -> tuple[F64, tuple[int, int]]:
    """Intrinsics and (w, h) of a rectified image that holds the whole left view."""
    H, W = left.gray.shape
    s = width_px / W
    corners = np.array([[0, 0, 1], [W - 1, 0, 1], [0, H - 1, 1], [W - 1, H - 1, 1.0]])
    ray = corners @ np.linalg.inv(left.K).T @ R_rect_left.T
    xy = ray[:, :2] / np.maximum(ray[:, 2:], 0.2)
    f = s * left.K[0, 0]
    low, high = xy.min(axis=0) * f, xy.max(axis=0) * f
    w, h = (int(n) for n in np.ceil(high - low).clip(32, 2.5 * width_px))
    K = np.array([[f, 0.0, -low[0]], [0.0, f, -low[1]], [0.0, 0.0, 1.0]])
    return K, (w, h)


def _disparity_window(
    points: F64,
    K: F64,
    base: float,
    config: VirtualStereoConfig,
    relief_m: tuple[float, float],
) -> tuple[F64, int] | str:
    """Disparity plane of label 0 and the number of labels, from points in the rectified view; or
    why there are none."""
    points = points[points[:, 2] > 0]
    u = K[0, 0] * points[:, 0] / points[:, 2] + K[0, 2]
    v = K[1, 1] * points[:, 1] / points[:, 2] + K[1, 2]
    d = K[0, 0] * base / points[:, 2]
    plane, residual = _fit_plane(u, v, d)
    if abs(plane[0]) > 0.7:
        return "ground too steep to rectify"
    depth = float(np.median(points[:, 2]))
    per_metre = float(np.median(d)) / depth  # disparity per metre towards the camera, near it
    low, high = np.percentile(residual, [1.0, 99.0])
    low = min(float(low), relief_m[0] * per_metre)
    near = relief_m[1] if relief_m[1] < 0.7 * depth else 0.7 * depth
    high = max(float(high), near * per_metre * depth / (depth - near))
    need = (high - low) / (1.0 - plane[0]) + 2 * config.margin_labels
    labels = config.labels_for(need)
    if labels > config.max_labels:
        return "relief too large for the baseline"
    spare = 0.5 * (labels - 1 - need) * (1.0 - plane[0])
    offset = low - config.margin_labels * (1.0 - plane[0]) - spare
    return plane + np.array([0.0, 0.0, offset]), labels


def _fit_plane(u: F64, v: F64, d: F64) -> tuple[F64, F64]:
    """(3,) plane with ``d ~ plane . (u, v, 1)``, robust, and the residuals (N,)."""
    A = np.stack([u, v, np.ones_like(u)], axis=1)
    weights = np.ones_like(u)
    plane = np.zeros(3)
    for _ in range(8):
        Aw = A * weights[:, None]
        plane = np.linalg.solve(Aw.T @ A + np.diag([1e-6, 1e-6, 1e-9]), Aw.T @ d)
        residual = d - A @ plane
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weights = 1.0 / (1.0 + (residual / (2 * scale)) ** 2)
    return np.asarray(plane), np.asarray(d - A @ plane)


def homography(
    view: PosedImage, R_rect_view: F64, K: F64, oversample: float, plane: F64 | None
) -> F64:
    """(3, 3) from a pixel of the rectified image (``oversample`` finer) to one of the view. The
    shift by the disparity plane is affine along the rows, so it is part of it."""
    fine = scaled_K(np.eye(3), 1 / oversample, 1 / oversample)
    shift = np.eye(3)
    if plane is not None:
        shift[0] -= plane
    return np.asarray(view.K @ R_rect_view.T @ np.linalg.inv(K) @ shift @ fine)


def _warp(
    image: U8,
    view: PosedImage,
    R_rect_view: F64,
    K: F64,
    size: tuple[int, int],
    oversample: float,
    plane: F64 | None = None,
) -> U8:
    """The view's ``image`` as the rectified camera sees it, shifted by the disparity plane.

    It is halved first until no pixel is skipped. Beyond the image its edge is repeated: a
    black rim would be matched with the other view's.
    """
    M = homography(view, R_rect_view, K, oversample, plane)
    ratio = float(view.K[0, 0]) / (K[0, 0] * oversample)
    fine = (int(size[0] * oversample), int(size[1] * oversample))
    return _sampled(halved(image, ratio), view, M, fine, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)


def _sampled(
    image: U8, view: PosedImage, M: F64, size: tuple[int, int], flags: int, border: int
) -> U8:
    """The view's ``image``, at any scale, of ``size`` (w, h) by ``M`` (3, 3) to the view's pixels.
    A rolling shutter's rows are brought to the middle row's time in the same step."""
    H, W = view.gray.shape
    sx, sy = image.shape[1] / W, image.shape[0] / H
    if view.rows is None:
        M = scaled_K(M, sx, sy)
        out = cv2.warpPerspective(
            image, M, size, flags=flags | cv2.WARP_INVERSE_MAP, borderMode=border
        )
        return np.asarray(out, np.uint8)
    there = _row_field(view, M, size)
    x, y = (there[..., 0] + 0.5) * sx - 0.5, (there[..., 1] + 0.5) * sy - 0.5
    return np.asarray(cv2.remap(image, x, y, flags, borderMode=border), np.uint8)


def _row_field(view: PosedImage, M: F64, size: tuple[int, int]) -> F32:
    """(h, w, 2) pixels of the view's image that show what ``M`` (3, 3) leads to at its middle row.
    Computed on a grid of CELL pixels and interpolated: the field is smooth."""
    assert view.rows is not None and view.scene is not None
    w, h = size
    cols, rows = -(-w // CELL) + 2, -(-h // CELL) + 2
    x, y = np.meshgrid(np.arange(cols) - 0.5, np.arange(rows) - 0.5)
    at = np.stack([x.ravel() * CELL - 0.5, y.ravel() * CELL - 0.5, np.ones(x.size)], axis=1) @ M.T
    uv = at[:, :2] / at[:, 2:]
    inverse_depth = np.maximum(rays(view.K, uv) @ view.scene, 0.0)
    coarse = view.rows.at_rows(view.K, uv, inverse_depth).reshape(rows, cols, 2)
    fine = cv2.resize(
        coarse.astype(np.float32), (cols * CELL, rows * CELL), interpolation=cv2.INTER_LINEAR
    )
    return np.asarray(fine[CELL : CELL + h, CELL : CELL + w])


def at_middle_row(view: PosedImage, image: U8) -> U8:
    """The view's ``image`` (H, W, 3) as a pinhole camera sees it at the middle row's time."""
    if view.rows is None:
        return image
    H, W = view.gray.shape
    return _sampled(image, view, np.eye(3), (W, H), cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)


def _stereo_view(
    view: PosedImage, R_rect_view: F64, K: F64, size: tuple[int, int], plane: F64 | None
) -> tuple[U8, Bool]:
    """Gray rectified view (h, w), averaged down from twice its size, and where it shows something,
    a pixel inside the border."""
    M, inside = homography(view, R_rect_view, K, 1.0, plane), view.inside(K[0, 0])
    seen = _sampled(inside, view, M, size, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT) > 0
    double = _warp(view.gray, view, R_rect_view, K, size, 2.0, plane)
    gray = np.asarray(cv2.resize(double, size, interpolation=cv2.INTER_AREA), np.uint8)
    return stretch(gray, seen), seen


def _still(view: PosedImage) -> PosedImage:
    """The view as a pinhole camera sees it at the middle row's time."""
    if view.rows is None:
        return view
    bgr = None if view.bgr is None else at_middle_row(view, view.bgr)
    return replace(view, bgr=bgr, gray=at_middle_row(view, view.gray), rows=None)


def plane_relief(depth: DepthMap, known: tuple[float, float]) -> tuple[float, float]:
    """Lowest and highest surface in metres towards the camera from the main plane of a view.
    ``known`` is what earlier views showed; it fades by a tenth per view."""
    h, w = depth.depth_m.shape
    step = max(1, h // 60)
    z = depth.depth_m[::step, ::step].astype(np.float64)
    u, v = np.meshgrid(np.arange(0, w, step), np.arange(0, h, step))
    good = np.isfinite(z) & (depth.views[::step, ::step] >= 2)
    if good.sum() < 50:
        return known
    plane, _ = _fit_plane(u[good].astype(np.float64), v[good].astype(np.float64), 1.0 / z[good])
    nearness = plane[0] * u[good] + plane[1] * v[good] + plane[2]
    share = 1.0 - z[good] * nearness  # of the distance: the same all over an oblique image
    low, high = np.percentile(share, [0.5, 99.5]) * float(np.median(z[good]))
    return min(0.9 * known[0], float(low)), max(0.9 * known[1], float(high))
