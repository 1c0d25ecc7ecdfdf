"""Which labels are believed, in torch: contrast, visibility, size of the surface, both pictures.

The same answers as :func:`recon.stereo.belief_propagation.believe` and
:func:`recon.stereo.virtual_stereo.drop_unseen`, without leaving the device. ``true`` begins
with the height and width of the pair in arrays that may be larger.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.backends.torch_cost import inside
from recon.stereo.belief_propagation import SPECKLE_STEP, BeliefPropagationConfig

CONTRAST_PX = 9
UNKNOWN = -2048 * SPECKLE_STEP


def believe(
    left: Tensor, px: Tensor, confidence: Tensor, true: Tensor, config: BeliefPropagationConfig
) -> tuple[Tensor, Tensor]:
    """Labels (h, w), NaN where nothing speaks for them, and their confidence.

    Raises ValueError for ``fill_occluded``, which belongs to still pairs.
    """
    if config.fill_occluded:
        raise ValueError("fill_occluded is not done on the device")
    if config.min_contrast > 0:
        confidence = torch.where(_contrast(left) < config.min_contrast, 0.0, confidence)
    gone = confidence <= 0
    if config.occlusion_tolerance >= 0:
        gone = gone | _hidden(px, confidence, true, config)
    px = torch.where(gone | ~inside(px.shape, true), math.nan, px)
    if config.speckle_px > 0:
        px = torch.where(_speckles(px, config.speckle_px), math.nan, px)
    return px, torch.where(px == px, confidence, 0.0)


def _contrast(image: Tensor) -> Tensor:
    """Standard deviation of the grey levels in 9x9, (h, w) float64; sums are exact."""
    r = CONTRAST_PX // 2
    wide = F.pad(image.float()[None], (r, r, r, r), mode="replicate")

    def mean(values: Tensor) -> Tensor:
        summed = F.avg_pool2d(values, CONTRAST_PX, 1, divisor_override=1)[0]
        return summed.double() / CONTRAST_PX**2

    return (mean(wide * wide) - mean(wide) ** 2).clamp(min=0).sqrt()


def _hidden(
    px: Tensor, confidence: Tensor, true: Tensor, config: BeliefPropagationConfig
) -> Tensor:
    """True where the right view would see a nearer, believed surface."""
    w = px.shape[1]
    known = px == px
    label = torch.where(known, px, 0.0)
    column = torch.arange(w, device=px.device)[None, :]
    partner = column - torch.floor(label + 0.5).long() - config.min_disparity
    sees = known & (partner >= 0) & (partner < true[1])
    partner = partner.clamp(0, w - 1)
    told = torch.where(sees & (confidence > 0), label, -math.inf)
    nearest = torch.full_like(px, -math.inf).scatter_reduce(1, partner, told, "amax")
    return sees & (nearest.gather(1, partner) > label + config.occlusion_tolerance)


def _speckles(px: Tensor, largest: int) -> Tensor:
    """True on surfaces of at most ``largest`` pixels.

    The least index of a surface wanders from neighbour to neighbour. After ``largest`` steps it
    has been everywhere on a surface that small; a set of pixels with one index is a whole
    surface when no neighbour of the same surface has another index.
    """
    h, w = px.shape
    level = torch.where(px == px, px * SPECKLE_STEP, float(UNKNOWN)).int()
    known = level > UNKNOWN
    across = ((level[:, 1:] - level[:, :-1]).abs() <= SPECKLE_STEP) & known[:, 1:] & known[:, :-1]
    down = ((level[1:] - level[:-1]).abs() <= SPECKLE_STEP) & known[1:] & known[:-1]
    own = torch.arange(h * w, device=px.device, dtype=torch.int32).view(h, w)
    for _ in range(largest):
        own = torch.minimum(own, _of_neighbours(own, across, down, h * w, torch.minimum))
    most = _of_neighbours(own, across, down, -1, torch.maximum)
    least = _of_neighbours(own, across, down, h * w, torch.minimum)
    mixed = ((most > own) | (least < own)).int().view(-1)
    index = own.view(-1).long()
    count = torch.zeros_like(mixed).scatter_add(0, index, torch.ones_like(mixed))
    part = torch.zeros_like(mixed).scatter_reduce(0, index, mixed, "amax")
    small = (count[index] <= largest) & (part[index] == 0)
    return small.view(h, w) & known


def _of_neighbours(own: Tensor, across: Tensor, down: Tensor, none: int, best: object) -> Tensor:
    """The best of the indices of the connected neighbours; ``none`` without any."""
    assert callable(best)
    right = F.pad(torch.where(across, own[:, 1:], none), (0, 1), value=none)
    left = F.pad(torch.where(across, own[:, :-1], none), (1, 0), value=none)
    below = F.pad(torch.where(down, own[1:], none), (0, 0, 0, 1), value=none)
    above = F.pad(torch.where(down, own[:-1], none), (0, 0, 1, 0), value=none)
    result: Tensor = best(best(right, left), best(below, above))
    return result


def drop_unseen(
    px: Tensor, confidence: Tensor, left_seen: Tensor, right_seen: Tensor, true: Tensor
) -> tuple[Tensor, Tensor]:
    """The labels without those that rest on nothing in either picture; masks are 0 or 1."""
    w = px.shape[1]
    known = px == px
    column = torch.arange(w, device=px.device)[None, :]
    partner = torch.round(column - torch.where(known, px, 0.0).double()).long()
    sees = known & (left_seen > 0) & (partner >= 0) & (partner < true[1])
    sees = sees & (right_seen.gather(1, partner.clamp(0, w - 1)) > 0)
    return torch.where(sees, px, math.nan), torch.where(sees, confidence, 0.0)
