"""Matching cost in torch, and which pixels of larger arrays are of the pair itself."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.matching_cost import CENSUS_RADIUS, COST_UNIT

FAR = 1.0e6
"""More than any cost or sum of costs."""


def inside(shape: torch.Size | tuple[int, ...], true: Tensor) -> Tensor:
    """(h, w) boolean: rows and columns of the pair itself; ``true`` begins with its size."""
    rows = torch.arange(shape[-2], device=true.device)[:, None]
    return (rows < true[0]) & (torch.arange(shape[-1], device=true.device)[None, :] < true[1])


def census(image: Tensor) -> Tensor:
    """(48, h, w) float32: 1 where the neighbour is darker than the pixel."""
    h, w = image.shape
    r = CENSUS_RADIUS
    padded = F.pad(image[None, None], (r, r, r, r), mode="replicate")[0, 0]
    offsets = [(j, i) for j in range(2 * r + 1) for i in range(2 * r + 1) if (j, i) != (r, r)]
    return torch.stack([(padded[j : j + h, i : i + w] < image).float() for j, i in offsets])


def matching_cost(
    left: Tensor, right: Tensor, labels: int, true: Tensor, config: BeliefPropagationConfig
) -> Tensor:
    """(L, h, w) cost of each label, see :mod:`recon.stereo.matching_cost`; 0 beyond."""
    c = config.cost
    width = left.shape[1]
    bits_left, bits_right = census(left), census(right)
    column = torch.arange(width, device=left.device)
    layers = []
    for label in range(labels):
        shift = label + config.min_disparity
        first, last = min(max(0, shift), width), max(min(width, width + shift), 0)
        if first >= last:
            layers.append(torch.full_like(left, FAR))
            continue
        there = slice(first - shift, last - shift)
        bits = (bits_left[:, :, first:last] - bits_right[:, :, there]).abs().sum(0)
        grey = (left[:, first:last] - right[:, there]).abs()
        seen = bits.clamp(max=c.census_truncation) * round(c.census_weight * COST_UNIT)
        seen = seen + grey.clamp(max=c.difference_truncation) * round(
            c.difference_weight * COST_UNIT
        )
        partner = column[first:last] - shift
        seen = torch.where((partner < true[1]) & (label < true[2]), seen, FAR)
        layers.append(F.pad(seen, (first, width - last), value=FAR))
    cost = torch.stack(layers)
    best = cost.amin(0, keepdim=True)
    unseen = torch.where(best < FAR, best + round(c.unseen * COST_UNIT), torch.zeros_like(best))
    return torch.where(cost < FAR, cost, unseen) * inside(cost.shape, true)
