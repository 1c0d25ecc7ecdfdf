"""The device's calls, images up and results down, against the processor's compiled ones."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from recon.backends import Backend, load_backend
from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import DepthMap, StereoPair
from service.bench import BenchOptions, BenchResult, compare
from service.bench.stereo import scene

GUIDE = (2704, 1520)
DEPTH = (1280, 720)
PAIRS = (1, 4)
SIZE, LABELS = (320, 180), 16  # size (w, h) and labels of the rectified pair


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds of each call; one line where the device cannot run."""
    try:
        from recon.backends.torch_backend import TorchBackend

        backend = TorchBackend()
    except (ImportError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        return [BenchResult("torch", float("nan"), "ms", note=f"cannot run: {first}")]
    return [*calls(backend, load_backend("cpu"), options), *clouds(backend, options)]


def calls(backend: Backend, compiled: Backend, options: BenchOptions) -> list[BenchResult]:
    """The backend's three calls, images up and results down, compared with the compiled ones."""
    left, right = scene(*SIZE, LABELS)
    matching = BeliefPropagationConfig()
    coarse = compiled.belief_propagation(left, right, LABELS, matching)
    guide = np.random.default_rng(0).integers(0, 256, (GUIDE[1], GUIDE[0], 3), np.uint8)
    source, target = ground(0.3), ground(0.0)
    icp = IcpConfig(strides=(1,), iterations=(6,))
    size = f"{SIZE[0]}x{SIZE[1]}"
    note = f"{backend.name} on {backend.device}"
    work: dict[str, Callable[[Backend], object]] = {
        f"stereo {size}, {LABELS} labels":
            lambda b: b.belief_propagation(left, right, LABELS, matching),
        f"upsampling {size} to {GUIDE[0]}x{GUIDE[1]}, exact":
            lambda b: b.upsample(coarse, guide),
        f"ICP of {SIZE[0] * SIZE[1]} points, 6 iterations":
            lambda b: b.register(source, target, np.eye(4), icp),
    }  # fmt: skip
    return [
        compare(
            f"{what}, with uploads", partial(call, backend), options, "cpu backend",
            partial(call, compiled), note,
        )
        for what, call in work.items()
    ]  # fmt: skip


def clouds(backend: Backend, options: BenchOptions) -> list[BenchResult]:
    """The fused depth of some pairs, without leaving the device in between."""
    pair, K, matching = flown_pair(DEPTH), camera(DEPTH), BeliefPropagationConfig()
    size = f"{DEPTH[0]}x{DEPTH[1]} from pairs of {SIZE[0]}x{SIZE[1]}"
    return [
        compare(
            f"cloud of {size}, {count} pair(s), with uploads",
            partial(backend.fused_depth, [pair] * count, K, DEPTH, np.eye(4), matching),
            options, note=f"{backend.name} on {backend.device}",
        )
        for count in PAIRS
    ]  # fmt: skip


def flown_pair(guide_px: tuple[int, int]) -> StereoPair:
    """A rectified pair with a guide, 50 m above the ground."""
    import cv2

    left, right = scene(*SIZE, LABELS)
    colour: Any = cv2.cvtColor(left, cv2.COLOR_GRAY2BGR)
    return StereoPair(
        left=left,
        right=right,
        baseline_m=4.0,
        K=camera(SIZE),
        labels=LABELS,
        plane=np.array([0.0, 0.0, 8.0]),
        slope=1.0,
        R_left_keyframe=np.eye(3),
        guide=np.asarray(cv2.resize(colour, guide_px), np.uint8),
        left_seen=np.ones(left.shape, np.bool_),
        right_seen=np.ones(left.shape, np.bool_),
    )


def camera(size_px: tuple[int, int]) -> Any:
    """(3, 3) intrinsics of the same view at any size (w, h)."""
    width, height = size_px
    f = 0.6 * width
    return np.array([[f, 0, width / 2 - 0.5], [0, f, height / 2 - 0.5], [0, 0, 1]])


def ground(shift_m: float) -> DepthMap:
    """Rolling ground 50 m below, seen from ``shift_m`` further along."""
    width, height = SIZE
    K = camera(SIZE)
    v, u = np.mgrid[0:height, 0:width]
    x, y = (u - K[0, 2]) / K[0, 0] * 50 + shift_m, (v - K[1, 2]) / K[1, 1] * 50
    depth = (50 + 2 * np.sin(x / 6) * np.cos(y / 7)).astype(np.float32)
    sigma = np.full(depth.shape, 0.05, np.float32)
    return DepthMap(depth, sigma, np.ones(depth.shape, np.uint8), K, np.eye(4))
