"""Every stage on a GPU, and the whole dense path, compared with the floor of that device.

The floor is the larger of the bytes that a stage must move over the bandwidth of a copy, and its
operations over the rate of a matrix product, both measured in the same run. Figures "on the device"
have their inputs there and leave their results there; figures "with uploads" start from images of
the host and end with results on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from recon.backends.padding import pyramid_levels
from recon.backends.torch_depth import DensePath, upsampled
from recon.backends.torch_icp import DeviceIcp
from recon.backends.torch_plan import Plan, part
from recon.backends.triton_dense import drop_unreliable, drop_unseen, fuse, reproject, stereo
from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.reprojection import LABEL_SIGMA_PX, MIN_CONFIDENCE
from recon.stereo.upsampling import DIAMETER
from recon.types import Array, StereoPair
from service.bench import BenchOptions, BenchResult, compare
from service.bench.gpu import DEPTH, GUIDE, LABELS, SIZE, camera, flown_pair, ground

PAIRS = 4
COPY_MB, PRODUCT = 1024, 8192
"""Size of the copy and of the matrix product that give the floor."""


MATCHING = BeliefPropagationConfig()
ALL_POINTS = IcpConfig(strides=(1,), iterations=(6,))


def run(
    options: BenchOptions,
    device: str = "cuda",
    matching: BeliefPropagationConfig = MATCHING,
    icp: IcpConfig = ALL_POINTS,
) -> list[BenchResult]:
    """The device itself, every stage on it, and the whole path."""
    floor, results = measure_floor(device, options)
    found = [
        *dense_stages(device, flown_pair(GUIDE), matching),
        icp_stage(device, icp),
        *whole_path(device, flown_pair(DEPTH), matching),
    ]
    return results + [against_floor(stage, floor, options) for stage in found]


def against_floor(stage: Stage, floor: Floor, options: BenchOptions) -> BenchResult:
    """The stage on the device compared with its floor."""
    found = compare(stage.what, finished(stage.device, stage.work), options)
    least = floor.ms(stage.moved_bytes, stage.operations)
    return BenchResult(
        stage.what, found.value, "ms", found.spread, "floor of the device", least,
        note=f"{stage.moved_bytes / 1e6:.3g} MB, {stage.operations / 1e6:.3g} Mop; {stage.note}",
    )  # fmt: skip


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

    source = torch.ones(COPY_MB << 18, device=device)
    target = torch.empty_like(source)
    n = PRODUCT
    a = torch.ones((n, n), device=device)
    b = torch.empty_like(a)
    name = device_name(device)
    copy = compare(
        f"copy of {COPY_MB} MiB", finished(device, lambda: target.copy_(source)),
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


VIEWS = {
    "view", "_unsafe_view", "expand", "slice", "select", "permute", "transpose", "t", "unsqueeze",
    "squeeze", "alias", "unfold", "detach", "as_strided", "split", "unbind", "diagonal", "empty",
    "empty_like", "lift_fresh",
}  # fmt: skip
"""Operations that launch nothing."""


class Launches(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the operations that launch a kernel, one or more."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.count = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.count += func.overloadpacket.__name__ not in VIEWS
        return func(*args, **(kwargs or {}))


def staged(
    what: str, device: str, plan: Plan, moved: float, operations: float, note: str = ""
) -> Stage:
    """The stage that a plan runs, with the number of operations it launches."""
    with torch.inference_mode(), Launches() as launches:
        plan.eager()
    words = [f"{launches.count} launches", *([note] if note else [])]
    return Stage(what, device, plan.run, moved, operations, ", ".join(words))


def planned(device: str, stage: Callable[..., Any], *arrays: Array) -> Plan:
    """The stage with its inputs on the device, run once."""

    def results(*inputs: Tensor) -> tuple[Tensor, ...]:
        found = stage(*inputs)
        return found if isinstance(found, tuple) else (found,)

    with torch.inference_mode():
        plan = Plan(device, results, [part(a) for a in arrays])
        plan.upload(arrays)
        plan.run()
    return plan


def icp_stage(device: str, config: IcpConfig) -> Stage:
    """The iterations on all points: surfaces, partners, sums and steps."""
    icp = DeviceIcp(device)
    icp.register(ground(0.3), ground(0.0), np.eye(4), config)
    points, rounds = SIZE[0] * SIZE[1], config.iterations[0] + 1
    return staged(
        f"ICP of {points} points, {rounds - 1} iterations, on the device", device, icp.plan(),
        points * (2 * 8.0 + rounds * 176), points * (2 * 200.0 + rounds * 400),
    )  # fmt: skip


def dense_stages(device: str, pair: StereoPair, matching: BeliefPropagationConfig) -> list[Stage]:
    """From two rectified images to fused depth, one after the other."""
    w, h = SIZE
    assert pair.guide is not None and pair.left_seen is not None
    H, W = pair.guide.shape[:2]
    own, both = np.array([h, w, LABELS]), np.array([h, w, H, W])
    levels = pyramid_levels(h, w, matching)
    moved, operations = propagation_work(matching, 2)
    labels = planned(
        device, lambda a, b, true: stereo(a, b, LABELS, levels, true, matching),
        pair.left, pair.right, own,
    )  # fmt: skip
    px, sure = (t.cpu().numpy() for t in labels.run())
    seen = np.ones((h, w), np.uint8)
    trusted = planned(
        device,
        lambda left, p, s, a, b, true: drop_unseen(
            *drop_unreliable(left, p, s, true, matching), a, b, true
        ),
        pair.left, px, sure, seen, seen, own,
    )  # fmt: skip
    px, sure = (t.cpu().numpy() for t in trusted.run())
    finer = planned(device, upsampled, px, sure, pair.guide, both)
    fine = [t.cpu().numpy() for t in finer.run()]
    to_left = pair.K @ np.linalg.inv(camera((W, H)))
    base = [pair.slope, pair.K[0, 0] * pair.baseline_m, LABEL_SIGMA_PX]
    geometry = np.array([*to_left.ravel(), *pair.plane, *base])
    depth = planned(
        device,
        lambda p, s, g, true: reproject(p, s, g, true, (W, H), MIN_CONFIDENCE),
        *fine,
        geometry,
        both,
    )
    z, sigma = (t.cpu().numpy() for t in depth.run())
    fused = planned(
        device, lambda a, b: fuse(a, b), np.stack([z] * PAIRS),
        np.stack([sigma] * PAIRS),
    )  # fmt: skip
    taps, pixels = DIAMETER**2, w * h
    return [
        staged(f"stereo {w}x{h}, {LABELS} labels, on the device", device, labels, moved,
               operations),
        staged(f"checks of labels, {w}x{h}, on the device", device, trusted,
              20.0 * pixels, 60.0 * pixels, "contrast, visibility, speckles, both images"),
        staged(f"upsampling to {W}x{H}, exact, on the device", device, finer,
              11.0 * W * H, 20.0 * taps * W * H, f"{taps} taps"),
        staged(f"reprojection to {W}x{H}, on the device", device, depth,
              16.0 * W * H, 60.0 * W * H),
        staged(f"fusion of {PAIRS} pairs at {W}x{H}, on the device", device, fused,
              (8.0 * PAIRS + 12) * W * H, 20.0 * PAIRS**2 * W * H),
    ]  # fmt: skip


def whole_path(device: str, pair: StereoPair, matching: BeliefPropagationConfig) -> list[Stage]:
    """A cloud of one pair: inputs on the device, then images up and depth down, and four."""
    assert pair.guide is not None
    path = DensePath(device, matching)
    H, W = pair.guide.shape[:2]
    K = camera((W, H))
    path.depth([pair], K, (W, H), np.eye(4))
    plan = next(iter(path.plans.values()))
    moved, operations = propagation_work(matching, 2)
    moved += (11.0 + 12.0) * W * H
    operations += 20.0 * DIAMETER**2 * W * H
    what = f"cloud of {W}x{H} from pairs of {SIZE[0]}x{SIZE[1]}"

    def cloud(count: int) -> Callable[[], object]:
        return lambda: path.depth([pair] * count, K, (W, H), np.eye(4))

    up = plan.upload_bytes / 1e6
    return [
        staged(f"{what}, on the device", device, plan, moved, operations, "one pair"),
        Stage(f"{what}, with uploads", device, cloud(1), moved, operations,
              f"one pair, {up:.3g} MB up"),
        Stage(f"{what}, {PAIRS} pairs, with uploads", device, cloud(PAIRS), PAIRS * moved,
              PAIRS * operations, f"{PAIRS} pairs, {PAIRS * up:.3g} MB up"),
    ]  # fmt: skip
