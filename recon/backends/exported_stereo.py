"""Belief propagation as an ONNX model, for any execution provider (Eq. 1).

Written in plain torch operations on one pair of fixed size and exported by torch. It takes all
labels of a pixel at once and holds all integers of the compiled backend exactly in float32, so
its labels are the same. Axes are (labels, h, w), messages (4, labels, h, w).
"""

from __future__ import annotations

import math
import warnings
from typing import BinaryIO

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.backends.padding import pyramid_levels
from recon.stereo.belief_propagation import RADIUS, BeliefPropagationConfig
from recon.stereo.matching_cost import (
    BIT_COST,
    CENSUS_OFFSETS,
    CENSUS_REACH,
    COST_UNIT,
    LEVEL_COST,
    MAX_BITS,
    MAX_LEVELS,
    UNSEEN_COST,
)
from recon.stereo.message_passing import FULL_WEIGHT

FAR = 1.0e6  # more than any cost or sum of costs

OPSET = 17


def export_stereo(
    file: BinaryIO, size: tuple[int, int], labels: int, config: BeliefPropagationConfig
) -> None:
    """Write an ONNX model into ``file``. Gray levels ``left`` and ``right`` (1, 1, h, w) float32, 0
    to 255, to ``disparity`` (1, 1, h, w) px, NaN where the partner is outside the right image."""
    model = BeliefPropagation(size, labels, config)
    images = torch.zeros((2, 1, 1, *size))
    with warnings.catch_warnings(), torch.inference_mode():
        # The newer exporter needs onnxscript and splits the loops no better.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            model, (images[0], images[1]), file,  # type: ignore[arg-type]
            input_names=["left", "right"],
            output_names=["disparity"], opset_version=OPSET, dynamo=False,
        )  # fmt: skip


class BeliefPropagation(torch.nn.Module):
    """Two gray images (1, 1, h, w) to the disparity of the left one."""

    def __init__(self, size: tuple[int, int], labels: int, config: BeliefPropagationConfig) -> None:
        super().__init__()
        self.labels, self.config = labels, config
        self.levels = pyramid_levels(*size, config)

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """(1, 1, h, w) px."""
        cost = matching_cost(left[0, 0], right[0, 0], self.labels, self.config)
        belief = propagate(cost, edge_weights(left[0, 0], self.config), self.levels, self.config)
        return (select(belief, cost, self.config) + self.config.min_disparity)[None, None]


def matching_cost(
    left: Tensor, right: Tensor, labels: int, config: BeliefPropagationConfig
) -> Tensor:
    """(L, h, w) cost of each label, see :mod:`recon.stereo.matching_cost`."""
    width = left.shape[1]
    bits_left, bits_right = census(left), census(right)
    layers = []
    for shift in range(config.min_disparity, config.min_disparity + labels):
        first, last = min(max(0, shift), width), max(min(width, width + shift), 0)
        if first >= last:
            layers.append(torch.full_like(left, FAR))
            continue
        there = slice(first - shift, last - shift)
        bits = (bits_left[:, :, first:last] - bits_right[:, :, there]).abs().sum(0)
        gray = (left[:, first:last] - right[:, there]).abs()
        seen = bits.clamp(max=MAX_BITS) * BIT_COST + gray.clamp(max=MAX_LEVELS) * LEVEL_COST
        layers.append(F.pad(seen, (first, width - last), value=FAR))
    cost = torch.stack(layers)
    best = cost.amin(0, keepdim=True)
    unseen = torch.where(best < FAR, best + UNSEEN_COST, torch.zeros_like(best))
    return torch.where(cost < FAR, cost, unseen)


def census(image: Tensor) -> Tensor:
    """(32, h, w) float32: 1 where the neighbour is darker than the pixel."""
    h, w = image.shape
    r = CENSUS_REACH
    padded = F.pad(image[None, None], (r, r, r, r), mode="replicate")[0, 0]
    bits = (padded[r + j : r + j + h, r + i : r + i + w] < image for j, i in CENSUS_OFFSETS)
    return torch.stack([bit.float() for bit in bits])


def edge_weights(image: Tensor, config: BeliefPropagationConfig) -> Tensor:
    """(2, h, w) weight of the edge above and to the left, in whole 1 / FULL_WEIGHT."""
    above = F.pad((image[1:] - image[:-1]).abs(), (0, 0, 1, 0))
    before = F.pad((image[:, 1:] - image[:, :-1]).abs(), (1, 0))
    fall = (1 - config.edge_floor) / config.edge_contrast
    share = (1 - torch.stack([above, before]) * fall).clamp(min=config.edge_floor)
    return torch.round(share * FULL_WEIGHT)


def propagate(
    cost: Tensor, weights: Tensor, levels: int, config: BeliefPropagationConfig
) -> Tensor:
    """(L, h, w) beliefs, as :func:`recon.stereo.message_passing.propagate` (Eq. 1)."""
    pyramid = [(_cut(cost, config.truncation), weights)]
    while len(pyramid) < levels:
        data, weight = pyramid[-1]
        pyramid.append((_cut(_pooled(data), config.truncation), _coarser(weight)))
    messages = torch.zeros((4, *pyramid[-1][0].shape))
    for data, weight in pyramid[::-1]:
        _, h, w = data.shape
        if messages.shape[2:] != data.shape[1:]:
            messages = F.interpolate(messages, scale_factor=2.0, mode="nearest")[:, :, :h, :w]
        slope = _per_direction(torch.floor(weight * (COST_UNIT / FULL_WEIGHT)))
        cut = _per_direction(torch.floor(weight * (config.truncation / FULL_WEIGHT)))
        colour = (torch.arange(h)[:, None] + torch.arange(w)[None, :]) % 2
        for t in range(config.iterations):
            new = _outgoing(data, messages, slope, cut, config.truncation)
            messages = torch.where(colour == t % 2, new, messages)
    return pyramid[0][0] + _arriving(messages).sum(0)


def _cut(data: Tensor, truncation: int) -> Tensor:
    """Above the pixel's best, at most what can win."""
    return (data - data.amin(0, keepdim=True)).clamp(max=4 * truncation)


def _pooled(data: Tensor) -> Tensor:
    """Sum over 2x2, missing pixels of an odd border counting as zero."""
    _, h, w = data.shape
    even = F.pad(data, (0, w % 2, 0, h % 2))
    rows = even[:, ::2] + even[:, 1::2]
    return rows[:, :, ::2] + rows[:, :, 1::2]


def _coarser(fine: Tensor) -> Tensor:
    """Weights of the edges of the next level: means of two, and no edge across the border."""
    _, h, w = fine.shape
    even = F.pad(fine[None], (0, w % 2, 0, h % 2), mode="replicate")[0]
    above = torch.floor((even[0, ::2, ::2] + even[0, ::2, 1::2]) / 2)
    before = torch.floor((even[1, ::2, ::2] + even[1, 1::2, ::2]) / 2)
    return torch.stack([above, before])


def _per_direction(edges: Tensor) -> Tensor:
    """(4, 1, h, w) of the edge that a message up, down, left and right crosses."""
    above, before = edges[0], edges[1]
    below = F.pad(above[1:], (0, 0, 0, 1))
    after = F.pad(before[:, 1:], (0, 1))
    return torch.stack([above, below, before, after])[:, None]


def _arriving(messages: Tensor) -> Tensor:
    """(4, L, h, w) from below, above, right and left; zero from beyond the border."""
    return torch.stack(
        [
            F.pad(messages[0, :, 1:], (0, 0, 0, 1)),
            F.pad(messages[1, :, :-1], (0, 0, 1, 0)),
            F.pad(messages[2, :, :, 1:], (0, 1)),
            F.pad(messages[3, :, :, :-1], (1, 0)),
        ]
    )


def _outgoing(
    data: Tensor, messages: Tensor, slope: Tensor, cut: Tensor, truncation: int
) -> Tensor:
    """Lower envelope of all other news; a label further than ``steps`` costs the cut anyway."""
    arriving = _arriving(messages)
    total = data + arriving.sum(0)
    rest = total - torch.stack([arriving[1], arriving[0], arriving[3], arriving[2]])
    labels = data.shape[0]
    steps = min(math.ceil(truncation / COST_UNIT) + 1, labels - 1)
    wide = F.pad(rest, (0, 0, 0, 0, steps, steps), value=FAR)
    best = rest
    for k in range(1, steps + 1):
        ahead, behind = wide[:, steps + k : steps + k + labels], wide[:, steps - k :][:, :labels]
        best = torch.minimum(best, torch.minimum(ahead, behind) + k * slope)
    return torch.minimum(best - rest.amin(1, keepdim=True), cut)


def select(belief: Tensor, cost: Tensor, config: BeliefPropagationConfig) -> Tensor:
    """(h, w) labels, as :func:`recon.stereo.belief_propagation.select`; NaN without a partner."""
    last, area = len(belief) - 1, (2 * RADIUS + 1) ** 2
    best = belief.argmin(0)
    box = torch.round(F.avg_pool2d(cost[None], 2 * RADIUS + 1, 1, RADIUS)[0] * area)
    here = box.gather(0, best[None])[0]
    a = box.gather(0, (best - 1).clamp(min=0)[None])[0] - here
    b = box.gather(0, (best + 1).clamp(max=last)[None])[0] - here
    steep = torch.maximum(a, b)
    offset = ((a - b) / (2 * steep.clamp(min=1))).clamp(-0.5, 0.5)
    inner = (best > 0) & (best < last) & (steep > 0)
    px = best.float() + torch.where(inner, offset, torch.zeros_like(offset))
    there = torch.arange(best.shape[1])[None, :] - best - config.min_disparity
    return torch.where((there >= 0) & (there < best.shape[1]), px, torch.full_like(px, math.nan))
