"""Fusion of several stereo readings of one keyframe."""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np
import pytest
from painted_ground import SIZE, on_plane, pose, still
from painted_ground import K as K_IMAGE
from some_views import view_at

from recon.backends.cpu import CpuBackend
from recon.pipeline.stages import DenseStereo, untimed
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.reprojection import (
    MAX_NOISE,
    PAIRS_CORRELATION,
    PairDepth,
    fuse,
    label_noise,
)
from recon.types import F32

K = np.array([[100.0, 0, 39.5], [0, 100.0, 29.5], [0, 0, 1]])
SHAPE = (60, 80)


def reading(rng: np.random.Generator, truth: F32, sigma: float) -> PairDepth:
    depth = truth + rng.normal(0, sigma, SHAPE)
    return PairDepth(depth.astype(np.float32), np.full(SHAPE, sigma, np.float32))


def test_sigma_is_honest_for_gaussian_readings() -> None:
    rng = np.random.default_rng(0)
    truth = np.full(SHAPE, 60.0, np.float32)
    pairs = [reading(rng, truth, s) for s in (0.2, 0.3, 0.4)]
    fused = fuse(pairs, K, np.eye(4))
    within = np.abs(fused.depth_m - truth) <= fused.sigma_m
    assert 0.6 < within.mean() < 0.85
    assert np.median(fused.sigma_m) < 0.2
    assert np.median(fused.views) == 3


def test_the_majority_wins_over_one_wrong_reading() -> None:
    rng = np.random.default_rng(1)
    truth = np.full(SHAPE, 60.0, np.float32)
    wrong = reading(rng, truth - 12.0, 0.1)
    pairs = [reading(rng, truth, 0.3), wrong, reading(rng, truth, 0.3)]
    fused = fuse(pairs, K, np.eye(4))
    # Where the two right ones miss each other by over 2.5 sigma (1 in 80) there is none.
    assert np.mean(np.abs(fused.depth_m - truth) < 2.0) > 0.97
    assert (fused.views <= 2).all()


def test_what_no_pair_knows_stays_unknown_and_single_views_are_marked() -> None:
    rng = np.random.default_rng(2)
    truth = np.full(SHAPE, 60.0, np.float32)
    a, b = reading(rng, truth, 0.3), reading(rng, truth, 0.3)
    a.depth_m[:, :40] = np.nan
    b.depth_m[:20] = np.nan
    fused = fuse([a, b], K, np.eye(4))
    assert np.isnan(fused.depth_m[:20, :40]).all() and (fused.views[:20, :40] == 0).all()
    assert (fused.views[:20, 40:] == 1).all()
    single, double = fused.sigma_m[:20, 40:], fused.sigma_m[20:, 40:]
    assert np.median(single) > 1.6 * np.nanmedian(double)


def test_readings_that_contradict_each_other_are_dropped() -> None:
    rng = np.random.default_rng(3)
    truth = np.full(SHAPE, 60.0, np.float32)
    a, b = reading(rng, truth, 0.3), reading(rng, truth, 0.3)
    b.depth_m[:, :10] += 12.0
    b.depth_m[:, 10:20] = a.depth_m[:, 10:20] + 2.0  # more than 2.5 sigma, less than 4 %
    fused = fuse([a, b], K, np.eye(4))
    assert np.isnan(fused.depth_m[:, :10]).all() and np.isnan(fused.sigma_m[:, :10]).all()
    assert (fused.views[:, :10] == 0).all()
    assert np.isfinite(fused.depth_m[:, 10:]).mean() > 0.97
    assert (fused.views[:, 10:20] == 1).all()


def test_pairs_that_mostly_contradict_each_other_give_nothing() -> None:
    """Water: each pair finds some depth, and no two the same. What one pair alone saw goes too."""
    rng = np.random.default_rng(4)
    truth = np.full(SHAPE, 60.0, np.float32)
    pairs = [reading(rng, truth + 12.0 * n, 0.3) for n in range(3)]
    for pair in pairs:
        pair.depth_m[:, :20] = 60.0
    pairs[0].depth_m[:5] = pairs[1].depth_m[:5] = np.nan
    fused = fuse(pairs, K, np.eye(4))
    assert np.isnan(fused.depth_m).all() and np.isnan(fused.sigma_m).all()
    assert (fused.views == 0).all()
    few = fuse(pairs[2:], K, np.eye(4))
    assert np.isfinite(few.depth_m).all()  # one pair alone contradicts none


def test_useless_readings_are_left_out() -> None:
    far = PairDepth(np.full(SHAPE, 60.0, np.float32), np.full(SHAPE, 30.0, np.float32))
    fused = fuse([far], K, np.eye(4))
    assert np.isnan(fused.depth_m).all()


@pytest.mark.parametrize("times", [1.1, 2.0, 3.0])
def test_noise_of_labels_is_how_far_pairs_of_a_view_disagree(times: float) -> None:
    """Pairs that err by ``times`` their sigmas, a part of it alike, as they share the view."""
    rng = np.random.default_rng(5)
    shape = (180, 320)
    truth = rng.uniform(40.0, 60.0, shape)
    shared = rng.normal(0.0, np.sqrt(PAIRS_CORRELATION), shape)
    own, pairs = np.sqrt(1.0 - PAIRS_CORRELATION), []
    for sigma in (0.1, 0.2, 0.2, 0.4):
        error = times * sigma * (shared + rng.normal(0.0, own, shape))
        pairs.append(
            PairDepth((truth + error).astype(np.float32), np.full(shape, sigma, np.float32))
        )
    pairs[0].depth_m[:, :100] = np.nan
    pairs[1].depth_m[:20] = 10.0  # wrong matches
    noise = label_noise(pairs)
    assert noise is not None and noise == pytest.approx(times, rel=0.1)
    assert label_noise(pairs[:1]) is None
    assert label_noise([PairDepth(p.depth_m[:30, :30], p.sigma_m[:30, :30]) for p in pairs]) is None
    fused = fuse(pairs, K, np.eye(4), noise)
    off = np.abs(fused.depth_m - truth)[20:, 100:]
    assert 0.6 < np.mean(off <= fused.sigma_m[20:, 100:]) < 0.8
    assert np.mean(fused.views[20:, 100:] == 4) > 0.9  # right sigmas: none is left out


def test_pairs_that_agree_better_than_usual_are_no_surer() -> None:
    """What is wrong in all of them does not show."""
    noise = np.random.default_rng(5).normal(0.0, 0.03, (4, 180, 320))
    pairs = [
        PairDepth((50.0 + error).astype(np.float32), np.full((180, 320), 0.1, np.float32))
        for error in noise
    ]
    assert label_noise(pairs) == 1.0


@pytest.mark.parametrize(("scatter", "is_kept"), [(0.02, True), (0.035, True), (0.12, False)])
def test_no_sigma_makes_a_surface_of_a_false_motion(scatter: float, is_kept: bool) -> None:
    """Pairs whose depths scatter by a share of them, where 0.5 % is stated."""
    rng = np.random.default_rng(6)
    depths = 60.0 * (1.0 + scatter * rng.standard_normal((4, 180, 320))).astype(np.float32)
    pairs = [PairDepth(depth, np.full(depth.shape, 0.3, np.float32)) for depth in depths]
    noise = label_noise(pairs)
    assert noise is not None and (is_kept or noise == MAX_NOISE)
    fused = fuse(pairs, K, np.eye(4), min(noise, 7.0))
    assert bool(np.isfinite(fused.depth_m).any()) == is_kept
    assert bool(fused.views.any()) == is_kept


@pytest.mark.parametrize(("quality", "most"), [(95, 0.95), (15, 0.9), (5, 0.85)])
def test_sigma_holds_however_much_the_images_are_compressed(quality: int, most: float) -> None:
    """The usual sigma also holds what is wrong in all pairs, here nothing: clear images do better.

    A tilted camera over painted ground, by four partners whose poses are exact.
    """
    images = []
    for seq, east_m in enumerate((0.0, 4.0, -4.0, 8.0, -8.0)):
        T = pose(east_m, seed=seq)
        coded = cv2.imencode(".jpg", still(T), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        gray = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
        bgr = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8)
        images.append(PosedImage(bgr, gray, K_IMAGE, T, seq=seq))
    T = images[0].T_odom_camera
    ground = on_plane(K_IMAGE, SIZE, T)[::997]
    view = view_at(0, T, image=images[0], partners=images[1:], points=ground)
    matching = BeliefPropagationConfig()
    config = VirtualStereoConfig(width_px=240, guided=False)
    depth, _ = DenseStereo(CpuBackend(), config, matching, Counter(), None, untimed)(view)
    assert depth is not None
    truth = on_plane(depth.K, (240, 180), T)[:, 2].reshape(180, 240)
    known = np.isfinite(depth.depth_m)
    off = np.abs(depth.depth_m - truth)[known]
    assert known.mean() > 0.9
    assert 0.7 < np.mean(off <= depth.sigma_m[known]) < most
    assert np.mean(off <= 2 * depth.sigma_m[known]) > 0.94
