"""Stereo and upsampling at the sizes of flight, against OpenCV's matcher and bilateral filter.

On pairs with true disparity the matcher is at its best: images padded on the left by the number of
disparities, dense (no uniqueness or left-right check), block size 3, and the better of its two-pass
modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np

from recon.backends import Backend
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.upsampling import UpsamplingConfig
from recon.types import F32, F64, U8, DisparityMap
from service.bench import BenchOptions, BenchResult, compare
from service.bench.stereo_scenes import EXPOSURES, SCENES, TruePair, exposed, rendered
from service.compute.backend_choice import choose_backend
from service.compute.rectified_pair import matching_config

SIZES = ((320, 180, 16), (640, 360, 32))
ITERATIONS = 5


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds for the sizes of flight, then wrong pixels on rendered pairs."""
    backend = choose_backend(options.backend)
    return speed(options, backend) + accuracy([rendered(name) for name in SCENES], backend)


def speed(options: BenchOptions, backend: Backend) -> list[BenchResult]:
    """Milliseconds for the sizes of flight."""
    results = []
    for width, height, labels in SIZES:
        left, right = scene(width, height, labels)
        matcher = semi_global(labels)
        config = BeliefPropagationConfig(iterations=ITERATIONS)
        results.append(
            compare(
                f"{width}x{height}, {labels} labels, {ITERATIONS} iterations",
                partial(backend.belief_propagation, left, right, labels, config),
                options,
                "OpenCV SGBM",
                partial(matcher.compute, left, right),
                note=f"{backend.name}, images to checked sub-pixel disparity",
            )
        )
    return results


def accuracy(pairs: Sequence[TruePair], backend: Backend) -> list[BenchResult]:
    """Wrong pixels of each pair, also where the right image's exposure differs, and the means."""
    same = [(pair.name, _wrong([pair], backend)) for pair in pairs]
    other = [
        (f"{pair.name}, exposures differ", _wrong([exposed(pair, e) for e in EXPOSURES], backend))
        for pair in pairs
    ]
    for name, of in (("mean", same), ("mean, exposures differ", other)):
        of.append((name, np.mean([shares for _, shares in of], axis=0)))
    return [
        BenchResult(
            f"{name}, bad-1.0", float(ours), "%", peer="OpenCV SGBM, padded",
            peer_value=float(theirs), note="visible pixels unknown or off by over 1 px",
        )
        for name, (ours, theirs) in same + other
    ]  # fmt: skip


def _wrong(pairs: Sequence[TruePair], backend: Backend) -> F64:
    """Per cent of wrong pixels, ours and the matcher's: the mean of some pairs."""
    config = matching_config(ITERATIONS, 0, checked=False)
    shares = []
    for pair in pairs:
        ours = backend.belief_propagation(pair.left, pair.right, pair.labels, config).px
        theirs = min(bad_share(semi_global_disparity(pair, m), pair, 1.0) for m in (0, 2))
        shares.append((bad_share(ours, pair, 1.0), theirs))
    return np.asarray(100 * np.mean(shares, axis=0), np.float64)


def semi_global_disparity(pair: TruePair, mode: int) -> F32:
    """Disparity of the matcher on the padded pair, NaN where it found none."""
    pad = -(-pair.labels // 16) * 16
    left, right = (
        cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_REPLICATE)
        for image in (pair.left, pair.right)
    )
    found = semi_global(pair.labels, mode).compute(left, right)[:, pad:].astype(np.float32) / 16
    found[found < 0] = np.nan
    return np.asarray(found, np.float32)


def bad_share(px: F32, pair: TruePair, limit: float) -> float:
    """Share of the visible pixels that are unknown or wrong by more than ``limit`` px."""
    good = np.abs(px - pair.truth_px) <= limit
    return float(1 - good[pair.visible].mean())


def scene(width: int, height: int, labels: int) -> tuple[U8, U8]:
    """A textured pair with steps and slopes of disparity, the same at every call."""
    rng = np.random.default_rng(7)
    noise = cv2.GaussianBlur(rng.normal(0, 1, (height, width + labels)), (0, 0), 1.2)
    texture = np.clip(128 + 45 * noise / noise.std(), 0, 255).astype(np.float32)
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    disparity = labels * (0.2 + 0.3 * v / height)
    disparity[(abs(u - width / 2) < width / 6) & (abs(v - height / 2) < height / 5)] = labels * 0.75
    left = cv2.remap(texture, u - disparity + labels, v, cv2.INTER_CUBIC)
    right = texture[:, labels : labels + width]
    return np.clip(left, 0, 255).astype(np.uint8), np.ascontiguousarray(right.astype(np.uint8))


def semi_global(labels: int, mode: int = 0) -> Any:
    """OpenCV's matcher, dense, for gray images; its number of disparities is a multiple of 16."""
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=-(-labels // 16) * 16,
        blockSize=3,
        P1=8 * 9,
        P2=32 * 9,
        disp12MaxDiff=-1,
        preFilterCap=63,
        uniquenessRatio=0,
        mode=mode,
    )


COARSE = (180, 320)
GUIDES = ((720, 1280), (1520, 2704))


def run_upsampling(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds to each guide size.

    OpenCV without contrib has no joint filter: the peer is its bilateral filter of the guide
    itself, with the paper's diameter 10 and sigmas 15, which reads as many taps a pixel.
    """
    backend = choose_backend(options.backend)
    rng = np.random.default_rng(3)
    px = cv2.GaussianBlur(rng.random(COARSE, np.float32) * 16, (0, 0), 4)
    coarse = DisparityMap(np.asarray(px, np.float32), np.ones(COARSE, np.float32))
    results = []
    for height, width in GUIDES:
        guide = rng.integers(0, 256, (height, width, 3), np.uint8)
        what = f"{COARSE[1]}x{COARSE[0]} to {width}x{height}"
        results.append(
            compare(
                f"{what}, exact",
                partial(backend.upsample, coarse, guide, UpsamplingConfig()),
                options,
                "OpenCV bilateralFilter d 10",
                partial(cv2.bilateralFilter, guide, 10, 15, 15),
                note=backend.name,
            )
        )
    return results
