"""Depth and points from disparity against a pinhole projection written out."""

from __future__ import annotations

import numpy as np
import pytest

from recon.reprojection import depth_from_disparity, points_from_depth, scale_intrinsics
from recon.types import F64, DepthMap, DisparityMap, StereoPair

K = np.array([[190.0, 0, 159.5], [0, 190.0, 89.5], [0, 0, 1]])
BASELINE_M = 4.0


def pair_for(plane: F64, slope: float = 1.0) -> StereoPair:
    """A pair with this disparity plane; the images do not matter here."""
    blank = np.zeros((180, 320), np.uint8)
    eye = np.eye(4)
    return StereoPair(blank, blank, BASELINE_M, K, 16, plane, slope, eye, np.eye(3))


def labels_of(depth: F64, pair: StereoPair, size: tuple[int, int]) -> DisparityMap:
    """The labels that a surface of this depth gives, on a grid of (H, W)."""
    height, width = size
    v, u = np.mgrid[0:height, 0:width]
    u = (u + 0.5) * 320 / width - 0.5
    v = (v + 0.5) * 180 / height - 0.5
    d = K[0, 0] * BASELINE_M / depth
    label = (d - pair.plane[0] * u - pair.plane[1] * v - pair.plane[2]) / pair.slope
    return DisparityMap(label.astype(np.float32), np.ones(size, np.float32))


@pytest.mark.parametrize("size", [(180, 320), (720, 1280), (1520, 2704)])
@pytest.mark.parametrize("slope", [1.0, 0.5, -1.0])
def test_depth_of_a_known_surface(size: tuple[int, int], slope: float) -> None:
    pair = pair_for(np.array([0.01, -0.02, 9.0]), slope)
    depth = 55 + 6 * np.sin(np.linspace(0, 5, size[1]))[None, :] * np.ones(size)
    found, sigma = depth_from_disparity(labels_of(depth, pair, size), pair)
    assert found.shape == size
    assert found.dtype == sigma.dtype == np.float32
    np.testing.assert_allclose(found, depth, rtol=1e-4)
    assert (sigma > 0).all()


def test_sigma_is_the_spread_of_depths_under_label_noise() -> None:
    """Propagation by sampling: a quarter of a label of noise gives the sigma that is claimed."""
    pair = pair_for(np.array([0, 0, 8.0]), 0.8)
    depth = np.full((180, 320), 60.0)
    labels = labels_of(depth, pair, (180, 320))
    _, sigma = depth_from_disparity(labels, pair)
    noise = np.random.default_rng(0).normal(0, 0.25, (180, 320)).astype(np.float32)
    shaken, _ = depth_from_disparity(DisparityMap(labels.px + noise, labels.confidence), pair)
    assert np.std(shaken) == pytest.approx(float(np.median(sigma)), rel=0.05)


def test_sigma_grows_as_confidence_falls() -> None:
    pair = pair_for(np.array([0, 0, 8.0]))
    labels = labels_of(np.full((180, 320), 60.0), pair, (180, 320))
    _, sure = depth_from_disparity(labels, pair)
    _, unsure = depth_from_disparity(DisparityMap(labels.px, labels.confidence * 0.25), pair)
    np.testing.assert_allclose(unsure, 2 * sure, rtol=1e-4)


def test_unknown_doubtful_and_infinite_are_nan() -> None:
    pair = pair_for(np.array([0, 0, 2.0]))
    px = np.full((180, 320), 5, np.float32)
    confidence = np.ones((180, 320), np.float32)
    px[0, 0], px[0, 1], px[0, 2], confidence[0, 3] = np.nan, -2, -9, 0.0
    depth, sigma = depth_from_disparity(DisparityMap(px, confidence), pair)
    assert np.isnan(depth[0, :4]).all()
    assert np.isnan(sigma[0, :4]).all()
    assert np.isfinite(depth[0, 4:]).all()
    with pytest.raises(ValueError, match="bad disparity"):
        depth_from_disparity(DisparityMap(px, confidence[1:]), pair)


def test_points_project_back_onto_their_pixels() -> None:
    depth = np.random.default_rng(0).uniform(30, 80, (36, 64)).astype(np.float32)
    depth[3, 4] = np.nan
    small = scale_intrinsics(K, (320, 180), (64, 36))
    ones = np.ones((36, 64), np.uint8)
    points = points_from_depth(DepthMap(depth, depth * 0.01, ones, small, np.eye(4)))
    assert points.shape == (36, 64, 3)
    assert points.dtype == np.float32
    assert np.isnan(points[3, 4]).all()
    points[3, 4] = (0, 0, 1)
    uvw = points.reshape(-1, 3).astype(np.float64) @ small.T
    v, u = np.mgrid[0:36, 0:64]
    keep = np.arange(36 * 64) != 3 * 64 + 4
    np.testing.assert_allclose((uvw[:, 0] / uvw[:, 2])[keep], u.ravel()[keep], atol=1e-3)
    np.testing.assert_allclose((uvw[:, 1] / uvw[:, 2])[keep], v.ravel()[keep], atol=1e-3)


def test_scaled_intrinsics_see_the_same_rays() -> None:
    """The corner of the image stays the corner; pixel centres lie at integers."""
    large = scale_intrinsics(K, (320, 180), (1280, 720))
    for corner in ((-0.5, -0.5), (319.5, 179.5)):
        ray = np.linalg.solve(K, np.array([*corner, 1.0]))
        scaled = large @ ray
        want = [(corner[0] + 0.5) * 4 - 0.5, (corner[1] + 0.5) * 4 - 0.5]
        np.testing.assert_allclose(scaled[:2] / scaled[2], want, atol=1e-9)
