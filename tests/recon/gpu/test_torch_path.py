"""The Triton kernels of the dense path against the compiled stages, which are their plain twin.

On ``--device cuda`` compiled and captured, else in Triton's interpreter, on smaller arrays.

Tolerances: labels 1e-3 px and unknown ones equal; depth 1e-5 of itself and sigma 1e-4 where
both are known, which 99.9 % of the pixels are alike; the whole path to 1e-3 of the depth on
99 % of the pixels (the compiled exponential is good to 8e-5, and labels on either side of a
threshold differ in a few pixels).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from recon.stereo import belief_propagation as compiled
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.reprojection import MIN_CONFIDENCE, PairDepth
from recon.stereo.reprojection import fuse as compiled_fuse
from recon.stereo.reprojection import label_noise as compiled_noise
from recon.stereo.reprojection import reproject as compiled_reproject
from recon.stereo.upsampling import guide_at_taps
from recon.stereo.upsampling import upsample as compiled_upsample
from recon.stereo.virtual_stereo import drop_unseen as compiled_drop
from recon.types import F32, U8, Array, DepthMap, DisparityMap, StereoPair

torch = pytest.importorskip("torch")

SIZE = (96, 54)
K = np.array([[100.0, 0, 47.5], [0, 100.0, 26.5], [0, 0, 1]])
QUICK = BeliefPropagationConfig(iterations=1, levels=2, speckle_px=4)
"""For the interpreter."""
SMALL = 0.08
"""Share of the keyframe that its small pairs cover."""


def stereo_pair(height: int, width: int, labels: int, seed: int, guide: int = 4) -> StereoPair:
    """A textured pair with a step in disparity, a blank patch, masks and a turned camera."""
    rng = np.random.default_rng(seed)
    canvas = cv2.GaussianBlur(rng.normal(128, 90, (height, width + 80)), (0, 0), 1.1)
    canvas[: height // 5, 50:90] = 128
    canvas = np.clip(canvas + rng.normal(0, 2, canvas.shape), 0, 255).astype(np.uint8)
    v, u = np.mgrid[0:height, 0:width]
    d = np.where((u > width // 2) & (v > height // 3), labels - 3, labels // 3)
    left = np.ascontiguousarray(canvas[v, u - d + 40])
    colour = np.asarray(cv2.cvtColor(left, cv2.COLOR_GRAY2BGR), np.uint8)
    turn = np.asarray(cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0], np.float64)
    own = np.array([[100.0, 0, width / 2 - 2], [0, 100.0, height / 2], [0, 0, 1]])
    seen = np.ones((height, width), np.bool_)
    seen[:, :5] = False
    return StereoPair(
        left=left,
        right=np.ascontiguousarray(canvas[:, 40 : 40 + width]),
        baseline_m=4.0,
        K=own,
        labels=labels,
        plane=np.array([0.01, -0.02, 8.0]),
        slope=0.99,
        R_left_keyframe=turn,
        guide=np.asarray(cv2.resize(colour, (guide * width, guide * height)), np.uint8)
        if guide
        else None,
        left_seen=seen,
        right_seen=seen[:, ::-1].copy(),
    )


def on(device: str, *arrays: Array) -> Any:
    """The arrays on the device."""
    return [torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in arrays]


def close(got: F32, want: F32, relative: float, alike: float = 0.999, covered: float = 0.2) -> None:
    """Known at the same pixels but for a few, and of one value there; at more than ``covered``."""
    assert (np.isnan(got) == np.isnan(want)).mean() >= alike
    both = np.isfinite(got) & np.isfinite(want)
    assert both.mean() > covered
    assert (np.abs(got - want)[both] <= relative * np.abs(want)[both]).mean() >= alike


@pytest.mark.parametrize(
    ("height", "width", "labels", "settings"),
    [
        (9, 13, 5, {"iterations": 2, "levels": 2}),
        (8, 21, 9, {"iterations": 1, "levels": 1, "min_disparity": -2, "min_evidence": 0.0}),
        (11, 20, 4, {"iterations": 1, "levels": 3, "min_disparity": 2,
                     "smoothness_truncation": 1.5}),
    ],
)  # fmt: skip
def test_room_around_a_pair_changes_nothing(
    device: str, height: int, width: int, labels: int, settings: dict[str, float]
) -> None:
    """Sizes and label counts that fill their arrays, and those that do not."""
    from recon.backends.torch_backend import TorchBackend

    config = BeliefPropagationConfig(**settings)  # type: ignore[arg-type]
    pair = stereo_pair(height, width, labels, 1)
    want = compiled.belief_propagation(pair.left, pair.right, labels, config)
    backend = TorchBackend(device)
    for _ in range(2):
        got = backend.belief_propagation(pair.left, pair.right, labels, config)
        np.testing.assert_array_equal(np.isnan(got.px), np.isnan(want.px))
        np.testing.assert_allclose(got.px, want.px, atol=1e-3)
        np.testing.assert_allclose(got.confidence, want.confidence, atol=1e-4)


@pytest.mark.parametrize("tolerance", [1.0, -1.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_belief_on_the_device_equals_the_compiled_one(
    device: str, seed: int, tolerance: float
) -> None:
    """Contrast, visibility, speckles of every size, and what either image does not see."""
    from recon.backends.triton_dense import drop_unreliable, drop_unseen

    config = BeliefPropagationConfig(occlusion_tolerance=tolerance)
    pair = stereo_pair(60, 100, 16, seed)
    rng = np.random.default_rng(seed)
    px = rng.choice(
        np.array([3.2, 3.6, 9.4, np.nan], np.float32), (60, 100), p=[0.3, 0.3, 0.2, 0.2]
    )
    px = np.where(cv2.blur(rng.random((60, 100)), (5, 5)) > 0.5, px, np.float32(5.1))
    confidence = np.where(np.isnan(px) | (rng.random(px.shape) < 0.1), 0, 0.7).astype(np.float32)
    assert isinstance(pair.left_seen, np.ndarray) and isinstance(pair.right_seen, np.ndarray)
    true = torch.tensor([60, 100], device=device)
    left, labels, sure = on(device, pair.left, px, confidence)
    got_px, got_confidence = drop_unreliable(left, labels, sure, true, config)
    here, there = on(device, pair.left_seen.view(np.uint8), pair.right_seen.view(np.uint8))
    seen_px, seen_confidence = drop_unseen(got_px, got_confidence, here, there, true)
    want = compiled.drop_unreliable(pair.left, px.copy(), confidence.copy(), config)
    np.testing.assert_array_equal(got_px.cpu().numpy(), want.px)
    np.testing.assert_array_equal(got_confidence.cpu().numpy(), want.confidence)
    assert 0.05 < np.isnan(want.px).mean() < 0.95
    dropped = compiled_drop(want, pair)
    np.testing.assert_array_equal(seen_px.cpu().numpy(), dropped.px)
    np.testing.assert_array_equal(seen_confidence.cpu().numpy(), dropped.confidence)


def test_guide_is_averaged_as_on_the_host(device: str) -> None:
    """Whole and broken ratios; a level of difference where a mean lies half way."""
    from recon.backends.triton_dense import averaged

    rng = np.random.default_rng(0)
    for h, w, H, W in ((30, 40, 120, 160), (27, 41, 229, 347)):
        guide: U8 = rng.integers(0, 256, (H, W, 3), np.uint8)
        true = torch.tensor([h, w, H, W], device=device)
        got = averaged(on(device, guide)[0], (32, 64), true).cpu().numpy()[:h, :w]
        want = guide_at_taps(guide, (h, w)).astype(np.float32)
        assert np.abs(got - want).max() <= 1
        assert (got == want).mean() > 0.9


def some_depths(count: int) -> list[PairDepth]:
    """Pairs of which some are far off and some say nothing."""
    rng = np.random.default_rng(3)
    depths = []
    for _ in range(count):
        z = 50 + rng.normal(0, 0.2, (40, 60)) + 5 * (rng.random((40, 60)) < 0.2)
        z[rng.random(z.shape) < 0.3] = np.nan
        sigma = rng.choice(np.array([0.1, 0.2, 0.2, 3.0]), z.shape)
        depths.append(PairDepth(z.astype(np.float32), sigma.astype(np.float32)))
    return depths


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("times", [1, 4])
def test_fusion_equals_the_compiled_one(device: str, count: int, times: int) -> None:
    """Depth, sigma and views of one to four pairs, ties and outliers among them; of large ones
    with the noise that they show."""
    from recon.backends.torch_depth import fused_pairs

    pairs = [
        PairDepth(np.tile(d.depth_m, (times, times)), np.tile(d.sigma_m, (times, times)))
        for d in some_depths(count)
    ]
    noise = compiled_noise(pairs) or 1.0
    want = compiled_fuse(pairs, K, np.eye(4), noise)
    z, error = on(
        device, np.stack([d.depth_m for d in pairs]), np.stack([d.sigma_m for d in pairs])
    )
    depth, sigma, views = (t.cpu().numpy() for t in fused_pairs(z, error))
    same = views == want.views
    if noise == 1.0:
        assert same.all()
        np.testing.assert_allclose(depth, want.depth_m, rtol=1e-6)
        np.testing.assert_allclose(sigma, want.sigma_m, rtol=1e-5)
    else:  # the device's median is one of the two middle ones
        assert same.mean() > 0.999
        np.testing.assert_allclose(depth[same], want.depth_m[same], rtol=1e-4)
        np.testing.assert_allclose(sigma[same], want.sigma_m[same], rtol=3e-3)


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("times", [1, 4])
def test_noise_of_labels_equals_that_of_the_host(device: str, count: int, times: int) -> None:
    """Small images share too few pixels: their sigmas stay."""
    from recon.backends.torch_depth import label_noise

    pairs = [
        PairDepth(np.tile(d.depth_m, (times, times)), np.tile(d.sigma_m, (times, times)))
        for d in some_depths(count)
    ]
    stacks = np.stack([d.depth_m for d in pairs]), np.stack([d.sigma_m for d in pairs])
    got = float(label_noise(*on(device, *stacks)).cpu())
    assert got == pytest.approx(compiled_noise(pairs) or 1.0, rel=3e-3)
    assert (got != 1.0) == (count > 1 and times > 1)


@pytest.mark.parametrize("finer", [1, 3])
def test_reprojection_equals_the_compiled_one(device: str, finer: int) -> None:
    """Labels at the pair's size and finer, holes, edges and places outside among them."""
    from recon.backends.torch_depth import device_inputs
    from recon.backends.triton_dense import reproject

    pair = stereo_pair(50, 90, 16, 1)
    rng = np.random.default_rng(1)
    rough = cv2.GaussianBlur(rng.normal(8, 6, (50 * finer, 90 * finer)), (0, 0), 2)
    px = np.asarray(rough, np.float32)
    px[20:30, 20:40] += 5
    px[rng.random(px.shape) < 0.1] = np.nan
    confidence = rng.uniform(0, 1, px.shape).astype(np.float32)
    pair = replace(pair, noise=1.7)
    want = compiled_reproject(DisparityMap(px, confidence), pair, K, SIZE)
    geometry = device_inputs(pair, K, 0)[-1]
    true = torch.tensor([50, 90, 50 * finer, 90 * finer], device=device)
    wide = [np.pad(a, ((0, 7), (0, 5)), constant_values=3) for a in (px, confidence)]
    labels, sure, numbers = on(device, *wide, geometry)
    depth, sigma = reproject(labels, sure, numbers, true, SIZE, MIN_CONFIDENCE)
    close(depth.cpu().numpy(), want.depth_m, 1e-5)
    close(sigma.cpu().numpy(), want.sigma_m, 1e-4)


def by_stages(pairs: list[StereoPair], matching: BeliefPropagationConfig) -> DepthMap:
    """The fused depth by the compiled stages."""
    depths = []
    for pair in pairs:
        found = compiled.belief_propagation(pair.left, pair.right, pair.labels, matching)
        found = compiled_drop(found, pair)
        if pair.guide is not None:
            found = compiled_upsample(found, pair.guide)
        depths.append(compiled_reproject(found, pair, K, SIZE))
    return compiled_fuse(depths, K, np.eye(4), compiled_noise(depths) or 1.0)


def pairs_for(device: str, guide: int) -> list[StereoPair]:
    """Pairs of two sizes; small ones for the interpreter."""
    if device == "cpu":
        return [stereo_pair(15, 40, 8, 1, guide), stereo_pair(21, 50, 8, 2, guide)]
    pairs = [stereo_pair(54, 96, 16, 1, guide), stereo_pair(55, 98, 18, 2, guide)]
    return [*pairs, replace(stereo_pair(54, 90, 16, 3, guide), left_seen=None)]


@pytest.mark.parametrize("guide", [0, 2])
def test_the_whole_path_equals_the_stages(device: str, guide: int) -> None:
    """Pairs of several sizes, twice over; the second time nothing is built again."""
    from recon.backends.torch_depth import DensePath

    matching = BeliefPropagationConfig() if device == "cuda" else QUICK
    path = DensePath(device, matching)
    pairs = pairs_for(device, guide)
    for chosen in (pairs, pairs[:1], pairs[::-1]) if device == "cuda" else (pairs,):
        want = by_stages(chosen, matching)
        got = path.depth(chosen, K, SIZE, np.eye(4))
        close(got.depth_m, want.depth_m, 1e-3, 0.99, SMALL)
        close(got.sigma_m, want.sigma_m, 1e-2, 0.98, SMALL)
        assert (got.views == want.views).mean() > 0.99
    assert len(path.plans) == 2


def test_the_path_needs_a_pair(device: str) -> None:
    from recon.backends.torch_depth import DensePath

    with pytest.raises(ValueError, match="no stereo pair"):
        path = DensePath(device, BeliefPropagationConfig())
        path.depth([], K, SIZE, np.eye(4))


def test_the_backend_gives_the_path_to_the_service_and_falls_back(device: str) -> None:
    """The same depth through the fallback; stage by stage once the device failed."""
    from recon.backends.torch_backend import TorchBackend
    from service.compute.backend_choice import FallbackBackend

    pair = pairs_for(device, 0)[0]
    own = TorchBackend(device)
    backend = FallbackBackend(own)
    assert backend.keeps_pairs
    found = backend.fused_depth([pair], K, SIZE, np.eye(4), QUICK)
    assert found is not None
    close(found.depth_m, by_stages([pair], QUICK).depth_m, 1e-3, 0.99, SMALL)

    def lost(*given: object) -> None:
        raise RuntimeError("CUDA error: device lost")

    own.fused_depth = lost  # type: ignore[assignment, method-assign]
    assert backend.fused_depth([pair], K, SIZE, np.eye(4), QUICK) is None
    assert backend.failure == "CUDA error: device lost"
    assert backend.name == "cpu"
    assert not backend.keeps_pairs
