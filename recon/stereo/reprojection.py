"""From disparity to depth (paper section 2.2, Eq. 3): several pairs' depths fused, sky left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numba import njit

from recon.parallel import parallel_for
from recon.types import F32, F64, Bool, DepthMap, DisparityMap, PosePrior, StereoPair

LABEL_SIGMA_PX = 0.075
"""Usual sigma of a label of full confidence, in pixels of the grid that was matched;
:func:`label_noise` measures what it is."""

MIN_CONFIDENCE = 0.05  # a label with a lower confidence is not used


@dataclass(frozen=True, slots=True, eq=False)
class PairDepth:
    """The keyframe's depth by one stereo pair, on the keyframe's own grid."""

    depth_m: F32  # (h, w), NaN = unknown
    sigma_m: F32  # (h, w)


def reproject(
    disparity: DisparityMap, pair: StereoPair, K: F64, size_px: tuple[int, int]
) -> PairDepth:
    """Depth along the keyframe's z on its own grid, and its sigma, in metres.

    ``disparity`` holds labels of ``pair`` on the pair's grid (h, w) or upsampled to any size;
    labels are always in pixels of (h, w). The rectified left camera sits where the keyframe's
    does and is only turned, so a keyframe pixel's ray meets exactly one of its pixels. With
    Eq. 3, ``z = f B / d`` where ``d = plane . (u, v, 1) + slope * label``; sigma is ``z / d``
    times the label's sigma, which grows with motion blur and as confidence falls.

    Args:
        K: (3, 3) intrinsics of the keyframe's grid of ``size_px`` (w, h).

    NaN where the label is unknown or not trusted, or the point at or beyond infinity. Between
    labels that agree within one the value is interpolated; at an edge the nearest is taken.
    """
    w, h = size_px
    out = PairDepth(np.empty((h, w), np.float32), np.empty((h, w), np.float32))
    to_left = pair.K @ pair.R_left_keyframe @ np.linalg.inv(K)
    finer = np.array(disparity.px.shape, np.float64) / pair.left.shape
    parallel_for(
        _reproject, h, disparity.px, disparity.confidence, np.ascontiguousarray(to_left), finer,
        np.asarray(pair.plane, np.float64), float(pair.slope),
        float(pair.K[0, 0] * pair.baseline_m), LABEL_SIGMA_PX * pair.noise, out.depth_m,
        out.sigma_m,
    )  # fmt: skip
    return out


@njit(cache=True, nogil=True, inline="always")
def label_at(px: Any, x: Any, y: Any) -> Any:
    """Label at a place: bilinear where the four around it agree, else the nearest; or NaN."""
    height, width = px.shape
    i, j = int(np.rint(x)), int(np.rint(y))
    if i < 0 or j < 0 or i >= width or j >= height:
        return np.nan
    nearest = px[j, i]
    i0, j0 = int(np.floor(x)), int(np.floor(y))
    if i0 < 0 or j0 < 0 or i0 + 1 >= width or j0 + 1 >= height:
        return nearest
    a, b, c, d = px[j0, i0], px[j0, i0 + 1], px[j0 + 1, i0], px[j0 + 1, i0 + 1]
    if not max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) <= 1.0:  # also NaN
        return nearest
    fx, fy = x - i0, y - j0
    mixed = (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)
    return nearest if np.isnan(mixed) else mixed


@njit(cache=True, nogil=True)
def _reproject(
    begin: int,
    end: int,
    px: Any,
    confidence: Any,
    to_left: Any,
    finer: Any,
    plane: Any,
    slope: float,
    focal_base: float,
    sigma_px: float,
    depth_m: Any,
    sigma_m: Any,
) -> None:
    width = depth_m.shape[1]
    for v in range(begin, end):
        for u in range(width):
            depth_m[v, u] = np.nan
            sigma_m[v, u] = np.nan
            z = to_left[2, 0] * u + to_left[2, 1] * v + to_left[2, 2]
            if z < 1e-3:
                continue
            x = (to_left[0, 0] * u + to_left[0, 1] * v + to_left[0, 2]) / z
            y = (to_left[1, 0] * u + to_left[1, 1] * v + to_left[1, 2]) / z
            X, Y = (x + 0.5) * finer[1] - 0.5, (y + 0.5) * finer[0] - 0.5
            label = label_at(px, X, Y)
            if np.isnan(label):
                continue
            trust = confidence[int(np.rint(Y)), int(np.rint(X))]
            d = plane[0] * x + plane[1] * y + plane[2] + slope * label
            if trust < MIN_CONFIDENCE or d < 1e-3:
                continue
            depth = focal_base / d / z  # Eq. 3, along the keyframe's z
            depth_m[v, u] = depth
            sigma_m[v, u] = depth / d * abs(slope) * sigma_px / np.sqrt(trust)


AGREES_SIGMAS = 3.0  # neighbours within so many sigmas of a pixel lie on its surface


def carry(pair: PairDepth, K: F64, T_here_there: F64) -> PairDepth:
    """The depth of ``pair``, seen from ``there``, on the same grid ``here``.

    ``K`` (3, 3) is of both grids; T_here_there (4, 4). Of several places that meet a pixel the
    nearest is taken, moved along its surface to the pixel's centre. Gaps of a pixel that the
    magnification leaves are closed where both sides agree.
    """
    moved = PairDepth(*(np.full(pair.depth_m.shape, np.nan, np.float32) for _ in range(2)))
    _carry(pair.depth_m, pair.sigma_m, K, T_here_there, moved.depth_m, moved.sigma_m)
    whole = PairDepth(moved.depth_m.copy(), moved.sigma_m.copy())
    _close_gaps(moved.depth_m, moved.sigma_m, whole.depth_m, whole.sigma_m)
    return whole


@njit(cache=True, nogil=True, inline="always")
def _slope(before: Any, here: Any, after: Any, sigma: Any) -> Any:
    """Change of the inverse depth from pixel to pixel; 0 at an edge or next to nothing."""
    near = AGREES_SIGMAS * sigma / here
    if abs(here / before - 1.0) < near and abs(here / after - 1.0) < near:
        return 0.5 * (1.0 / after - 1.0 / before)
    return 0.0


@njit(cache=True, nogil=True)
def _carry(depth: Any, sigma: Any, K: Any, T: Any, out_depth: Any, out_sigma: Any) -> None:
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            z, s = float(depth[v, u]), float(sigma[v, u])
            if not z > 0:
                continue
            x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
            there = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not there > 1e-3 * z:
                continue
            U = K[0, 0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / there + K[0, 2]
            V = K[1, 1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / there + K[1, 2]
            if not (-0.5 < U < width - 0.5 and -0.5 < V < height - 0.5):
                continue
            i, j = int(np.rint(U)), int(np.rint(V))
            across = down = 0.0
            if 0 < u < width - 1:
                across = _slope(float(depth[v, u - 1]), z, float(depth[v, u + 1]), s)
            if 0 < v < height - 1:
                down = _slope(float(depth[v - 1, u]), z, float(depth[v + 1, u]), s)
            off_u, off_v = i - U, j - V
            inverse = 1.0 / there
            inverse += (T[0, 0] * across + T[0, 1] * down) * off_u
            inverse += (T[1, 0] * across + T[1, 1] * down) * off_v
            if inverse > 0.0 and not 1.0 / inverse >= out_depth[j, i]:
                out_depth[j, i] = 1.0 / inverse
                out_sigma[j, i] = s * (there / z)


@njit(cache=True, nogil=True)
def _close_gaps(depth: Any, sigma: Any, out_depth: Any, out_sigma: Any) -> None:
    height, width = depth.shape
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            if not np.isnan(depth[v, u]):
                continue
            for dv, du in ((0, 1), (1, 0)):
                a, b = depth[v - dv, u - du], depth[v + dv, u + du]
                s = max(sigma[v - dv, u - du], sigma[v + dv, u + du])
                if abs(a - b) <= AGREES_SIGMAS * s:
                    out_depth[v, u], out_sigma[v, u] = 0.5 * (a + b), s
                    break


AGREE_SIGMAS = 2.5  # pairs agree within that many combined sigmas
SINGLE_VIEW_SIGMA = 1.5  # factor on the sigma of a point that one pair saw alone
MAX_SIGMA_SHARE = 0.04  # of the depth; a worse reading says nothing
MIN_SIGMA_SHARE = 0.0005  # of the depth; no pair is better than this

NOISE_STRIDE, MIN_COMMON = 3, 500
"""Pixels from one sample of two pairs' difference to the next, and samples that two pairs share at
least."""

PAIRS_CORRELATION = 0.15
"""Correlation of the errors of two pairs of a view: they share its image. Measured on simulated
flights at crf 18 and 32 (docs/reports/simulated-flights.md)."""

MAX_NOISE = 8.0  # noise of labels over the usual one, at most: with more, nothing matches


def label_noise(pairs: Sequence[PairDepth]) -> float | None:
    """Sigma of labels over the usual one, 1 to 8, as the pairs of one view show; None where too few
    do.

    It is the square root of the variance factor (Mikhail and Ackermann, Observations and Least
    Squares, 1976): how far pairs disagree over what their sigmas let expect. What an encoder smears
    or drops matches several times worse than usual. Pairs of clear images disagree less, but what
    is wrong in all of them, as the view's pose, keeps the usual sigma right.
    """
    inverse = [1.0 / pair.depth_m[::NOISE_STRIDE, ::NOISE_STRIDE] for pair in pairs]
    sigma = [
        pair.sigma_m[::NOISE_STRIDE, ::NOISE_STRIDE] * w * w
        for pair, w in zip(pairs, inverse, strict=True)
    ]
    squares = []
    for i, j in combinations(range(len(pairs)), 2):
        apart = np.abs(inverse[i] - inverse[j]) / np.hypot(sigma[i], sigma[j])
        apart = apart[np.isfinite(apart)]
        if len(apart) >= MIN_COMMON:
            squares.append((float(np.median(apart)) / 0.6745) ** 2)
    if not squares:
        return None
    noise = np.sqrt(np.mean(squares) / (1.0 - PAIRS_CORRELATION))
    return float(np.clip(noise, 1.0, MAX_NOISE))


def fuse(pairs: Sequence[PairDepth], K: F64, T_world_camera: F64, noise: float = 1.0) -> DepthMap:
    """One depth map of all pairs: at each pixel the largest group that agrees, averaged.

    The mean is over inverse depth (whose error is nearly Gaussian) with weights 1/sigma^2; the
    sigma is the larger of the propagated one and the spread inside the group. ``noise``, at least
    1, multiplies all sigmas. ``views`` counts the group. Where several pairs read and none comes
    within MAX_SIGMA_SHARE of another nothing is known. Where that is so at more pixels than
    those at which two agree within usual sigmas, what they see is not a rigid surface, or their
    motion is false, which no noise excuses, and the whole map is unknown.
    """
    depth = np.stack([p.depth_m for p in pairs])
    sigma = np.stack([p.sigma_m for p in pairs])
    if noise > 1.0:
        rows = [np.ascontiguousarray(a[:, ::NOISE_STRIDE]) for a in (depth, sigma)]
        if _fused(rows[0], rows[1], K, T_world_camera).views.any():  # not refuted
            sigma *= np.float32(noise)
    return _fused(depth, sigma, K, T_world_camera)


def _fused(depth: F32, sigma: F32, K: F64, T_world_camera: F64) -> DepthMap:
    """As :func:`fuse`, of depths and sigmas (P, h, w)."""
    shape = depth.shape[1:]
    out = DepthMap(
        np.empty(shape, np.float32), np.empty(shape, np.float32), np.zeros(shape, np.uint8), K,
        T_world_camera,
    )  # fmt: skip
    parallel_for(_fuse, shape[0], depth, sigma, out.depth_m, out.sigma_m, out.views)
    contradicted = np.isnan(out.depth_m) & (out.views > 0)
    refuted = np.count_nonzero(contradicted) > np.count_nonzero(out.views >= 2)
    out.views[contradicted | refuted] = 0
    if refuted:
        out.depth_m[:] = out.sigma_m[:] = np.nan
    return out


@njit(cache=True, nogil=True)
def _largest_group(inverse: Any, sigma: Any, count: int) -> int:
    """The reading that most others agree with; ties go to the smaller sigma."""
    best, most = 0, -1
    square = AGREE_SIGMAS * AGREE_SIGMAS
    for i in range(count):
        support = 0
        for j in range(count):
            apart = inverse[i] - inverse[j]
            support += apart * apart <= square * (sigma[i] * sigma[i] + sigma[j] * sigma[j])
        if support > most or (support == most and sigma[i] < sigma[best]):
            best, most = i, support
    return best


@njit(cache=True, nogil=True)
def _fuse(
    begin: int, end: int, depth: Any, sigma: Any, out_depth: Any, out_sigma: Any, out_views: Any
) -> None:
    P, _, width = depth.shape
    square = AGREE_SIGMAS * AGREE_SIGMAS
    for v in range(begin, end):
        w = np.empty(P)
        s = np.empty(P)
        for u in range(width):
            out_depth[v, u] = np.nan
            out_sigma[v, u] = np.nan
            count = 0
            for p in range(P):
                z, e = float(depth[p, v, u]), float(sigma[p, v, u])
                if z > 0 and e < MAX_SIGMA_SHARE * z:
                    w[count] = 1.0 / z
                    s[count] = e / (z * z)
                    count += 1
            if count == 0:
                continue
            centre = _largest_group(w, s, count)
            total = mean = squares = 0.0
            views = 0
            for p in range(count):
                apart, variance = w[p] - w[centre], s[p] * s[p]
                if apart * apart <= square * (variance + s[centre] * s[centre]):
                    weight = 1.0 / variance
                    total += weight
                    mean += weight * apart
                    squares += weight * apart * apart
                    views += 1
            out_views[v, u] = views
            if views == 1 and count > 1:
                near = 0
                for p in range(count):
                    near += abs(w[p] - w[centre]) <= MAX_SIGMA_SHARE * w[centre]
                if near == 1:
                    continue
            mean /= total  # from the centre, as small numbers lose nothing when squared
            spread = max(squares / total - mean * mean, 0.0)
            variance = 1.0 / total + spread / max(views - 1, 1)
            z = 1.0 / (w[centre] + mean)
            e = np.sqrt(variance) * z * z * (SINGLE_VIEW_SIGMA if views == 1 else 1.0)
            out_depth[v, u] = z
            out_sigma[v, u] = max(e, MIN_SIGMA_SHARE * z)


TILT_SIGMAS = 2.0

MAX_STEP_SHARE = 0.1  # neighbouring pixels whose depths differ by more belong to two surfaces

STRIP_SHARE = 0.2
"""Of the image below the horizon; less of it without any depth shows no ground: the pairs' other
images may end above it, as those of a camera that looks up a facade."""


def plausible(depth: DepthMap, prior: PosePrior) -> DepthMap | None:
    """``depth`` without false surface above the horizon; None with nothing left.

    Below the horizon a ray ends at the ground. Above it there may be nothing but sky, so a
    surface there takes two pairs that agree, and stands on surface below: clouds do not.
    """
    if prior.R_world_camera is not None:
        sky = _above_horizon(depth, prior.R_world_camera[2], TILT_SIGMAS * prior.sigma_tilt_rad)
        if sky.any():
            false = sky & ((depth.views == 1) | ~_reaching(depth.depth_m, ~sky))
            depth = known_where(depth, ~false)
    return depth if np.isfinite(depth.depth_m).any() else None


def known_where(depth: DepthMap, kept: Bool) -> DepthMap:
    """``depth`` (h, w) without the pixels that are not ``kept``."""
    return replace(
        depth,
        depth_m=np.where(kept, depth.depth_m, np.float32(np.nan)),
        sigma_m=np.where(kept, depth.sigma_m, np.float32(np.nan)),
        views=np.where(kept, depth.views, np.uint8(0)),
    )


def _reaching(depth_m: F32, ground: Bool) -> Bool:
    """(h, w) pixels of surfaces that reach into ``ground``; all where the image shows none."""
    known = np.isfinite(depth_m)
    if ground.mean() < STRIP_SHARE and not (ground & known).any():
        return np.ones(depth_m.shape, np.bool_)
    away = np.log(np.where(known, depth_m, np.float32(1.0)))
    square = np.ones((3, 3), np.uint8)
    farthest = cv2.dilate(np.where(known, away, np.float32(-99.0)), square)
    nearest = cv2.erode(np.where(known, away, np.float32(99.0)), square)
    smooth = known & (farthest - nearest < MAX_STEP_SHARE)
    _, surface = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    return np.isin(surface, surface[ground & smooth])


def _above_horizon(depth: DepthMap, up: F64, margin_rad: float) -> Bool:
    """(h, w) pixels whose ray rises by more than the margin; ``up`` (3,) in the camera's frame."""
    h, w = depth.depth_m.shape
    K = depth.K
    x, y = (np.arange(w) - K[0, 2]) / K[0, 0], (np.arange(h)[:, None] - K[1, 2]) / K[1, 1]
    rise = up[0] * x + up[1] * y + up[2]
    return np.asarray(rise > np.sin(margin_rad) * np.sqrt(1.0 + x**2 + y**2))
