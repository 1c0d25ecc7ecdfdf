"""Every stage on a device, and the whole dense path, compared with the floor of that device.

The floor is the larger of the bytes that a stage must move over the bandwidth of a copy, and its
operations over the rate of a matrix product, both measured in the same run. Figures "on the device"
have their inputs there and leave their results there; figures "with uploads" start from images of
the host and end with results on it. On a machine without a GPU all of it runs on the processor: the
figures then show why ``auto`` leaves torch and ONNX Runtime alone there, and nothing about a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from recon.backends import Backend, load_backend
from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.upsampling import UpsamplingConfig
from recon.types import DepthMap, StereoPair
from service.bench import BenchOptions, BenchResult, compare
from service.bench.stereo import scene

GUIDE = (640, 360)
GUIDE_ON_DEVICE = (2704, 1520)
DEPTH_ON_DEVICE = (1280, 720)


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds of each stage in torch and ONNX Runtime; one line for a backend that cannot
    run."""
    compiled = load_backend("cpu")
    results: list[BenchResult] = []
    for name, measure in (("torch", torch_results), ("onnx", onnx_results)):
        try:
            results += measure(compiled, options)
        except (ImportError, RuntimeError) as error:
            first = str(error).splitlines()[0]
            nothing = float("nan")
            results.append(BenchResult(name, nothing, "ms", note=f"cannot run: {first}"))
    return results


def torch_results(compiled: Backend, options: BenchOptions) -> list[BenchResult]:
    """The device itself, every stage on it, the backend's calls, and the whole path."""
    import torch

    from recon.backends.torch_backend import TorchBackend
    from service.bench.gpu_stages import stages, whole_path

    device = options.device or ("cuda" if torch.cuda.is_available() else "cpu")
    backend = TorchBackend(device)
    floor, results = measure_floor(device, options)
    guide = GUIDE_ON_DEVICE if device == "cuda" else GUIDE
    pair = flown_pair(guide)
    for stage in stages(device, pair):
        results.append(against_floor(stage, floor, options))
    results += calls(backend, compiled, guide, options)
    depth = DEPTH_ON_DEVICE if device == "cuda" else GUIDE
    whole = whole_path(device, flown_pair(depth))
    results += [against_floor(stage, floor, options) for stage in whole]
    return results


def onnx_results(compiled: Backend, options: BenchOptions) -> list[BenchResult]:
    """The calls of the ONNX backend with the providers that it finds."""
    backend = load_backend("onnx")
    if options.device == "cuda" and backend.device == "cpu":
        raise RuntimeError("ONNX Runtime has no GPU provider")
    return calls(backend, compiled, GUIDE if backend.device == "cpu" else GUIDE_ON_DEVICE, options)


def against_floor(stage: Stage, floor: Floor, options: BenchOptions) -> BenchResult:
    """The stage on the device compared with its floor."""
    found = compare(stage.what, finished(stage.device, stage.work), options)
    least = floor.ms(stage.moved_bytes, stage.operations)
    return BenchResult(
        stage.what, found.value, "ms", found.spread, "floor of the device", least,
        note=f"{stage.moved_bytes / 1e6:.3g} MB, {stage.operations / 1e6:.3g} Mop; {stage.note}",
    )  # fmt: skip


def calls(
    backend: Backend, compiled: Backend, guide_px: tuple[int, int], options: BenchOptions
) -> list[BenchResult]:
    """The backend's three calls, images up and results down, compared with the compiled ones."""
    left, right = scene(*SIZE, LABELS)
    matching, upsampling = BeliefPropagationConfig(), UpsamplingConfig()
    coarse = compiled.belief_propagation(left, right, LABELS, matching)
    guide = np.random.default_rng(0).integers(0, 256, (guide_px[1], guide_px[0], 3), np.uint8)
    source, target = ground(0.3), ground(0.0)
    icp = IcpConfig(strides=(1,), iterations=(6,))
    size = f"{SIZE[0]}x{SIZE[1]}"
    note = f"{backend.name} on {backend.device}"
    own: Iterator[tuple[str, Callable[[Backend], object]]] = iter(
        (
            (f"stereo {size}, {LABELS} labels",
             lambda b: b.belief_propagation(left, right, LABELS, matching)),
            (f"upsampling {size} to {guide_px[0]}x{guide_px[1]}, exact",
             lambda b: b.upsample(coarse, guide, upsampling)),
            (f"ICP of {SIZE[0] * SIZE[1]} points, 6 iterations",
             lambda b: b.register(source, target, np.eye(4), icp)),
        )
    )  # fmt: skip
    return [
        compare(
            f"{what}, with uploads", partial(call, backend), options, "cpu backend",
            partial(call, compiled), note,
        )
        for what, call in own
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


SIZE, LABELS = (320, 180), 16
"""Size (w, h) and labels of the rectified pair."""

COPY_MB = {"cuda": 1024, "cpu": 64}
PRODUCT = {"cuda": 8192, "cpu": 768}
"""Size of the copy and of the matrix product that give the floor."""


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """Something to be timed on a device."""

    what: str
    device: str
    work: Callable[[], object]
    moved_bytes: float
    operations: float
    note: str = ""


@dataclass(frozen=True, slots=True)
class Floor:
    """The device's bandwidth and arithmetic rate at best."""

    bytes_per_s: float
    operations_per_s: float

    def ms(self, moved_bytes: float, operations: float) -> float:
        """Least milliseconds for that much work."""
        return 1e3 * max(moved_bytes / self.bytes_per_s, operations / self.operations_per_s)


def device_name(device: str) -> str:
    """Of the GPU, or how many threads of the processor."""
    import torch

    if device == "cuda":
        return str(torch.cuda.get_device_name())
    return f"processor, {torch.get_num_threads()} threads"


def finished(device: str, work: Callable[[], object]) -> Callable[[], None]:
    """``work``, and the wait until the device has done it."""
    import torch

    def timed() -> None:
        with torch.inference_mode():
            work()
        if device == "cuda":
            torch.cuda.synchronize()

    return timed


def measure_floor(device: str, options: BenchOptions) -> tuple[Floor, list[BenchResult]]:
    """Rates of a large copy and of a float32 matrix product, and their results."""
    import torch

    source = torch.ones(COPY_MB[device] << 18, device=device)
    target = torch.empty_like(source)
    n = PRODUCT[device]
    a = torch.ones((n, n), device=device)
    b = torch.empty_like(a)
    name = device_name(device)
    copy = compare(
        f"copy of {COPY_MB[device]} MiB", finished(device, lambda: target.copy_(source)),
        options, note=name,
    )  # fmt: skip
    product = compare(
        f"matrix product of {n}", finished(device, lambda: torch.matmul(a, a, out=b)),
        options, note=name,
    )  # fmt: skip
    moved = 2.0 * source.numel() * 4
    floor = Floor(moved / copy.value * 1e3, 2.0 * n**3 / product.value * 1e3)
    rates = [
        BenchResult("bandwidth of the device", floor.bytes_per_s / 1e9, "GB/s", note=name),
        BenchResult("float32 rate of the device", floor.operations_per_s / 1e9, "Gop/s", note=name),
    ]
    return floor, [copy, product, *rates]


def propagation_work(config: BeliefPropagationConfig, bytes_each: int) -> tuple[float, float]:
    """Bytes and operations that belief propagation cannot do without.

    An iteration reads cost and four messages of every other pixel and writes four; it adds
    them, goes through the labels up and down for the envelope in four directions, normalises
    and cuts: 36 operations a label.
    """
    h, w = SIZE[1], SIZE[0]
    moved = operations = 0.0
    for _ in range(config.levels):
        cells = 0.5 * h * w * LABELS * config.iterations
        moved += 9 * cells * bytes_each
        operations += 36 * cells
        h, w = (h + 1) // 2, (w + 1) // 2
    return moved, operations


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
