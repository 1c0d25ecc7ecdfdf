"""The dense stage in torch: matching cost, belief propagation, winner, bilateral upsampling.

Written in plain operations on fixed shapes, so that it runs on any device, is captured as one
CUDA graph, and exports to ONNX. All integers of the compiled backend are held exactly in
float32 (they stay below 2**24), so the beliefs are the same to the last bit. Axes are
(labels, h, w).
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.belief_propagation import BeliefPropagationConfig
from recon.disparity_selection import NOISE, RADIUS, SURE_EVIDENCE
from recon.matching_cost import CENSUS_RADIUS, COST_UNIT
from recon.message_passing import FULL_WEIGHT
from recon.upsampling import MIN_CONFIDENCE, RANGE_FLOOR, UpsamplingConfig

FAR = 1.0e6


class DenseStereo(torch.nn.Module):
    """Grey images (h, w) in 0 to 255 to labels and their confidence, two (h, w)."""

    def __init__(self, labels: int, config: BeliefPropagationConfig) -> None:
        super().__init__()
        self.labels = labels
        self.config = config

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """Labels, NaN where the partner is outside the right image; confidence, 0: not believed."""
        cost = matching_cost(left, right, self.labels, self.config)
        belief = propagate(cost, edge_weights(left, self.config), self.config)
        return select(belief, cost, self.config)


def census(image: Tensor) -> Tensor:
    """(48, h, w) float32: 1 where the neighbour is darker than the pixel."""
    h, w = image.shape
    r = CENSUS_RADIUS
    padded = F.pad(image[None, None], (r, r, r, r), mode="replicate")[0, 0]
    offsets = [(j, i) for j in range(2 * r + 1) for i in range(2 * r + 1) if (j, i) != (r, r)]
    return torch.stack([(padded[j : j + h, i : i + w] < image).float() for j, i in offsets])


def matching_cost(
    left: Tensor, right: Tensor, labels: int, config: BeliefPropagationConfig
) -> Tensor:
    """(L, h, w) cost of each label, as :func:`recon.matching_cost.matching_cost`."""
    c = config.cost
    width = left.shape[1]
    bits_left, bits_right = census(left), census(right)
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
        layers.append(F.pad(seen, (first, width - last), value=FAR))
    cost = torch.stack(layers)
    best = cost.amin(0, keepdim=True)
    unseen = torch.where(best < FAR, best + round(c.unseen * COST_UNIT), torch.zeros_like(best))
    return torch.where(cost < FAR, cost, unseen)


def edge_weights(image: Tensor, config: BeliefPropagationConfig) -> Tensor:
    """(2, h, w) weight of the edge above and to the left, in whole 1 / FULL_WEIGHT."""
    above = F.pad((image[1:] - image[:-1]).abs(), (0, 0, 1, 0))
    before = F.pad((image[:, 1:] - image[:, :-1]).abs(), (1, 0))
    fall = (1 - config.edge_floor) / config.edge_contrast
    share = (1 - torch.stack([above, before]) * fall).clamp(min=config.edge_floor)
    return torch.round(share * FULL_WEIGHT)


def propagate(cost: Tensor, weights: Tensor, config: BeliefPropagationConfig) -> Tensor:
    """(L, h, w) beliefs, as :func:`recon.message_passing.propagate` (Eq. 1)."""
    top = 4.0 * config.truncation
    pyramid = [_cut(cost, top)]
    edges = [weights]
    while len(pyramid) < config.levels and min(pyramid[-1].shape[1:]) >= 8:
        pyramid.append(_cut(_pooled(pyramid[-1]) * 4, top))
        edges.append(_coarser_weights(edges[-1]))
    messages = torch.zeros_like(pyramid[-1]).expand(4, *pyramid[-1].shape)
    for data, weight in zip(reversed(pyramid), reversed(edges), strict=True):
        _, h, w = data.shape
        if messages.shape[2:] != data.shape[1:]:
            messages = messages.repeat_interleave(2, 2).repeat_interleave(2, 3)[:, :, :h, :w]
        rows = torch.arange(h, device=data.device)[:, None]
        colour = (rows + torch.arange(w, device=data.device)[None, :]) % 2
        slope = torch.floor(weight * (COST_UNIT / FULL_WEIGHT))
        cut = torch.floor(weight * (config.truncation / FULL_WEIGHT))
        smooth = (_per_direction(slope), _per_direction(cut))
        for t in range(config.iterations):
            fresh = _outgoing(data, messages, *smooth, config)
            messages = torch.where(colour == t % 2, fresh, messages)
    return pyramid[0] + _arriving(messages).sum(0)


def _cut(data: Tensor, top: float) -> Tensor:
    return (data - data.amin(0, keepdim=True)).clamp(max=top)


def _pooled(data: Tensor) -> Tensor:
    """Mean over 2x2, missing pixels of an odd border counting as zero."""
    _, h, w = data.shape
    return F.avg_pool2d(F.pad(data, (0, w % 2, 0, h % 2))[None], 2)[0]


def _coarser_weights(fine: Tensor) -> Tensor:
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
    data: Tensor, messages: Tensor, slope: Tensor, cut: Tensor, config: BeliefPropagationConfig
) -> Tensor:
    """Lower envelope of all other news; a label further than ``steps`` costs the cut anyway."""
    arriving = _arriving(messages)
    total = data + arriving.sum(0)
    rest = total - torch.stack([arriving[1], arriving[0], arriving[3], arriving[2]])
    labels = data.shape[0]
    steps = min(math.ceil(config.truncation / COST_UNIT) + 1, labels - 1)
    wide = F.pad(rest, (0, 0, 0, 0, steps, steps), value=FAR)
    best = rest
    for k in range(1, steps + 1):
        ahead, behind = wide[:, steps + k : steps + k + labels], wide[:, steps - k :][:, :labels]
        best = torch.minimum(best, torch.minimum(ahead, behind) + k * slope)
    return torch.minimum(best - rest.amin(1, keepdim=True), cut)


def select(belief: Tensor, cost: Tensor, config: BeliefPropagationConfig) -> tuple[Tensor, Tensor]:
    """Labels and confidence, as :func:`recon.disparity_selection.select`."""
    labels, _, w = belief.shape
    index = torch.arange(labels, device=belief.device)[:, None, None]
    column = torch.arange(w, device=belief.device)[None, None, :]
    low, best = belief.min(0)
    second = torch.where((index - best).abs() <= 1, FAR, belief).amin(0)
    area = (2 * RADIUS + 1) ** 2
    box = torch.round(F.avg_pool2d(cost[None], 2 * RADIUS + 1, 1, RADIUS)[0] * area)
    partner = column - index - config.min_disparity
    seen = ((partner >= 0) & (partner < w)).float()
    mean = (box * seen).sum(0) / seen.sum(0).clamp(min=1)
    here = box.gather(0, best[None])[0]
    a = box.gather(0, (best - 1).clamp(min=0)[None])[0] - here
    b = box.gather(0, (best + 1).clamp(max=labels - 1)[None])[0] - here
    steep = torch.maximum(a, b)
    offset = ((a - b) / (2 * steep.clamp(min=1))).clamp(-0.5, 0.5)
    inner = (best > 0) & (best < labels - 1) & (steep > 0)
    px = best.float() + torch.where(inner, offset, torch.zeros_like(offset))
    evidence = (mean - here) / (mean + area * NOISE)
    margin = (second - low) / (2.0 * config.truncation)
    believed = margin > 0
    if config.min_evidence > 0:
        believed = believed & (evidence >= config.min_evidence)
    sure = (evidence.clamp(min=0.01) / SURE_EVIDENCE).clamp(max=1)
    there = column[0] - best - config.min_disparity
    inside = (there >= 0) & (there < w)
    confidence = torch.where(believed & inside, margin.clamp(max=1) * sure, 0.0)
    return torch.where(inside, px, math.nan), confidence


class JointBilateral(torch.nn.Module):
    """Eq. 2 with every tap, from (h, w) to the size of the guide (H, W, 3)."""

    def __init__(
        self, coarse: tuple[int, int], fine: tuple[int, int], config: UpsamplingConfig
    ) -> None:
        super().__init__()
        self.config = config
        self.window = [self._axis(n, m) for n, m in zip(coarse, fine, strict=True)]
        for k, (index, log) in enumerate(self.window):
            self.register_buffer(f"index{k}", index)
            self.register_buffer(f"log{k}", log)

    def _axis(self, taps: int, fine: int) -> tuple[Tensor, Tensor]:
        """Coarse index (D, fine), clamped, and log of s, very low outside, of each tap."""
        q = (torch.arange(fine, dtype=torch.float64) + 0.5) * (taps / fine) - 0.5
        index = torch.ceil(q - self.config.diameter_px / 2)[None, :] + torch.arange(
            self.config.diameter_px, dtype=torch.float64
        ).unsqueeze(1)
        log = -0.5 * ((index - q) / self.config.spatial_sigma) ** 2
        log = torch.where((index >= 0) & (index < taps), log, -1e4)
        return index.clamp(0, taps - 1).long(), log.float()

    def forward(
        self, px: Tensor, confidence: Tensor, taps: Tensor, guide: Tensor
    ) -> tuple[Tensor, Tensor]:
        """``taps`` (h, w, 3) and ``guide`` (H, W, 3) in grey levels, float32."""
        known = px == px
        trust = torch.where(known, confidence.clamp(min=MIN_CONFIDENCE), 0.0)
        value = torch.where(known, px, 0.0) * trust
        layers = torch.cat([taps.permute(2, 0, 1), torch.stack([trust, value, known.float()])])
        image = guide.permute(2, 0, 1)
        everything = torch.zeros_like(image[0])
        sums = torch.zeros_like(image)
        for j in range(self.config.diameter_px):
            rows = layers[:, self.index0[j]]
            for i in range(self.config.diameter_px):
                tap = rows[:, :, self.index1[i]]
                tonal = -((image - tap[:3]) ** 2).sum(0) / (2 * self.config.range_sigma**2)
                near = self.log0[j][:, None] + self.log1[i][None, :]
                weight = torch.exp(tonal.clamp(min=RANGE_FLOOR * math.log(2)) + near)
                everything = everything + weight
                sums = sums + weight * tap[3:]
        good = sums[2] > self.config.min_support * everything
        out = torch.where(good, sums[1] / sums[0], math.nan)
        return out, torch.where(good, sums[0] / everything, 0.0)

    index0: Any
    index1: Any
    log0: Any
    log1: Any
