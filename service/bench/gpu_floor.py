"""What a device can do at best, and the work that no implementation can do without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import DepthMap
from service.bench import BenchOptions, BenchResult, compare

SIZE, LABELS = (320, 180), 16
"""Of a rectified pair (w, h)."""

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
    """What the device can do at best."""

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
    """Rates of a large copy and of a float32 matrix product, and the lines that say so."""
    import torch

    source = torch.ones(COPY_MB[device] << 18, device=device)
    target = torch.empty_like(source)
    n = PRODUCT[device]
    a = torch.ones((n, n), device=device)
    b = torch.empty_like(a)
    name = device_name(device)
    copy = compare(
        "gpu", f"copy of {COPY_MB[device]} MiB", finished(device, lambda: target.copy_(source)),
        options, note=name,
    )  # fmt: skip
    product = compare(
        "gpu", f"matrix product of {n}", finished(device, lambda: torch.matmul(a, a, out=b)),
        options, note=name,
    )  # fmt: skip
    moved = 2.0 * source.numel() * 4
    floor = Floor(moved / copy.value * 1e3, 2.0 * n**3 / product.value * 1e3)
    rates = [
        BenchResult("gpu", "bandwidth of the device", floor.bytes_per_s / 1e9, "GB/s", note=name),
        BenchResult(
            "gpu", "float32 rate of the device", floor.operations_per_s / 1e9, "Gop/s", note=name
        ),
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


def camera() -> Any:
    """(3, 3) intrinsics at ``SIZE``."""
    width, height = SIZE
    return np.array([[190.0, 0, width / 2 - 0.5], [0, 190.0, height / 2 - 0.5], [0, 0, 1]])


def ground(shift_m: float) -> DepthMap:
    """Rolling ground 50 m below, seen from ``shift_m`` further along."""
    width, height = SIZE
    K = camera()
    v, u = np.mgrid[0:height, 0:width]
    x, y = (u - K[0, 2]) / K[0, 0] * 50 + shift_m, (v - K[1, 2]) / K[1, 1] * 50
    depth = (50 + 2 * np.sin(x / 6) * np.cos(y / 7)).astype(np.float32)
    sigma = np.full(depth.shape, 0.05, np.float32)
    return DepthMap(depth, sigma, np.ones(depth.shape, np.uint8), K, np.eye(4))
