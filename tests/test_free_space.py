"""Invented points go, true ones stay: over flat ground with known roofs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from recon.clouds.cloud_fusion import cloud_of
from recon.clouds.free_space import open_above, seen_through
from recon.types import DepthMap, PointCloud

if TYPE_CHECKING:
    from conftest import HouseFlight


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


def test_points_that_nobody_looks_at_are_kept(house: HouseFlight) -> None:
    blob = flyers(10, 5.0)
    away = house.keyframe(0, 500.0).depth
    blank = house.keyframe(0, 22.0).depth
    blank.depth_m[:] = np.nan
    assert not seen_through(blob, [away, blank]).any()
    assert not seen_through(blob, []).any()


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
    found = open_above(ground, (2.0, 4.0), [one])
    half = 36.0 * np.array([80.0, 45.0]) / 140.0  # the picture's half size, 4 m up
    gap = (np.abs(ground[:, :2] - [-100.0, 0.0]) - half).max(axis=1)
    assert found[gap < -0.3].all() and not found[gap > 0.3].any()


def test_ground_below_an_eave_is_not_open(house: HouseFlight) -> None:
    """A roof 3 m up hides what is above it from the camera that sees both."""
    flat = house.keyframe(0, -100.0).depth
    depth = flat.depth_m.copy()
    depth[40:50, 70:90] = 37.0
    roofed = replace(flat, depth_m=depth)
    below = np.array([[-100.0, 0.0, 0.0], [-90.0, 5.0, 0.0]])
    assert open_above(below, (2.0,), [roofed]).tolist() == [False, True]
    assert open_above(below, (2.0,), [roofed, flat]).all()  # another saw it before it was built
    assert not open_above(below, (2.0,), []).any()
    with pytest.raises(ValueError, match="1 to 8 heights"):
        open_above(below, (), [flat])
