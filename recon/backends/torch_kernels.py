"""Which plain torch operations a fused kernel may take the place of, and whether it may.

Without Triton, as with many wheels for the Jetson, none does. A kernel is used only where a trial
on the device at hand shows that it gives what the plain operation gives; whether it is faster is
measured by the service.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from recon.stereo.upsampling import UpsamplingConfig

if TYPE_CHECKING:
    from recon.backends.torch_icp import Weighed
    from recon.backends.torch_surface import DeviceSurface, SourcePoints
    from recon.mapping.registration import IcpConfig
    from recon.stereo.belief_propagation import BeliefPropagationConfig


Sweep = Callable[[Tensor, Tensor, Tensor, Tensor, int], None]
"""Renews in place the messages that leave one colour; see ``triton_dense.sweep``."""

Results = Callable[[], tuple[Tensor, ...]]


@dataclass(frozen=True, slots=True)
class Kernels:
    """What replaces the plain operation of that name in the Triton modules; None: nothing does."""

    sweep: Sweep | None = None
    bilateral: (
        Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, UpsamplingConfig], tuple[Tensor, Tensor]]
        | None
    ) = None
    weigh: (
        Callable[[SourcePoints, DeviceSurface, DeviceSurface, Tensor, bool, IcpConfig], Weighed]
        | None
    ) = None
    advance: (
        Callable[[Weighed, DeviceSurface, Tensor, Tensor, float, IcpConfig], tuple[Tensor, Tensor]]
        | None
    ) = None
    cost: Callable[[Tensor, Tensor, int, Tensor, BeliefPropagationConfig], Tensor] | None = None


PLAIN = Kernels()
"""Everything in plain torch."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One kernel beside the plain operation, on the same made-up inputs of a device."""

    name: str
    alone: Kernels  # this kernel and no other
    plain: Results
    fused: Results
    tolerance: float  # of every number; 0: equal

    def difference(self) -> str | None:
        """How the two disagree, or None: NaN at the same places, and numbers alike."""
        for a, b in zip(self.plain(), self.fused(), strict=True):
            if bool((torch.isnan(a) != torch.isnan(b)).any()):
                return "other pixels are unknown"
            off = float((a.double() - b.double()).abs().nan_to_num().max())
            if off > self.tolerance:
                return f"a number is off by {off:.3g}, {self.tolerance:g} is allowed"
        return None


def load_kernels() -> Kernels:
    """All kernels there are; ImportError without Triton."""
    from recon.backends.triton_dense import bilateral, matching_cost, sweep
    from recon.backends.triton_icp import advance, weigh

    return Kernels(sweep, bilateral, weigh, advance, matching_cost)


def trials(
    kernels: Kernels, device: str, size_px: tuple[int, int], guide_px: tuple[int, int], labels: int
) -> list[Trial]:
    """Each of the kernels beside the plain operation, at a size (w, h) and with a guide (W, H)."""
    from recon.backends.room import pyramid_levels
    from recon.backends.torch_depth import JointBilateral, averaged
    from recon.backends.torch_stereo import edge_weights, matching_cost, propagate
    from recon.stereo.belief_propagation import BeliefPropagationConfig

    (w, h), (W, H) = size_px, guide_px
    given = torch.Generator().manual_seed(0)
    guide = torch.randint(0, 256, (H, W, 3), generator=given, dtype=torch.uint8).to(device)
    left = torch.randint(0, 256, (h, w), generator=given).float().to(device)
    right = left.roll(-labels // 2, 1)
    matching, upsampling = BeliefPropagationConfig(), UpsamplingConfig()
    own = torch.tensor([h - 1, w - 1, labels - 1], device=device)
    sizes = torch.tensor([h - 1, w - 1, H - 1, W - 1], device=device)
    cost = matching_cost(left, right, labels, own, matching)
    edges = edge_weights(left, own, matching)
    levels = pyramid_levels(h, w, matching)
    px = labels * torch.rand((h, w), generator=given)
    px = torch.where(px > 0.8 * labels, torch.nan, px).to(device)
    sure = torch.rand((h, w), generator=given).to(device)
    taps = averaged(guide, (h, w), sizes)

    def believed(sweep: Sweep | None) -> tuple[Tensor, ...]:
        return (propagate(cost, edges, own, levels, matching, torch.int16, sweep),)

    def upsampled(kernels: Kernels) -> tuple[Tensor, ...]:
        found: tuple[Tensor, ...] = JointBilateral(upsampling, kernels)(
            px, sure, taps, guide, sizes
        )
        return tuple(layer[: H - 1, : W - 1] for layer in found)

    swept, bilateral = Kernels(sweep=kernels.sweep), Kernels(bilateral=kernels.bilateral)

    def both(kernels: Kernels) -> tuple[Results, Results]:
        return lambda: believed(kernels.sweep), lambda: upsampled(kernels)

    (plain, plain_px), (fused, _), (_, fused_px) = both(PLAIN), both(swept), both(bilateral)
    icp = Kernels(weigh=kernels.weigh, advance=kernels.advance)
    register, priced = _registered(device, size_px), Kernels(cost=kernels.cost)

    def compared(kernels: Kernels) -> tuple[Tensor, ...]:
        return ((kernels.cost or matching_cost)(left, right, labels, own, matching),)

    every = [
        Trial("belief propagation", swept, plain, fused, 0.0),
        Trial("upsampling", bilateral, plain_px, fused_px, 0.01),
        Trial("matching cost", priced, lambda: compared(PLAIN), lambda: compared(priced), 0.0),
        Trial("registration", icp, lambda: register(PLAIN), lambda: register(icp), 1e-6),
    ]
    return [trial for trial in every if trial.alone != PLAIN]


def joined(kernels: Sequence[Kernels]) -> Kernels:
    """All that any of them replaces."""
    chosen = {
        field.name: getattr(k, field.name)
        for k in kernels
        for field in fields(Kernels)
        if getattr(k, field.name) is not None
    }
    return Kernels(**chosen)


def _registered(device: str, size_px: tuple[int, int]) -> Callable[[Kernels], tuple[Tensor, ...]]:
    """ICP of rolling ground seen from two places: kernels to the motion (4, 4)."""
    from recon.backends.torch_icp import descend
    from recon.backends.torch_surface import DOUBLE, build
    from recon.mapping.registration import IcpConfig

    (w, h), config = size_px, IcpConfig()
    intrinsics = torch.tensor([0.6 * w, 0.6 * w, w / 2, h / 2], dtype=DOUBLE, device=device)
    u = torch.arange(w, device=device)[None, :] / w
    v = torch.arange(h, device=device)[:, None] / w
    seen = [50 + 2 * torch.sin(9 * u + away) * torch.cos(8 * v) for away in (0.0, 0.1)]
    sigma = torch.full((h, w), 0.05, device=device)
    a, b = (build(z, sigma, intrinsics, config.edge_share) for z in seen)
    start = torch.eye(4, dtype=DOUBLE, device=device)
    return lambda kernels: (descend(a, b, start, config, kernels)[0],)
