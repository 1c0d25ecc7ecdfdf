"""The bare ground below a surface model: objects on it are found and bridged.

Simple morphological filter (Pingel, Clarke and McBride 2013, doi:10.1016/j.isprsjprs.2012.12.002):
openings with growing windows lower the surface; cells lowered by more than the slope allows are
objects.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from recon.surface.harmonic import between
from recon.surface.raster import Raster
from recon.types import F32, Bool

LARGEST_OBJECT_M = 36.0
"""Width of the widest building that is removed."""

SLOPE = 0.2
STEP_M = 0.25
MARGIN_M = 0.75
"""Margin around objects: matching widens them."""

WORKING_CELL_M = 0.5


def ground_cells(surface: Raster) -> Bool:
    """(rows, cols) known cells of the surface model that are bare ground."""
    cell_m = surface.grid.cell_m
    shrink = max(1, round(WORKING_CELL_M / cell_m))
    low = _lowest(surface.height_m, shrink)
    objects, coarse_m = np.zeros(low.shape, np.bool_), cell_m * shrink
    known = np.isfinite(low)
    inside = np.asarray(ndimage.binary_fill_holes(known), np.bool_)
    last = whole = _bridged(low, known, inside, coarse_m)
    radius = 1
    while (2 * radius + 1) * coarse_m <= LARGEST_OBJECT_M + 2 * coarse_m:
        window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        opened = cv2.morphologyEx(whole, cv2.MORPH_OPEN, window, borderType=cv2.BORDER_REPLICATE)
        objects |= last - opened > STEP_M + SLOPE * coarse_m * _steps(radius)
        last, radius = np.asarray(opened, np.float32), max(radius + 1, round(1.5 * radius))
    reach = 2 * max(1, round(MARGIN_M / coarse_m)) + 1
    wide = cv2.dilate(objects.astype(np.uint8), np.ones((reach, reach), np.uint8))
    full = np.repeat(np.repeat(wide, shrink, 0), shrink, 1)
    rows, cols = surface.grid.shape
    return np.asarray(surface.known & (full[:rows, :cols] == 0))


def _steps(radius: int) -> int:
    """Cells by which a window is wider than the one before it."""
    return max(1, radius - round(radius / 1.5))


@dataclass(frozen=True, slots=True, eq=False)
class BareGround:
    """The bare ground of a surface model.

    Ground is bridged smoothly below what stands on it and in holes of the surface model.
    """

    everywhere_m: F32  # (rows, cols) beyond the outline that of the nearest; NaN without ground
    is_inside: Bool  # (rows, cols) within the outline of the surface model, which does not grow
    is_bridged: Bool  # (rows, cols) inside, and not seen as ground


def terrain(surface: Raster, inside: Bool | None = None) -> BareGround:
    """The bare ground below ``surface``; ``inside`` is by default what its cells enclose."""
    ground = ground_cells(surface)
    if inside is None:
        inside = np.asarray(ndimage.binary_fill_holes(surface.known), np.bool_)
    inside = inside & ground.any()
    height = np.where(ground, surface.height_m, np.float32(np.nan)).astype(np.float32)
    bridged = _bridged(height, ground, inside, surface.grid.cell_m)
    return BareGround(bridged, inside, inside & ~ground)


def _lowest(height_m: F32, shrink: int) -> F32:
    """The lowest known height of each block of cells; NaN where none is known."""
    rows, cols = height_m.shape
    pad = (-rows % shrink, -cols % shrink)
    padded = np.pad(height_m, ((0, pad[0]), (0, pad[1])), constant_values=np.nan)
    blocks = np.where(np.isfinite(padded), padded, np.float32(np.inf))
    blocks = blocks.reshape(padded.shape[0] // shrink, shrink, -1, shrink).min(axis=(1, 3))
    return np.where(np.isfinite(blocks), blocks, np.float32(np.nan)).astype(np.float32)


def _bridged(height_m: F32, known: Bool, inside: Bool, cell_m: float) -> F32:
    """All cells: the known as they are, the others inside without facets between the known, those
    beyond by the nearest."""
    if not known.any() or known.all():
        return height_m
    near = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    out: F32 = height_m[tuple(near)]
    wanted = inside & ~known
    out[wanted] = between(height_m, known, wanted, cell_m)[wanted]
    return out
