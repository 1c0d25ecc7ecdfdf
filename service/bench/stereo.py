"""Stereo and upsampling at the sizes of flight, against OpenCV's matcher and bilateral filter."""

from __future__ import annotations

from functools import partial
from typing import Any

import cv2
import numpy as np

from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import U8, DisparityMap
from service.bench import BenchOptions, BenchResult, compare
from service.compute.backend_choice import choose_backend

SIZES = ((320, 180, 16), (640, 360, 32))
ITERATIONS = 5


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds for the sizes of flight."""
    backend = choose_backend(options.backend)
    results = []
    for width, height, labels in SIZES:
        left, right = scene(width, height, labels)
        config = BeliefPropagationConfig(iterations=ITERATIONS)
        what = f"{width}x{height}, {labels} labels, {ITERATIONS} iterations"
        ours = partial(backend.belief_propagation, left, right, labels, config)
        theirs = partial(semi_global(labels).compute, left, right)
        note = f"{backend.name}, images to checked sub-pixel disparity"
        results.append(compare(what, ours, options, "OpenCV SGBM", theirs, note))
    return results


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
        minDisparity=0, numDisparities=-(-labels // 16) * 16, blockSize=3, P1=8 * 9, P2=32 * 9,
        disp12MaxDiff=-1, preFilterCap=63, uniquenessRatio=0, mode=mode,
    )  # fmt: skip


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
        what = f"{COARSE[1]}x{COARSE[0]} to {width}x{height}, exact"
        ours = partial(backend.upsample, coarse, guide)
        theirs = partial(cv2.bilateralFilter, guide, 10, 15, 15)
        peer = "OpenCV bilateralFilter d 10"
        results.append(compare(what, ours, options, peer, theirs, backend.name))
    return results
