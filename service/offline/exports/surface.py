"""The surface model of a scan, from which rasters are made."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from recon.surface.ground import BareGround, terrain
from recon.surface.hole_filling import completed, outline
from recon.surface.raster import (
    STEP_M,
    Grid,
    Raster,
    highest_lowest,
    reliable,
    smoothed,
    standing_height,
    without_cells,
)
from recon.types import F32, F64, U8, Bool
from service.offline.exports.view import ScanView, made_once

OPEN_STEP_M = 2
SIDEWAYS_DEG = 15.0
MAX_OPEN_M, MAX_OPEN_SIDEWAYS_M = 4, 6
"""Maximum height of free air required above a cell: trees and eaves overhang higher up as well, but
every metre costs ground at the border of the survey. Looking sideways one sees more of the ground
below them."""

NEAR_M = 1.0
"""So near to something higher, free air is required up to MAX_OPEN_SIDEWAYS_M in any case."""

OBJECT_REACH_M = 3.0
"""So far from the known part of an object a cell may lie below it."""

BENEATH_M = 0.5
"""Air so far below the top of an object is looked at."""

PROBE_M = 1.0
"""A surface is no surface where a keyframe sees through the place so far below it."""


FILLED, UNCERTAIN = 1, 2


@made_once
def surface_model(scan: ScanView, cell_m: float | None) -> Raster:
    """The surface where it is certain and the air above it was seen.

    :func:`recon.surface.raster.reliable` removes uncertain cells.
    """
    measured = scan.raster(cell_m)
    return _open_to_the_sky(scan, measured, reliable(measured))


@made_once
def bare_ground(scan: ScanView, cell_m: float | None) -> BareGround:
    """The bare ground below the surface model, within the outline of the survey."""
    return terrain(surface_model(scan, cell_m), _inside(scan, cell_m))


@made_once
def _inside(scan: ScanView, cell_m: float | None) -> Bool:
    measured, sure = scan.raster(cell_m), surface_model(scan, cell_m)
    return outline(measured.known, sure.known, measured.grid.cell_m)


@made_once
def complete_model(scan: ScanView, cell_m: float | None) -> tuple[Raster, U8]:
    """The surface without holes inside the outline of the survey, and none beyond it; (rows, cols)
    0 where it is measured, FILLED, or UNCERTAIN.

    Uncertain heights are measured ones that :func:`surface_model` leaves out and no keyframe sees
    through. Other cells are filled: below an object as high as that, else from the lower side.
    Noise is smoothed, steps stay.
    """
    measured, sure, inside = scan.raster(cell_m), surface_model(scan, cell_m), _inside(scan, cell_m)
    low_m = bare_ground(scan, cell_m).everywhere_m
    kept = _not_seen_through(scan, measured, inside & measured.known & ~sure.known)
    raised, below = _below_objects(scan, measured, low_m, kept)
    both = without_cells(raised, ~(sure.known | kept))
    whole = smoothed(completed(both, low_m, inside, kept))
    origin = np.where(sure.known, 0, FILLED).astype(np.uint8)
    origin[kept & ~below] = UNCERTAIN
    return without_cells(whole, ~inside), origin


def _below_objects(
    scan: ScanView, measured: Raster, low_m: F32, cells: Bool
) -> tuple[Raster, Bool]:
    """``measured`` where of the ``cells`` (rows, cols) those below a crown or an eave are as high
    as the nearest object, and which these are.

    Looking sideways one sees the ground below an object. No keyframe sees through the air below
    its top there, and one sees a surface in front of that air.
    """
    from scipy import ndimage

    is_object = measured.known & (measured.height_m - low_m > STEP_M)
    below = np.zeros_like(cells)
    if not is_object.any():
        return measured, below
    far, near = ndimage.distance_transform_edt(~is_object, return_indices=True)
    top_m = measured.height_m[tuple(near)]
    up_m = top_m - measured.height_m
    below = cells & (up_m > OPEN_STEP_M) & (far * measured.grid.cell_m < OBJECT_REACH_M)
    is_open, is_hidden = np.zeros((2, int(below.sum())), np.bool_)
    for down_m in (BENEATH_M, 0.25 * up_m):
        places = cell_places(scan, measured.grid, top_m - down_m)[below]
        free, behind = scan.air_above(places, (0.0,))
        is_open |= free[:, 0]
        is_hidden |= behind[:, 0] > 0
    below[below] = is_hidden & ~is_open
    raised = replace(
        measured,
        height_m=np.where(below, top_m, measured.height_m),
        sigma_m=np.where(below, 2.0 * measured.sigma_m[tuple(near)], measured.sigma_m),
        rgb=np.where(below[..., None], measured.rgb[tuple(near)], measured.rgb),
    )
    return raised, below


def _not_seen_through(scan: ScanView, measured: Raster, cells: Bool) -> Bool:
    """Those of the ``cells`` (rows, cols) whose surface no keyframe sees through."""
    places = cell_places(scan, measured.grid, measured.height_m)[cells]
    is_open, _ = scan.air_above(places, (-PROBE_M,))
    out: Bool = cells.copy()
    out[cells] = ~is_open[:, 0]
    return out


def cell_places(scan: ScanView, grid: Grid, height_m: F32) -> F64:
    """(rows, cols, 3) places in the scan's frame of the middles of cells with heights (rows, cols);
    NaN where unknown."""
    x: F64 = grid.west_m + (np.arange(grid.shape[1], dtype=np.float64) + 0.5) * grid.cell_m
    y: F64 = grid.north_m - (np.arange(grid.shape[0], dtype=np.float64) + 0.5) * grid.cell_m
    if scan.frame is not None:
        return scan.frame.from_utm_grid(x, y, height_m)
    return np.stack([*np.meshgrid(x, y), height_m.astype(np.float64)], axis=-1)


def _open_to_the_sky(scan: ScanView, measured: Raster, raster: Raster) -> Raster:
    """``raster`` where the air above was seen to be free, as high as things stand on this site."""
    sideways = float(np.median(scan.off_nadir_deg)) > SIDEWAYS_DEG
    usual = MAX_OPEN_SIDEWAYS_M if sideways else MAX_OPEN_M
    highest = math.ceil(min(standing_height(raster), MAX_OPEN_SIDEWAYS_M))
    heights_m = np.arange(OPEN_STEP_M, highest + 1, OPEN_STEP_M, dtype=np.float64)
    if not len(heights_m):
        return raster
    known, reach = raster.known, max(1, round(NEAR_M / raster.grid.cell_m))
    above_m = highest_lowest(measured.height_m, reach)[0] - raster.height_m
    is_open, _ = scan.air_above(
        cell_places(scan, raster.grid, raster.height_m)[known], heights_m.tolist()
    )
    needed = (heights_m <= usual) | (above_m[known] > OPEN_STEP_M)[:, None]
    hidden = np.zeros(raster.grid.shape, np.bool_)
    hidden[known] = ~(is_open | ~needed).all(axis=1)
    return without_cells(raster, hidden)
