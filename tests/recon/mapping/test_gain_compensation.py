"""Automatic exposure leaves no seam: each image is as bright as those that showed its ground."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from painted_ground import HEIGHT_M, K, on_plane, pose, still

from recon.mapping.gain_compensation import KNEE, GainCompensation
from recon.types import F64, U8, Camera, DepthMap

SIZE = (120, 90)
SMALL = np.diag([0.25, 0.25, 1.0]) @ K
STEP_M = 8.0
SPOTS = np.random.default_rng(3).integers(0, 255, (240, 240)).astype(np.uint8)
GROUND = np.asarray(cv2.resize(SPOTS, (2400, 2400)), np.uint8)


def _seen(T: F64) -> tuple[DepthMap, U8]:
    """Depth and image of the ground from there, at one exposure; no colour is burnt."""
    image = still(T, Camera(SMALL, np.zeros(5), SIZE), GROUND)
    z = on_plane(SMALL, SIZE, T)[:, 2].reshape(SIZE[::-1]).astype(np.float32)
    depth = DepthMap(z, np.full_like(z, 0.1), np.full(z.shape, 2, np.uint8), SMALL, T)
    return depth, np.repeat((40 + image * 0.3).astype(np.uint8)[..., None], 3, axis=2)


def _apart(levelled: U8, right: U8) -> F64:
    """(3,) median of the colours over those at the first exposure, less one."""
    ratio = levelled.reshape(-1, 3).astype(float) / right.reshape(-1, 3)
    return np.asarray(np.abs(np.median(ratio, axis=0) - 1.0))


def test_a_step_of_exposure_in_flight_leaves_no_seam() -> None:
    """Brighter by half, and redder, from the fifth image on."""
    gains, gain = GainCompensation(), np.array([1.4, 1.5, 1.7])
    for k in range(10):
        depth, right = _seen(pose(STEP_M * k))
        raw = np.rint(right * (gain if k >= 4 else np.ones(3))).astype(np.uint8)
        levelled = gains(0, depth, raw)
        assert levelled.shape == raw.shape and levelled.dtype == np.uint8
        # By as much as it returns from image to image, and by what is left.
        assert (_apart(levelled, right) < 0.02 + 0.04 * max(k - 3, 0)).all(), k
    before, after = _apart(raw, right), _apart(levelled, right)
    assert (after < 0.4 * before).all()


def test_the_lens_colouring_its_edges_adds_up_to_no_other_colour() -> None:
    """Edges are bluer and darker, as far as ordinary lenses make them."""
    gains = GainCompensation()
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE[0]), np.linspace(-1, 1, SIZE[1]))
    shading = 1.0 - (x * x + y * y)[..., None] * [0.05, 0.15, 0.2]
    for k in range(12):
        depth, right = _seen(pose(STEP_M * k))
        raw = np.rint(right * shading * (0.6 if k in (3, 4, 8) else 1.0)).astype(np.uint8)
        levelled = gains(0, depth, raw)
        blue, _, red = levelled.reshape(-1, 3).mean(axis=0) / raw.reshape(-1, 3).mean(axis=0)
        assert abs(blue / red - 1.0) < 0.05, k


def test_images_of_one_exposure_stay_as_they_are() -> None:
    """Nearly so where their edges are somewhat darker, as lenses make them."""
    gains, darkened = GainCompensation(), GainCompensation()
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE[0]), np.linspace(-1, 1, SIZE[1]))
    vignette = (1.0 - 0.05 * (x * x + y * y))[..., None]
    for k in range(8):
        depth, image = _seen(pose(STEP_M * k, seed=k))
        np.testing.assert_array_equal(gains(0, depth, image), image)
        dark = np.rint(image * vignette).astype(np.uint8)
        assert np.abs(darkened(0, depth, dark).astype(int) - dark).max() <= 2


def test_a_side_that_is_brighter_in_all_images_adds_up_to_no_gain() -> None:
    """Ahead, as with the sun behind the drone: ground darkens as it moves through the image."""
    gains = GainCompensation()
    ramp = np.linspace(1.2, 0.8, SIZE[0])[None, :, None]
    for k in range(30):
        depth, right = _seen(pose(STEP_M * k))
        raw = np.rint(right * ramp).astype(np.uint8)
        levelled = gains(0, depth, raw)
    assert (_apart(levelled, raw) < 0.1).all()


def test_without_common_ground_a_gain_lasts_and_returns_to_one() -> None:
    gains = GainCompensation()
    gains(0, *_seen(pose(0.0)))
    depth, right = _seen(pose(1.0))
    gains(0, depth, np.rint(right * 2.0).astype(np.uint8))
    raw = np.full((90, 120, 3), 100, np.uint8)
    assert 45 < gains.level(raw)[45, 60, 1] < 58
    blank = DepthMap(
        np.full_like(depth.depth_m, np.nan), *(depth.sigma_m, depth.views), SMALL, np.eye(4)
    )
    assert 47 < gains(1, blank, raw)[45, 60, 1] < 60  # of a new segment
    for _ in range(100):
        back = gains(1, blank, raw)
    assert (np.abs(back.astype(int) - 100) <= 1).all()


@pytest.mark.parametrize("gain", [0.5, 1.0, 2.0])
def test_a_gain_burns_nothing(gain: float) -> None:
    """Levels stay in order, and white stays apart from what was less bright."""
    gains = GainCompensation()
    gains._gain[:] = np.log(gain)
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    levels = gains.level(ramp)[0, :, 1].astype(int)
    assert (np.diff(levels) >= 0).all() and levels[-1] == round(255 * min(gain, 1.0))
    linear = np.arange(256) * gain <= KNEE
    np.testing.assert_allclose(levels[linear], gain * np.arange(256)[linear], atol=0.5)
    assert np.unique(levels[128:]).size > 25


def test_colours_that_say_nothing_change_nothing() -> None:
    """Black, burnt, of another surface, or too few."""
    gains = GainCompensation()
    depth, right = _seen(pose(0.0))
    gains(0, depth, right)
    for raw in (np.zeros_like(right), np.full_like(right, 255)):
        np.testing.assert_array_equal(gains(0, depth, raw), raw)
    higher = DepthMap(0.9 * depth.depth_m, depth.sigma_m, depth.views, SMALL, depth.T_world_camera)
    np.testing.assert_array_equal(gains(0, higher, right // 2), right // 2)
    assert np.median(depth.depth_m) == pytest.approx(HEIGHT_M, rel=0.02)
