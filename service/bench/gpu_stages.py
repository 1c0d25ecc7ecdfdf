"""The stages of the device, each with its inputs there and the work that it cannot do without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from recon.backends.room import pyramid_levels
from recon.backends.torch_depth import DensePath, JointBilateral, averaged, fuse, reproject
from recon.backends.torch_icp import DeviceIcp
from recon.backends.torch_kernels import PLAIN, Kernels
from recon.backends.torch_matching import harris_cells, refine, search
from recon.backends.torch_plan import Plan, part
from recon.backends.torch_stereo import DenseStereo, believe, drop_unseen
from recon.backends.torch_tracking import TorchMatcher
from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.reprojection import FusionConfig
from recon.stereo.upsampling import UpsamplingConfig
from recon.tracking.matching import MatchingConfig, harris_grid
from recon.types import U8, Array, StereoPair
from service.bench.gpu import LABELS, SIZE, Stage, ground, propagation_work

PAIRS = 4
REACH = 8
ITERATIONS = 6


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


def stages(device: str, pair: StereoPair, kernels: Kernels = PLAIN) -> list[Stage]:
    """Cost and belief propagation, what is believed, upsampling, depth, fusion, ICP, matching."""
    return [
        *dense_stages(device, pair, PLAIN),
        *(fused_stages(device, pair, kernels) if kernels != PLAIN else []),
        icp_stage(device),
        *matching_stages(device),
    ]


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


def fused_stages(device: str, pair: StereoPair, kernels: Kernels) -> list[Stage]:
    """The stages that a fused kernel changes."""
    found = dense_stages(device, pair, kernels)
    chosen = [found[0]] if kernels.sweep is not None or kernels.cost is not None else []
    if kernels.bilateral is not None:
        chosen += [s for s in found if s.what.startswith("upsampling")]
    if kernels.weigh is not None:
        chosen.append(icp_stage(device, kernels))
    return [replace(s, what=f"{s.what}, fused") for s in chosen]


def icp_stage(device: str, kernels: Kernels = PLAIN) -> Stage:
    """Six iterations on all points: surfaces, partners, sums and steps."""
    icp = DeviceIcp(device, kernels)
    config = IcpConfig(strides=(1,), iterations=(6,))
    icp.register(ground(0.3), ground(0.0), np.eye(4), config)
    points, rounds = SIZE[0] * SIZE[1], config.iterations[0] + 1
    return staged(
        f"ICP of {points} points, 6 iterations, on the device", device, icp.plan(),
        points * (2 * 8.0 + rounds * 176), points * (2 * 200.0 + rounds * 400),
    )  # fmt: skip


def dense_stages(device: str, pair: StereoPair, kernels: Kernels) -> list[Stage]:
    """From two rectified pictures to fused depth, one after the other."""
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
            device, DenseStereo(LABELS, levels, matching, kind, kernels), pair.left, pair.right,
            own,
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
            *believe(left, p, s, true, matching), a, b, true
        ),
        pair.left, px, sure, seen, seen, own,
    )  # fmt: skip
    px, sure = (t.cpu().numpy() for t in trusted.run())
    bilateral = JointBilateral(upsampling, kernels)
    finer = planned(
        device,
        lambda p, s, guide, true: bilateral(p, s, averaged(guide, (h, w), true), guide, true),
        px, sure, pair.guide, both,
    )  # fmt: skip
    fine = [t.cpu().numpy() for t in finer.run()]
    geometry = np.array([*np.eye(3).ravel(), *pair.plane, pair.slope, 190.0 * pair.baseline_m])
    depth = planned(
        device, lambda p, s, g, true: reproject(p, s, g, true, SIZE), *fine, geometry, both
    )
    z, sigma = (t.cpu().numpy() for t in depth.run())
    fused = planned(
        device, lambda a, b: fuse(a, b, FusionConfig()), np.stack([z] * PAIRS),
        np.stack([sigma] * PAIRS),
    )  # fmt: skip
    taps, pixels = upsampling.diameter_px**2, w * h
    return [
        *found,
        staged(f"what is believed, {w}x{h}, on the device", device, trusted,
              20.0 * pixels, 60.0 * pixels, "contrast, visibility, speckles, both pictures"),
        staged(f"upsampling to {W}x{H}, exact, on the device", device, finer,
              11.0 * W * H, 20.0 * taps * W * H, f"{taps} taps"),
        staged(f"reprojection to {w}x{h}, on the device", device, depth,
              (8 * 5 + 8.0) * pixels, 60.0 * pixels),
        staged(f"fusion of {PAIRS} pairs, on the device", device, fused,
              (8.0 * PAIRS + 12) * pixels, 20.0 * PAIRS**2 * pixels),
    ]  # fmt: skip


def matching_stages(device: str) -> list[Stage]:
    """Corners of a picture, the search for them in another one, and its refinement."""
    config = MatchingConfig()
    a, b = moved_pictures()
    uv = harris_grid(a, config).uv_px.astype(np.float64)
    warp = np.tile([1.0, 0, 0, 1], (len(uv), 1))
    active = np.ones(len(uv), np.uint8)
    r = config.patch_radius_px
    corners = planned(device, lambda image: harris_cells(image, config), a)

    def searched(
        a: Tensor, b: Tensor, uv: Tensor, near: Tensor, warp: Tensor, active: Tensor
    ) -> tuple[Tensor, ...]:
        found = search(a, b, uv, near, warp, active > 0, REACH, r, config.min_contrast)
        return found.uv, found.score, found.second

    def refined(
        a: Tensor, b: Tensor, uv: Tensor, near: Tensor, warp: Tensor, active: Tensor
    ) -> tuple[Tensor, ...]:
        found = refine(a, b, uv, near, warp, active > 0, r, ITERATIONS)
        return found.uv, found.score

    given = (a, b, uv, uv + 2.0, warp, active)
    look, place = planned(device, searched, *given), planned(device, refined, *given)
    n, area = len(uv), (2 * r + 1) ** 2
    places = (2 * REACH + 1) ** 2
    size = f"{a.shape[1]}x{a.shape[0]}"
    matcher = TorchMatcher(device)

    def tracks() -> object:
        key, new = (matcher.pyramid(p, config.search_levels) for p in (a, b))
        return matcher.match(key, uv, new, uv, 4.0 * REACH, None, config)

    return [
        staged(f"corners of {size}, on the device", device, corners, 1.0 * a.size,
              60.0 * a.size),
        staged(f"search of {n} corners, on the device", device, look,
              n * (2 * REACH + 2 * r + 1.0) ** 2, 2.0 * n * area * places, f"reach {REACH} px"),
        staged(f"refinement of {n} places, on the device", device, place,
              n * (2.0 * r + 4) ** 2, 20.0 * n * area * ITERATIONS, f"{ITERATIONS} iterations"),
        Stage(f"tracks of {n} corners from picture to picture, with uploads", device, tracks,
              2.7 * a.size, 2.0 * n * area * (places + 81 + 20 * ITERATIONS),
              "pyramids up, search and refinement both ways, matches down"),
    ]  # fmt: skip


def moved_pictures() -> tuple[U8, U8]:
    """A textured picture of 1280x720, and the same two pixels on."""
    rng = np.random.default_rng(0)
    rough = cv2.GaussianBlur(rng.normal(0, 90, (730, 1290)), (0, 0), 1.5)
    canvas = np.clip(np.asarray(rough) * 2 + 128, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(canvas[2:722, 2:1282]), np.ascontiguousarray(canvas[:720, :1280])


def whole_path(device: str, pair: StereoPair, kernels: Kernels = PLAIN) -> list[Stage]:
    """A cloud of one pair: inputs on the device, then pictures up and depth down, and four."""
    assert pair.guide is not None
    path = DensePath(
        device, BeliefPropagationConfig(), UpsamplingConfig(), FusionConfig(), kernels=kernels
    )
    path.depth([pair], pair.K, SIZE, np.eye(4))
    plan = next(iter(path._plans.values()))
    moved, operations = propagation_work(path.matching, 2)
    H, W = pair.guide.shape[:2]
    moved += 11.0 * W * H
    operations += 20.0 * path.upsampling.diameter_px**2 * W * H
    what = f"cloud of {SIZE[0]}x{SIZE[1]} guided by {W}x{H}"

    def cloud(count: int) -> Callable[[], object]:
        return lambda: path.depth([pair] * count, pair.K, SIZE, np.eye(4))

    up = plan.upload_bytes / 1e6
    return [
        staged(f"{what}, on the device", device, plan, moved, operations, "one pair"),
        Stage(f"{what}, with uploads", device, cloud(1), moved, operations,
              f"one pair, {up:.3g} MB up"),
        Stage(f"{what}, {PAIRS} pairs, with uploads", device, cloud(PAIRS), PAIRS * moved,
              PAIRS * operations, f"{PAIRS} pairs, {PAIRS * up:.3g} MB up"),
    ]  # fmt: skip
