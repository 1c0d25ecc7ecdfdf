"""The orthophoto of a block on level ground, drawn by exact ray casting, against its true map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.surface.orthophoto import Terrain, chosen_views, one_view_each, orthophoto
from recon.surface.raster import Grid, Raster, round_cell
from recon.surface.texture_views import TextureView, TriangleViews
from recon.types import F64, U8, Bool

CELL_M = 0.5
SIDE = 48
TOP_M = 6.0
BLOCK = (9.0, 9.0, 15.0, 15.0)  # west, south, east, north
FINE_M = 0.1


def on_block(x: F64, y: F64) -> Bool:
    west, south, east, north = BLOCK
    return np.asarray((x > west) & (x < east) & (y > south) & (y < north))


def colour(x: F64, y: F64, is_top: Bool) -> F64:
    """(N, 3) BGR: waves of 3 m on the ground, red on the block."""
    waves = 110.0 + 40.0 * np.sin(2.1 * x) * np.cos(2.1 * y)
    ground = np.stack([waves, waves + 20.0, waves - 20.0], axis=-1)
    return np.where(is_top[..., None], np.array([30.0, 30.0, 200.0]), ground)


def view(x: float, y: float, gain: float = 1.0) -> TextureView:
    """An image straight down from 30 m, by the exact intersection of every ray."""
    w, h, focal = 400, 300, 320.0
    K = np.array([[focal, 0.0, (w - 1) / 2], [0.0, focal, (h - 1) / 2], [0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = x, y, 30.0
    v, u = np.indices((h, w)).astype(float)
    east, north = (u - K[0, 2]) / focal, -(v - K[1, 2]) / focal
    top_x, top_y = x + east * (30.0 - TOP_M), y + north * (30.0 - TOP_M)
    is_top = on_block(top_x, top_y)
    wall = np.zeros_like(is_top)
    for share in np.linspace(0.0, 1.0, 60):
        reach = 30.0 - TOP_M * share
        wall |= on_block(x + east * reach, y + north * reach)
    ground = colour(x + east * 30.0, y + north * 30.0, np.zeros_like(is_top))
    bgr = np.where(wall[..., None], 10.0, ground)
    bgr = np.where(is_top[..., None], np.array([30.0, 30.0, 200.0]), bgr) * gain
    alpha = np.full((h, w, 1), 255.0)
    return TextureView(np.dstack([bgr, alpha]).clip(0, 255).astype(np.uint8), K, T)


def terrain(views: list[TextureView]) -> Terrain:
    grid = Grid(0.0, SIDE * CELL_M, CELL_M, (SIDE, SIDE))
    rows, cols = np.indices(grid.shape)
    x, y = (cols + 0.5) * CELL_M, grid.north_m - (rows + 0.5) * CELL_M
    height = np.where(on_block(x, y), TOP_M, 0.0).astype(np.float32)
    height[:2] = np.nan
    sigma = np.full(grid.shape, 0.1, np.float32)
    raster = Raster(grid, height, sigma, np.full((*grid.shape, 3), 77, np.uint8))
    places = np.stack([x, y, np.nan_to_num(height).astype(float)], axis=-1)
    return Terrain(raster, places, np.array([v.T_world_camera[:3, 3] for v in views]))


FINE = Grid(0.0, SIDE * CELL_M, FINE_M, (240, 240))


def true_map() -> U8:
    rows, cols = np.indices(FINE.shape)
    x, y = (cols + 0.5) * FINE_M, FINE.north_m - (rows + 0.5) * FINE_M
    return colour(x, y, on_block(x, y))[..., ::-1].clip(0, 255).astype(np.uint8)


def away_from_walls(metres: float) -> Bool:
    rows, cols = np.indices(FINE.shape)
    x, y = (cols + 0.5) * FINE_M, FINE.north_m - (rows + 0.5) * FINE_M
    west, south, east, north = BLOCK
    to_wall = np.maximum(np.abs(x - (west + east) / 2), np.abs(y - (south + north) / 2)) - 3.0
    return np.asarray(np.abs(to_wall) > metres)


def test_every_place_shows_what_stands_there_and_no_wall() -> None:
    views = [view(x, y) for x in (5.0, 12.0, 19.0) for y in (5.0, 12.0, 19.0)]
    rgb, known = orthophoto(terrain(views), views, FINE)
    assert not known[:10].any() and known[11:].all()
    off = np.abs(rgb.astype(int) - true_map().astype(int)).max(axis=2)
    checked = known & away_from_walls(0.6)
    assert (off[checked] < 16).mean() > 0.995
    # A roof that leans away from the middle of an image would cover ground next to the block.
    red = (rgb[..., 0] > 150) & (rgb[..., 1] < 60) & away_from_walls(0.6)
    assert red.sum() == pytest.approx(
        away_from_walls(0.6)[(true_map()[..., 1] == 30)].sum(), rel=0.02
    )


def test_ground_that_no_view_sees_takes_the_colour_of_the_model() -> None:
    views = [view(-2.0, 12.0)]
    rgb, known = orthophoto(terrain(views), views, FINE)
    hidden = np.s_[110:130, 152:156]  # 15.2 to 15.6 m east, right behind the block
    assert known[hidden].all() and (np.abs(rgb[hidden].astype(int) - 77) < 12).mean() > 0.9


def test_colours_of_the_model_run_evenly_from_cell_to_cell() -> None:
    views = [view(200.0, 200.0)]  # of other ground
    land = terrain(views)
    land.raster.rgb[:] = (4 * np.arange(SIDE))[None, :, None]
    rgb, known = orthophoto(land, views, FINE)
    row = rgb[220, 3:237, 0].astype(int)
    assert known[220].all() and np.ptp(row) > 180 and np.diff(row).min() >= 0
    assert np.diff(row).max() <= 1


def test_a_roof_that_the_model_has_too_narrow_is_not_seen_on_the_ground_behind() -> None:
    views = [view(2.0, 12.0)]
    land = terrain(views)
    height, places = land.raster.height_m.copy(), land.places_m.copy()
    height[:, 29] = 0.0  # the block's last column, 14.5 to 15 m east
    places[:, 29, 2] = 0.0
    narrow = Terrain(replace(land.raster, height_m=height), places, land.eyes_m)
    rgb, _ = orthophoto(narrow, views, FINE)
    behind = np.s_[100:140, 155:200]
    assert not ((rgb[behind][..., 0] > 150) & (rgb[behind][..., 1] < 60)).any()


def test_exposures_are_levelled() -> None:
    plain = [view(x, 12.0) for x in (6.0, 12.0, 18.0)]
    uneven = [view(x, 12.0, gain) for x, gain in ((6.0, 0.8), (12.0, 1.0), (18.0, 1.2))]
    ground = away_from_walls(2.0)
    ground[:12] = False
    ground &= true_map()[..., 1] != 30
    want, _ = orthophoto(terrain(plain), plain, FINE)
    found, _ = orthophoto(terrain(uneven), uneven, FINE)
    ratio = found[ground].astype(float).mean(axis=1) / want[ground].astype(float).mean(axis=1)
    columns = np.broadcast_to(np.arange(240), (240, 240))[ground]
    west, east = ratio[columns < 80].mean(), ratio[columns > 160].mean()
    assert abs(west / east - 1.0) < 0.1  # 0.67 without


def test_an_image_that_is_brighter_in_one_part_leaves_no_seam() -> None:
    plain = [view(x, 12.0) for x in (4.0, 12.0, 20.0)]
    shade = np.linspace(1.3, 0.7, 400)[:, None]  # no gain of a whole image removes it
    shaded = [*plain[:1], view(12.0, 12.0), *plain[2:]]
    shaded[1].bgra[..., :3] = (shaded[1].bgra[..., :3] * shade).clip(0, 255)
    want, _ = orthophoto(terrain(plain), plain, FINE)
    found, _ = orthophoto(terrain(shaded), shaded, FINE)
    clear = np.s_[30:80], np.s_[5:235]  # north of the block
    ratio = (found[clear].astype(float).sum(axis=2) / want[clear].sum(axis=2)).mean(axis=0)
    assert np.abs(ratio[10:] - ratio[:-10]).max() < 0.025  # 0.037 with gains alone


def test_no_seam_runs_across_an_object_that_one_view_sees() -> None:
    view = np.array([[0, 1, 2], [0, 1, -1], [1, 0, 2], [1, 0, -1], [2, -1, -1], [0, 2, -1]])
    px = np.array([[9, 8, 1], [9, 8, 0], [9, 8, 1], [9, 7, 0], [5, 0, 0], [9, 1, 0]])
    found = TriangleViews(
        view.astype(np.int32), px.astype(np.float32), np.zeros((6, 3, 3), np.float32)
    )
    objects = np.array([3, 3, 3, 3, 3, 0], np.int32)
    label = found.view[:, 0]
    assert one_view_each(found, objects, label).tolist() == [1, 1, 1, 1, 2, 0]  # 34 px against 33
    assert one_view_each(found, 0 * objects, label).tolist() == label.tolist()


def test_neighbours_show_one_view_where_that_costs_little_resolution() -> None:
    rng = np.random.default_rng(1)
    shape = 12, 20
    px = 10.0 + 0.2 * rng.standard_normal((*shape, 2))
    px[:, 10:, 1] += 5.0  # the second view is nearer there
    px[3, 4] = 0.0, 9.0
    best = np.argsort(-px, axis=2)
    view = np.where(np.take_along_axis(px, best, 2) > 0.0, best, -1).reshape(-1, 2)
    view[7] = -1
    px = np.take_along_axis(px, best, 2).reshape(-1, 2)
    found = TriangleViews(
        view.astype(np.int32), px.astype(np.float32), np.zeros((len(view), 2, 3), np.float32)
    )
    label = chosen_views(found, shape).reshape(shape)
    assert label[0, 7] == -1 and label[3, 4] == 1
    assert (label[:, 10:] == 1).all()
    west = label[:, :9]
    assert np.unique(west[west >= 0], return_counts=True)[1].max() > 0.9 * west.size


def test_what_shines_in_one_view_alone_has_no_edge_at_the_seam() -> None:
    """As a wet road does. It is narrower than the field that levels an image's parts."""
    views = [view(x, 12.0) for x in (8.0, 16.0)]
    views[0].bgra[60:84, :, :3] += 40  # a road from west to east, 2 m wide, at 18 to 20 m north
    found, _ = orthophoto(terrain(views), views, FINE)
    road = found[45:55, 5:235].astype(float).mean(axis=(0, 2))
    rest = true_map()[45:55, 5:235].astype(float).mean(axis=(0, 2))
    shine = np.convolve(road - rest, np.ones(5) / 5, mode="valid")
    assert shine.max() - shine.min() > 15.0
    assert np.abs(shine[10:] - shine[:-10]).max() < 0.4 * (shine.max() - shine.min())


def test_a_slanted_edge_runs_across_cells_not_around_them() -> None:
    far = view(1e4, 1e4)  # shows nothing: the model's own colours are painted
    flat = terrain([far])
    grid, fine = flat.raster.grid, FINE.centres(*np.indices(FINE.shape).reshape(2, -1))
    rows, cols = np.indices(grid.shape).reshape(2, -1)

    def is_high(xy: F64) -> Bool:
        return np.asarray(xy[:, 0] + 0.4 * xy[:, 1] < 15.3)

    high = is_high(grid.centres(rows, cols)).reshape(grid.shape)
    height = np.where(high, np.float32(TOP_M), np.float32(0.0))
    rgb = np.where(high[..., None], np.uint8(200), np.uint8(50)).repeat(3, axis=2)
    raster = Raster(grid, height, flat.raster.sigma_m, rgb)
    places = np.dstack([flat.places_m[..., :2], height])
    found, known = orthophoto(Terrain(raster, places, flat.eyes_m), [far], FINE)
    wrong = (found[..., 0] > 125) != is_high(fine).reshape(FINE.shape)
    around = rgb[grid.cells(fine)][:, 0].reshape(FINE.shape) > 125
    stairs = around != is_high(fine).reshape(FINE.shape)
    assert known.all() and wrong.sum() < 0.7 * stairs.sum()


@pytest.mark.parametrize(
    ("cell", "down", "up"),
    [(0.0627, 0.06, 0.08), (0.05, 0.05, 0.05), (0.225, 0.2, 0.25), (0.99, 0.8, 1.0),
     (1.0, 1.0, 1.0), (13.0, 12.0, 15.0)],
)  # fmt: skip
def test_cells_are_round(cell: float, down: float, up: float) -> None:
    assert round_cell(cell) == pytest.approx(down) and round_cell(cell, up=True) == pytest.approx(
        up
    )
