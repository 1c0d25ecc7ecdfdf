"""The surface model of a scan, from which rasters are made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.surface.ground import BareGround, terrain
from recon.surface.hole_filling import LEVEL_M, completed, filled, outline, outlined
from recon.surface.raster import (
    STEP_M,
    Raster,
    highest_lowest,
    inner_doubtful,
    reliable,
    smoothed,
    standing_height,
    without_cells,
)
from recon.types import F64, U8, Bool
from service.offline.exports.view import ScanView

OPEN_STEP_M = 2
SIDEWAYS_DEG = 15.0
MAX_OPEN_M, MAX_OPEN_SIDEWAYS_M = 4, 6
"""Maximum height of free air required above a cell: trees and eaves overhang higher up as well, but
every metre costs ground at the border of the survey. Looking sideways one sees more of the ground
below them."""

NEAR_M = 1.0
"""So near to something higher, free air is required up to MAX_OPEN_SIDEWAYS_M in any case."""

FILLED_UP_M = (4, 6, 8)
"""Above a filled cell no surface may hide the air at these heights from all that look there: what
hangs over the ground hides it at the same time."""

FILLED_REACH_M = 3.0
"""Holes of twice this width are filled: on one side of the flight a roof or a crown of 8 m hides
so much ground from all images."""

FILLED_EDGE_CELLS = 1
"""Cells may be filled closer to something higher than without keyframes that contradict."""

NEAR_UP_M, NEAR_CELLS = (1, 2, 3), 2
"""So near to something higher, a filled cell needs free air at these heights as well: the edges of
crowns that matching has lost lie low."""

PROBE_M = 1.0
"""A surface is no surface where a keyframe sees through the place so far below it."""


FILLED, UNCERTAIN = 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceHeights:
    """Heights of the upper surface, and (rows, cols) those that are no certain measurements."""

    raster: Raster
    is_filled: Bool


def surface_model(scan: ScanView, cell_m: float | None, strict: bool = False) -> SurfaceHeights:
    """The surface where it is certain and the air above it was seen, its holes filled.

    ``strict`` leaves the holes unknown. :func:`recon.surface.raster.reliable` removes uncertain
    cells. Those of them that some keyframe ends at and none sees through come back as filled, and
    so does level ground below air that was not seen, if nothing is known to hide it.
    :func:`recon.surface.hole_filling.filled` fills the rest, where no keyframe contradicts it.
    Beyond the outline of the certain cells there are no holes, only guesses; a tile of a scan does
    not know this outline.
    """
    key = ("surface", cell_m, strict)
    return scan.shared(key, lambda: _surface_model(scan, cell_m, strict))


def bare_ground(scan: ScanView, cell_m: float | None) -> BareGround:
    """The bare ground below the surface model, within the outline of the survey."""

    def made() -> BareGround:
        return terrain(surface_model(scan, cell_m).raster, _inside(scan, cell_m))

    return scan.shared(("ground", cell_m), made)


def _inside(scan: ScanView, cell_m: float | None) -> Bool:
    measured, sure = scan.raster(cell_m), surface_model(scan, cell_m).raster

    def made() -> Bool:
        return outline(measured.known, sure.known, measured.grid.cell_m)

    return scan.shared(("inside", cell_m), made)


def complete_model(scan: ScanView, cell_m: float | None) -> tuple[Raster, U8]:
    """The surface without holes inside the outline of the survey, and none beyond it; (rows, cols)
    0 where it is measured, FILLED, or UNCERTAIN.

    Uncertain heights are measured ones that :func:`surface_model` leaves out and no keyframe sees
    through. Other cells are filled from the lower side. Noise is smoothed, steps stay.
    """
    return scan.shared(("complete", cell_m), lambda: _complete_model(scan, cell_m))


def _complete_model(scan: ScanView, cell_m: float | None) -> tuple[Raster, U8]:
    measured, seen, inside = scan.raster(cell_m), surface_model(scan, cell_m), _inside(scan, cell_m)
    known = seen.raster.known
    kept = _unrefuted(scan, measured, inside & measured.known & ~known, ())
    both = replace(
        seen.raster,
        height_m=np.where(kept, measured.height_m, seen.raster.height_m),
        sigma_m=np.where(kept, measured.sigma_m, seen.raster.sigma_m),
        rgb=np.where(kept[..., None], measured.rgb, seen.raster.rgb),
    )
    unsure = kept | seen.is_filled
    whole = smoothed(completed(both, bare_ground(scan, cell_m).everywhere_m, inside, unsure))
    origin = np.where(known & ~seen.is_filled, 0, FILLED).astype(np.uint8)
    origin[kept] = UNCERTAIN
    return without_cells(whole, ~inside), origin


def _surface_model(scan: ScanView, cell_m: float | None, strict: bool) -> SurfaceHeights:
    measured = scan.raster(cell_m)
    sure = reliable(measured)
    certain = _open_to_the_sky(scan, measured, sure)
    if strict:
        return SurfaceHeights(certain, np.zeros(certain.grid.shape, np.bool_))
    holes = ~certain.known & (outlined(certain.known) if scan.is_whole else True)
    held = _unrefuted(scan, measured, holes & inner_doubtful(measured, sure), ())
    level = sure.known & _at_lowest(measured, certain)
    held |= _unrefuted(scan, measured, holes & level, (*NEAR_UP_M, *FILLED_UP_M))
    known = without_cells(measured, ~(certain.known | held))
    raster, new = filled(known, measured, FILLED_REACH_M, FILLED_EDGE_CELLS)
    top_m = highest_lowest(measured.height_m, NEAR_CELLS)[0]
    right = _unrefuted(scan, raster, new & holes, FILLED_UP_M)
    below = right & (top_m - raster.height_m > STEP_M)
    right &= ~below | _unrefuted(scan, raster, below, NEAR_UP_M)
    return SurfaceHeights(without_cells(raster, new & ~right), right | held)


def _at_lowest(measured: Raster, certain: Raster) -> Bool:
    """(rows, cols) cells of ``measured`` level with the lowest certain one next to them."""
    lowest_m = highest_lowest(certain.height_m, 1)[1]
    return np.asarray(np.abs(measured.height_m - lowest_m) <= LEVEL_M)


def _unrefuted(scan: ScanView, raster: Raster, cells: Bool, free_up_m: Sequence[float]) -> Bool:
    """Those of the ``cells`` (rows, cols) that no keyframe sees through, and above which no surface
    hides the air at these heights from all keyframes that look there."""
    is_open, behind = scan.air_above(_places(scan, raster, cells), (-PROBE_M, *free_up_m))
    out: Bool = cells.copy()
    out[cells] = ~is_open[:, 0] & ~(~is_open & (behind > 0))[:, 1:].any(axis=1)
    return out


def cell_places(scan: ScanView, raster: Raster) -> F64:
    """(rows, cols, 3) places of the middles of the cells in the scan's frame; NaN where unknown."""
    grid = raster.grid
    x: F64 = grid.west_m + (np.arange(grid.shape[1], dtype=np.float64) + 0.5) * grid.cell_m
    y: F64 = grid.north_m - (np.arange(grid.shape[0], dtype=np.float64) + 0.5) * grid.cell_m
    if scan.frame is not None:
        return scan.frame.from_utm_grid(x, y, raster.height_m)
    return np.stack([*np.meshgrid(x, y), raster.height_m.astype(np.float64)], axis=-1)


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
    is_open, _ = scan.air_above(cell_places(scan, raster)[known], heights_m.tolist())
    needed = (heights_m <= usual) | (above_m[known] > OPEN_STEP_M)[:, None]
    hidden = np.zeros(raster.grid.shape, np.bool_)
    hidden[known] = ~(is_open | ~needed).all(axis=1)
    return without_cells(raster, hidden)


def _places(scan: ScanView, raster: Raster, cells: Bool) -> F64:
    """(N, 3) places of the middles of some of the cells in the scan's frame."""
    places = np.column_stack([raster.grid.centres(*np.nonzero(cells)), raster.height_m[cells]])
    return places if scan.frame is None else scan.frame.from_utm(places)
