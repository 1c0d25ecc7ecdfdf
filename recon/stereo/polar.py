"""Virtual stereo along the line of sight: a pair in polar coordinates about the epipole.

Both views are turned so that their z axis lies along the baseline. A point keeps its angle about
that axis (the row) and moves away from it (along the row) by an angle that depends on distance
over baseline alone. Columns are spaced evenly in that angle, which stays finite in any direction;
planar versions use the radius or its logarithm (Pollefeys et al.,
https://doi.org/10.1109/ICCV.1999.791270). Belief propagation and upsampling take such a pair as
they take any other: partners lie on one row, and the labels lie about the plane of the ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit

from recon import se3
from recon.image_quality import halved, local_variance, stretch
from recon.parallel import parallel_for
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.reprojection import LABEL_SIGMA_PX, MIN_CONFIDENCE, PairDepth, label_at
from recon.types import F32, F64, U8, Bool, DisparityMap, PolarPair

SEAM_GAP_RAD = 0.3
"""A gap between the directions of the pixels that is wider is no part of the image."""

OUTSIDE_PX = 1e4  # further out than any image

MIN_DETAIL = 1.5
"""Gray levels of standard deviation in 5x5 pixels: less is sky, water or plain paint."""

SAMPLES = (64, 36)  # pixels across and down that stand for an image when its sector is measured


@dataclass(frozen=True, slots=True, eq=False)
class Sampling:
    """Rows and columns of a polar pair: the angle about the axis, and away from it."""

    px_per_rad: float  # columns per radian away from the axis
    rows_per_rad: float
    first_rad: float  # angle away from the axis of column 0; it falls with the column
    first_row_rad: float  # angle about the axis of row 0
    size: tuple[int, int]  # (w, h)

    def angles(self, finer: float = 1.0) -> tuple[F64, F64]:
        """(w,) angles away from the axis and (h,) about it, on a grid ``finer`` times as fine."""
        w, h = (int(n * finer) for n in self.size)
        columns, rows = (np.arange(w) + 0.5) / finer - 0.5, (np.arange(h) + 0.5) / finer - 0.5
        away = self.first_rad - columns / self.px_per_rad
        about = self.first_row_rad + rows / self.rows_per_rad
        return np.asarray(away, np.float64), np.asarray(about, np.float64)


def axis_rotation(axis: F64) -> F64:
    """(3, 3) R_polar_left with z along ``axis`` (3,)."""
    z = axis / np.linalg.norm(axis)
    x = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def polar_angles(rays: F64) -> tuple[F64, F64]:
    """Angle away from z and angle about it of ``rays`` (..., 3), rad."""
    away = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
    return away, np.arctan2(rays[..., 1], rays[..., 0])


def axes_about(rays: F64, axis: F64) -> F64:
    """(N, 2, 2) directions to ``axis`` (3,) and about it in the image at rays (N, 3), z = 1."""
    ahead = axis * (rays**2).sum(axis=1)[:, None] - (rays @ axis)[:, None] * rays
    towards = ahead[:, :2] - rays[:, :2] * ahead[:, 2:]
    towards /= np.maximum(np.linalg.norm(towards, axis=1), 1e-12)[:, None]
    about = np.stack([-towards[:, 1], towards[:, 0]], axis=1)
    return np.stack([towards, about], axis=1)


def directions(away: F64, about: F64) -> F64:
    """(..., 3) unit rays of the angles away from z and about it."""
    s = np.sin(away)
    return np.stack(np.broadcast_arrays(s * np.cos(about), s * np.sin(about), np.cos(away)), -1)


def seen_from_right(away: F64, about: F64, plane: F64, baseline: float) -> F64:
    """Angle away from the axis at which the right view sees the plane where the left ray meets it.

    ``plane`` (3,) n with ``n . X = 1`` in polar axes about the left camera. A ray that misses the
    plane ends at infinity.
    """
    nearness = baseline * np.maximum(directions(away, about) @ plane, 0.0)
    return np.asarray(np.arctan2(np.sin(away), np.cos(away) - nearness))


def seen_from_left(away: F64, about: F64, plane: F64, baseline: float) -> F64:
    """The inverse of :func:`seen_from_right`."""
    at = max(1.0 - baseline * float(plane[2]), 1e-6)
    nearness = baseline * np.maximum(directions(away, about) @ plane, 0.0) / at
    return np.asarray(np.arctan2(np.sin(away), np.cos(away) + nearness))


def sigma_share(away: F64, right: F64, slope: F64 | float, px_per_rad: float) -> F64:
    """Sigma of a label of full confidence as a share of the distance.

    ``away`` and ``right`` are the angles at which left and right see the point, ``slope`` is
    d(right) / d(label) in columns. It grows with one over the angle from the epipole.
    """
    shift = np.sin(right - away)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.sin(away) / (shift * np.sin(right)) * slope * LABEL_SIGMA_PX / px_per_rad
    return np.asarray(np.where(shift > 1e-9, share, np.inf))


def masked_rad(distance: float, baseline: float, px_per_rad: float, share: float) -> float:
    """Angle about the epipole inside which sigma at ``distance`` exceeds ``share`` of it."""
    need = LABEL_SIGMA_PX * distance / (share * baseline * px_per_rad)
    return float(np.arcsin(min(need, 1.0)))


def sampling(rays: F64, px_per_rad: float, masked: float) -> Sampling | None:
    """The sector that ``rays`` (N, 3) of an image in polar axes fill; None when all is masked. At
    the rim of the sector rows lie as far apart as columns do."""
    away, about = polar_angles(rays)
    good = (away > masked) & (away < np.pi - masked)
    if good.sum() < 8:
        return None
    low, high = float(away[good].min()), float(away[good].max())
    about = np.sort(about[good])
    gaps = np.diff(about, append=about[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    span = 2 * np.pi - (gaps[widest] if gaps[widest] > SEAM_GAP_RAD else 0.0)
    rim = 1.0 if low < np.pi / 2 < high else max(np.sin(low), np.sin(high))
    rows_per_rad = px_per_rad * rim
    w, h = int(np.ceil((high - low) * px_per_rad)) + 1, int(np.ceil(span * rows_per_rad)) + 1
    first_row = about[(widest + 1) % len(about)]
    return Sampling(px_per_rad, rows_per_rad, high, float(first_row), (max(w, 32), max(h, 32)))


def relief_of(
    points: F64, plane: F64, known: tuple[float, float], margin: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """(lowest, highest) surface that labels must reach, and that is accepted at all.

    Shares of the distance nearer than the plane: of the camera's height, so that one surface
    has one share in the whole of an oblique image, and 1 at the horizon. ``points`` (N, 3) show
    the relief, ``margin`` more is accepted, and ``known`` widens what the labels reach up to that.
    """
    low, high = np.percentile(1.0 - points @ plane, [1.0, 99.0])
    accepted = float(low) - margin, float(high) + margin
    low, high = (float(np.clip(k, *accepted)) for k in (min(low, known[0]), max(high, known[1])))
    return (low, high), accepted


def label_window(
    points: F64, plane: F64, baseline: float, px_per_rad: float, relief: tuple[float, float]
) -> tuple[float, float]:
    """Lowest and highest shift from the plane, columns, of ``points`` (N, 3) in polar axes. Half of
    the plane below ``points`` keeps in it when raised or lowered to ``relief``."""

    def shift(P: F64) -> F64:
        away, about = polar_angles(P)
        right, _ = polar_angles(P - np.array([0.0, 0.0, baseline]))
        return np.asarray((seen_from_left(right, about, plane, baseline) - away) * px_per_rad)

    low, high = (float(p) for p in np.percentile(shift(points), [1.0, 99.0]))
    height = points @ plane
    on_plane = points[height > 1e-9] / height[height > 1e-9, None]
    if len(on_plane):
        low = min(low, float(np.median(shift(on_plane * (1.0 - relief[0])))))
        high = max(high, float(np.median(shift(on_plane * max(1.0 - relief[1], 0.5)))))
    return low, high


def is_usable(rays: F64, plane: F64, baseline: float, px_per_rad: float, share: float) -> Bool:
    """(N,) True where the expected sigma of the plane along ``rays`` is within ``share`` of it."""
    away, about = polar_angles(rays)
    step = 1e-4
    near, far = (seen_from_right(away + d, about, plane, baseline) for d in (-step, step))
    right = seen_from_right(away, about, plane, baseline)
    sigma = sigma_share(away, right, (far - near) / (2 * step), px_per_rad)
    return np.asarray(sigma < share)


def rectify_polar(
    left: PosedImage,
    right: PosedImage,
    points_m: F64,
    plane: F64,
    config: VirtualStereoConfig,
    relief: tuple[float, float],
) -> PolarPair | str:
    """The pair about the epipole, or why there is none.

    Args:
        points_m: (N, 3) points of the scene in the left camera; they place the labels.
        plane: (3,) n with ``n . X = 1`` for the ground, in the left camera.
        relief: lowest and highest surface known, as shares of the distance nearer than the plane.
    """
    T_left_right = se3.inverse(left.T_odom_camera) @ right.T_odom_camera
    baseline = float(np.linalg.norm(T_left_right[:3, 3]))
    R_left = axis_rotation(T_left_right[:3, 3])
    R_right = R_left @ T_left_right[:3, :3]
    f = float(left.K[0, 0]) * config.width_px / left.gray.shape[1]
    points, plane, rays = points_m @ R_left.T, R_left @ plane, view_rays(left) @ R_left.T
    distance = float(np.median(np.linalg.norm(points, axis=1)))
    sector = sampling(rays, f, masked_rad(distance, baseline, f, config.max_sigma_share))
    usable = is_usable(rays, plane, baseline, f, config.max_sigma_share)
    if sector is None or usable.mean() < config.min_usable:
        return "flying along the line of sight"
    reached, accepted = relief_of(points, plane, relief, config.margin_share)
    low, high = label_window(points, plane, baseline, f, reached)
    need = (high - low) + 2 * config.margin_labels
    labels = config.labels_for(need)
    if labels > config.max_labels:
        return "relief too large for the baseline"
    lowest = 0.5 * (low + high) - 0.5 * (labels - 1)

    left_view = _PolarView(left, R_left, sector, np.zeros(3), 0.0)
    right_view = _PolarView(right, R_right, sector, baseline * plane, lowest / f)
    left_gray, left_seen = left_view.for_stereo()
    right_gray, right_seen = right_view.for_stereo()
    guide = None
    if config.guided and left.bgr is not None:
        guide = left_view.warped(left.bgr, 1.0)
    return PolarPair(
        left=left_gray,
        right=right_gray,
        baseline_m=baseline,
        labels=labels,
        px_per_rad=f,
        rows_per_rad=sector.rows_per_rad,
        first_rad=sector.first_rad,
        first_row_rad=sector.first_row_rad,
        plane=plane,
        first_label=lowest,
        relief=accepted,
        R_left_keyframe=R_left,
        guide=guide,
        left_seen=left_seen,
        right_seen=right_seen,
    )


def view_rays(view: PosedImage) -> F64:
    """(N, 3) rays of pixels spread evenly over the view, to its border."""
    H, W = view.gray.shape
    u, v = np.meshgrid(np.linspace(0, W - 1, SAMPLES[0]), np.linspace(0, H - 1, SAMPLES[1]))
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    return np.asarray(pixels @ np.linalg.inv(view.K).T)


@dataclass(frozen=True, slots=True, eq=False)
class _PolarView:
    """A view on the grid of a pair; the right one as it sees what lies at the plane."""

    view: PosedImage
    R_polar_view: F64
    sampling: Sampling
    nearness: F64  # (3,) plane times baseline: the step towards it; zeros for the left view
    shift_rad: float  # away from the axis: that of label 0

    def maps(self, finer: float) -> tuple[F32, F32]:
        """Columns and rows (h, w) of the view's pixels; far outside for rays behind it."""
        away, about = self.sampling.angles(finer)
        away = np.maximum(away + self.shift_rad, 0.0)
        s, c = np.sin(away).astype(np.float32), np.cos(away).astype(np.float32)
        turn = np.stack([np.cos(about), np.sin(about)], axis=1).astype(np.float32)
        n, M = self.nearness.astype(np.float32), self.view.K @ self.R_polar_view.T
        ahead = c - np.maximum(np.outer(turn @ n[:2], s) + n[2] * c, 0.0)
        x, y, z = (np.outer(turn @ m[:2], s) + m[2] * ahead for m in M.astype(np.float32))
        behind = z < 1e-3
        z[behind] = 1.0
        for axis in (x, y):
            axis /= z
            axis[behind] = -OUTSIDE_PX
            np.clip(axis, -OUTSIDE_PX, OUTSIDE_PX, out=axis)
        return x, y

    def warped(self, image: U8, finer: float) -> U8:
        """``image`` of the view on a grid ``finer`` times as fine; halved until none is skipped."""
        x, y = self.maps(finer)
        H, W = image.shape[:2]
        image = halved(image, float(self.view.K[0, 0]) / (self.sampling.px_per_rad * finer))
        if image.shape[:2] != (H, W):
            x = (x + 0.5) * np.float32(image.shape[1] / W) - 0.5
            y = (y + 0.5) * np.float32(image.shape[0] / H) - 0.5
        out = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(out, np.uint8)

    def for_stereo(self) -> tuple[U8, Bool]:
        """Gray (h, w), averaged down from twice its size, and where it shows something."""
        inside = self.view.inside(self.sampling.px_per_rad)
        seen = cv2.remap(inside, *self.maps(1.0), cv2.INTER_NEAREST) > 0
        double = self.warped(self.view.gray, 2.0)
        size = self.sampling.size
        gray = np.asarray(cv2.resize(double, size, interpolation=cv2.INTER_AREA), np.uint8)
        return stretch(gray, seen), seen & _has_detail(gray)


def _has_detail(gray: U8) -> Bool:
    """(h, w) False where 5x5 pixels are plain, as the sky is: neighbours make the labels there."""
    return np.asarray(local_variance(gray, 5) > MIN_DETAIL**2)


def reproject_polar(
    disparity: DisparityMap, pair: PolarPair, K: F64, size_px: tuple[int, int]
) -> PairDepth:
    """Depth along the keyframe's z on its own grid, and its sigma; as ``reproject`` does it.

    With the angles a and a' from the axis at which left and right see a point, its distance is
    ``B sin(a') / sin(a' - a)`` (the law of sines; Eq. 3 where a is a right angle).
    """
    w, h = size_px
    out = PairDepth(np.empty((h, w), np.float32), np.empty((h, w), np.float32))
    sampling = [
        pair.px_per_rad, pair.rows_per_rad, pair.first_rad, pair.first_row_rad,
        pair.first_label, pair.baseline_m, *pair.relief, LABEL_SIGMA_PX * pair.noise,
    ]  # fmt: skip
    parallel_for(
        _reproject,
        h,
        disparity.px,
        disparity.confidence,
        np.ascontiguousarray(pair.R_left_keyframe @ np.linalg.inv(K)),
        np.array(disparity.px.shape, np.float64) / pair.left.shape,
        np.array(sampling),
        np.asarray(pair.plane, np.float64),
        out.depth_m,
        out.sigma_m,
    )
    return out


@njit(cache=True, nogil=True)
def _reproject(
    begin: int,
    end: int,
    px: Any,
    confidence: Any,
    to_polar: Any,
    finer: Any,
    sampling: Any,
    plane: Any,
    depth_m: Any,
    sigma_m: Any,
) -> None:
    width = depth_m.shape[1]
    f, rows_per_rad, first, first_row, lowest, base, low, high, sigma_px = sampling
    for v in range(begin, end):
        for u in range(width):
            depth_m[v, u] = np.nan
            sigma_m[v, u] = np.nan
            x = to_polar[0, 0] * u + to_polar[0, 1] * v + to_polar[0, 2]
            y = to_polar[1, 0] * u + to_polar[1, 1] * v + to_polar[1, 2]
            z = to_polar[2, 0] * u + to_polar[2, 1] * v + to_polar[2, 2]
            away, about = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
            row = ((about - first_row) % (2 * np.pi)) * rows_per_rad
            X = ((first - away) * f + 0.5) * finer[1] - 0.5
            Y = (row + 0.5) * finer[0] - 0.5
            label = label_at(px, X, Y)
            if np.isnan(label):
                continue
            trust = confidence[int(np.rint(Y)), int(np.rint(X))]
            if trust < MIN_CONFIDENCE:
                continue
            # where the right view sees the plane that the label shifted the column to
            a = away + (lowest + label) / f
            s, c = np.sin(a), np.cos(a)
            p, q = plane[0] * np.cos(about) + plane[1] * np.sin(about), plane[2]
            near, turn = base * (p * s + q * c), base * (p * c - q * s)
            if near < 0.0:
                near, turn = 0.0, 0.0
            right = np.arctan2(s, c - near)
            slope = (1.0 - near * c + turn * s) / (1.0 - 2.0 * near * c + near * near)
            shift = np.sin(right - away)
            if shift < 1e-6:
                continue
            distance = base * np.sin(right) / shift  # Eq. 3, by the law of sines
            nearer = 1.0 - distance * (p * np.sin(away) + q * np.cos(away))
            if nearer < low or nearer > high:
                continue
            per_rad = base * np.sin(away) / (shift * shift)
            along = np.sqrt(x * x + y * y + z * z)  # the ray's length at depth 1
            depth_m[v, u] = distance / along
            sigma_m[v, u] = per_rad * abs(slope) / along * sigma_px / f / np.sqrt(trust)
