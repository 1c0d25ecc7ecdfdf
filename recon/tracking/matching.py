"""Corners and their partners in another image (paper section 2.3, Eq. 4-5).

Harris corners, the best of each cell of a 30x30 grid; zero-mean SSD of patches, coarse to
fine through an image pyramid, all corners in one compiled call; sub-pixel at the end. Pixel
centres are at integers; level ``l`` of a pyramid holds the pixel (u, v) at (u, v) / 2^l.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from recon.parallel import parallel_for
from recon.tracking import patch_search
from recon.types import F32, F64, U8, Bool


@njit(inline="always", fastmath=True)
def _window_products(image: Any, row0: int, row1: int, sums: Any) -> None:
    """Fill ``sums`` (3, rows, W) with Ix^2, Iy^2, Ix Iy under the binomial window w of Eq. 4."""
    H, W = image.shape
    rows = row1 - row0
    products = np.zeros((3, rows + 4, W), np.float32)
    for r in range(rows + 4):
        y = row0 - 2 + r
        if y < 1 or y >= H - 1:
            continue
        up, mid, down = image[y - 1], image[y], image[y + 1]
        for x in range(1, W - 1):
            a, c = np.float32(up[x - 1]), np.float32(up[x + 1])
            g, i = np.float32(down[x - 1]), np.float32(down[x + 1])
            d, f = np.float32(mid[x - 1]), np.float32(mid[x + 1])
            gx = np.float32(0.125) * (c - a + np.float32(2) * (f - d) + i - g)
            gy = np.float32(0.125) * (
                g - a + np.float32(2) * (np.float32(down[x]) - np.float32(up[x])) + i - c
            )
            products[0, r, x] = gx * gx
            products[1, r, x] = gy * gy
            products[2, r, x] = gx * gy
    line = np.zeros(W, np.float32)
    for k in range(3):
        for r in range(rows):
            p0, p1, p2, p3, p4 = (
                products[k, r], products[k, r + 1], products[k, r + 2], products[k, r + 3],
                products[k, r + 4],
            )  # fmt: skip
            for x in range(W):
                line[x] = p0[x] + p4[x] + np.float32(4) * (p1[x] + p3[x]) + np.float32(6) * p2[x]
            out = sums[k, r]
            for x in range(2, W - 2):
                out[x] = np.float32(1.0 / 256) * (
                    line[x - 2]
                    + line[x + 2]
                    + np.float32(4) * (line[x - 1] + line[x + 1])
                    + np.float32(6) * line[x]
                )


@njit(cache=True, nogil=True, fastmath=True)
def harris_cells(
    begin: int, end: int, image: Any, mask: Any, columns: int, rows: int, margin: int, k: float,
    found: Any,
) -> None:  # fmt: skip
    """Fill ``found`` (rows, columns, 3) with u, v and R of each cell's best local maximum. R is
    zero where the cell has none. ``mask`` is (H, W) uint8 or (0, 0) for none."""
    H, W = image.shape
    masked = mask.shape[0] == H
    kk = np.float32(k)
    for j in range(begin, end):
        y0, y1 = max(H * j // rows, margin), min(H * (j + 1) // rows, H - margin)
        if y1 <= y0:
            continue
        sums = np.zeros((3, y1 - y0 + 2, W), np.float32)
        _window_products(image, y0 - 1, y1 + 1, sums)
        response = sums[0]
        for r in range(y1 - y0 + 2):
            for x in range(W):
                a, b, c = sums[0, r, x], sums[1, r, x], sums[2, r, x]
                # Eq. (5)
                response[r, x] = a * b - c * c - kk * (a + b) * (a + b)
        for i in range(columns):
            x0, x1 = max(W * i // columns, margin), min(W * (i + 1) // columns, W - margin)
            best, bx, by = np.float32(0), 0, 0
            for r in range(1, y1 - y0 + 1):
                for x in range(x0, x1):
                    if response[r, x] > best and (not masked or mask[y0 + r - 1, x] != 0):
                        best, bx, by = response[r, x], x, r
            # The maximum of the cell may be the flank of a corner in the next cell.
            peak = best > 0 and bx > 0 and bx < W - 1
            if peak:
                for dy in range(-1, 2):
                    for dx in range(-1, 2):
                        if response[by + dy, bx + dx] > best:
                            peak = False
            if peak:
                found[j, i, 0], found[j, i, 1], found[j, i, 2] = bx, y0 + by - 1, best


HARRIS_K = 0.04  # k of Eq. 5, as usual since Harris and Stephens 1988 (0.04 to 0.06)

MIN_RESPONSE, MIN_CONTRAST = 4.0, 2.0
"""R of Eq. 5, gray levels to the fourth, and standard deviation of a patch, gray levels, at least:
noise alone reaches no more."""

PATCH_RADIUS_PX = 5  # a patch is 11 x 11 px

LEVELS, COARSE_REACH_PX = 5, 8
"""Levels of a pyramid, and the search radius in pixels of the level that a search begins at, both
at most."""

REFINE_ITERATIONS = 6
"""Gauss-Newton steps to the sub-pixel place, at most; a step below 0.02 px ends it."""

UNIT_PX = 1e3  # of pixels in a trend over the image: so its normal matrix is well scaled
FAR = 1e6  # px; stands for a prediction that is not a number


@dataclass(frozen=True, slots=True)
class MatchingConfig:
    grid: int = 30  # cells along each side; one corner per cell (paper: 30 x 30)
    max_zssd: float = 0.4  # of patches made unit: 2 (1 - correlation)
    ambiguity: float = 0.8  # best zssd over that of the next separate peak, at most
    max_return_px: float = 0.5  # forward and backward match may differ by this; inf: not matched


DEFAULT = MatchingConfig()


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Where each point of image a was found in image b."""

    uv_px: F32  # (N, 2) in image b; the prediction where nothing was found
    zssd: F32  # (N,) zero-mean SSD of the unit patches, 0 to 4; 4 where nothing was found
    ok: Bool  # (N,)


Pyramid = tuple[U8, ...]
"""A gray image and its halvings, each (ceil(H / 2^l), ceil(W / 2^l)) uint8."""


def build_pyramid(gray: U8, levels: int = LEVELS) -> Pyramid:
    """The pyramid of ``gray`` (H, W) uint8; levels under 40 px are left out."""
    _check_gray(gray)
    stack = [np.ascontiguousarray(gray)]
    while len(stack) < levels and min(stack[-1].shape) >= 80:
        stack.append(np.asarray(cv2.pyrDown(stack[-1]), dtype=np.uint8))
    return tuple(stack)


def _check_gray(gray: U8) -> None:
    if gray.ndim != 2 or gray.dtype != np.uint8 or min(gray.shape) < 16:
        raise ValueError(f"image must be (H, W) uint8 of 16 px or more, got {gray.shape}")


def harris_grid(gray: U8, config: MatchingConfig = DEFAULT, mask: U8 | None = None) -> F32:
    """(N, 3) u, v and R of the strongest Harris corner in each cell of ``gray`` (H, W), Eq. 4-5.
    ``mask`` (H, W) is zero where the image holds nothing; patches stay clear of it."""
    _check_gray(gray)
    margin = PATCH_RADIUS_PX + 3
    allowed = np.zeros((0, 0), np.uint8)
    if mask is not None:
        if mask.shape != gray.shape:
            raise ValueError(f"mask {mask.shape} and image {gray.shape} differ")
        if not mask.all():
            side = 2 * margin + 1
            allowed = np.asarray(cv2.erode(mask, np.ones((side, side), np.uint8)), np.uint8)
    cells = np.zeros((config.grid, config.grid, 3), np.float32)
    parallel_for(
        harris_cells, config.grid, np.ascontiguousarray(gray), allowed, config.grid, config.grid,
        margin, HARRIS_K, cells,
    )  # fmt: skip
    best = cells.reshape(-1, 3)
    return np.asarray(best[best[:, 2] > MIN_RESPONSE])


def checked_points(uv_px: npt.ArrayLike) -> F64:
    """(N, 2) points, those that are not finite far away."""
    uv = np.array(uv_px, dtype=np.float64)
    uv[~np.isfinite(uv).all(axis=1)] = -FAR
    return np.clip(uv, -FAR, FAR)


def checked_warps(warp: npt.ArrayLike | None, count: int) -> tuple[F64, F64]:
    """Forward and inverse warps as (N, 4) rows; a singular warp becomes the identity."""
    matrices = np.eye(2) if warp is None else np.asarray(warp, dtype=np.float64)
    matrices = np.array(np.broadcast_to(matrices, (count, 2, 2)), order="C")
    determinant = matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]
    usable = np.isfinite(matrices).all(axis=(1, 2)) & (np.abs(determinant) > 1e-3)
    matrices[~usable] = np.eye(2)
    a, b, c, d = matrices.reshape(count, 4).T
    inverse = np.stack([d, -b, -c, a], axis=1) / (a * d - b * c)[:, None]
    return matrices.reshape(count, 4), np.ascontiguousarray(inverse)


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """One direction of matching: patches about the points of image a, looked for in image b."""

    a: tuple[U8, ...]
    b: tuple[U8, ...]
    uv_a: F64
    inverse_warp: F64
    config: MatchingConfig

    def at(self, level: int, uv_b: F64, active: Bool, reach: int) -> tuple[F64, F64, F64, F64]:
        """Best places (N, 2) in b within ``reach`` px of ``level`` about ``uv_b``, in full-size px.

        And (N,) their correlation, NO_SCORE where nothing could be compared, that of the next
        separate peak, and the contrast of the patch of a in gray levels.
        """
        N = len(uv_b)
        uv, score, second, contrast = uv_b / 2.0**level, np.empty(N), np.empty(N), np.empty(N)
        parallel_for(
            patch_search.search, -(-N // patch_search.CHUNK), self.a[level], self.b[level],
            self.uv_a / 2.0**level, uv.copy(),
            self.inverse_warp, active, reach, PATCH_RADIUS_PX,
            MIN_CONTRAST, uv, score, second, contrast,
        )  # fmt: skip
        return uv * 2.0**level, score, second, contrast

    def refined(self, uv_b: F64, active: Bool) -> tuple[F64, F64, F64, F64]:
        """Sub-pixel places (N, 2) in b from starts within about a pixel, their correlation (N,),
        NO_SCORE where there is none, and contrast (N,) of the patch in a and where it was found."""
        N = len(uv_b)
        uv, score, contrast_a, contrast_b = uv_b.copy(), np.empty(N), np.empty(N), np.empty(N)
        parallel_for(
            patch_search.refine, -(-N // patch_search.CHUNK), self.a[0], self.b[0], self.uv_a,
            self.inverse_warp, active,
            PATCH_RADIUS_PX, REFINE_ITERATIONS, uv, score, contrast_a,
            contrast_b,
        )  # fmt: skip
        return uv, score, contrast_a, contrast_b


def consensus(uv: F64, moves: F64, good: Bool, tolerance_px: float) -> F64 | None:
    """(3, 2) how ``moves`` (N, 2) change over ``uv`` (N, 2), as a row of 1, u, v times it, seen by
    most good points; else None. The weights of the others fall off at a tolerance that narrows from
    eightfold to itself."""
    if np.count_nonzero(good) < 12:
        return None
    x, y = np.column_stack([np.ones(len(uv)), uv / UNIT_PX])[good], moves[good]
    trend = np.vstack([np.median(y, axis=0), np.zeros((2, 2))])
    for wider in (8.0, 4.0, 2.0, 1.0, 1.0):
        square = np.sum((y - x @ trend) ** 2, axis=1) / (wider * tolerance_px) ** 2
        weighted = x.T / (1.0 + square) ** 2
        trend = np.linalg.solve(weighted @ x + 1e-6 * np.eye(3), weighted @ y)
    agree = np.linalg.norm(y - x @ trend, axis=1) < 2 * tolerance_px
    trend[1:] /= UNIT_PX
    return trend if np.count_nonzero(agree) >= max(12, 0.4 * len(y)) else None


def start_level(radius_px: float, levels: int) -> tuple[int, int]:
    """Level to start at and the search radius in its pixels."""
    level = 0
    while level + 1 < min(levels, LEVELS) and radius_px / 2.0**level > COARSE_REACH_PX:
        level += 1
    return level, min(max(2, int(np.ceil(radius_px / 2.0**level))), 64)


def match(
    pyramid_a: Pyramid,
    uv_a: npt.ArrayLike,
    pyramid_b: Pyramid,
    uv_b_predicted: npt.ArrayLike,
    radius_px: float,
    warp: npt.ArrayLike | None = None,
    config: MatchingConfig = DEFAULT,
) -> Matches:
    """Where the points ``uv_a`` (N, 2) of image a lie in image b.

    Each is searched within ``radius_px`` of ``uv_b_predicted`` (N, 2). ``warp`` ((2, 2) or
    (N, 2, 2)) takes an offset in a to the offset in b: rotation, scale, a linearised
    homography. Not ok: nothing alike, a second place as good, no texture, a backward match
    that ends elsewhere, a patch outside the image. A change of brightness or contrast does
    no harm. On a coarse level, points without an answer of their own follow the trend of the
    others. Points that are not finite are not ok. With a ``radius_px`` of 0 predictions that are
    good to a pixel are only refined.
    """
    a, predicted = checked_points(uv_a), checked_points(uv_b_predicted)
    forward_warp, inverse_warp = checked_warps(warp, len(a))
    forward = Search(pyramid_a, pyramid_b, a, inverse_warp, config)
    everyone: Bool = np.abs(np.hstack([a, predicted])).max(axis=1, initial=0.0) < FAR
    uv, active, contrast = predicted, everyone, None
    if radius_px > 0:
        back = Search(pyramid_b, pyramid_a, predicted, forward_warp, config)
        uv, active, contrast = _coarse_to_fine(forward, back, predicted, everyone, radius_px)
    uv, score, contrast_a, contrast_b = forward.refined(uv, active)
    ok = active & (2.0 * (1.0 - score) <= config.max_zssd)
    ok &= contrast_b >= MIN_CONTRAST
    if contrast is not None:
        ok &= ~_repeats(forward, uv, ok, contrast, contrast_a)
    if np.isfinite(config.max_return_px):
        back = Search(pyramid_b, pyramid_a, uv, forward_warp, config)
        home, alike, *_ = back.refined(a, ok)
        ok &= (alike > 0) & (np.linalg.norm(home - a, axis=1) <= config.max_return_px)
    uv = np.where(ok[:, None], uv, predicted)
    zssd = np.where(score > patch_search.NO_SCORE, 2.0 * (1.0 - score), 4.0)
    return Matches(uv.astype(np.float32), zssd.astype(np.float32), ok)


LEADERS = 48  # points that show the error of all predictions
STEADY_PX = 1.0  # their errors differ by about this from an affine motion, at most


def match_led(
    pyramid_a: Pyramid, uv_a: F32, pyramid_b: Pyramid, uv_b_predicted: F32, radius_px: float,
    warp: F32, config: MatchingConfig,
) -> Matches:  # fmt: skip
    """As :func:`match` for predictions whose errors are about an affine motion: those of known
    points by a pose, or by one for all rows of a rolling shutter.

    ``warp`` is (N, 2, 2). A few points are searched; by them the others are known to a pixel.
    """
    step, count = len(uv_a) // LEADERS, len(uv_a)
    if step > 1:
        led, good = np.zeros((count, 2)), np.zeros(count, np.bool_)
        some = slice(None, None, step)
        start = uv_b_predicted[some]
        found = match(pyramid_a, uv_a[some], pyramid_b, start, radius_px, warp[some], config)
        led[some], good[some] = found.uv_px - start, found.ok
        trend = consensus(uv_a.astype(np.float64), led, good, STEADY_PX)
        if trend is not None:
            there = uv_b_predicted + (trend[0] + uv_a @ trend[1:])
            return match(pyramid_a, uv_a, pyramid_b, there, 0.0, warp, config)
    return match(pyramid_a, uv_a, pyramid_b, uv_b_predicted, radius_px, warp, config)


def _coarse_to_fine(
    forward: Search, back: Search, predicted: F64, everyone: Bool, radius_px: float
) -> tuple[F64, Bool, F64 | None]:
    """(N, 2) places in b to about a pixel, which (N,) take part, and the contrast (N,) on the level
    where the search began; None where that is the finest."""
    a, config = forward.uv_a, forward.config
    level, reach = start_level(radius_px, min(len(forward.a), len(forward.b)))
    uv, score, second, contrast = forward.at(level, predicted, everyone, reach)
    # A coarse pixel blurs; the fine patches have the last word on likeness.
    active = _distinct(score, second, config.ambiguity) & (1.0 - score <= config.max_zssd)
    doubtful = active & ~_distinct(score, second, 0.4 * config.ambiguity)
    returned, *_ = replace(back, uv_a=uv).at(level, a, doubtful, min(reach, 4))
    active &= np.abs(returned - a).max(axis=1, initial=0.0) <= 1.6 * 2**level
    if level == 0:
        return uv, active, None
    stray_px = max(0.5 * radius_px, 4.0 * 2**level)
    uv, active = _follow_others(a, uv, predicted, active, everyone, 2.0 * 2**level, stray_px)
    while level > 1:
        finer = max(level - 2, 1)
        uv, score, *_ = forward.at(finer, uv, active, 1 + level - finer)
        level, active = finer, active & (score > 0)
    return uv, active, contrast


def _distinct(score: F64, second: F64, ratio: float) -> Bool:
    """(N,) True where the best place is that much better than any other."""
    return np.asarray(1.0 - score <= ratio * (1.0 - second))


def _follow_others(
    a: F64, uv: F64, predicted: F64, active: Bool, everyone: Bool, tolerance_px: float,
    stray_px: float,
) -> tuple[F64, Bool]:  # fmt: skip
    """Places, and which of them take part, after points without an answer got one from the trend.
    So did those further than ``stray_px`` from it: relief moves points, but not that far."""
    trend = consensus(a, uv - predicted, active, tolerance_px)
    if trend is None:
        return uv, active
    expected = predicted + (trend[0] + a @ trend[1:])
    own = active & (np.linalg.norm(uv - expected, axis=1) <= stray_px)
    return np.where(own[:, None], uv, expected), everyone.copy()


def _repeats(search: Search, uv: F64, ok: Bool, coarse: F64, fine: F64) -> Bool:
    """(N,) True for places in a texture that repeats.

    It may vanish on the coarse level, whose little contrast then decides by chance; such
    points must be distinct on a level that shows the repetition.
    """
    vague = ok & (coarse < 0.3 * fine)
    if not vague.any():
        return vague
    _, score, second, _ = search.at(1, uv, vague, 8)
    return np.asarray(vague & ~_distinct(score, second, search.config.ambiguity))
