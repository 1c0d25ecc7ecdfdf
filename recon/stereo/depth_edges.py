"""Depth that matching windows get wrong at edges, because they see both of an edge's sides.

They mix the depths of the two: such depth lies on no surface. From aside it fills the strip of
ground that a raised object hides. And they spill the nearer surface over the edge, because its
contour matches. Either makes an object wider than it is.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from recon.parallel import parallel_for
from recon.stereo.reprojection import known_where
from recon.types import F32, F64, U8, Bool, DepthMap

FLAT_RADIUS, PLANE_RADIUS = 3, 5
"""Pixels: a level surface of 7x7, such as a small roof, or a slanted one of 11x11. A mixture over
fewer pixels than a slanted surface has would itself pass for one."""

CLOSED_PX = 5
"""Gaps in what is dropped are closed by a square of this side: halfway between the two surfaces
the plane through the mixture fits."""

FILL_PX = 15  # unknown pixels take the mean of the known ones in a window of this side

STEP_SIGMAS = 6.0
"""A pixel that lies farther than the surface of another by more of both sigmas is behind it: about
one label."""

COLOUR_SIGMA, UNLIKE, ODDS = 15.0, 1e-6, 1.01
"""Gray levels of the distance of two colours of one surface; likelihood of a colour unlike all; a
pixel whose colour tells nothing stays."""

LIKE: F64 = np.exp(-0.5 * np.arange(1 << 14) / COLOUR_SIGMA**2) + UNLIKE
"""Likelihood of two colours of one surface by the square of their distance."""

_AXIS = np.arange(-PLANE_RADIUS, PLANE_RADIUS + 1) ** 2
NEAR: F64 = np.exp(-2.0 * np.add.outer(_AXIS, _AXIS) / PLANE_RADIUS**2)
"""Weight of a neighbour in the window about a pixel."""

Windows = tuple[F32, F32, F32, F32]
"""(h, w) mean, slope along columns and along rows, and variance about them."""


def drop_edges(depth: DepthMap, bgr: U8) -> DepthMap:
    """``depth`` without mixtures of two surfaces and without spills of the nearer one.

    ``bgr`` (h, w, 3) is the image on the grid of the depth. Of the windows that contain a pixel,
    the one whose inverse depths vary least about a constant (Kuwahara et al. 1976,
    doi:10.1007/978-1-4684-0769-3_13) or about a plane is its surface. A pixel off both by more
    than its own sigma and their spread is a mixture. A plane's inverse depth is affine in the
    image, so slanted ground stays. A pixel on a surface in front of another one is a spill if its
    colour is more likely on the other one: the likelihood is the mean of a Gaussian kernel over
    the pixels of each in a window.
    """
    known = np.isfinite(depth.depth_m)
    if not known.any():
        return depth
    z = np.where(known, depth.depth_m, np.float32(1.0))
    middle = np.float32(z[known].mean())
    nearness = np.where(known, middle / z - np.float32(1.0), np.float32(0.0))
    around = cv2.blur(nearness, (FILL_PX, FILL_PX)) / np.maximum(
        cv2.blur(known.astype(np.float32), (FILL_PX, FILL_PX)), np.float32(1e-6)
    )
    nearness = np.where(known, nearness, around)
    noise = np.where(known, middle * depth.sigma_m / (z * z), np.float32(0.0))
    windows = window_fits(nearness, FLAT_RADIUS, False), window_fits(nearness, PLANE_RADIUS, True)
    mixed, places = known.copy(), np.empty((2, *known.shape), np.float32)
    parallel_for(_find_surfaces, len(mixed), nearness, noise, *windows, places, mixed)
    closed = cv2.morphologyEx(mixed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((CLOSED_PX,) * 2))
    kept = known & (closed == 0)
    farthest = cv2.erode(np.where(kept, nearness, np.inf), np.ones((2 * PLANE_RADIUS + 1,) * 2))
    spilt = kept & (nearness - farthest > STEP_SIGMAS * noise)
    parallel_for(_keep_spills, len(spilt), nearness, noise, kept, bgr, *windows, places, spilt)
    kept &= ~spilt
    return depth if kept.sum() == known.sum() else known_where(depth, kept)


def window_fits(x: F32, radius: int, is_slanted: bool) -> Windows:
    """Of the window of ``x`` (h, w) about each pixel."""
    size = 2 * radius + 1
    spread = (size**2 - 1) / 12.0
    mean = np.full(size, 1.0 / size)
    slope = np.arange(-radius, radius + 1) * (mean / spread if is_slanted else 0.0)

    def filtered(values: F32, across: F64, down: F64) -> F32:
        found = cv2.sepFilter2D(values, -1, across, down, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(found, np.float32)

    m, dx, dy = (filtered(x, *k) for k in ((mean, mean), (slope, mean), (mean, slope)))
    variance = filtered(x * x, mean, mean) - m * m - np.float32(spread) * (dx * dx + dy * dy)
    return m, dx, dy, variance


@njit(cache=True, nogil=True)
def _find_surfaces(
    begin: int, end: int, x: F32, noise: F32, flat: Windows, slanted: Windows, places: F32,
    mixed: Bool,
) -> None:  # fmt: skip
    """Fill ``places`` (2, h, w) with those of the steadiest flat and slanted window of a pixel,
    -1 where it does not lie on the slanted one; set ``mixed`` to False where it lies on one."""
    width = x.shape[1]
    least, expected = np.empty(width, np.float32), np.empty(width, np.float32)
    for v in range(begin, end):
        for n, windows, radius in ((0, flat, FLAT_RADIUS), (1, slanted, PLANE_RADIUS)):
            place = places[n, v]
            steadiest_windows(windows, radius, v, least, expected, place)
            for u in range(width):
                off = abs(x[v, u] - expected[u]) - noise[v, u]
                is_off = off > np.sqrt(max(least[u], np.float32(0)))
                mixed[v, u] &= is_off
                place[u] = np.float32(-1) if is_off and n == 1 else place[u]


@njit(cache=True, nogil=True)
def steadiest_windows(
    windows: Windows, radius: int, v: int, least: F32, expected: F32, place: F32
) -> None:
    """The steadiest of the windows that contain each pixel of a row: (w,) variance, value at the
    pixel, and place of that window, 0 to 8.

    One place of the window after the other, so that vector registers take the pixels.
    """
    height, width = windows[0].shape
    least[:] = np.inf
    for n in range(9):
        dv, du = radius * (n // 3 - 1), radius * (n % 3 - 1)
        if not 0 <= v - dv < height:
            continue
        first, count = max(du, 0), width - abs(du)
        low, value = least[first : first + count], expected[first : first + count]
        best, start, row = place[first : first + count], first - du, v - dv
        m, a = windows[0][row, start : start + count], windows[1][row, start : start + count]
        d, s = windows[2][row, start : start + count], windows[3][row, start : start + count]
        right, below, number = np.float32(du), np.float32(dv), np.float32(n)
        for i in range(count):
            is_less = s[i] < low[i]
            value[i] = m[i] + a[i] * right + d[i] * below if is_less else value[i]
            best[i] = number if is_less else best[i]
            low[i] = s[i] if is_less else low[i]


@njit(cache=True, nogil=True)
def plane_at(
    windows: Windows, radius: int, place: float, u: int, v: int
) -> tuple[float, float, float]:
    """Value at a pixel and slopes along columns and rows of the window at a place."""
    mean, across, down, _ = windows
    dv, du = radius * (int(place) // 3 - 1), radius * (int(place) % 3 - 1)
    a, d = across[v - dv, u - du], down[v - dv, u - du]
    return mean[v - dv, u - du] + a * du + d * dv, a, d


@njit(cache=True, nogil=True)
def _keep_spills(
    begin: int, end: int, x: F32, noise: F32, kept: Bool, bgr: U8, flat: Windows,
    slanted: Windows, places: F32, spilt: Bool,
) -> None:  # fmt: skip
    """Set ``spilt`` to False where a pixel's colour is that of its own surface."""
    for v in range(begin, end):
        for u in range(x.shape[1]):
            if spilt[v, u]:
                plane = plane_at(flat, FLAT_RADIUS, places[0, v, u], u, v)
                if places[1, v, u] >= 0:
                    plane = plane_at(slanted, PLANE_RADIUS, places[1, v, u], u, v)
                spilt[v, u] = _is_spilt(u, v, plane, noise[v, u], x, noise, kept, bgr)


@njit(cache=True, nogil=True)
def _is_spilt(
    u: int, v: int, plane: tuple[float, float, float], sigma: float, x: F32, noise: F32,
    kept: Bool, bgr: U8,
) -> bool:  # fmt: skip
    """True where the colours of the surface behind are like the pixel's, more than its own are."""
    expected, across, down = plane
    own = own_weight = other = other_weight = 0.0  # likelihoods of both surfaces, and weights
    for dv in range(-PLANE_RADIUS, PLANE_RADIUS + 1):
        for du in range(-PLANE_RADIUS, PLANE_RADIUS + 1):
            i, j = u + du, v + dv
            if not (0 <= i < x.shape[1] and 0 <= j < x.shape[0] and kept[j, i]) or du == dv == 0:
                continue
            behind = expected + across * du + down * dv - x[j, i]
            limit = STEP_SIGMAS * (sigma + noise[j, i])
            if behind < -limit:
                continue
            apart = 0
            for k in range(3):
                apart += (int(bgr[v, u, k]) - int(bgr[j, i, k])) ** 2
            near = NEAR[dv + PLANE_RADIUS, du + PLANE_RADIUS]
            like = near * LIKE[min(apart, LIKE.size - 1)]
            if behind > limit:
                other, other_weight = other + like, other_weight + near
            else:
                own, own_weight = own + like, own_weight + near
    return bool(other * own_weight > ODDS * own * other_weight)
