"""The bare ground below houses and trees on a hill that is known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from recon.surface.ground import BareGround, ground_cells, terrain
from recon.surface.raster import Grid, Raster
from recon.types import F32, Bool

CELL_M = 0.25
SIDE = 320
ROWS, COLS = np.mgrid[0:SIDE, 0:SIDE]
X, Y = CELL_M * COLS, CELL_M * ROWS


def hill() -> F32:
    slope = 0.06 * X + 1.5 * np.sin(X / 17.0) * np.cos(Y / 23.0)
    return np.asarray(slope + np.random.default_rng(3).normal(0.0, 0.03, X.shape), np.float32)


def things() -> F32:
    """Heights above the ground: a hall 20 m wide, a gabled house, a crown, a car."""
    out = np.zeros(X.shape)
    out[(abs(X - 20) < 10) & (abs(Y - 20) < 12)] = 7.0
    house = (abs(X - 55) < 5) & (abs(Y - 20) < 7)
    out[house] = (7.0 - 0.6 * abs(X - 55))[house]
    crown = np.hypot(X - 25, Y - 60) < 3.0
    out[crown] = 8.0 - np.hypot(X - 25, Y - 60)[crown]
    out[(abs(X - 60) < 1.0) & (abs(Y - 60) < 2.2)] = 1.5
    return out.astype(np.float32)


def raster(height: F32) -> Raster:
    grid = Grid(0.0, 0.0, CELL_M, height.shape)
    sigma = np.full(height.shape, 0.05, np.float32)
    return Raster(grid, height, sigma, np.zeros((*height.shape, 3), np.uint8))


def within(bare: BareGround) -> F32:
    """Heights within the outline; NaN beyond."""
    return np.where(bare.is_inside, bare.everywhere_m, np.float32(np.nan)).astype(np.float32)


def holes() -> Bool:
    return np.asarray(np.random.default_rng(4).random(X.shape) < 0.1)


@pytest.mark.slow
def test_what_stands_on_a_hill_is_taken_off_and_the_hill_stays() -> None:
    ground, above = hill(), things()
    surface = np.where(holes(), np.float32(np.nan), ground + above).astype(np.float32)
    kept = ground_cells(raster(surface))
    assert not kept[above > 0.5].any()
    clear = np.hypot(X - 40, Y - 40) < 6.0
    assert kept[clear & np.isfinite(surface)].all()
    bare = terrain(raster(surface))
    found, is_bridged = within(bare), bare.is_bridged
    inner = np.s_[4:-4, 4:-4]
    assert np.isfinite(found[inner]).all() and is_bridged[above > 0.5].all()
    error = found - ground
    assert np.sqrt(np.mean(error[inner][above[inner] == 0] ** 2)) < 0.1
    assert np.sqrt(np.mean(error[above > 0] ** 2)) < 0.6  # the hill bends below the hall


def test_the_outline_does_not_grow() -> None:
    surface = hill()
    surface[:, :100] = np.nan
    bare = terrain(raster(surface))
    found = within(bare)
    assert np.isnan(found[:, :100]).all() and np.isfinite(found[:, 100:]).all()
    assert np.isfinite(bare.everywhere_m).all()  # beyond the outline that of the nearest


@pytest.mark.parametrize("known", [0, 1])
def test_a_model_of_nothing_or_one_cell_is_no_trouble(known: int) -> None:
    surface = np.full((9, 9), np.nan, np.float32)
    surface[4, 4 : 4 + known] = 3.0
    bare = terrain(raster(surface))
    assert np.isfinite(within(bare)).sum() == known and not bare.is_bridged.any()


def test_ground_on_one_line_is_no_trouble() -> None:
    surface = np.full((9, 9), np.nan, np.float32)
    surface[np.arange(9), np.arange(9)] = 3.0
    bare = terrain(raster(surface))
    assert (bare.everywhere_m == 3.0).all() and bare.is_inside.sum() == 9
