"""Rasters against dictionaries of cells, planes with known shading, and holes with known edges."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recon.surface.raster import (
    Grid,
    Raster,
    fill_holes,
    grid_over,
    hillshade,
    rasterise,
    reliable,
    smoothed,
    standing_height,
)
from recon.types import F32, F64, PointCloud


def cloud(xyz: F64, sigma_m: float = 0.05, gray: int = 100) -> PointCloud:
    n = len(xyz)
    return PointCloud(
        np.asarray(xyz, np.float32),
        np.full((n, 3), gray, np.uint8),
        np.full(n, sigma_m, np.float32),
        np.ones(n, np.uint8),
    )


def raster_of(height: F32, cell_m: float = 1.0) -> Raster:
    rgb = np.full((*height.shape, 3), 120, np.uint8)
    sigma = np.where(np.isfinite(height), np.float32(0.1), np.float32(np.nan))
    return Raster(Grid(0.0, 0.0, cell_m, height.shape), height, sigma, rgb)


def test_grid_covers_its_points_on_whole_multiples() -> None:
    xy = np.array([[-3.2, 10.1], [4.9, 20.0]])
    grid = grid_over(xy, 0.5)
    west, south, east, north = grid.bounds
    assert (west, south, east, north) == (-3.5, 10.0, 5.0, 20.5)
    px = grid.pixels(np.array([[-3.25, 20.25]]))
    np.testing.assert_allclose(px, [[0.0, 0.0]])


def test_cells_of_places_on_and_off_the_grid() -> None:
    grid = Grid(10.0, 50.0, 2.0, (3, 4))  # east 10 to 18, north 44 to 50
    xy = np.array([[10.1, 49.9], [17.9, 44.1], [13.0, 47.0], [9.9, 47.0], [18.1, 43.9]])
    assert grid.holds(xy).tolist() == [True, True, True, False, False]
    rows, cols = grid.cells(xy)
    assert rows.tolist() == [0, 2, 1, 1, 2] and cols.tolist() == [0, 3, 1, 0, 3]
    assert grid.holds(np.array([[np.nan, 47.0], [12.0, np.inf]])).tolist() == [False, False]


def test_a_cell_is_the_weighted_mean_of_its_top_layer() -> None:
    rng = np.random.default_rng(0)
    n = 4000
    xyz = np.column_stack([rng.uniform(0, 10, (n, 2)), rng.normal(3.0, 0.05, n)])
    sigma = rng.uniform(0.03, 0.08, n).astype(np.float32)
    points = PointCloud(
        xyz.astype(np.float32),
        rng.integers(0, 255, (n, 3), dtype=np.uint8),
        sigma,
        np.ones(n, np.uint8),
    )
    raster = rasterise(points, grid_over(points.xyz_m[:, :2].astype(float), 1.0))
    for row in range(raster.grid.shape[0]):
        for col in range(raster.grid.shape[1]):
            x, y = points.xyz_m[:, 0], points.xyz_m[:, 1]
            north = raster.grid.north_m - row
            inside = (np.floor(x) == raster.grid.west_m + col) & (np.floor(y) == north - 1)
            z = points.xyz_m[inside, 2].astype(float)
            s = sigma[inside].astype(float)
            top = z.argmax()
            layer = z >= z[top] - 4.0 * s[top]
            w = 1 / s[layer] ** 2
            assert raster.height_m[row, col] == pytest.approx(w @ z[layer] / w.sum(), abs=1e-4)
            mean = w @ points.rgb[inside][layer] / w.sum()
            assert np.abs(raster.rgb[row, col] - mean).max() <= 1.0


def test_rows_that_are_summed_in_turn_join_without_a_seam() -> None:
    rng = np.random.default_rng(2)
    xyz = rng.uniform(0, [1024, 600, 5], (20_000, 3))
    whole = rasterise(cloud(xyz), Grid(0.0, 600.0, 1.0, (600, 1024)))
    for row in (0, 250, 500):
        part = rasterise(cloud(xyz), Grid(0.0, 600.0 - row, 1.0, (100, 1024)))
        np.testing.assert_array_equal(whole.height_m[row : row + 100], part.height_m)
        np.testing.assert_array_equal(whole.rgb[row : row + 100], part.rgb)


def test_a_roof_is_not_mixed_with_the_ground_below_it() -> None:
    xy = np.array([[0.5, 0.5]] * 30)
    z = np.r_[np.zeros(25), np.full(5, 6.0)]
    raster = rasterise(cloud(np.column_stack([xy, z])), Grid(0.0, 1.0, 1.0, (1, 1)))
    assert raster.height_m[0, 0] == pytest.approx(6.0)


def test_north_is_up_and_points_outside_are_left_out() -> None:
    xyz = np.array([[0.5, 9.5, 1.0], [9.5, 0.5, 2.0], [50.0, 50.0, 9.0]])
    raster = rasterise(cloud(xyz), Grid(0.0, 10.0, 1.0, (10, 10)))
    assert raster.height_m[0, 0] == 1.0
    assert raster.height_m[9, 9] == 2.0
    assert raster.known.sum() == 2
    assert raster.area_m2 == 2.0


def test_small_holes_are_filled_and_the_outline_stays() -> None:
    height = np.full((60, 60), np.nan, np.float32)
    _, cols = np.mgrid[10:50, 10:50]
    height[10:50, 10:50] = 0.1 * cols
    whole = height.copy()
    height[20:22, 20:22] = np.nan
    height[30:44, 30:44] = np.nan
    filled = fill_holes(raster_of(height), largest_cells=4)
    assert np.abs(filled.height_m[20:22, 20:22] - whole[20:22, 20:22]).max() < 0.15
    assert not filled.known[36:38, 36:38].any()  # too wide to guess
    outside = np.ones((60, 60), bool)
    outside[10:50, 10:50] = False
    assert not filled.known[outside].any()
    assert filled.sigma_m[20, 20] == pytest.approx(0.2)
    kept = np.isfinite(height)
    np.testing.assert_array_equal(filled.height_m[kept], height[kept])


def test_a_hole_takes_the_mean_of_the_smallest_window_that_knows_anything() -> None:
    rng = np.random.default_rng(4)
    known = rng.random((40, 50)) > 0.4
    known[12:16, 20:25] = False
    height = np.where(known, rng.normal(5, 1, known.shape), np.nan).astype(np.float32)
    raster = raster_of(height)
    raster.rgb[:] = rng.integers(0, 256, raster.rgb.shape)
    filled = fill_holes(raster, largest_cells=4)
    holes = np.argwhere(filled.known & ~known)
    assert len(holes) > 500
    for r, c in holes:
        for reach in range(1, 5):
            here = (
                slice(max(r - reach, 0), r + reach + 1),
                slice(max(c - reach, 0), c + reach + 1),
            )
            if known[here].any():
                break
        assert filled.height_m[r, c] == pytest.approx(height[here][known[here]].mean(), abs=1e-5)
        mean = raster.rgb[here][known[here]].mean(axis=0)
        np.testing.assert_allclose(filled.rgb[r, c], mean, atol=0.51)


@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (0.3, 0.0), (0.0, -0.5), (0.2, 0.4)])
def test_shading_of_a_plane_is_the_cosine_to_the_sun(east: float, north: float) -> None:
    rows, cols = np.mgrid[0:20, 0:30].astype(float)
    cell = 0.5
    height = (east * cols * cell - north * rows * cell).astype(np.float32)
    shade = hillshade(height, cell)
    normal = np.array([-east, -north, 1.0]) / math.sqrt(1 + east**2 + north**2)
    h = math.sqrt(0.5)
    sun = np.array([-math.sqrt(0.5) * h, math.sqrt(0.5) * h, h])
    np.testing.assert_allclose(shade, max(normal @ sun, 0.0), atol=1e-4)


def test_unknown_cells_have_no_shade_and_do_not_spoil_their_neighbours() -> None:
    height = np.zeros((9, 9), np.float32)
    height[4, 4] = np.nan
    shade = hillshade(height, 1.0)
    assert np.isnan(shade[4, 4])
    np.testing.assert_allclose(shade[np.isfinite(height)], math.sqrt(0.5), atol=1e-6)


def test_a_large_map_is_smoothed_and_shaded_without_seams() -> None:
    """Of a plane with waves across the slope, each row is as the one a wavelength further."""
    rows, columns = np.mgrid[:600, :40]
    height = (0.5 * columns + np.sin(2.0 * np.pi * rows / 50.0)).astype(np.float32)
    smooth = smoothed(raster_of(height)).height_m
    shade = hillshade(height, 1.0)
    for values in (smooth, shade):
        inner = values[10:-10]
        assert inner[:-50] == pytest.approx(inner[50:], abs=1e-3)
    assert float(np.ptp(shade)) > 0.05


def test_grids_are_checked() -> None:
    with pytest.raises(ValueError, match="too large"):
        Grid(0.0, 0.0, 0.1, (100_000, 100_000))
    with pytest.raises(ValueError, match="cell_m"):
        Grid(0.0, 0.0, 0.0, (1, 1))
    with pytest.raises(ValueError, match=r"\(N, 2\)"):
        grid_over(np.zeros((0, 2)), 1.0)


def step_raster(sigma: F32) -> Raster:
    """A roof 5 m high east of column 20."""
    height = np.zeros((40, 40), np.float32)
    height[:, 20:] = 5.0
    return Raster(Grid(0.0, 0.0, 0.25, (40, 40)), height, sigma, np.full((40, 40, 3), 50, np.uint8))


def test_a_smear_down_a_wall_is_no_surface_but_a_steep_roof_is() -> None:
    raster = step_raster(np.full((40, 40), 0.05, np.float32))
    for n, column in enumerate(range(16, 20)):
        raster.height_m[:, column] = 1.0 + n
    left = reliable(raster)
    assert not left.known[:, 16:20].any()
    assert left.known[:, :16].all()
    x = 0.25 * np.arange(40, dtype=np.float32)
    roof = np.tile(np.minimum(x, x[::-1]), (40, 1))  # 45 degrees up and down
    one = Raster(raster.grid, roof, np.full((40, 40), 0.05, np.float32), raster.rgb)
    assert reliable(one).known.all()


def test_of_cells_above_a_step_the_uncertain_are_left_out() -> None:
    sigma = np.full((40, 40), 0.08, np.float32)
    sigma[:, 20:22] = 0.3  # the spill next to the roof: few views
    left = reliable(step_raster(sigma))
    assert not left.known[:, 20:22].any()
    assert left.known[:, 23:].all() and left.known[:, :20].all()
    sigma[:, 20:22] = 0.02  # an edge that is well seen
    assert reliable(step_raster(sigma)).known[:, 20:22].all()


def test_crumbs_high_above_the_ground_are_left_out_and_a_roof_stays() -> None:
    height = np.zeros((60, 60), np.float32)
    height[10:25, 10:25] = 5.0
    height[35:50, 35:50] = np.nan  # what a tree hides, with crumbs of its crown
    height[38:48:4, 38:48:4] = 6.0
    found = reliable(raster_of(height, 0.25)).height_m
    assert np.isnan(found[35:50, 35:50]).all()
    assert (found[14:21, 14:21] == 5.0).all()
    assert np.isfinite(found[:8]).all()


def test_standing_height_is_that_of_the_things_on_the_ground() -> None:
    height = np.tile(np.linspace(0.0, 3.0, 100, dtype=np.float32), (100, 1))  # a gentle slope
    assert standing_height(raster_of(height, 0.25)) < 0.6
    height[40:60, 40:60] += 5.0
    assert 4.9 < standing_height(raster_of(height, 0.25)) < 5.6
    assert standing_height(raster_of(np.full((5, 5), np.nan, np.float32))) == 0.0
