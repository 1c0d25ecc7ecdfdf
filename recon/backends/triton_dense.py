"""The dense stages as Triton kernels: cost, messages, labels, their checks and depth, Eq. 1 to 3.

Each function computes what the compiled one of :mod:`recon.stereo` does, which the tests compare.
A kernel is compiled once for all sizes. The pairs of a flight differ by a few pixels and labels
from each other: arrays are a little larger than the pair (:mod:`recon.backends.padding`), and its
true height, width and number of labels come as a tensor ``true``. What lies beyond them says
nothing. Costs and messages are (h, w, L) int16, L a power of two: a thread holds labels that lie
side by side in memory. Sums have 32 bits, so all integers are exact.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs
# Triton reads annotations of a kernel as values of its own, so its arguments have none.
from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.stereo.belief_propagation import (
    NOISE,
    RADIUS,
    SPECKLE_STEP,
    SURE_EVIDENCE,
    UNKNOWN,
    BeliefPropagationConfig,
)
from recon.stereo.matching_cost import (
    BIT_COST,
    CENSUS_OFFSETS,
    COST_UNIT,
    LEVEL_COST,
    MAX_BITS,
    MAX_LEVELS,
    UNSEEN_COST,
)
from recon.stereo.message_passing import FULL_WEIGHT
from recon.stereo.reprojection import (
    AGREE_SIGMAS,
    MAX_SIGMA_SHARE,
    MIN_SIGMA_SHARE,
    SINGLE_VIEW_SIGMA,
)
from recon.stereo.upsampling import COLOUR_SCALE, DIAMETER, MIN_SUPPORT, RANGE_FLOOR, SPATIAL_SIGMA

PIXELS = 128  # pixels of one program that holds one number each
CELLS = 32  # pixels of one program that holds all labels of each


def stereo(
    left: Tensor, right: Tensor, labels: int, levels: int, true: Tensor,
    config: BeliefPropagationConfig,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Labels of gray images (h, w) uint8, NaN where the partner is outside the right one, and their
    confidence, 0 where rejected; Eq. 1.

    ``true`` (3,) is height, width and labels of the pair; beyond them the images repeat their last
    row and column. ``labels`` is the room for them, ``levels`` of the pyramid.
    """
    room = max(triton.next_power_of_2(labels), 8)
    cost, data = matching_cost(left, right, room, true, config)
    edges = edge_weights(left, true, config)
    pyramid = [(data, edges)]
    for level in range(1, levels):
        pyramid.append(coarser(*pyramid[-1], true, level, config))
    messages = torch.zeros((4, *pyramid[-1][0].shape), dtype=torch.int16, device=left.device)
    for level in reversed(range(levels)):
        data, edges = pyramid[level]
        if messages.shape[1:] != data.shape:
            messages = finer(messages, data, true, level)
        for t in range(config.iterations):
            sweep(data, messages, edges, t % 2, config)
    return select(data, messages, cost, true, config)


def blocks(pixels: int, each: int) -> int:
    """How many programs of ``each`` pixels."""
    return -(-pixels // each)


def matching_cost(
    left: Tensor, right: Tensor, room: int, true: Tensor, config: BeliefPropagationConfig
) -> tuple[Tensor, Tensor]:
    """Cost of each label (h, w, L), and the same above the pixel's best and cut."""
    h, w = left.shape
    words = torch.empty((2, h, w), dtype=torch.int32, device=left.device)
    census_kernel[(blocks(h * w, PIXELS), 2)](left, right, words, h, w, CENSUS_OFFSETS, PIXELS)
    cost, data = torch.empty((2, h, w, room), dtype=torch.int16, device=left.device)
    cost_kernel[(blocks(h * w, CELLS),)](
        left, right, words, true, cost, data, h, w, config.min_disparity, MAX_BITS,
        BIT_COST, MAX_LEVELS, LEVEL_COST, UNSEEN_COST, 4 * config.truncation, room, CELLS,
    )  # fmt: skip
    return cost, data


@triton.jit(do_not_specialize=["height", "width"])
def census_kernel(left, right, words, height, width, offsets: tl.constexpr, PIXELS: tl.constexpr):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    image = left
    if tl.program_id(1) == 1:
        image = right
    here = at < height * width
    v, u = at // width, at % width
    centre = tl.load(image + at, mask=here, other=0)
    word = tl.full((PIXELS,), 0, tl.int32)
    for n in tl.static_range(32):
        y = tl.minimum(tl.maximum(v + offsets[n][0], 0), height - 1)
        x = tl.minimum(tl.maximum(u + offsets[n][1], 0), width - 1)
        darker = tl.load(image + y * width + x, mask=here, other=0) < centre
        word = 2 * word + darker.to(tl.int32)
    tl.store(words + tl.program_id(1) * height * width + at, word, mask=here)


@triton.jit
def _ones(word):
    """How many bits are set of 32."""
    word = word - ((word >> 1) & 0x55555555)
    word = (word & 0x33333333) + ((word >> 2) & 0x33333333)
    word = (word + (word >> 4)) & 0x0F0F0F0F
    return (word + (word >> 8) + (word >> 16) + (word >> 24)) & 63


@triton.jit(
    do_not_specialize=["height", "width", "first", "max_bits", "bit_weight", "max_gray",
                       "gray_weight", "unseen", "top"],
)  # fmt: skip
def cost_kernel(
    left, right, words, true, cost, data, height, width, first, max_bits, bit_weight, max_gray,
    gray_weight, unseen, top, LABELS: tl.constexpr, CELLS: tl.constexpr,
):  # fmt: skip
    far = 1 << 20
    pixel = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    plane = height * width
    here = pixel < plane
    v, u = pixel // width, pixel % width
    rows, columns = tl.load(true).to(tl.int32), tl.load(true + 1).to(tl.int32)
    label = tl.arange(0, LABELS)[None, :]
    ours = label < tl.load(true + 2).to(tl.int32) + 0 * v[:, None]
    partner = u[:, None] - label - first
    seen = here[:, None] & (partner >= 0) & (partner < columns) & ours
    there = pixel[:, None] - label - first
    word = tl.load(words + pixel, mask=here, other=0)[:, None]
    gray = tl.load(left + pixel, mask=here, other=0).to(tl.int32)[:, None]
    bits = _ones(tl.load(words + plane + there, mask=seen, other=0) ^ word)
    apart = tl.abs(tl.load(right + there, mask=seen, other=0).to(tl.int32) - gray)
    value = tl.minimum(bits, max_bits) * bit_weight + tl.minimum(apart, max_gray) * gray_weight
    best = tl.min(tl.where(seen, value, far), 1)
    instead = tl.where(best < far, best + unseen, 0)[:, None]
    value = tl.where(seen, value, instead)
    value = tl.where((here & (v < rows) & (u < columns))[:, None], value, 0)
    at = pixel[:, None] * LABELS + label
    tl.store(cost + at, value.to(tl.int16), mask=here[:, None])
    tl.store(data + at, _cut(value, ours, top).to(tl.int16), mask=here[:, None])


@triton.jit
def _cut(value, ours, top):
    """Above the pixel's best, at most what can win; a label that is not of the pair cannot."""
    least = tl.min(tl.where(ours, value, 1 << 20), 1)[:, None]
    return tl.where(ours, tl.minimum(value - least, top), top)


def edge_weights(image: Tensor, true: Tensor, config: BeliefPropagationConfig) -> Tensor:
    """(2, h, w) int32 weight of the edge above and to the left, in 1 / FULL_WEIGHT."""
    h, w = image.shape
    edges = torch.empty((2, h, w), dtype=torch.int32, device=image.device)
    fall = (1 - config.edge_floor) / config.edge_contrast
    edges_kernel[(blocks(h * w, PIXELS),)](
        image, true, edges, h, w, fall, config.edge_floor, FULL_WEIGHT, PIXELS
    )
    return edges


@triton.jit
def _whole(x):
    """The nearest whole number, halves to the even one."""
    low = tl.floor(x)
    part = x - low
    odd = (low.to(tl.int32) & 1) == 1
    return low + tl.where((part > 0.5) | ((part == 0.5) & odd), 1.0, 0.0)


@triton.jit
def _edge(here, there, fall, floor, full):
    step = tl.abs(here - there).to(tl.float32)
    return _whole(tl.maximum(1.0 - step * fall, floor) * full).to(tl.int32)


@triton.jit(do_not_specialize=["height", "width", "full"])
def edges_kernel(image, true, edges, height, width, fall, floor, full, PIXELS: tl.constexpr):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < height * width
    v, u = at // width, at % width
    rows, columns = tl.load(true).to(tl.int32), tl.load(true + 1).to(tl.int32)
    gray = tl.load(image + at, mask=here, other=0).to(tl.int32)
    above = tl.load(image + tl.where(v > 0, at - width, at), mask=here, other=0).to(tl.int32)
    before = tl.load(image + tl.where(u > 0, at - 1, at), mask=here, other=0).to(tl.int32)
    inside = (v < rows) & (u < columns)
    across = tl.where(inside, _edge(gray, above, fall, floor, full), 0)
    along = tl.where(inside, _edge(gray, before, fall, floor, full), 0)
    tl.store(edges + at, across, mask=here)
    tl.store(edges + height * width + at, along, mask=here)


def coarser(
    data: Tensor, edges: Tensor, true: Tensor, level: int, config: BeliefPropagationConfig
) -> tuple[Tensor, Tensor]:
    """Costs and edges of half the size, for ``level`` of the pyramid: sums of 2x2, means of two."""
    h, w, room = data.shape
    size = ((h + 1) // 2, (w + 1) // 2)
    small = torch.empty((*size, room), dtype=torch.int16, device=data.device)
    fewer = torch.empty((2, *size), dtype=torch.int32, device=data.device)
    coarser_kernel[(blocks(size[0] * size[1], CELLS),)](
        data, edges, true, small, fewer, h, w, level, 4 * config.truncation, room, CELLS
    )
    return small, fewer


@triton.jit
def _halved(n, level):
    """A number of pixels at a level of the pyramid."""
    for _ in range(level):
        n = (n + 1) // 2
    return n


@triton.jit(do_not_specialize=["height", "width", "level", "top"])
def coarser_kernel(
    data, edges, true, small, fewer, height, width, level, top, LABELS: tl.constexpr,
    CELLS: tl.constexpr,
):  # fmt: skip
    """``height`` and ``width`` of the finer level, the one before ``level``."""
    rows = _halved(tl.load(true).to(tl.int32), level - 1)
    columns = _halved(tl.load(true + 1).to(tl.int32), level - 1)
    tall, wide = (height + 1) // 2, (width + 1) // 2
    pixel = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    here = pixel < tall * wide
    v, u = 2 * (pixel // wide), 2 * (pixel % wide)
    label = tl.arange(0, LABELS)[None, :]
    ours = label < tl.load(true + 2).to(tl.int32) + 0 * v[:, None]
    total = tl.full((CELLS, LABELS), 0, tl.int32)
    for part in tl.static_range(4):
        y, x = v + part // 2, u + part % 2
        near = (here & (y < height) & (x < width))[:, None]
        total += tl.load(data + (y * width + x)[:, None] * LABELS + label, mask=near, other=0)
    at = pixel[:, None] * LABELS + label
    tl.store(small + at, _cut(total, ours, top).to(tl.int16), mask=here[:, None])
    inside = here & (v < rows) & (u < columns)
    first = v * width + u
    after = v * width + tl.minimum(u + 1, columns - 1)
    below = tl.minimum(v + 1, rows - 1) * width + u
    plane = height * width
    across = tl.load(edges + first, mask=inside, other=0)
    across += tl.load(edges + after, mask=inside, other=0)
    along = tl.load(edges + plane + first, mask=inside, other=0)
    along += tl.load(edges + plane + below, mask=inside, other=0)
    tl.store(fewer + pixel, across // 2, mask=here)
    tl.store(fewer + tall * wide + pixel, along // 2, mask=here)


def finer(messages: Tensor, data: Tensor, true: Tensor, level: int) -> Tensor:
    """Messages (4, h, w, L) at the size of ``data``: those of the coarser pixel."""
    h, w, room = data.shape
    out = torch.empty((4, h, w, room), dtype=torch.int16, device=data.device)
    finer_kernel[(blocks(h * w, CELLS), 4)](
        messages, out, true, h, w, messages.shape[1], messages.shape[2], level, room, CELLS
    )
    return out


@triton.jit(do_not_specialize=["height", "width", "tall", "wide", "level"])
def finer_kernel(
    messages, out, true, height, width, tall, wide, level, LABELS: tl.constexpr,
    CELLS: tl.constexpr,
):  # fmt: skip
    rows = _halved(tl.load(true).to(tl.int32), level)
    columns = _halved(tl.load(true + 1).to(tl.int32), level)
    pixel = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    way = tl.program_id(1)
    here = pixel < height * width
    v, u = pixel // width, pixel % width
    label = tl.arange(0, LABELS)[None, :]
    inside = (here & (v < rows) & (u < columns))[:, None]
    coarse = way * tall * wide + (v // 2) * wide + u // 2
    value = tl.load(messages + coarse[:, None] * LABELS + label, mask=inside, other=0)
    at = (way * height * width + pixel)[:, None] * LABELS + label
    tl.store(out + at, value, mask=here[:, None])


def sweep(
    data: Tensor, messages: Tensor, edges: Tensor, colour: int, config: BeliefPropagationConfig
) -> None:
    """Renew in place the messages that leave the pixels of ``colour``: v + u = colour modulo 2.

    ``messages`` (4, h, w, L) go up, down, left and right. The lower envelope (Felzenszwalb and
    Huttenlocher, doi:10.1007/s11263-006-7899-4) of a linear cost is a running minimum of the costs
    less a ramp, up and down the labels.
    """
    h, w, room = data.shape
    sweep_kernel[(blocks(h * ((w + 1) // 2), SWEPT),)](
        data, messages, edges, colour, h, w, COST_UNIT, config.truncation, FULL_WEIGHT, room, SWEPT,
        num_warps=SWEEP_WARPS,
    )  # fmt: skip


SWEPT, SWEEP_WARPS = 16, 1  # pixels of one program of a sweep, and its warps


@triton.jit
def _least(a, b):
    return tl.minimum(a, b)


@triton.jit
def _envelope(rest, weight, unit, truncation, full, label):
    """The message (CELLS, LABELS) int16 of the costs ``rest`` over edges of ``weight`` (CELLS,)."""
    ramp = label * ((weight * unit) // full)[:, None]
    ahead = tl.associative_scan(rest - ramp, 1, _least) + ramp
    behind = tl.associative_scan(rest + ramp, 1, _least, reverse=True) - ramp
    best = tl.minimum(ahead, behind) - tl.min(rest, 1)[:, None]
    return tl.minimum(best, ((weight * truncation) // full)[:, None]).to(tl.int16)


@triton.jit(do_not_specialize=["colour", "height", "width", "unit", "truncation", "full"])
def sweep_kernel(
    data, messages, edges, colour, height, width, unit, truncation, full, LABELS: tl.constexpr,
    CELLS: tl.constexpr,
):  # fmt: skip
    half = (width + 1) // 2
    cell = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    v = cell // half
    u = 2 * (cell % half) + (v + colour) % 2
    here = (v < height) & (u < width)
    pixel = v * width + u
    label = tl.arange(0, LABELS)[None, :]
    own = here[:, None]
    plane = height * width
    at = pixel[:, None] * LABELS + label
    row, volume = width * LABELS, plane * LABELS
    up, down, left, right = (
        messages,
        messages + volume,
        messages + 2 * volume,
        messages + 3 * volume,
    )
    has_below, has_after = here & (v + 1 < height), here & (u + 1 < width)
    below = tl.load(up + at + row, mask=has_below[:, None], other=0).to(tl.int32)
    above = tl.load(down + at - row, mask=(here & (v > 0))[:, None], other=0).to(tl.int32)
    after = tl.load(left + at + LABELS, mask=has_after[:, None], other=0).to(tl.int32)
    before = tl.load(right + at - LABELS, mask=(here & (u > 0))[:, None], other=0)
    before = before.to(tl.int32)
    total = tl.load(data + at, mask=own, other=0).to(tl.int32) + below + above + after + before
    weight = tl.load(edges + pixel, mask=here, other=0)
    tl.store(up + at, _envelope(total - above, weight, unit, truncation, full, label), mask=own)
    weight = tl.load(edges + pixel + width, mask=has_below, other=0)
    tl.store(down + at, _envelope(total - below, weight, unit, truncation, full, label), mask=own)
    weight = tl.load(edges + plane + pixel, mask=here, other=0)
    tl.store(left + at, _envelope(total - before, weight, unit, truncation, full, label), mask=own)
    weight = tl.load(edges + plane + pixel + 1, mask=has_after, other=0)
    tl.store(right + at, _envelope(total - after, weight, unit, truncation, full, label), mask=own)


def select(
    data: Tensor, messages: Tensor, cost: Tensor, true: Tensor, config: BeliefPropagationConfig
) -> tuple[Tensor, Tensor]:
    """Labels and confidence (h, w), as :func:`recon.stereo.belief_propagation.select`."""
    h, w, room = data.shape
    px, confidence = torch.empty((2, h, w), device=data.device)
    evidence = config.min_evidence if config.min_evidence > 0 else -math.inf
    select_kernel[(blocks(h * w, CELLS),)](
        data, messages, cost, true, px, confidence, h, w, config.min_disparity,
        2.0 * config.truncation, evidence, float(NOISE), SURE_EVIDENCE, RADIUS, room, CELLS,
    )  # fmt: skip
    return px, confidence


@triton.jit
def _at(values, label, chosen):
    """(CELLS,) the value of each row at its ``chosen`` label."""
    return tl.sum(tl.where(label == chosen[:, None], values, 0), 1)


@triton.jit(do_not_specialize=["height", "width", "first"])
def select_kernel(
    data, messages, cost, true, px, confidence, height, width, first, full_margin, min_evidence,
    noise, sure_evidence, radius: tl.constexpr, LABELS: tl.constexpr, CELLS: tl.constexpr,
):  # fmt: skip
    far = 1 << 20
    pixel = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    here = pixel < height * width
    v, u = pixel // width, pixel % width
    rows, columns = tl.load(true).to(tl.int32), tl.load(true + 1).to(tl.int32)
    count = tl.load(true + 2).to(tl.int32)
    label = tl.arange(0, LABELS)[None, :]
    ours = here[:, None] & (label < count)
    at = pixel[:, None] * LABELS + label
    row, volume = width * LABELS, height * width * LABELS
    belief = tl.load(data + at, mask=here[:, None], other=0).to(tl.int32)
    near = (here & (v + 1 < height))[:, None]
    belief += tl.load(messages + at + row, mask=near, other=0)
    near = (here & (v > 0))[:, None]
    belief += tl.load(messages + volume + at - row, mask=near, other=0)
    near = (here & (u + 1 < width))[:, None]
    belief += tl.load(messages + 2 * volume + at + LABELS, mask=near, other=0)
    near = (here & (u > 0))[:, None]
    belief += tl.load(messages + 3 * volume + at - LABELS, mask=near, other=0)
    belief = tl.where(ours, belief, far)
    low = tl.min(belief, 1)
    best = tl.min(tl.where(belief == low[:, None], label, LABELS), 1)
    adjacent = tl.abs(label - best[:, None]) <= 1
    second = tl.min(tl.where(adjacent, far, belief), 1)
    box = tl.full((CELLS, LABELS), 0, tl.int32)
    for j in range(-radius, radius + 1):
        for i in range(-radius, radius + 1):
            y, x = v + j, u + i
            inside = here & (y >= 0) & (y < height) & (x >= 0) & (x < width)
            there = cost + (y * width + x)[:, None] * LABELS + label
            box += tl.load(there, mask=inside[:, None], other=0)
    partner = u[:, None] - label - first
    seen = ours & (partner >= 0) & (partner < columns)
    many = tl.maximum(tl.sum(seen.to(tl.int32), 1), 1).to(tl.float32)
    mean = tl.sum(tl.where(seen, box, 0), 1).to(tl.float32) / many
    centre = _at(box, label, best)
    a = (_at(box, label, tl.maximum(best - 1, 0)) - centre).to(tl.float32)
    b = (_at(box, label, tl.minimum(best + 1, count - 1)) - centre).to(tl.float32)
    steep = tl.maximum(a, b)
    offset = (a - b) / (2 * tl.maximum(steep, 1.0))
    offset = tl.minimum(tl.maximum(offset, -0.5), 0.5)
    inner = (best > 0) & (best < count - 1) & (steep > 0)
    area = (2 * radius + 1) * (2 * radius + 1)
    evidence = (mean - centre.to(tl.float32)) / (mean + area * noise)
    margin = (second - low).to(tl.float32) / full_margin
    sure = tl.minimum(tl.maximum(evidence, 0.01) / sure_evidence, 1.0)
    there = u - best - first
    sees = (there >= 0) & (there < columns) & (v < rows) & (u < columns)
    accepted = sees & (margin > 0) & (evidence >= min_evidence)
    found = best.to(tl.float32) + tl.where(inner, offset, 0.0)
    tl.store(px + pixel, tl.where(sees, found, float("nan")), mask=here)
    trust = tl.where(accepted, tl.minimum(margin, 1.0) * sure, 0.0)
    tl.store(confidence + pixel, trust, mask=here)


CONTRAST_PX = 9


def drop_unreliable(
    left: Tensor, px: Tensor, confidence: Tensor, true: Tensor, config: BeliefPropagationConfig
) -> tuple[Tensor, Tensor]:
    """Labels (h, w), NaN where they are unreliable, and their confidence."""
    if config.min_contrast > 0:
        flat = contrast(left, CONTRAST_PX // 2) < config.min_contrast
        confidence = torch.where(flat, 0.0, confidence)
    gone = confidence <= 0
    if config.occlusion_tolerance >= 0:
        gone = gone | hidden(px, confidence, true, config)
    rows, columns = (torch.arange(n, device=px.device) for n in px.shape)
    inside = (rows[:, None] < true[0]) & (columns[None, :] < true[1])
    px = torch.where(gone | ~inside, math.nan, px)
    if config.speckle_px > 0:
        level = torch.where(px == px, px * SPECKLE_STEP, float(UNKNOWN)).int()
        px = torch.where(speckles(level, config.speckle_px, UNKNOWN), math.nan, px)
    return px, torch.where(px == px, confidence, 0.0)


def contrast(image: Tensor, radius: int) -> Tensor:
    """(h, w) float64 standard deviation of the gray levels (h, w) uint8 in a square window."""
    h, w = image.shape
    out = torch.empty((h, w), dtype=torch.float64, device=image.device)
    contrast_kernel[(blocks(h * w, PIXELS),)](image, out, h, w, radius, PIXELS)
    return out


@triton.jit(do_not_specialize=["height", "width"])
def contrast_kernel(image, out, height, width, radius: tl.constexpr, PIXELS: tl.constexpr):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < height * width
    v, u = at // width, at % width
    total = tl.full((PIXELS,), 0, tl.int32)
    squares = total
    for j in range(-radius, radius + 1):
        y = tl.minimum(tl.maximum(v + j, 0), height - 1) * width
        for i in range(-radius, radius + 1):
            x = tl.minimum(tl.maximum(u + i, 0), width - 1)
            gray = tl.load(image + y + x, mask=here, other=0).to(tl.int32)
            total += gray
            squares += gray * gray
    area = (2 * radius + 1) * (2 * radius + 1)
    mean = total.to(tl.float64) / area
    spread = tl.maximum(squares.to(tl.float64) / area - mean * mean, 0.0)
    tl.store(out + at, tl.sqrt(spread), mask=here)


def hidden(px: Tensor, confidence: Tensor, true: Tensor, config: BeliefPropagationConfig) -> Tensor:
    """(h, w) True where the right view would see a nearer, accepted surface."""
    h, w = px.shape
    nearest = torch.full((h, w), -1, dtype=torch.int32, device=px.device)
    out = torch.empty((h, w), dtype=torch.bool, device=px.device)
    given = (px, confidence, true, nearest, out, h * w, w, config.min_disparity)
    for kernel in (project_kernel, compare_kernel):
        kernel[(blocks(h * w, PIXELS),)](*given, float(config.occlusion_tolerance), PIXELS)
    return out


@triton.jit
def _partners(px, true, at, here, width, first):
    """Label of each pixel, its partner's place, and whether the right image has that."""
    label = tl.load(px + at, mask=here, other=float("nan"))
    known = label == label
    label = tl.where(known, label, 0.0)
    u = at % width
    partner = u - tl.floor(label + 0.5).to(tl.int32) - first
    sees = known & (partner >= 0) & (partner < tl.load(true + 1).to(tl.int32))
    return label, at - u + partner, sees


@triton.jit(do_not_specialize=["plane", "width", "first"])
def project_kernel(
    px, confidence, true, nearest, out, plane, width, first, tolerance, PIXELS: tl.constexpr
):
    """The largest label at each place of the right image; labels in float32 order as integers."""
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < plane
    label, there, sees = _partners(px, true, at, here, width, first)
    sees = sees & (tl.load(confidence + at, mask=here, other=0.0) > 0)
    bits = tl.maximum(label, 0.0).to(tl.int32, bitcast=True)
    tl.atomic_max(nearest + there, bits, mask=sees)


@triton.jit(do_not_specialize=["plane", "width", "first"])
def compare_kernel(
    px, confidence, true, nearest, out, plane, width, first, tolerance, PIXELS: tl.constexpr
):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < plane
    label, there, sees = _partners(px, true, at, here, width, first)
    bits = tl.load(nearest + there, mask=sees, other=-1)
    other = bits.to(tl.float32, bitcast=True)
    tl.store(out + at, sees & (bits >= 0) & (other > label + tolerance), mask=here)


def drop_unseen(
    px: Tensor, confidence: Tensor, left_seen: Tensor, right_seen: Tensor, true: Tensor
) -> tuple[Tensor, Tensor]:
    """The labels without those on masked pixels of either image; masks are 0 or 1."""
    h, w = px.shape
    label, trust = torch.empty((2, h, w), device=px.device)
    unseen_kernel[(blocks(h * w, PIXELS),)](
        px, confidence, left_seen, right_seen, true, label, trust, h * w, w, PIXELS
    )
    return label, trust


@triton.jit(do_not_specialize=["plane", "width"])
def unseen_kernel(
    px, confidence, left_seen, right_seen, true, label, trust, plane, width, PIXELS: tl.constexpr
):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < plane
    found = tl.load(px + at, mask=here, other=float("nan"))
    known = found == found
    u = at % width
    partner = _whole(u.to(tl.float64) - tl.where(known, found, 0.0).to(tl.float64)).to(tl.int32)
    sees = known & (partner >= 0) & (partner < tl.load(true + 1).to(tl.int32))
    sees = sees & (tl.load(left_seen + at, mask=here, other=0) > 0)
    sees = sees & (tl.load(right_seen + at - u + partner, mask=sees, other=0) > 0)
    sure = tl.load(confidence + at, mask=here, other=0.0)
    tl.store(label + at, tl.where(sees, found, float("nan")), mask=here)
    tl.store(trust + at, tl.where(sees, sure, 0.0), mask=here)


def speckles(level: Tensor, largest: int, unknown: int) -> Tensor:
    """(h, w) True on surfaces of at most ``largest`` pixels; ``level`` (h, w) int32.

    The least index of a surface wanders from neighbour to neighbour. After ``largest`` steps it
    has been everywhere on a surface that small; a set of pixels with one index is a whole
    surface when no neighbour of the same surface has another index.
    """
    h, w = level.shape
    grid = (blocks(h * w, PIXELS),)
    own = torch.arange(h * w, dtype=torch.int32, device=level.device)
    for _ in range(largest):
        least = torch.empty_like(own)
        wander_kernel[grid](own, level, least, h, w, SPECKLE_STEP, unknown, PIXELS)
        own = least
    count = torch.zeros_like(own)
    measure_kernel[grid](own, level, count, h, w, SPECKLE_STEP, unknown, largest + 1, PIXELS)
    return (count[own.long()].view(h, w) <= largest) & (level > unknown)


@triton.jit
def _neighbour(own, level, there, inside, here, step, unknown, none):
    """The index at ``there`` where it lies on the surface of ``here``, else ``none``."""
    other = tl.load(level + there, mask=inside, other=unknown)
    joined = inside & (other > unknown) & (here > unknown) & (tl.abs(other - here) <= step)
    return tl.load(own + there, mask=joined, other=none)


@triton.jit
def _extremes(own, level, at, index, inside, height, width, step, unknown):
    """The least and the largest index of a pixel and its neighbours on the same surface."""
    v, u = at // width, at % width
    here = tl.load(level + at, mask=inside, other=unknown)
    far = 1 << 30
    least, most = index, index
    for way in tl.static_range(4):
        if way == 0:
            there, near = at + 1, inside & (u + 1 < width)
        elif way == 1:
            there, near = at - 1, inside & (u > 0)
        elif way == 2:
            there, near = at + width, inside & (v + 1 < height)
        else:
            there, near = at - width, inside & (v > 0)
        found = _neighbour(own, level, there, near, here, step, unknown, far)
        least = tl.minimum(least, found)
        most = tl.maximum(most, tl.where(found == far, -1, found))
    return least, most


@triton.jit(do_not_specialize=["height", "width", "step", "unknown"])
def wander_kernel(own, level, out, height, width, step, unknown, PIXELS: tl.constexpr):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = at < height * width
    index = tl.load(own + at, mask=inside, other=0)
    least, _most = _extremes(own, level, at, index, inside, height, width, step, unknown)
    tl.store(out + at, least, mask=inside)


@triton.jit(do_not_specialize=["height", "width", "step", "unknown", "many"])
def measure_kernel(own, level, count, height, width, step, unknown, many, PIXELS: tl.constexpr):
    """Add up the pixels of each index; one that is not a whole surface counts as ``many``."""
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = at < height * width
    index = tl.load(own + at, mask=inside, other=0)
    least, most = _extremes(own, level, at, index, inside, height, width, step, unknown)
    mixed = (least < index) | (most > index)
    tl.atomic_add(count + index, tl.where(mixed, many, 1), mask=inside)


ROWS, COLUMNS = 4, 64  # fine pixels of one program

LOG2_E = 1 / math.log(2)


def bilateral(layers: Tensor, guide: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Labels and confidence (H, W) of a guide (H, W, 3); Eq. 2, all sums in registers. ``layers``
    (5, h, w) are what a tap brings: three colours, trust, trust times label."""
    _, h, w = layers.shape
    height, width, _ = guide.shape
    spatial = math.sqrt(0.5 * LOG2_E) / SPATIAL_SIGMA
    layers[:3] *= COLOUR_SCALE
    out, sure = torch.empty((2, height, width), device=guide.device)
    bilateral_kernel[(blocks(height, ROWS), blocks(width, COLUMNS))](
        layers, guide.contiguous(), true, out, sure, height, width, h, w, COLOUR_SCALE, spatial,
        RANGE_FLOOR, MIN_SUPPORT, DIAMETER, ROWS, COLUMNS,
    )  # fmt: skip
    return out, sure


@triton.jit
def _first_tap(n, taps, fine, diameter: tl.constexpr):
    """The first of the taps around fine pixel ``n``, and how far it lies ahead, in taps."""
    place = (n.to(tl.float64) + 0.5) * (taps.to(tl.float64) / fine.to(tl.float64)) - 0.5
    first = tl.ceil(place - diameter / 2)
    return first.to(tl.int32), (first - place).to(tl.float32)


@triton.jit(do_not_specialize=["height", "width", "tall", "wide"])
def bilateral_kernel(
    layers, guide, true, out, sure, height, width, tall, wide, tonal_scale, spatial_scale, floor,
    support, diameter: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """A tile of fine pixels; ``layers`` are three colours, trust, trust times label."""
    v = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    u = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    here = (v < height)[:, None] & (u < width)[None, :]
    at = v[:, None] * width + u[None, :]
    b = tl.load(guide + 3 * at, mask=here, other=0).to(tl.float32) * tonal_scale
    g = tl.load(guide + 3 * at + 1, mask=here, other=0).to(tl.float32) * tonal_scale
    r = tl.load(guide + 3 * at + 2, mask=here, other=0).to(tl.float32) * tonal_scale
    rows, columns = tl.load(true).to(tl.int32), tl.load(true + 1).to(tl.int32)
    top, below = _first_tap(v, rows, tl.load(true + 2), diameter)
    first, ahead = _first_tap(u, columns, tl.load(true + 3), diameter)
    everything = tl.full((ROWS, COLUMNS), 0.0, tl.float32)
    known, trusted, value = everything, everything, everything
    plane = tall * wide
    for j in range(diameter):
        y = top + j
        dy = (below + j) * spatial_scale
        near_y = tl.where((y >= 0) & (y < rows), -dy * dy, -1e4)
        row = tl.minimum(tl.maximum(y, 0), tall - 1) * wide
        for i in range(diameter):
            x = first + i
            dx = (ahead + i) * spatial_scale
            near_x = tl.where((x >= 0) & (x < columns), -dx * dx, -1e4)
            column = tl.minimum(tl.maximum(x, 0), wide - 1)
            tap = layers + row[:, None] + column[None, :]
            db = b - tl.load(tap)
            dg = g - tl.load(tap + plane)
            dr = r - tl.load(tap + 2 * plane)
            trust = tl.load(tap + 3 * plane)
            tonal = tl.maximum(-(db * db + dg * dg + dr * dr), floor)
            weight = tl.exp2(tonal + near_y[:, None] + near_x[None, :])
            everything += weight
            known += tl.where(trust > 0, weight, 0.0)
            trusted += weight * trust
            value += weight * tl.load(tap + 4 * plane)
    good = known > support * everything
    label = tl.where(good, value / tl.where(good, trusted, 1.0), float("nan"))
    tl.store(out + at, label, mask=here)
    tl.store(sure + at, tl.where(good, trusted / everything, 0.0), mask=here)


def averaged(guide: Tensor, room: tuple[int, int], true: Tensor) -> Tensor:
    """(h, w, 3) float32 means of the guide (H, W, 3) over each tap, in whole levels. As
    :func:`recon.stereo.upsampling.guide_at_taps`, where halves may round the other way."""
    H, W, _ = guide.shape
    out = torch.empty((*room, 3), device=guide.device)
    averaged_kernel[(blocks(room[0] * room[1], PIXELS),)](guide, true, out, H, W, *room, PIXELS)
    return out


@triton.jit
def _span(n, step, fine):
    """First and last place that tap ``n`` of ``step`` fine pixels covers, of ``fine``."""
    first = n.to(tl.float64) * step
    return first, tl.minimum(first + step, fine)


@triton.jit(do_not_specialize=["height", "width", "tall", "wide"])
def averaged_kernel(guide, true, out, height, width, tall, wide, PIXELS: tl.constexpr):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < tall * wide
    v, u = at // wide, at % wide
    rows, columns = tl.load(true + 2).to(tl.float64), tl.load(true + 3).to(tl.float64)
    down, across = rows / tl.load(true).to(tl.float64), columns / tl.load(true + 1).to(tl.float64)
    top, bottom = _span(v, down, rows)
    first, last = _span(u, across, columns)
    b = tl.full((PIXELS,), 0.0, tl.float32)
    g, r = b, b
    for j in range(tl.ceil(down).to(tl.int32) + 1):
        y = tl.floor(top) + j
        tall_share = tl.maximum(tl.minimum(bottom, y + 1) - tl.maximum(top, y), 0.0)
        for i in range(tl.ceil(across).to(tl.int32) + 1):
            x = tl.floor(first) + i
            share = tl.maximum(tl.minimum(last, x + 1) - tl.maximum(first, x), 0.0)
            weight = (tall_share * share / (down * across)).to(tl.float32)
            pixel = guide + 3 * (y * width + x).to(tl.int32)
            inside = here & (weight > 0) & (y < height) & (x < width)
            b += weight * tl.load(pixel, mask=inside, other=0).to(tl.float32)
            g += weight * tl.load(pixel + 1, mask=inside, other=0).to(tl.float32)
            r += weight * tl.load(pixel + 2, mask=inside, other=0).to(tl.float32)
    tl.store(out + 3 * at, _whole(b), mask=here)
    tl.store(out + 3 * at + 1, _whole(g), mask=here)
    tl.store(out + 3 * at + 2, _whole(r), mask=here)


def reproject(
    px: Tensor, confidence: Tensor, geometry: Tensor, true: Tensor, size_px: tuple[int, int],
    min_confidence: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Depth and sigma in metres (h, w) float32 on the keyframe's grid of ``size_px`` (w, h); Eq. 3.

    As :func:`recon.stereo.reprojection.reproject`. ``geometry`` (15,) float64 is the homography to
    the left image (9), the plane (3), slope, f B, and sigma of a label of full confidence in
    pixels; ``true`` (4,) is the size h, w of the pair and that of ``px``, which may be a larger
    array.
    """
    width, height = size_px
    depth, sigma = torch.empty((2, height, width), device=px.device)
    reproject_kernel[(blocks(height * width, PIXELS),)](
        px.contiguous(), confidence.contiguous(), geometry, true, depth, sigma, height, width,
        px.shape[1], min_confidence, PIXELS,
    )  # fmt: skip
    return depth, sigma


@triton.jit(do_not_specialize=["height", "width", "pitch"])
def reproject_kernel(
    px, confidence, geometry, true, depth, sigma, height, width, pitch, min_confidence,
    PIXELS: tl.constexpr,
):  # fmt: skip
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < height * width
    u, v = (at % width).to(tl.float64), (at // width).to(tl.float64)
    rows, columns = tl.load(true + 2).to(tl.float64), tl.load(true + 3).to(tl.float64)
    g = geometry
    z = tl.load(g + 6) * u + tl.load(g + 7) * v + tl.load(g + 8)
    ahead = here & (z >= 1e-3)
    z = tl.where(ahead, z, 1.0)
    x = (tl.load(g) * u + tl.load(g + 1) * v + tl.load(g + 2)) / z
    y = (tl.load(g + 3) * u + tl.load(g + 4) * v + tl.load(g + 5)) / z
    X = (x + 0.5) * (columns / tl.load(true + 1).to(tl.float64)) - 0.5
    Y = (y + 0.5) * (rows / tl.load(true).to(tl.float64)) - 0.5
    i, j = _whole(X), _whole(Y)
    within = ahead & (i >= 0) & (j >= 0) & (i < columns) & (j < rows)
    centre = tl.where(within, j * pitch + i, 0.0).to(tl.int32)
    label = tl.load(px + centre, mask=within, other=float("nan")).to(tl.float64)
    trust = tl.load(confidence + centre, mask=within, other=0.0).to(tl.float64)
    i0, j0 = tl.floor(X), tl.floor(Y)
    around = within & (i0 >= 0) & (j0 >= 0) & (i0 + 1 < columns) & (j0 + 1 < rows)
    first = px + tl.where(around, j0 * pitch + i0, 0.0).to(tl.int32)
    a = tl.load(first, mask=around, other=0.0).to(tl.float64)
    b = tl.load(first + 1, mask=around, other=0.0).to(tl.float64)
    c = tl.load(first + pitch, mask=around, other=0.0).to(tl.float64)
    d = tl.load(first + pitch + 1, mask=around, other=0.0).to(tl.float64)
    most = tl.maximum(tl.maximum(a, b), tl.maximum(c, d))
    least = tl.minimum(tl.minimum(a, b), tl.minimum(c, d))
    sum_known = (a + b) + (c + d)
    agree = around & (sum_known == sum_known) & (most - least <= 1.0)
    fx, fy = X - i0, Y - j0
    mixed = (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)
    label = tl.where(agree, mixed, label)
    slope = tl.load(g + 12)
    away = tl.load(g + 9) * x + tl.load(g + 10) * y + tl.load(g + 11) + slope * label
    good = within & (label == label) & (trust >= min_confidence) & (away >= 1e-3)
    away = tl.where(good, away, 1.0)
    metres = tl.load(g + 13) / away / z
    error = metres / away * tl.abs(slope) * tl.load(g + 14) / tl.sqrt(tl.where(good, trust, 1.0))
    tl.store(depth + at, tl.where(good, metres, float("nan")).to(tl.float32), mask=here)
    tl.store(sigma + at, tl.where(good, error, float("nan")).to(tl.float32), mask=here)


def fuse(depth: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, sigma (h, w) float32 and number of views uint8 of pairs (P, h, w); no view: NaN.

    As :func:`recon.stereo.reprojection.fuse`: inverse depth of the largest group that agrees,
    nothing where several pairs read and none comes near another.
    """
    pairs, height, width = depth.shape
    plane, device = height * width, depth.device
    out, error = torch.empty((2, height, width), device=device)
    views = torch.empty((height, width), dtype=torch.uint8, device=device)
    balance = torch.zeros(1, dtype=torch.int32, device=device)
    fuse_kernel[(blocks(plane, FUSED_PIXELS),)](
        depth.contiguous(), sigma.contiguous(), out, error, views, balance, plane,
        AGREE_SIGMAS, MAX_SIGMA_SHARE, SINGLE_VIEW_SIGMA, MIN_SIGMA_SHARE, pairs, FUSED_PIXELS,
    )  # fmt: skip
    refute_kernel[(blocks(plane, FUSED_PIXELS),)](out, error, views, balance, plane, FUSED_PIXELS)
    return out, error, views


@triton.jit(do_not_specialize=["plane"])
def refute_kernel(out, error, views, balance, plane, PIXELS: tl.constexpr):
    """Empty the map where more pixels are contradicted than confirmed."""
    if tl.load(balance) > 0:
        at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
        nothing = tl.full((PIXELS,), float("nan"), tl.float32)
        tl.store(out + at, nothing, mask=at < plane)
        tl.store(error + at, nothing, mask=at < plane)
        tl.store(views + at, tl.full((PIXELS,), 0, tl.uint8), mask=at < plane)


FUSED_PIXELS = 256


@triton.jit
def _reading(depth, sigma, at, here, max_share):
    """Inverse depth, its sigma and 1 where a pair's reading is usable."""
    z = tl.load(depth + at, mask=here, other=0.0).to(tl.float64)
    e = tl.load(sigma + at, mask=here, other=0.0).to(tl.float64)
    usable = (z > 0) & (e < max_share * z)
    z = tl.where(usable, z, 1.0)
    return 1.0 / z, tl.where(usable, e, 1.0) / (z * z), usable


@triton.jit(do_not_specialize=["plane"])
def fuse_kernel(
    depth, sigma, out, error, out_views, balance, plane, agree, max_share, single, min_share,
    PAIRS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """``balance`` grows by the pixels that are contradicted less those that two views confirm."""
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < plane
    best = tl.full((PIXELS,), -1, tl.int32)
    count = tl.full((PIXELS,), 0, tl.int32)
    centre = tl.full((PIXELS,), 0.0, tl.float64)
    spread = tl.full((PIXELS,), 1.0, tl.float64)
    for i in tl.static_range(PAIRS):
        w, s, usable = _reading(depth + i * plane, sigma + i * plane, at, here, max_share)
        support = tl.full((PIXELS,), 0, tl.int32)
        for k in tl.static_range(PAIRS):
            w2, s2, other = _reading(depth + k * plane, sigma + k * plane, at, here, max_share)
            near = (w - w2) * (w - w2) <= agree * agree * (s * s + s2 * s2)
            support += (near & other).to(tl.int32)
        better = usable & ((support > best) | ((support == best) & (s < spread)))
        best = tl.where(better, support, best)
        centre, spread = tl.where(better, w, centre), tl.where(better, s, spread)
        count += usable.to(tl.int32)
    total = tl.full((PIXELS,), 0.0, tl.float64)
    mean, squares = total, total
    views = tl.full((PIXELS,), 0, tl.int32)
    close = views
    for i in tl.static_range(PAIRS):
        w, s, usable = _reading(depth + i * plane, sigma + i * plane, at, here, max_share)
        apart = w - centre
        near = usable & (apart * apart <= agree * agree * (s * s + spread * spread))
        weight = tl.where(near, 1.0 / (s * s), 0.0)
        total += weight
        mean += weight * apart
        squares += weight * apart * apart
        views += near.to(tl.int32)
        close += (usable & (tl.abs(apart) <= max_share * centre)).to(tl.int32)
    seen = count > 0
    total = tl.where(seen, total, 1.0)
    mean = mean / total
    variance = 1.0 / total + tl.maximum(squares / total - mean * mean, 0.0) / tl.maximum(
        views - 1, 1
    ).to(tl.float64)
    z = 1.0 / tl.where(seen, centre + mean, 1.0)
    e = tl.sqrt(variance) * z * z * tl.where(views == 1, single, 1.0)
    contradicted = (views == 1) & (count > 1) & (close == 1)
    seen = seen & ~contradicted
    e = tl.maximum(e, min_share * z)
    tl.store(out + at, tl.where(seen, z, float("nan")).to(tl.float32), mask=here)
    tl.store(error + at, tl.where(seen, e, float("nan")).to(tl.float32), mask=here)
    tl.store(out_views + at, tl.where(contradicted, 0, views).to(tl.uint8), mask=here)
    votes = (here & contradicted).to(tl.int32) - (here & (views >= 2)).to(tl.int32)
    tl.atomic_add(balance, tl.sum(votes, 0))
