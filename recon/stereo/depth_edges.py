"""Depth that lies on no surface: matching windows see both sides of an edge and mix their depths.

In the image the mixture is as wide as the windows. From aside it fills the strip of ground that a
raised object hides, so that the object comes out wider than it is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numba import njit

from recon.bands import in_bands
from recon.types import F32, F64, Bool, DepthMap

FLAT_RADIUS, PLANE_RADIUS = 3, 5
"""Pixels: a level surface of 7x7, such as a small roof, or a slanted one of 11x11. A mixture over
fewer pixels than a slanted surface has would itself pass for one."""

CLOSED_PX = 5
"""Gaps in what is dropped are closed by a square of this side: halfway between the two surfaces
the plane through the mixture fits."""

FILL_PX = 15
"""Unknown pixels take the mean of the known ones in a window of this side."""

Windows = tuple[F32, F32, F32, F32]
"""(h, w) mean, slope along columns and along rows, and variance about them."""


def drop_mixtures(depth: DepthMap) -> DepthMap:
    """``depth`` without the pixels that belong to no surface next to them.

    Of the windows that contain a pixel, the one whose inverse depths vary least about a constant
    (Kuwahara et al. 1976, doi:10.1007/978-1-4684-0769-3_13) or about a plane is its surface. A
    pixel off both by more than its own sigma and their spread is a mixture. A plane's inverse
    depth is affine in the image, so slanted ground stays.
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
    mixed = known.copy()
    in_bands(
        _keep_mixtures, len(mixed), nearness, noise,
        _windows(nearness, FLAT_RADIUS, False), _windows(nearness, PLANE_RADIUS, True), mixed,
    )  # fmt: skip
    if not mixed.any():
        return depth
    closed = cv2.morphologyEx(mixed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((CLOSED_PX,) * 2))
    mixed = known & (closed > 0)
    return replace(
        depth,
        depth_m=np.where(mixed, np.float32(np.nan), depth.depth_m),
        sigma_m=np.where(mixed, np.float32(np.nan), depth.sigma_m),
        views=np.where(mixed, np.uint8(0), depth.views),
    )


def _windows(x: F32, radius: int, is_slanted: bool) -> Windows:
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
def _keep_mixtures(
    begin: int, end: int, x: F32, noise: F32, flat: Windows, slanted: Windows, mixed: Bool
) -> None:  # pragma: no cover - compiled
    """Set ``mixed`` to False where the pixel lies on a surface."""
    for v in range(begin, end):
        for u in range(x.shape[1]):
            if mixed[v, u]:
                off = _is_off(flat, FLAT_RADIUS, u, v, x[v, u], noise[v, u])
                mixed[v, u] = off and _is_off(slanted, PLANE_RADIUS, u, v, x[v, u], noise[v, u])


@njit(cache=True, nogil=True)
def _is_off(
    windows: Windows, radius: int, u: int, v: int, here: float, noise: float
) -> Any:  # pragma: no cover - compiled
    """True where a pixel does not lie on the steadiest of the windows that contain it."""
    mean, across, down, variance = windows
    least, expected = np.inf, here
    for dv in (-radius, 0, radius):
        for du in (-radius, 0, radius):
            i, j = u - du, v - dv
            if 0 <= i < mean.shape[1] and 0 <= j < mean.shape[0] and variance[j, i] < least:
                least = variance[j, i]
                expected = mean[j, i] + across[j, i] * du + down[j, i] * dv
    return abs(here - expected) > np.sqrt(max(least, 0.0)) + noise
