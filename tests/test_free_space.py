"""Invented points go, true ones stay: over flat ground with known roofs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from recon.cloud_fusion import cloud_of
from recon.free_space import seen_through
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
