"""Invented points go, true ones stay: over flat ground with known roofs; tiles in view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from recon.mapping.cloud_fusion import cloud_of
from recon.mapping.free_space import MAX_VIEWS, Tiles, air_above, seen_through, spread
from recon.types import F64, DepthMap, PointCloud

if TYPE_CHECKING:
    from house_flight import HouseFlight


def flyers(n: int, height_m: float) -> PointCloud:
    """A blob of points in the air above the ground east of the house."""
    rng = np.random.default_rng(0)
    xyz = np.array([22.0, -4.0, height_m]) + rng.uniform(-0.3, 0.3, (n, 3))
    return PointCloud(
        xyz.astype(np.float32),
        np.zeros((n, 3), np.uint8),
        np.full(n, 0.1, np.float32),
        np.ones(n, np.uint8),
    )


def test_true_surface_is_kept(house: HouseFlight) -> None:
    keyframes = [house.keyframe(k, 5.0 * k) for k in range(5)]
    maps = [k.depth for k in keyframes]
    for k in keyframes:
        gone = seen_through(cloud_of(k.depth, k.bgr), maps)
        assert gone.mean() < 0.002  # at most at the walls


@pytest.mark.parametrize("height_m", [2.0, 5.0, 15.0])
def test_a_blob_that_others_see_through_is_found(house: HouseFlight, height_m: float) -> None:
    maps = [house.keyframe(k, 5.0 * k).depth for k in range(5)]
    assert seen_through(flyers(50, height_m), maps).all()


def test_who_confirms_counts_as_much_as_who_contradicts(house: HouseFlight) -> None:
    blob = flyers(200, 5.0)
    seer = house.keyframe(0, 22.0).depth
    h, w = seer.depth_m.shape
    inventor = DepthMap(
        np.full((h, w), 35.0, np.float32),
        seer.sigma_m,
        np.full((h, w), 3, np.uint8),
        seer.K,
        seer.T_world_camera,
    )
    assert not seen_through(blob, [inventor]).any()
    assert seen_through(blob, [seer]).all()
    assert not seen_through(blob, [inventor, seer]).any()  # three pairs against two
    assert seen_through(blob, [inventor, seer, seer]).all()


def test_points_out_of_every_view_are_kept(house: HouseFlight) -> None:
    blob = flyers(10, 5.0)
    away = house.keyframe(0, 500.0).depth
    blank = house.keyframe(0, 22.0).depth
    blank.depth_m[:] = np.nan
    assert not seen_through(blob, [away, blank]).any()
    assert not seen_through(blob, []).any()


def test_the_first_keyframes_asked_decide(house: HouseFlight) -> None:
    """A camera that hovers is asked a limited number of times."""
    blob = flyers(50, 5.0)
    seer = house.keyframe(0, 22.0).depth
    inventor = replace(seer, depth_m=np.full_like(seer.depth_m, 35.0))
    asked = [0]

    def views(*numbers: int) -> Iterator[DepthMap]:
        for view, number in zip((seer, inventor), numbers, strict=True):
            for _ in range(number):
                asked[0] += 1
                yield view

    assert seen_through(blob, views(MAX_VIEWS, 3 * MAX_VIEWS)).all()
    assert asked == [4 * MAX_VIEWS]
    assert not seen_through(blob, views(MAX_VIEWS // 2 - 1, MAX_VIEWS)).any()


@pytest.mark.parametrize("count", [0, 1, 7, 1000])
def test_views_are_spread_over_the_flight(count: int) -> None:
    order = spread(range(count))
    assert sorted(order) == list(range(count))
    for asked in (10, 64):
        if count > 10 * asked:
            gaps = np.diff(np.sort([*order[:asked], 0, count]))
            assert gaps.max() < 3 * count / asked  # of evenly spread ones, 1


def test_unknown_surroundings_are_no_evidence(house: HouseFlight) -> None:
    blob = flyers(50, 5.0)
    sparse = house.keyframe(0, 22.0).depth
    keep = np.zeros(sparse.depth_m.shape, bool)
    keep[::3, ::3] = True
    sparse.depth_m[~keep] = np.nan
    assert not seen_through(blob, [sparse]).any()


def test_ground_is_open_where_a_ray_passes_above_it(house: HouseFlight) -> None:
    """Against the cone of one camera: 4 m above the ground it is a tenth narrower."""
    one = house.keyframe(0, -100.0).depth  # over level ground only
    x, y = np.meshgrid(np.linspace(-130.0, -70.0, 121), np.linspace(-16.0, 16.0, 65))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    found = np.asarray(air_above(ground, (2.0, 4.0), [one])[0].all(axis=1))
    half = 36.0 * np.array([80.0, 45.0]) / 140.0  # the image's half size, 4 m up
    gap = (np.abs(ground[:, :2] - [-100.0, 0.0]) - half).max(axis=1)
    assert found[gap < -0.3].all() and not found[gap > 0.3].any()


def test_ground_below_an_eave_is_not_open(house: HouseFlight) -> None:
    """A roof 3 m up hides what is above it from the camera that sees both."""
    flat = house.keyframe(0, -100.0).depth
    depth = flat.depth_m.copy()
    depth[40:50, 70:90] = 37.0
    roofed = replace(flat, depth_m=depth)
    below = np.array([[-100.0, 0.0, 0.0], [-90.0, 5.0, 0.0]])
    is_open, behind = air_above(below, (2.0,), [roofed, roofed])
    assert is_open.tolist() == [[False], [True]] and behind[0] == 2
    assert air_above(below, (2.0,), [roofed, flat])[0].all()  # another saw it before it was built
    is_open, behind = air_above(below, (2.0,), [])
    assert not is_open.any() and not behind.any()
    inside = below + np.array([0.0, 0.0, 2.9])
    is_open, behind = air_above(inside, (0.0, 2.0), [roofed])
    assert is_open.tolist() == [[False, True], [True, True]] and behind[0].tolist() == [1, 0]
    unknown = replace(flat, depth_m=np.full_like(depth, np.nan))
    is_open, behind = air_above(below, (2.0,), [unknown])
    assert not is_open.any() and not behind.any()


def ground(n: int, seed: int = 0) -> F64:
    """Places in a landscape, one of them far away."""
    rng = np.random.default_rng(seed)
    out: F64 = rng.uniform([-300.0, -200.0, -3.0], [300.0, 200.0, 12.0], (n, 3))
    out[0] = [9e3, -7e3, 0.0]
    return out


def test_tiles_keep_every_place_once_and_neighbours_together() -> None:
    places = ground(40_000)
    tiles = Tiles(places)
    assert 10 < len(tiles) < 200
    assert sorted(tiles.order) == list(range(len(places)))
    assert np.array_equal(tiles.xyz_m, places[tiles.order].astype(np.float32))
    assert tiles.first[0] == 0 and tiles.first[-1] == len(places)
    parts = np.split(tiles.xyz_m, tiles.first[1:-1])
    widest = [np.ptp(part[:, :2], axis=0).max() for part in parts]
    assert max(widest) < 0.25 * 600.0
    assert len(Tiles(places[:0])) == 0 and len(Tiles(places[:1])) == 1
    in_line = places * [1.0, 0.0, 0.0]  # without an area
    assert 10 < len(Tiles(in_line)) < 2000


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 60.0])
@pytest.mark.parametrize("up_m", [-1.0, 0.0, 8.0])
def test_every_place_in_the_image_lies_in_a_tile_in_view(
    house: HouseFlight, tilt_deg: float, up_m: float
) -> None:
    """Against the projection of each place by itself."""
    tiles = Tiles(ground(300_000))
    level = house.keyframe(0, 20.0).depth
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    T = level.T_world_camera.copy()
    T[:3, :3] = T[:3, :3] @ [[1, 0, 0], [0, c, -s], [0, s, c]]
    depth = replace(level, T_world_camera=T)
    far_m = float(np.nanmax(depth.depth_m)) + 5.0
    xyz = tiles.xyz_m + np.array([0.0, 0.0, up_m], np.float32)
    inside = (xyz - T[:3, 3]) @ T[:3, :3]
    uv = inside @ depth.K.T
    h, w = depth.depth_m.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = uv[:, 0] / uv[:, 2], uv[:, 1] / uv[:, 2]
    seen = (inside[:, 2] > 0) & (inside[:, 2] < far_m) & (abs(u - w / 2) < w / 2)
    seen &= abs(v - h / 2) < h / 2
    assert seen.sum() > 100
    found = tiles.in_view(depth, slack_m=5.0, up_m=(min(up_m, 0.0), max(up_m, 0.0)))
    tile_of = np.repeat(np.arange(len(tiles)), np.diff(tiles.first))
    assert set(tile_of[seen]) <= set(found)
    assert len(found) < 0.5 * len(tiles)  # and most of the others are left out
    blank = replace(depth, depth_m=np.full((h, w), np.nan, np.float32))
    assert len(tiles.in_view(blank)) == 0
