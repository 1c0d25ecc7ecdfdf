"""Holes of a surface model against the surface that they were cut into."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.surface.hole_filling import EDGE_CELLS, filled, outlined, surface_model
from recon.surface.raster import Grid, Raster, grid_over, without_cells
from recon.types import F32, Bool

CELL_M = 0.25
SIZE = 60
ROWS, COLS = np.mgrid[0:SIZE, 0:SIZE]


def raster_of(height: F32) -> Raster:
    grid = Grid(0.0, 0.0, CELL_M, (SIZE, SIZE))
    sigma = np.where(np.isfinite(height), np.float32(0.05), np.float32(np.nan))
    return Raster(grid, height.astype(np.float32), sigma, np.full((SIZE, SIZE, 3), 90, np.uint8))


def cut(height: F32, holes: Bool) -> tuple[Raster, Bool]:
    """The surface with ``holes`` in it, filled; and which cells were filled."""
    whole = raster_of(height)
    pierced = without_cells(whole, holes)
    return filled(pierced, pierced)


def roof(height_m: float = 6.0) -> F32:
    """A roof east of column 30."""
    return np.where(COLS >= 30, height_m, 0.0).astype(np.float32)


@settings(max_examples=30)
@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.integers(0, 2**32 - 1))
def test_pepper_on_a_slope_is_filled_by_the_slope(east: float, north: float, seed: int) -> None:
    plane = (CELL_M * (east * COLS - north * ROWS)).astype(np.float32)
    holes = np.random.default_rng(seed).random((SIZE, SIZE)) < 0.3
    found, new = cut(plane, holes)
    inner = np.zeros_like(holes)
    inner[4:-4, 4:-4] = True
    assert new[holes & inner].mean() > 0.98 and not new[~holes].any()
    assert np.nanmax(np.abs(found.height_m - plane)[inner]) < 0.25
    np.testing.assert_array_equal(found.height_m[~holes], plane[~holes])
    assert (found.sigma_m[new] > 0.099).all() and (found.rgb[new] == 90).all()


def test_ground_that_a_roof_hides_takes_the_lower_height() -> None:
    height = roof()
    holes = (COLS >= 24) & (COLS < 30)
    holes |= (COLS < 2) | (COLS > 57)
    found, new = cut(height, holes)
    middle = slice(15, 45)
    assert (found.height_m[middle, 24 : 30 - EDGE_CELLS] == 0.0).all()
    assert not new[:, 30 - EDGE_CELLS : 30].any()


def test_nothing_is_filled_below_a_doubtful_roof() -> None:
    height = roof()
    whole = raster_of(height)
    doubtful = (COLS >= 26) & (COLS < 34)
    spill = raster_of(np.where(doubtful, 6.0, height).astype(np.float32))
    _, new = filled(without_cells(whole, doubtful), spill)
    assert not new[:, 26:30].any()


def test_a_doubtful_height_that_fits_is_confirmed() -> None:
    gable = (3.0 + CELL_M * 0.8 * np.minimum(COLS, SIZE - 1 - COLS)).astype(np.float32)
    holes = (ROWS % 7 == 3) & (COLS % 7 == 3)
    whole = raster_of(gable)
    found, new = filled(without_cells(whole, holes), whole)
    assert new[holes & (ROWS > 3) & (COLS > 3)].mean() > 0.9
    assert np.abs(found.height_m - gable)[new].max() < 0.25


def test_a_bush_in_level_ground_is_not_erased() -> None:
    ground = np.zeros((SIZE, SIZE), np.float32)
    bush = (np.abs(ROWS - 30) < 3) & (np.abs(COLS - 30) < 3)
    certain = without_cells(raster_of(ground), bush)
    _, new = filled(certain, raster_of(np.where(bush, 1.5, ground).astype(np.float32)))
    assert not new.any()


def test_large_holes_and_the_outside_stay_unknown() -> None:
    height = np.full((SIZE, SIZE), np.nan, np.float32)
    height[10:50, 10:50] = 1.0
    height[18:42, 18:42] = np.nan
    found, _ = filled(raster_of(height), raster_of(height))
    assert not found.known[29:31, 29:31].any()
    outside = np.ones((SIZE, SIZE), bool)
    outside[10:50, 10:50] = False
    assert not found.known[outside].any()
    height[18:42, 18:42] = 1.0
    height[10:50, 30:34] = np.nan  # a gap across the survey
    assert filled(raster_of(height), raster_of(height))[0].known[20:40, 30:34].all()


def test_the_surface_model_of_a_plain_cloud_is_its_upper_surface() -> None:
    rng = np.random.default_rng(5)
    xyz = np.column_stack([rng.uniform(0, 10, (20_000, 2)), rng.normal(2.0, 0.02, 20_000)])
    grid = grid_over(xyz[:, :2], 0.25)
    colour = np.zeros((len(xyz), 3), np.uint8)
    model = surface_model(xyz, colour, np.full(len(xyz), 0.02, np.float32), grid)
    assert model.known.mean() > 0.99
    assert np.nanmax(np.abs(model.height_m - 2.0)) < 0.06


def test_a_hole_is_enclosed_and_a_bay_is_not() -> None:
    known = np.zeros((40, 60), np.bool_)
    known[5:35, 5:55] = True
    known[10:20, 10:20] = False  # a hole
    known[5:20, 35:45] = False  # a bay
    known[30:35, 25:27] = False  # a gap of two cells in the rim
    inside = outlined(known)
    assert inside[10:20, 10:20].all() and inside[31:34, 25:27].all()
    assert not inside[5:20, 36:44].any() and not inside[:4].any()
