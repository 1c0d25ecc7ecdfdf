"""The outline of a surface model, and its holes filled from the lower side.

A roof hides the ground next to it, so a hole there is ground.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from recon.surface.harmonic import between
from recon.surface.raster import STEP_M, Raster
from recon.types import F32, U8, Bool

BEYOND_M = 3.0
"""The outline reaches so far beyond certain heights: half a crown at the border."""

OPENING_M = 1.5
ISLAND_SHARE = 0.02
"""Of the largest part; a smaller one is an island."""

THIN_CELLS = 1.5
"""A gap of one cell, also across."""

SPREAD = 0.2
"""Sigma of a filled height per distance from what is known."""

GAP_CELLS = 1
"""The outline of known cells closes gaps of twice this width."""


def outlined(known: Bool) -> Bool:
    """(rows, cols) the cells within the outline of the ``known`` ones: those and their holes."""
    from scipy.ndimage import binary_fill_holes

    square = np.ones((2 * GAP_CELLS + 1,) * 2, np.uint8)
    closed = cv2.morphologyEx(known.astype(np.uint8), cv2.MORPH_CLOSE, square)
    return np.asarray(binary_fill_holes(closed), np.bool_)


def outline(known: Bool, sure: Bool, cell_m: float) -> Bool:
    """(rows, cols) the surveyed ground: the ``known`` cells near ``sure`` ones, and what they
    enclose, without teeth at its border, strips and islands."""
    from scipy import ndimage

    if not sure.any():
        return np.zeros_like(known)
    far = ndimage.distance_transform_edt(~sure) > BEYOND_M / cell_m
    cells = np.pad(known & ~far, 1).astype(np.uint8)
    closed = cv2.morphologyEx(cells, cv2.MORPH_CLOSE, _disc(0.5, cell_m))
    whole = np.asarray(ndimage.binary_fill_holes(closed), np.uint8)
    opened = cv2.morphologyEx(whole, cv2.MORPH_OPEN, _disc(OPENING_M, cell_m)).astype(np.float32)
    soft = cv2.GaussianBlur(opened, (0, 0), max(1.0, OPENING_M / cell_m))
    parts, _ = ndimage.label((whole > 0) & (soft > 0.5))
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray((sizes > ISLAND_SHARE * sizes.max())[parts][1:-1, 1:-1])


def _disc(radius_m: float, cell_m: float) -> U8:
    size = 2 * max(1, round(radius_m / cell_m)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def completed(raster: Raster, low_m: F32, inside: Bool, unsure: Bool) -> Raster:
    """``raster`` with every cell ``inside`` filled, from the lower side.

    Next to a known cell it takes that one's height, because voxels leave lines without a point;
    else the ground ``low_m`` (rows, cols), or, in holes that no ground touches, what is around.
    At steps, filled and ``unsure`` cells are of the surface that most of the cells around are of.
    """
    from scipy import ndimage

    known, cell_m = raster.known, raster.grid.cell_m
    if not known.any():
        return raster
    wanted = inside & ~known
    distance, near = ndimage.distance_transform_edt(~known, return_indices=True)
    height = raster.height_m[tuple(near)]
    rest = wanted & (distance > THIN_CELLS)
    level = known & (np.abs(raster.height_m - low_m) <= STEP_M)
    parts, count = ndimage.label(rest, np.ones((3, 3)))
    reach = 2 * math.ceil(THIN_CELLS) + 1
    touched = parts[cv2.dilate(level.astype(np.uint8), np.ones((reach, reach))) > 0]
    is_open = np.isin(np.arange(count + 1), touched)
    is_open[0] = False
    below = is_open[parts]
    height = np.where(below, low_m, height).astype(np.float32)
    rgb = np.where(wanted[..., None], raster.rgb[tuple(near)], raster.rgb)
    values = np.dstack([raster.height_m, raster.rgb.astype(np.float32)])
    for cells, fixed in ((below, level), (rest & ~below, known)):
        filled = between(values, fixed, cells, cell_m)[cells]
        rgb[cells] = np.clip(filled[:, 1:], 0, 255)
        if fixed is known:
            height[cells] = filled[:, 0]
    height = np.where(wanted, height, raster.height_m[tuple(near)]).astype(np.float32)
    middle = float(np.median(raster.height_m[known]))
    most = cv2.medianBlur(height - middle, 5) + middle
    torn = (wanted | unsure) & (np.abs(most - height) > STEP_M)
    height[torn] = most[torn]
    sigma = np.hypot(2.0 * raster.sigma_m[tuple(near)], SPREAD * cell_m * distance)
    return replace(
        raster,
        height_m=np.where(wanted | torn, height, raster.height_m),
        sigma_m=np.where(wanted, sigma, raster.sigma_m).astype(np.float32),
        rgb=rgb,
    )
