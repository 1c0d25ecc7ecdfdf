"""Depth that a camera cannot have seen is dropped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA, rotation_from_rpy
from recon.posegraph.segments import Segments
from recon.stereo.reprojection import plausible
from recon.types import F64, U8, DepthMap, PosePrior

K = np.array([[100.0, 0, 59.5], [0, 100.0, 39.5], [0, 0, 1]])
SHAPE = (80, 120)


def surface(views: U8) -> DepthMap:
    depth = np.where(views > 0, 50.0, np.nan).astype(np.float32)
    return DepthMap(depth, 0.01 * depth, views, K, np.eye(4))


def looking(pitch_deg: float) -> F64:
    R = rotation_from_rpy(0.0, np.radians(pitch_deg), 0.7)
    return np.asarray(R_ENU_NED @ R @ R_GIMBAL_CAMERA)


def test_above_the_horizon_one_pair_alone_says_nothing() -> None:
    """The camera looks 10 degrees down: the horizon lies 17.6 rows above the middle."""
    views = np.full(SHAPE, 1, np.uint8)
    views[:, :30] = 2
    kept = plausible(surface(views), PosePrior(looking(-10.0), sigma_tilt_rad=0.0))
    assert kept is not None
    known = np.isfinite(kept.depth_m)
    assert known[:, :30].all() and (kept.views[:, :30] == 2).all()
    horizon = 39.5 - 100.0 * np.tan(np.radians(10.0))
    np.testing.assert_array_equal(known[:, 30:].all(axis=1), np.arange(80) > horizon)
    np.testing.assert_array_equal(known, kept.views > 0)
    np.testing.assert_array_equal(known, np.isfinite(kept.sigma_m))


def test_above_the_horizon_only_what_stands_on_the_ground_is_kept() -> None:
    """Clouds 300 m away over the sea, and a tower at 50 m in front of both."""
    horizon = 39.5 - 100.0 * np.tan(np.radians(10.0))
    above = np.arange(80)[:, None] < horizon - 2.0
    depth = np.where(above, 300.0, 120.0) * np.ones(SHAPE)
    depth[10:, 80:95] = 50.0
    depth[:, :20] = np.nan
    views = np.where(np.isnan(depth), 0, 2).astype(np.uint8)
    seen = replace(surface(views), depth_m=depth.astype(np.float32))
    kept = plausible(seen, PosePrior(looking(-10.0), sigma_tilt_rad=0.0))
    assert kept is not None
    known = np.isfinite(kept.depth_m)
    assert not known[:18, 20:78].any() and not known[:8, 80:95].any()
    assert known[12:, 82:93].all() and known[26:, 20:].all()
    np.testing.assert_array_equal(known, kept.views > 0)


def test_of_an_image_that_shows_no_ground_two_pairs_decide() -> None:
    up = surface(np.full(SHAPE, 2, np.uint8))
    kept = plausible(up, PosePrior(looking(60.0), sigma_tilt_rad=0.0))
    assert kept is not None and np.isfinite(kept.depth_m).all()


def test_a_facade_stays_where_only_a_strip_without_depth_lies_below_the_horizon() -> None:
    """The camera looks 16 degrees up: the horizon lies 11 rows above the lower edge, where the
    other images of the pairs end."""
    facade = surface(np.full(SHAPE, 2, np.uint8))
    facade.depth_m[65:], facade.views[65:] = np.nan, 0
    kept = plausible(facade, PosePrior(looking(16.0), sigma_tilt_rad=0.0))
    assert kept is not None and np.isfinite(kept.depth_m[:65]).all()


def test_clouds_over_a_sea_without_depth_are_dropped() -> None:
    clouds = surface(np.full(SHAPE, 2, np.uint8))
    clouds.depth_m[20:], clouds.views[20:] = np.nan, 0
    assert plausible(clouds, PosePrior(looking(0.0), sigma_tilt_rad=0.0)) is None


def test_what_may_lie_below_the_horizon_is_kept() -> None:
    alone = surface(np.ones(SHAPE, np.uint8))
    unsure = PosePrior(looking(-10.0), sigma_tilt_rad=np.radians(6.1))
    assert plausible(alone, PosePrior(looking(-90.0))) is alone
    assert plausible(alone, PosePrior()) is alone
    kept = plausible(alone, unsure)
    assert kept is not None and np.isfinite(kept.depth_m).mean() > 0.9


def test_nothing_left_is_no_depth() -> None:
    assert plausible(surface(np.zeros(SHAPE, np.uint8)), PosePrior()) is None
    assert plausible(surface(np.ones(SHAPE, np.uint8)), PosePrior(looking(60.0), 0.0)) is None


def test_a_segment_that_was_refuted_needs_more_views_that_agree() -> None:
    """Two views of a false motion contradict themselves; a third that does not stays out."""
    segments = Segments()
    first, second = segments[0], segments[1]
    false, good = surface(np.zeros(SHAPE, np.uint8)), surface(np.full(SHAPE, 2, np.uint8))
    found = [plausible(d, PosePrior()) is not None for d in (false, false, good, good, good)]
    assert found == [False, False, True, True, True]
    assert [first.judge(one) for one in found] == [False] * 4 + [True]
    assert second.judge(True) and not second.is_false
    second.add_surface(7, 100, PosePrior())
    assert not second.judge(False) and second.is_false
    assert [s.surface for s in segments.false()] == [[7]]  # it was kept before that showed
