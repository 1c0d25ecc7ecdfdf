"""Every other backend against the compiled one, stage by stage, uploads and results included.

On a machine without a GPU the torch and ONNX backends run on the processor: the figures then
show why ``auto`` leaves them alone there, and nothing about a GPU.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from recon.backends import BACKENDS, Backend, load_backend
from recon.belief_propagation import BeliefPropagationConfig
from recon.registration import IcpConfig
from recon.types import DepthMap
from recon.upsampling import UpsamplingConfig
from service.bench import BenchOptions, BenchResult, compare
from service.bench.stereo import scene

SIZE, LABELS = (320, 180), 16
GUIDE = (1280, 720)
GUIDE_ON_DEVICE = (2704, 1520)


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds of each stage on each backend but "cpu"; one line for one that cannot run."""
    compiled = load_backend("cpu")
    results: list[BenchResult] = []
    for name in BACKENDS:
        if name == "cpu":
            continue
        try:
            backend = load_backend(name)
        except (ImportError, RuntimeError) as error:
            nothing = float("nan")
            results.append(BenchResult("gpu", name, nothing, "ms", note=f"cannot run: {error}"))
            continue
        results += stages(backend, compiled, options)
    return results


def stages(backend: Backend, compiled: Backend, options: BenchOptions) -> list[BenchResult]:
    """Belief propagation, exact upsampling and ICP of one backend beside the compiled one."""
    left, right = scene(*SIZE, LABELS)
    matching, upsampling = BeliefPropagationConfig(), UpsamplingConfig()
    coarse = compiled.belief_propagation(left, right, LABELS, matching)
    width, height = GUIDE if backend.device == "cpu" else GUIDE_ON_DEVICE
    guide = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    source, target = ground(0.3), ground(0.0)
    icp = IcpConfig(strides=(1,), iterations=(6,))
    note = f"{backend.name} on {backend.device}"
    peer = "cpu backend"
    size = f"{SIZE[0]}x{SIZE[1]}"
    return [
        compare(
            "gpu", f"stereo {size}, {LABELS} labels",
            partial(backend.belief_propagation, left, right, LABELS, matching), options, peer,
            partial(compiled.belief_propagation, left, right, LABELS, matching), note,
        ),
        compare(
            "gpu", f"upsampling {size} to {width}x{height}, exact",
            partial(backend.upsample, coarse, guide, upsampling), options, peer,
            partial(compiled.upsample, coarse, guide, upsampling), note,
        ),
        compare(
            "gpu", f"ICP of {SIZE[0] * SIZE[1]} points",
            partial(backend.register, source, target, np.eye(4), icp), options, peer,
            partial(compiled.register, source, target, np.eye(4), icp), note,
        ),
    ]  # fmt: skip


def ground(shift_m: float) -> DepthMap:
    """Rolling ground 50 m below, seen from ``shift_m`` further along."""
    width, height = SIZE
    K = np.array([[190.0, 0, width / 2 - 0.5], [0, 190.0, height / 2 - 0.5], [0, 0, 1]])
    v, u = np.mgrid[0:height, 0:width]
    x, y = (u - K[0, 2]) / K[0, 0] * 50 + shift_m, (v - K[1, 2]) / K[1, 1] * 50
    depth = (50 + 2 * np.sin(x / 6) * np.cos(y / 7)).astype(np.float32)
    sigma = np.full(depth.shape, 0.05, np.float32)
    return DepthMap(depth, sigma, np.ones(depth.shape, np.uint8), K, np.eye(4))
