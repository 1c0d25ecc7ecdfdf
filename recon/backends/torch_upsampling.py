"""Joint bilateral upsampling (Eq. 2) in torch, with every tap.

As in :mod:`recon.backends.torch_dense` arrays may be larger than the pictures in them; the true
sizes come as a tensor.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from recon.backends.torch_kernels import PLAIN, Kernels
from recon.stereo.upsampling import MIN_CONFIDENCE, RANGE_FLOOR, UpsamplingConfig

FAR_TAP = -1.0e4
"""Log of the weight of a tap outside the coarse image."""


class JointBilateral(torch.nn.Module):
    """From (h, w) to the size of the guide (H, W, 3); a kernel may do all of it."""

    def __init__(self, config: UpsamplingConfig, kernels: Kernels = PLAIN) -> None:
        super().__init__()
        self.config = config
        self.kernel = kernels.bilateral

    def forward(
        self, px: Tensor, confidence: Tensor, taps: Tensor, guide: Tensor, true: Tensor
    ) -> tuple[Tensor, Tensor]:
        """``taps`` (h, w, 3) and ``guide`` (H, W, 3) in grey levels; ``true`` (4,) h, w, H, W."""
        if self.kernel is not None:
            return self.kernel(px, confidence, taps, guide, true, self.config)
        layers = tap_layers(px, confidence, taps)
        image = guide.float().permute(2, 0, 1)
        everything = torch.zeros_like(image[0])
        sums = torch.zeros_like(image)
        rows, log_y = window(px.shape[0], guide.shape[0], true[0], true[2], self.config)
        columns, log_x = window(px.shape[1], guide.shape[1], true[1], true[3], self.config)
        for j in range(self.config.diameter_px):
            row = layers.index_select(1, rows[j])
            for i in range(self.config.diameter_px):
                tap = row.index_select(2, columns[i])
                tonal = -((image - tap[:3]) ** 2).sum(0) / (2 * self.config.range_sigma**2)
                near = log_y[j][:, None] + log_x[i][None, :]
                weight = torch.exp(tonal.clamp(min=RANGE_FLOOR * math.log(2)) + near)
                everything = everything + weight
                sums = sums + weight * tap[3:]
        good = sums[2] > self.config.min_support * everything
        out = torch.where(good, sums[1] / sums[0], math.nan)
        return out, torch.where(good, sums[0] / everything, 0.0)


def tap_layers(px: Tensor, confidence: Tensor, taps: Tensor) -> Tensor:
    """(6, h, w) what a tap brings: three colours, trust, trust times label, 1 where known."""
    known = px == px
    trust = torch.where(known, confidence.clamp(min=MIN_CONFIDENCE), 0.0)
    value = torch.where(known, px, 0.0) * trust
    colour = taps.float().permute(2, 0, 1)
    return torch.cat([colour, torch.stack([trust, value, known.float()])])


def window(
    room: int, fine_room: int, taps: Tensor, fine: Tensor, config: UpsamplingConfig
) -> tuple[Tensor, Tensor]:
    """Coarse index (D, fine), clamped, and log of s, very low outside, of each tap."""
    place = torch.arange(fine_room, dtype=torch.float64, device=taps.device)
    q = (place + 0.5) * (taps.double() / fine) - 0.5
    step = torch.arange(config.diameter_px, dtype=torch.float64, device=taps.device)
    index = torch.ceil(q - config.diameter_px / 2)[None, :] + step[:, None]
    log = -0.5 * ((index - q) / config.spatial_sigma) ** 2
    log = torch.where((index >= 0) & (index < taps), log, FAR_TAP)
    return index.clamp(0, room - 1).long(), log.float()


def averaged(guide: Tensor, room: tuple[int, int], true: Tensor) -> Tensor:
    """(h, w, 3) the guide at the coarse grid: the mean of what each tap covers, in whole levels.

    As :func:`recon.stereo.upsampling.guide_at_taps`, where halves may round the other way.
    """
    down = _shares(room[0], guide.shape[0], true[0], true[2])
    across = _shares(room[1], guide.shape[1], true[1], true[3])
    image = guide.float().permute(2, 0, 1)
    return torch.round(down @ (image @ across.T)).permute(1, 2, 0)


def _shares(room: int, fine_room: int, taps: Tensor, fine: Tensor) -> Tensor:
    """(room, fine_room) the share of each fine pixel in each coarse one along an axis."""
    step = fine.double() / taps
    first = torch.arange(room, dtype=torch.float64, device=taps.device)[:, None] * step
    pixel = torch.arange(fine_room, dtype=torch.float64, device=taps.device)[None, :]
    last = torch.minimum(first + step, fine.double())
    overlap = torch.minimum(last, pixel + 1) - torch.maximum(first, pixel)
    return (overlap.clamp(min=0) / step).float()
