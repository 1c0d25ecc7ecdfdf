"""Heights between known ones: smooth, exact on slopes, and complete inside the outline."""

from __future__ import annotations

import numpy as np
import pytest

from recon.surface.harmonic import between
from recon.surface.hole_filling import completed, outline
from recon.surface.raster import Grid, Raster
from recon.types import F32, Bool

CELL_M = 0.25
ROWS, COLS = np.mgrid[:200, :240]


def surface(height_m: F32, known: Bool) -> Raster:
    height = np.where(known, height_m, np.nan).astype(np.float32)
    sigma = np.where(known, 0.05, np.nan).astype(np.float32)
    rgb = np.where(known & (height_m > 3.0), 200, 50).astype(np.uint8)[..., None].repeat(3, axis=2)
    return Raster(Grid(0.0, 0.0, CELL_M, (known.shape[0], known.shape[1])), height, sigma, rgb)


def test_a_slope_runs_on_below_a_building() -> None:
    slope = (400.0 + CELL_M * (0.1 * COLS + 0.05 * ROWS)).astype(np.float32)
    fixed = np.ones(slope.shape, np.bool_)
    fixed[60:120, 80:160] = False
    found = between(np.where(fixed, slope, np.nan).astype(np.float32), fixed, ~fixed, CELL_M)
    assert np.abs(found - slope).max() < 0.06
    assert np.abs(np.diff(found, axis=1)).max() < 0.08  # 2.5 cm a cell, and no step at the border


def test_between_two_heights_nothing_is_higher_or_lower() -> None:
    height = np.where(COLS < 100, 10.0, 14.0).astype(np.float32)
    fixed = (COLS < 60) | (COLS > 180)
    found = between(height, fixed, ~fixed, CELL_M)
    assert (np.diff(found[100]) > -1e-3).all() and found.min() >= 9.99 and found.max() <= 14.01


def test_what_is_mirrored_is_filled_alike() -> None:
    height = (3e-4 * ((ROWS - 60) ** 2 + COLS**2)).astype(np.float32)
    fixed = np.hypot(ROWS - 90, COLS - 130) > 50
    found = between(height, fixed, ~fixed, CELL_M)
    for axes in (0, 1):
        turned, known = np.flip(height, axes).copy(), np.flip(fixed, axes).copy()
        other = between(turned, known, ~known, CELL_M)
        np.testing.assert_allclose(np.flip(other, axes), found, atol=0.05)  # ties of the nearest


def test_a_difference_to_the_known_heights_fades_out_over_a_metre() -> None:
    height = np.zeros(ROWS.shape, np.float32)
    fixed = COLS < 100
    height[100, 99] = 1.0  # its block of two by two cells has a fourth of that
    found = between(height, fixed, ~fixed, CELL_M)[100, 100:]
    assert found[0] > 0.6 and found[0] - found[1] < 0.25
    assert 0.2 * found[0] < found[4] < 0.6 * found[0] and found[16] < 0.1


def test_every_cell_inside_is_filled_from_the_lower_side() -> None:
    """A roof of 6 m with a hole, and a gap of 1.5 m around it."""
    roof = (np.abs(ROWS - 100) < 40) & (np.abs(COLS - 120) < 40)
    truth = np.where(roof, 6.0, 0.0).astype(np.float32)
    known = np.ones(truth.shape, np.bool_)
    ring = (np.abs(ROWS - 100) < 46) & (np.abs(COLS - 120) < 46) & ~roof
    hole = (np.abs(ROWS - 100) < 5) & (np.abs(COLS - 120) < 5)
    known[ring | hole] = False
    known[::7, ::3] = False  # voxels leave single cells without a point
    inside = np.ones(truth.shape, np.bool_)
    low_m, unsure = np.zeros(truth.shape, np.float32), np.zeros(truth.shape, np.bool_)
    whole = completed(surface(truth, known), low_m, inside, unsure)
    assert whole.known.all() and (whole.sigma_m[~known] > 0.05).all()
    edge = ring & (np.maximum(np.abs(ROWS - 100), np.abs(COLS - 120)) < 42)
    wrong = np.abs(whole.height_m - truth) > 0.1
    wrong |= (whole.rgb[..., 0] > 100) != roof
    assert not wrong[~edge].any()  # next to the roof a cell may be roof


def test_the_outline_has_no_teeth_and_no_holes() -> None:
    known = np.zeros((200, 240), np.bool_)
    known[20:180, 20:220] = True
    known[60:140, 80:160] = False  # a lake
    known[10:20, 30:200:8] = True  # teeth of two cells
    known[10:20, 31:200:8] = True
    known[5, 5] = True  # a stray point
    far = known.copy()
    far[185:, 40:180] = True  # and what only doubtful cells show
    inside = outline(far, known, CELL_M)
    assert not inside[195:].any()
    assert inside[60:140, 80:160].all() and not inside[:12].any() and not inside[5, 5]
    assert inside[30:170, 30:210].all()


def test_nothing_is_made_of_nothing() -> None:
    none = np.zeros((20, 20), np.bool_)
    low = np.zeros((20, 20), np.float32)
    assert not completed(surface(low, none), low, ~none, none).known.any()
    np.testing.assert_array_equal(between(low, none, ~none, CELL_M), low)
    assert outline(none, none, CELL_M).sum() == pytest.approx(0)
