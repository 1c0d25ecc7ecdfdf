"""The surface model of a scan, from which rasters are made."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from recon.mapping.free_space import open_above
from recon.surface.ground import BareGround, terrain
from recon.surface.hole_filling import filled
from recon.surface.raster import Raster, reliable, standing_height, without_cells
from recon.types import F64, Bool
from service.offline.exports.view import ScanView
from service.scans.main_piece import main_keyframes

OPEN_STEP_M = 2
SIDEWAYS_DEG = 15.0
MAX_OPEN_M, MAX_OPEN_SIDEWAYS_M = 4, 6
"""Maximum height of free air required above a cell: trees and eaves overhang higher up as well, but
every metre costs ground at the border of the survey. Looking sideways one sees more of the ground
below them."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Heights of the upper surface, and (rows, cols) where a hole was filled."""

    raster: Raster
    is_filled: Bool


def surface_model(scan: ScanView, cell_m: float | None, strict: bool = False) -> Surface:
    """The surface where it is certain and the air above it was seen, its holes filled.

    ``strict`` leaves the holes unknown. :func:`recon.surface.raster.reliable` removes uncertain
    cells, :func:`recon.surface.hole_filling.filled` fills holes.
    """
    key = ("surface", cell_m, strict)
    return scan.shared(key, lambda: _surface_model(scan, cell_m, strict))


def bare_ground(scan: ScanView, cell_m: float | None) -> BareGround:
    """The bare ground below the surface model."""
    return scan.shared(("ground", cell_m), lambda: terrain(surface_model(scan, cell_m).raster))


def _surface_model(scan: ScanView, cell_m: float | None, strict: bool) -> Surface:
    measured = scan.raster(cell_m)
    certain = _open_to_the_sky(scan, reliable(measured))
    if strict:
        return Surface(certain, np.zeros(certain.grid.shape, np.bool_))
    return Surface(*filled(certain, measured))


def cell_places(scan: ScanView, raster: Raster) -> F64:
    """(rows, cols, 3) places of the middles of the cells in the scan's frame; NaN where unknown."""
    grid = raster.grid
    x: F64 = grid.west_m + (np.arange(grid.shape[1], dtype=np.float64) + 0.5) * grid.cell_m
    y: F64 = grid.north_m - (np.arange(grid.shape[0], dtype=np.float64) + 0.5) * grid.cell_m
    if scan.frame is not None:
        return scan.frame.from_utm_grid(x, y, raster.height_m)
    return np.stack([*np.meshgrid(x, y), raster.height_m.astype(np.float64)], axis=-1)


def _open_to_the_sky(scan: ScanView, raster: Raster) -> Raster:
    """``raster`` where the air above was seen to be free, as high as things stand on this site."""
    sideways = float(np.median(scan.off_nadir_deg)) > SIDEWAYS_DEG
    highest = min(standing_height(raster), MAX_OPEN_SIDEWAYS_M if sideways else MAX_OPEN_M)
    heights_m = [float(m) for m in range(OPEN_STEP_M, math.ceil(highest) + 1, OPEN_STEP_M)]
    if not heights_m:
        return raster
    places = cell_places(scan, raster)[raster.known]
    keyframes = scan.progress.over(main_keyframes(scan.store), len(scan.store.seqs()))
    hidden = np.zeros(raster.grid.shape, np.bool_)
    with scan.progress.part("surface that is open to the sky", 0.5):
        hidden[raster.known] = ~open_above(places, heights_m, (k.depth for k in keyframes))
    return without_cells(raster, hidden)
