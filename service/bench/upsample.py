"""Joint bilateral upsampling against OpenCV's bilateral filter and the guided filter."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from recon.stereo.upsampling import UpsamplingConfig
from recon.types import DisparityMap
from service.bench import BenchOptions, BenchResult, compare
from service.compute.backend_choice import choose_backend

COARSE = (180, 320)
GUIDES = ((720, 1280), (1520, 2704))


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds to each guide size, exact and guided.

    OpenCV without contrib has no joint filter: the peer of the exact one is its bilateral
    filter of the guide itself, with the paper's diameter 10 and sigmas 15, which reads as
    many taps a pixel; the peer of the guided one is plain linear resizing of the same map.
    """
    backend = choose_backend(options.backend)
    rng = np.random.default_rng(3)
    px = cv2.GaussianBlur(rng.random(COARSE, np.float32) * 16, (0, 0), 4)
    coarse = DisparityMap(np.asarray(px, np.float32), np.ones(COARSE, np.float32))
    results = []
    for height, width in GUIDES:
        guide = rng.integers(0, 256, (height, width, 3), np.uint8)
        size = (width, height)
        what = f"{COARSE[1]}x{COARSE[0]} to {width}x{height}"
        results.append(
            compare(
                "upsample",
                f"{what}, exact",
                partial(backend.upsample, coarse, guide, UpsamplingConfig()),
                options,
                "OpenCV bilateralFilter d 10",
                partial(cv2.bilateralFilter, guide, 10, 15, 15),
                note=backend.name,
            )
        )
        results.append(
            compare(
                "upsample",
                f"{what}, guided",
                partial(backend.upsample, coarse, guide, UpsamplingConfig(method="guided")),
                options,
                "OpenCV linear resize",
                partial(cv2.resize, coarse.px, size, interpolation=cv2.INTER_LINEAR),
                note=backend.name,
            )
        )
    return results
