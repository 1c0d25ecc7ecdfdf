"""Depth and points from disparity against a pinhole projection written out."""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np
import pytest
from some_views import view_at

from recon import se3
from recon.backends.cpu import CpuBackend
from recon.pipeline.stages import DenseStereo, untimed
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.reprojection import LABEL_SIGMA_PX, PairDepth, carry, reproject
from recon.types import F64, DisparityMap, StereoPair
from service.compute.backend_choice import FallbackBackend

K = np.array([[190.0, 0, 159.5], [0, 190.0, 89.5], [0, 0, 1]])
BASELINE_M = 4.0
SIZE = (320, 180)


def pair_for(plane: F64, slope: float = 1.0, turn: F64 | None = None) -> StereoPair:
    """A pair with this disparity plane; the images do not matter here."""
    blank = np.zeros((180, 320), np.uint8)
    R = np.eye(3) if turn is None else turn
    return StereoPair(blank, blank, BASELINE_M, K, 16, plane, slope, R)


def labels_of(depth: F64, pair: StereoPair) -> DisparityMap:
    """The labels that a surface of this depth gives the rectified left view, on any grid."""
    height, width = depth.shape
    v, u = np.mgrid[0:height, 0:width]
    x, y = (u + 0.5) * 320 / width - 0.5, (v + 0.5) * 180 / height - 0.5
    d = K[0, 0] * BASELINE_M / depth
    label = (d - pair.plane[0] * x - pair.plane[1] * y - pair.plane[2]) / pair.slope
    return DisparityMap(label.astype(np.float32), np.ones(depth.shape, np.float32))


@pytest.mark.parametrize("finer", [1, 2, 4])
@pytest.mark.parametrize("slope", [1.0, 0.5, -1.0])
def test_depth_of_a_known_surface(finer: int, slope: float) -> None:
    """z = f B / d (Eq. 3), from labels on the pair's grid or an upsampled one."""
    pair = pair_for(np.array([0.01, -0.02, 9.0]), slope)
    width, height = 320 * finer, 180 * finer
    x = (np.arange(width) + 0.5) / finer - 0.5
    depth = np.tile(55 + 6 * np.sin(x / 60), (height, 1))
    found = reproject(labels_of(depth, pair), pair, K, SIZE)
    assert found.depth_m.shape == found.sigma_m.shape == (180, 320)
    assert found.depth_m.dtype == found.sigma_m.dtype == np.float32
    want = np.tile(55 + 6 * np.sin(np.arange(320) / 60), (180, 1))
    np.testing.assert_allclose(found.depth_m, want, rtol=1e-3)
    assert (found.sigma_m > 0).all()


def test_keyframe_turned_against_the_rectified_view() -> None:
    """A plane seen by the turned left camera comes back as the plane the keyframe sees."""
    turn = cv2.Rodrigues(np.array([0.05, -0.03, 0.2]))[0].astype(np.float64)
    pair = pair_for(np.array([0, 0, 5.0]), 1.0, turn)
    normal, offset = np.array([0.1, 0.05, 1.0]), 60.0  # in the keyframe's frame
    v, u = np.mgrid[0:180, 0:320]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    in_left = offset / (rays @ (turn @ normal))  # z of the plane along the left camera's rays
    found = reproject(labels_of(in_left, pair), pair, K, SIZE)
    want = offset / (rays @ normal)
    known = np.isfinite(found.depth_m)
    assert known.mean() > 0.6
    np.testing.assert_allclose(found.depth_m[known], want[known], rtol=2e-3)


def test_sigma_is_the_spread_of_depths_under_label_noise() -> None:
    """propagation by sampling: noise of one label sigma gives the sigma that is claimed."""
    pair = pair_for(np.array([0, 0, 8.0]), 0.8)
    labels = labels_of(np.full((180, 320), 60.0), pair)
    sigma = reproject(labels, pair, K, SIZE).sigma_m
    shaken = []
    for seed in range(60):
        shift = np.random.default_rng(seed).normal(0, LABEL_SIGMA_PX)
        moved = DisparityMap((labels.px + shift).astype(np.float32), labels.confidence)
        shaken.append(float(np.median(reproject(moved, pair, K, SIZE).depth_m)))
    assert np.std(shaken) == pytest.approx(float(np.median(sigma)), rel=0.3)


def test_sigma_grows_as_confidence_falls() -> None:
    pair = pair_for(np.array([0, 0, 8.0]))
    labels = labels_of(np.full((180, 320), 60.0), pair)
    sure = reproject(labels, pair, K, SIZE).sigma_m
    unsure = reproject(DisparityMap(labels.px, labels.confidence * 0.25), pair, K, SIZE).sigma_m
    assert (unsure > 1.5 * sure).all()


def test_unknown_doubtful_and_infinite_are_nan() -> None:
    pair = pair_for(np.array([0, 0, 2.0]))
    px = np.full((180, 320), 5, np.float32)
    confidence = np.ones((180, 320), np.float32)
    px[0, 0], px[0, 4], px[0, 8], confidence[0, 12] = np.nan, -2, -9, 0.0
    found = reproject(DisparityMap(px, confidence), pair, K, SIZE)
    assert np.isnan(found.depth_m[0, [0, 4, 8, 12]]).all()
    assert np.isnan(found.sigma_m[0, [0, 4, 8, 12]]).all()
    assert np.isfinite(found.depth_m[2:]).all()


def seen_from(T: F64) -> F64:
    """(h, w) depth of tilted ground 60 m away and a box 8 m high on it; ``T`` is T_world_camera."""
    v, u = np.mgrid[0:180, 0:320]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    rays, at = rays @ T[:3, :3].T, T[:3, 3]
    normal = np.array([0.1, 0.2, 1.0])
    ground = (60.0 - normal @ at) / (rays @ normal)
    top = (52.0 - at[2]) / rays[..., 2]
    x, y = (at[k] + top * rays[..., k] for k in (0, 1))
    roof = (np.abs(x) < 8.0) & (np.abs(y) < 8.0)
    return np.where(roof, np.minimum(top, ground), ground)


@pytest.mark.parametrize("move_m", [(6.0, 1.0, 0.0), (-5.0, 3.0, 0.0), (0.5, 0.5, 6.0)])
def test_a_pairs_depth_is_carried_to_the_other_view(move_m: tuple[float, float, float]) -> None:
    """Sideways, and a tenth nearer: nearly all of what both see, to a fraction of a sigma."""
    turned = se3.so3_exp(np.array([0.01, -0.02, 0.08]))
    T_there, T_here = np.eye(4), se3.compose(turned, np.array(move_m))
    depth = seen_from(T_there).astype(np.float32)
    pair = PairDepth(depth, 0.002 * depth)
    found = carry(pair, K, se3.inverse(T_here) @ T_there)
    truth = seen_from(T_here)
    back = carry(
        PairDepth(truth.astype(np.float32), pair.sigma_m), K, se3.inverse(T_there) @ T_here
    )
    both = np.isfinite(back.depth_m).sum()  # of their pixels meet the other view
    known = np.isfinite(found.depth_m)
    assert known.sum() > 0.95 * both > 0.7 * known.size
    error = np.abs(found.depth_m[known] / truth[known] - 1.0)
    assert np.median(error) < 1e-4 and np.mean(error > 0.002) < 0.02
    np.testing.assert_allclose(found.sigma_m[known], 0.002 * found.depth_m[known], rtol=0.02)


def test_a_pair_is_matched_once_on_a_backend_that_gives_its_depth() -> None:
    """ONNX Runtime's too, behind the fallback; not on a device that keeps the depth of pairs."""
    gray, T = np.zeros((180, 320), np.uint8), np.eye(4)
    here, there = (PosedImage(None, gray, K, T, seq=seq) for seq in (1, 0))
    again = view_at(1, T, image=here, partners=(there,))
    depth = np.full((180, 320), 60.0, np.float32)
    for keeps_pairs, found in ((False, [0]), (True, [])):
        own = CpuBackend()
        own.name, own.keeps_pairs = "onnx", keeps_pairs
        stage = DenseStereo(
            FallbackBackend(own), VirtualStereoConfig(), BeliefPropagationConfig(), Counter(), None,
            untimed,
        )  # fmt: skip
        stage.keep(0, {1: PairDepth(depth, 0.01 * depth)})
        assert [*stage.carried(again, K, (320, 180))] == found


def test_the_nearer_surface_hides_what_is_behind_it() -> None:
    depth = np.full((180, 320), 60.0, np.float32)
    depth[:, :100] = 30.0  # moves twice as far
    moved = np.eye(4)
    moved[0, 3] = 60.0 * 20 / K[0, 0]
    found = carry(PairDepth(depth, 0.01 * depth), K, moved).depth_m
    assert (found[:, 45:135] == 30.0).all() and (found[:, 145:] == 60.0).all()
