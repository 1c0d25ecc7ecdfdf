"""Stereo in torch: matching cost, belief propagation (Eq. 1), winner, and its checks.

Written in plain operations on fixed shapes, so that it runs on any device and is captured as
one CUDA graph. The pairs of a flight differ by a few pixels and labels from each other: arrays
are a little larger than the pair (see :mod:`recon.backends.room`), and its true height, width
and number of labels come as a tensor. What lies beyond them says nothing, so the results are
those of the pair alone, to the last bit. All integers of the compiled backend are held exactly,
in float32 (they stay below 2**24) or in int16 (half the bytes). Axes are (labels, h, w).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.backends.torch_plan import fused
from recon.stereo.belief_propagation import (
    NOISE,
    RADIUS,
    SPECKLE_STEP,
    SURE_EVIDENCE,
    BeliefPropagationConfig,
)
from recon.stereo.matching_cost import CENSUS_RADIUS, COST_UNIT
from recon.stereo.message_passing import FULL_WEIGHT

BEYOND = 28000
"""In place of ``FAR`` in 16 bits: more than any sum, and room for the longest slope on top."""

MAX_SHORT_TRUNCATION = 1024
"""The largest truncation for which no sum of four costs leaves 16 bits."""


def dense_stereo(
    left: Tensor, right: Tensor, true: Tensor, labels: int, levels: int,
    config: BeliefPropagationConfig, messages: torch.dtype = torch.int16,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Labels of gray images (h, w), NaN where the partner is outside the right one; and their
    confidence, 0 where rejected.

    Args:
        true: (3,) height, width and labels of the pair; beyond them the images repeat their last
            row and column, and the results mean nothing.
        labels: the room for them.
        levels: of the pyramid.
        messages: type of costs and messages, torch.int16 (where they fit) or torch.float32.
    """
    if config.truncation > MAX_SHORT_TRUNCATION:
        messages = torch.float32
    if fused(left) and messages == torch.int16:
        from recon.backends import triton_dense

        return triton_dense.stereo(left, right, labels, levels, true, config)
    left, right = left.float(), right.float()
    cost = matching_cost(left, right, labels, true, config)
    belief = propagate(cost, edge_weights(left, true, config), true, levels, config, messages)
    return select(belief, cost, true, config)


def edge_weights(image: Tensor, true: Tensor, config: BeliefPropagationConfig) -> Tensor:
    """(2, h, w) weight of the edge above and to the left, in whole 1 / FULL_WEIGHT."""
    above = F.pad((image[1:] - image[:-1]).abs(), (0, 0, 1, 0))
    before = F.pad((image[:, 1:] - image[:, :-1]).abs(), (1, 0))
    fall = (1 - config.edge_floor) / config.edge_contrast
    share = (1 - torch.stack([above, before]) * fall).clamp(min=config.edge_floor)
    return _bounded(torch.round(share * FULL_WEIGHT), true)


def _bounded(edges: Tensor, true: Tensor) -> Tensor:
    """The last edges along the border of the pair repeated, and no edge across it."""
    rows = torch.arange(edges.shape[1], device=edges.device)
    columns = torch.arange(edges.shape[2], device=edges.device)
    edges = edges.index_select(1, torch.minimum(rows, true[0] - 1))
    edges = edges.index_select(2, torch.minimum(columns, true[1] - 1))
    return torch.stack([edges[0] * (rows < true[0])[:, None], edges[1] * (columns < true[1])])


def propagate(
    cost: Tensor,
    weights: Tensor,
    true: Tensor,
    levels: int,
    config: BeliefPropagationConfig,
    kind: torch.dtype,
) -> Tensor:
    """(L, h, w) beliefs, as :func:`recon.stereo.message_passing.propagate` (Eq. 1)."""
    labels = true[2]
    pyramid = [_cut(cost.to(kind), labels, config.truncation)]
    edges, sizes = [weights], [true[:2]]
    while len(pyramid) < levels:
        pyramid.append(_cut(_pooled(pyramid[-1]), labels, config.truncation))
        sizes.append((sizes[-1] + 1) // 2)
        edges.append(_bounded(_coarser_weights(edges[-1]), sizes[-1]))
    messages = torch.zeros_like(pyramid[-1]).expand(4, *pyramid[-1].shape)
    for data, weight, size in zip(pyramid[::-1], edges[::-1], sizes[::-1], strict=True):
        _, h, w = data.shape
        if messages.shape[2:] != data.shape[1:]:
            messages = messages.repeat_interleave(2, 2).repeat_interleave(2, 3)[:, :, :h, :w]
            messages = messages * inside(data.shape, size)
        slope = torch.floor(weight * (COST_UNIT / FULL_WEIGHT)).to(kind)
        cut = torch.floor(weight * (config.truncation / FULL_WEIGHT)).to(kind)
        smooth = (_per_direction(slope), _per_direction(cut))
        for t in range(config.iterations):
            messages = sweep(data, messages, *smooth, t % 2, config.truncation)
    return pyramid[0] + _total(_arriving(messages))


def sweep(
    data: Tensor, messages: Tensor, slope: Tensor, cut: Tensor, colour: int, truncation: int
) -> Tensor:
    """(4, L, h, w) messages of which those of the pixels of ``colour`` are new.

    ``slope`` and ``cut`` (4, 1, h, w) are of the edge that each direction crosses.
    """
    _, h, w = data.shape
    rows = torch.arange(h, device=data.device)[:, None]
    ours = (rows + torch.arange(w, device=data.device)[None, :]) % 2 == colour
    return torch.where(ours, _outgoing(data, messages, slope, cut, truncation), messages)


def _beyond(values: Tensor) -> float:
    """A number of their type above all of them."""
    return FAR if values.dtype == torch.float32 else BEYOND


def _cut(data: Tensor, labels: Tensor, truncation: int) -> Tensor:
    """Above the pixel's best, at most what can win; a label that is not of the pair cannot."""
    top = 4 * truncation
    ours = torch.arange(data.shape[0], device=data.device)[:, None, None] < labels
    least = torch.where(ours, data, _beyond(data)).amin(0, keepdim=True)
    return torch.where(ours, (data - least).clamp(max=top), top).to(data.dtype)


def _pooled(data: Tensor) -> Tensor:
    """Sum over 2x2, missing pixels of an odd border counting as zero."""
    _, h, w = data.shape
    even = F.pad(data, (0, w % 2, 0, h % 2))
    rows = even[:, ::2] + even[:, 1::2]
    return rows[:, :, ::2] + rows[:, :, 1::2]


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


def _total(arriving: Tensor) -> Tensor:
    """Sum of the four, in their own type."""
    return (arriving[0] + arriving[1]) + (arriving[2] + arriving[3])


def _outgoing(
    data: Tensor, messages: Tensor, slope: Tensor, cut: Tensor, truncation: int
) -> Tensor:
    """Lower envelope of all other news; a label further than ``steps`` costs the cut anyway."""
    arriving = _arriving(messages)
    total = data + _total(arriving)
    rest = total - torch.stack([arriving[1], arriving[0], arriving[3], arriving[2]])
    labels = data.shape[0]
    steps = min(math.ceil(truncation / COST_UNIT) + 1, labels - 1)
    wide = F.pad(rest, (0, 0, 0, 0, steps, steps), value=_beyond(rest))
    best = rest
    for k in range(1, steps + 1):
        ahead, behind = wide[:, steps + k : steps + k + labels], wide[:, steps - k :][:, :labels]
        best = torch.minimum(best, torch.minimum(ahead, behind) + k * slope)
    return torch.minimum(best - rest.amin(1, keepdim=True), cut)


def select(
    belief: Tensor, cost: Tensor, true: Tensor, config: BeliefPropagationConfig
) -> tuple[Tensor, Tensor]:
    """Labels and confidence, as :func:`recon.stereo.belief_propagation.select`."""
    room_for, _, w = belief.shape
    index = torch.arange(room_for, device=belief.device)[:, None, None]
    column = torch.arange(w, device=belief.device)[None, None, :]
    ours = index < true[2]
    belief = torch.where(ours, belief, _beyond(belief))
    low, best = belief.min(0)
    adjacent = (index - best).abs() <= 1
    second = torch.where(adjacent | ~ours, FAR, belief.float()).amin(0)
    area = (2 * RADIUS + 1) ** 2
    box = torch.round(F.avg_pool2d(cost[None], 2 * RADIUS + 1, 1, RADIUS)[0] * area)
    partner = column - index - config.min_disparity
    seen = ((partner >= 0) & (partner < true[1]) & ours).float()
    mean = (box * seen).sum(0) / seen.sum(0).clamp(min=1)
    here = box.gather(0, best[None])[0]
    a = box.gather(0, (best - 1).clamp(min=0)[None])[0] - here
    b = box.gather(0, torch.minimum(best + 1, true[2] - 1)[None])[0] - here
    steep = torch.maximum(a, b)
    offset = ((a - b) / (2 * steep.clamp(min=1))).clamp(-0.5, 0.5)
    inner = (best > 0) & (best < true[2] - 1) & (steep > 0)
    px = best.float() + torch.where(inner, offset, torch.zeros_like(offset))
    evidence = (mean - here) / (mean + area * NOISE)
    margin = (second - low) / (2.0 * config.truncation)
    accepted = margin > 0
    if config.min_evidence > 0:
        accepted = accepted & (evidence >= config.min_evidence)
    sure = (evidence.clamp(min=0.01) / SURE_EVIDENCE).clamp(max=1)
    there = column[0] - best - config.min_disparity
    sees = (there >= 0) & (there < true[1]) & inside(best.shape, true)
    confidence = torch.where(accepted & sees, margin.clamp(max=1) * sure, 0.0)
    return torch.where(sees, px, math.nan), confidence


FAR = 1.0e6
"""More than any cost or sum of costs."""


def inside(shape: torch.Size | tuple[int, ...], true: Tensor) -> Tensor:
    """(h, w) boolean: rows and columns of the pair itself; ``true`` begins with its size."""
    rows = torch.arange(shape[-2], device=true.device)[:, None]
    return (rows < true[0]) & (torch.arange(shape[-1], device=true.device)[None, :] < true[1])


def census(image: Tensor) -> Tensor:
    """(24, h, w) float32: 1 where the neighbour is darker than the pixel."""
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
        gray = (left[:, first:last] - right[:, there]).abs()
        seen = bits.clamp(max=c.census_truncation) * round(c.census_weight * COST_UNIT)
        seen = seen + gray.clamp(max=c.difference_truncation) * round(
            c.difference_weight * COST_UNIT
        )
        partner = column[first:last] - shift
        seen = torch.where((partner < true[1]) & (label < true[2]), seen, FAR)
        layers.append(F.pad(seen, (first, width - last), value=FAR))
    cost = torch.stack(layers)
    best = cost.amin(0, keepdim=True)
    unseen = torch.where(best < FAR, best + round(c.unseen * COST_UNIT), torch.zeros_like(best))
    return torch.where(cost < FAR, cost, unseen) * inside(cost.shape, true)


CONTRAST_PX = 9
UNKNOWN = -2048 * SPECKLE_STEP


def drop_unreliable(
    left: Tensor, px: Tensor, confidence: Tensor, true: Tensor, config: BeliefPropagationConfig
) -> tuple[Tensor, Tensor]:
    """Labels (h, w), NaN where they are unreliable, and their confidence."""
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
    """Standard deviation of the gray levels in 9x9, (h, w) float64; sums are exact."""
    r = CONTRAST_PX // 2
    if fused(image):
        from recon.backends import triton_dense

        return triton_dense.contrast(image, r)
    wide = F.pad(image.float()[None], (r, r, r, r), mode="replicate")

    def mean(values: Tensor) -> Tensor:
        summed = F.avg_pool2d(values, CONTRAST_PX, 1, divisor_override=1)[0]
        return summed.double() / CONTRAST_PX**2

    return (mean(wide * wide) - mean(wide) ** 2).clamp(min=0).sqrt()


def _hidden(
    px: Tensor, confidence: Tensor, true: Tensor, config: BeliefPropagationConfig
) -> Tensor:
    """True where the right view would see a nearer, accepted surface."""
    if fused(px):
        from recon.backends import triton_dense

        return triton_dense.hidden(px, confidence, true, config)
    w = px.shape[1]
    known = px == px
    label = torch.where(known, px, 0.0)
    column = torch.arange(w, device=px.device)[None, :]
    partner = column - torch.floor(label + 0.5).long() - config.min_disparity
    sees = known & (partner >= 0) & (partner < true[1])
    partner = partner.clamp(0, w - 1)
    known = torch.where(sees & (confidence > 0), label, -math.inf)
    nearest = torch.full_like(px, -math.inf).scatter_reduce(1, partner, known, "amax")
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
    if fused(px):
        from recon.backends import triton_dense

        return triton_dense.speckles(level, largest, UNKNOWN)
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


def _of_neighbours(
    own: Tensor, across: Tensor, down: Tensor, none: int, best: Callable[[Tensor, Tensor], Tensor]
) -> Tensor:
    """The best of the indices of the connected neighbours; ``none`` without any."""
    right = F.pad(torch.where(across, own[:, 1:], none), (0, 1), value=none)
    left = F.pad(torch.where(across, own[:, :-1], none), (1, 0), value=none)
    below = F.pad(torch.where(down, own[1:], none), (0, 0, 0, 1), value=none)
    above = F.pad(torch.where(down, own[:-1], none), (0, 0, 1, 0), value=none)
    return best(best(right, left), best(below, above))


def drop_unseen(
    px: Tensor, confidence: Tensor, left_seen: Tensor, right_seen: Tensor, true: Tensor
) -> tuple[Tensor, Tensor]:
    """The labels without those on masked pixels of either image; masks are 0 or 1."""
    if fused(px):
        from recon.backends import triton_dense

        return triton_dense.drop_unseen(px, confidence, left_seen, right_seen, true)
    w = px.shape[1]
    known = px == px
    column = torch.arange(w, device=px.device)[None, :]
    partner = torch.round(column - torch.where(known, px, 0.0).double()).long()
    sees = known & (left_seen > 0) & (partner >= 0) & (partner < true[1])
    sees = sees & (right_seen.gather(1, partner.clamp(0, w - 1)) > 0)
    return torch.where(sees, px, math.nan), torch.where(sees, confidence, 0.0)
