"""The stages of the device, each with its inputs there and the work that it cannot do without."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from recon.backends import DenseStages
from recon.backends.room import pyramid_levels
from recon.backends.torch_depth import DensePath, fuse, reproject, upsampled
from recon.backends.torch_icp import DeviceIcp
from recon.backends.torch_plan import Plan, part
from recon.backends.torch_stereo import dense_stereo, drop_unreliable, drop_unseen
from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.reprojection import LABEL_SIGMA_PX, DepthFusionConfig
from recon.stereo.upsampling import UpsamplingConfig
from recon.types import Array, StereoPair
from service.bench.gpu import LABELS, SIZE, Stage, camera, ground, propagation_work

PAIRS = 4


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


def stages(device: str, pair: StereoPair) -> list[Stage]:
    """Cost and belief propagation, checks of labels, upsampling, depth, fusion, ICP."""
    return [*dense_stages(device, pair), icp_stage(device)]


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


def icp_stage(device: str) -> Stage:
    """Six iterations on all points: surfaces, partners, sums and steps."""
    icp = DeviceIcp(device)
    config = IcpConfig(strides=(1,), iterations=(6,))
    icp.register(ground(0.3), ground(0.0), np.eye(4), config)
    points, rounds = SIZE[0] * SIZE[1], config.iterations[0] + 1
    return staged(
        f"ICP of {points} points, 6 iterations, on the device", device, icp.plan(),
        points * (2 * 8.0 + rounds * 176), points * (2 * 200.0 + rounds * 400),
    )  # fmt: skip


def dense_stages(device: str, pair: StereoPair) -> list[Stage]:
    """From two rectified images to fused depth, one after the other."""
    w, h = SIZE
    matching, upsampling = BeliefPropagationConfig(), UpsamplingConfig()
    assert pair.guide is not None and pair.left_seen is not None
    H, W = pair.guide.shape[:2]
    own, both = np.array([h, w, LABELS]), np.array([h, w, H, W])
    levels = pyramid_levels(h, w, matching)
    moved, operations = propagation_work(matching, 2)
    found = []
    for kind in (torch.int16, torch.float32):
        stereo = planned(
            device,
            partial(
                dense_stereo, labels=LABELS, levels=levels, config=matching, messages=kind
            ),
            pair.left, pair.right, own,
        )  # fmt: skip
        found.append(
            staged(f"stereo {w}x{h}, {LABELS} labels, on the device", device, stereo, moved,
                  operations, f"messages of {str(kind).removeprefix('torch.')}")
        )  # fmt: skip
    px, sure = (t.cpu().numpy() for t in stereo.run())
    seen = np.ones((h, w), np.uint8)
    trusted = planned(
        device,
        lambda left, p, s, a, b, true: drop_unseen(
            *drop_unreliable(left, p, s, true, matching), a, b, true
        ),
        pair.left, px, sure, seen, seen, own,
    )  # fmt: skip
    px, sure = (t.cpu().numpy() for t in trusted.run())
    finer = planned(device, partial(upsampled, config=upsampling), px, sure, pair.guide, both)
    fine = [t.cpu().numpy() for t in finer.run()]
    to_left = pair.K @ np.linalg.inv(camera((W, H)))
    base = [pair.slope, pair.K[0, 0] * pair.baseline_m, LABEL_SIGMA_PX]
    geometry = np.array([*to_left.ravel(), *pair.plane, *base])
    depth = planned(
        device, lambda p, s, g, true: reproject(p, s, g, true, (W, H)), *fine, geometry, both
    )
    z, sigma = (t.cpu().numpy() for t in depth.run())
    fused = planned(
        device, lambda a, b: fuse(a, b, DepthFusionConfig()), np.stack([z] * PAIRS),
        np.stack([sigma] * PAIRS),
    )  # fmt: skip
    taps, pixels = upsampling.diameter_px**2, w * h
    return [
        *found,
        staged(f"checks of labels, {w}x{h}, on the device", device, trusted,
              20.0 * pixels, 60.0 * pixels, "contrast, visibility, speckles, both images"),
        staged(f"upsampling to {W}x{H}, exact, on the device", device, finer,
              11.0 * W * H, 20.0 * taps * W * H, f"{taps} taps"),
        staged(f"reprojection to {W}x{H}, on the device", device, depth,
              16.0 * W * H, 60.0 * W * H),
        staged(f"fusion of {PAIRS} pairs at {W}x{H}, on the device", device, fused,
              (8.0 * PAIRS + 12) * W * H, 20.0 * PAIRS**2 * W * H),
    ]  # fmt: skip


def whole_path(device: str, pair: StereoPair) -> list[Stage]:
    """A cloud of one pair: inputs on the device, then images up and depth down, and four."""
    assert pair.guide is not None
    stages = DenseStages(BeliefPropagationConfig(), UpsamplingConfig(), DepthFusionConfig())
    path = DensePath(device, stages)
    H, W = pair.guide.shape[:2]
    K = camera((W, H))
    path.depth([pair], K, (W, H), np.eye(4))
    plan = next(iter(path._plans.values()))
    moved, operations = propagation_work(stages.matching, 2)
    moved += (11.0 + 12.0) * W * H
    operations += 20.0 * stages.upsampling.diameter_px**2 * W * H
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
