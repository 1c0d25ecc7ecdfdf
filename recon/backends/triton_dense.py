"""The dense stages as Triton kernels: cost, messages, speckles, upsampling and depth, Eq. 1 to 3.

Each computes what the function of the same name in torch_stereo or torch_depth does, compiled once
for all sizes.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs
# Triton reads annotations of a kernel as values of its own, so its arguments have none.
from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.matching_cost import CENSUS_RADIUS, COST_UNIT
from recon.stereo.reprojection import FusionConfig
from recon.stereo.upsampling import RANGE_FLOOR, UpsamplingConfig

PIXELS = 128
"""Pixels of one program."""


def matching_cost(
    left: Tensor, right: Tensor, labels: int, true: Tensor, config: BeliefPropagationConfig
) -> Tensor:
    """(L, h, w) float32, as :func:`recon.backends.torch_stereo.matching_cost`.

    Census first: 49 comparisons of each pixel of both images, into two words of 24 bits. Then the
    labels of a pixel: bits and gray levels that differ, the best of them, and a little more than
    that for partners outside the image.
    """
    c = config.cost
    height, width = left.shape
    images = torch.stack([left, right]).contiguous()
    words = torch.empty((2, 2, height, width), dtype=torch.int32, device=left.device)
    grid = (triton.cdiv(height * width, PIXELS),)
    _census[(grid[0], 2)](images, words, height, width, CENSUS_RADIUS, PIXELS)
    cost = torch.empty((labels, height, width), device=left.device)
    _cost[grid](
        images, words, true, cost, labels, height, width, config.min_disparity,
        c.census_truncation, round(c.census_weight * COST_UNIT), float(c.difference_truncation),
        round(c.difference_weight * COST_UNIT), round(c.unseen * COST_UNIT), PIXELS,
    )  # fmt: skip
    return cost


@triton.jit(do_not_specialize=["height", "width"])
def _census(images, words, height, width, radius: tl.constexpr, PIXELS: tl.constexpr):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    plane = height * width
    image, words = images + tl.program_id(1) * plane, words + tl.program_id(1) * 2 * plane
    here = at < plane
    v, u = at // width, at % width
    centre = tl.load(image + at, mask=here, other=0.0)
    low = tl.full((PIXELS,), 0, tl.int32)
    high = tl.full((PIXELS,), 0, tl.int32)
    side: tl.constexpr = 2 * radius + 1
    half: tl.constexpr = side * side // 2
    for n in tl.static_range(side * side):  # the centre itself, in the middle, is not darker
        y = tl.minimum(tl.maximum(v + n // side - radius, 0), height - 1)
        x = tl.minimum(tl.maximum(u + n % side - radius, 0), width - 1)
        darker = (tl.load(image + y * width + x, mask=here, other=0.0) < centre).to(tl.int32)
        if n < half:
            low = 2 * low + darker
        else:
            high = 2 * high + darker
    tl.store(words + at, low, mask=here)
    tl.store(words + plane + at, high, mask=here)


@triton.jit
def _ones(word):
    """How many bits are set of 25."""
    word = word - ((word >> 1) & 0x55555555)
    word = (word & 0x33333333) + ((word >> 2) & 0x33333333)
    word = (word + (word >> 4)) & 0x0F0F0F0F
    return (word + (word >> 8) + (word >> 16) + (word >> 24)) & 63


@triton.jit(do_not_specialize=["labels", "height", "width", "first"])
def _cost(
    images, words, true, cost, labels, height, width, first, max_bits, bit_weight, max_gray,
    gray_weight, unseen, PIXELS: tl.constexpr,
):  # fmt: skip
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    plane = height * width
    here = at < plane
    v, u = at // width, at % width
    rows, columns = tl.load(true).to(tl.int32), tl.load(true + 1).to(tl.int32)
    count = tl.load(true + 2).to(tl.int32)
    own = here & (v < rows) & (u < columns)
    gray = tl.load(images + at, mask=here, other=0.0)
    low = tl.load(words + at, mask=here, other=0)
    high = tl.load(words + plane + at, mask=here, other=0)
    best = tl.full((PIXELS,), 1.0e6, tl.float32)
    for label in range(labels):
        partner = u - label - first
        seen = here & (partner >= 0) & (partner < columns) & (label < count + 0 * u)
        there = at - label - first
        a = tl.load(words + 2 * plane + there, mask=seen, other=0) ^ low
        b = tl.load(words + 3 * plane + there, mask=seen, other=0) ^ high
        bits = tl.minimum(_ones(a) + _ones(b), max_bits) * bit_weight
        apart = tl.abs(gray - tl.load(images + plane + there, mask=seen, other=0.0))
        value = bits.to(tl.float32) + tl.minimum(apart, max_gray) * gray_weight
        best = tl.minimum(best, tl.where(seen, value, 1.0e6))
        tl.store(cost + label * plane + at, tl.where(seen, value, -1.0), mask=here)
    tl.debug_barrier()  # what a thread stored is read again below
    instead = tl.where(best < 1.0e6, best + unseen, 0.0)
    for label in range(labels):
        value = tl.load(cost + label * plane + at, mask=here, other=0.0)
        value = tl.where(value < 0, instead, value)
        tl.store(cost + label * plane + at, tl.where(own, value, 0.0), mask=here)


CELLS = 32
"""Pixels of one program, whose one warp holds a pixel in each thread."""


def sweep(data: Tensor, messages: Tensor, slope: Tensor, cut: Tensor, colour: int) -> None:
    """Renew in place the messages that leave the pixels of ``colour``: v + u = colour modulo 2.

    ``data`` (L, h, w) and ``messages`` (4, L, h, w) up, down, left and right, contiguous int16;
    ``slope`` and ``cut`` (4, 1, h, w) int16 of the edge that each direction crosses. The lower
    envelope (Felzenszwalb and Huttenlocher, doi:10.1007/s11263-006-7899-4) of a linear cost is a
    running minimum of the costs less a ramp, up and down the labels. Sums have 32 bits: exact.
    """
    labels, height, width = data.shape
    cells = height * ((width + 1) // 2)
    _sweep[(triton.cdiv(cells, CELLS),)](
        data, messages, slope, cut, colour, labels, height, width, triton.next_power_of_2(labels),
        CELLS, num_warps=1,
    )  # fmt: skip


@triton.jit
def _least(a, b):
    return tl.minimum(a, b)


@triton.jit
def _envelope(rest, slope, cut, label):
    """The message (LABELS, CELLS) of the costs ``rest`` over an edge of ``slope`` and ``cut``."""
    ramp = label * slope[None, :]
    ahead = tl.associative_scan(rest - ramp, 0, _least) + ramp
    behind = tl.associative_scan(rest + ramp, 0, _least, reverse=True) - ramp
    best = tl.minimum(ahead, behind) - tl.min(rest, 0)[None, :]
    return tl.minimum(best, cut[None, :]).to(tl.int16)


@triton.jit(do_not_specialize=["colour", "labels", "height", "width"])
def _sweep(
    data, messages, slope, cut, colour, labels, height, width, LABELS: tl.constexpr,
    CELLS: tl.constexpr,
):  # fmt: skip
    half = (width + 1) // 2
    cell = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    v = cell // half
    u = 2 * (cell % half) + (v + colour) % 2
    here = (v < height) & (u < width)
    here_at = v * width + u
    plane = height * width
    label = tl.arange(0, LABELS)[:, None]
    own = here[None, :] & (label < labels)
    at = label * plane + here_at[None, :]
    up, down = messages, messages + labels * plane
    left, right = down + labels * plane, down + 2 * labels * plane
    below = tl.load(up + at + width, mask=own & (v + 1 < height)[None, :], other=0).to(tl.int32)
    above = tl.load(down + at - width, mask=own & (v > 0)[None, :], other=0).to(tl.int32)
    after = tl.load(left + at + 1, mask=own & (u + 1 < width)[None, :], other=0).to(tl.int32)
    before = tl.load(right + at - 1, mask=own & (u > 0)[None, :], other=0).to(tl.int32)
    total = tl.load(data + at, mask=own, other=0).to(tl.int32) + below + above + after + before
    total = tl.where(own, total, 1 << 24)
    for way in tl.static_range(4):
        behind = above if way == 0 else below if way == 1 else before if way == 2 else after
        s = tl.load(slope + way * plane + here_at, mask=here, other=0).to(tl.int32)
        c = tl.load(cut + way * plane + here_at, mask=here, other=0).to(tl.int32)
        to = messages + way * labels * plane + at
        tl.store(to, _envelope(total - behind, s, c, label), mask=own)


def wander(own: Tensor, level: Tensor, step: int, unknown: int) -> Tensor:
    """(h, w) int32 the least index of each pixel and its neighbours on the same surface."""
    least = torch.empty_like(own)
    height, width = own.shape
    grid = (triton.cdiv(height * width, PIXELS),)
    _wander[grid](own, level, least, height, width, step, unknown, PIXELS)
    return least


@triton.jit
def _met(own, level, there, inside, index, here, step, unknown):
    """The index at ``there`` where it lies on the surface of ``here``, else ``index``."""
    other = tl.load(level + there, mask=inside, other=unknown)
    joined = inside & (other > unknown) & (here > unknown) & (tl.abs(other - here) <= step)
    return tl.load(own + there, mask=joined, other=1 << 30)


@triton.jit(do_not_specialize=["height", "width"])
def _wander(own, level, least, height, width, step, unknown, PIXELS: tl.constexpr):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = at < height * width
    v, u = at // width, at % width
    index = tl.load(own + at, mask=inside, other=0)
    here = tl.load(level + at, mask=inside, other=unknown)
    found = _met(own, level, at + 1, inside & (u + 1 < width), index, here, step, unknown)
    index = tl.minimum(index, found)
    found = _met(own, level, at - 1, inside & (u > 0), index, here, step, unknown)
    index = tl.minimum(index, found)
    found = _met(own, level, at + width, inside & (v + 1 < height), index, here, step, unknown)
    index = tl.minimum(index, found)
    found = _met(own, level, at - width, inside & (v > 0), index, here, step, unknown)
    tl.store(least + at, tl.minimum(index, found), mask=inside)


ROWS, COLUMNS = 4, 64
"""Fine pixels of one program."""

LOG2_E = 1 / math.log(2)


def bilateral(
    layers: Tensor, guide: Tensor, rows: tuple[Tensor, Tensor], columns: tuple[Tensor, Tensor],
    config: UpsamplingConfig,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Labels and confidence (H, W) of a guide (H, W, 3); Eq. 2, all sums in registers.

    ``layers`` (6, h, w) are those of :func:`recon.backends.torch_depth.tap_layers`; ``rows`` and
    ``columns`` hold the coarse index (D, fine) and the log of the weight of each tap.
    """
    _, h, w = layers.shape
    height, width, _ = guide.shape
    scale = math.sqrt(0.5 * LOG2_E) / config.range_sigma
    layers = layers[:5].clone()
    layers[:3] *= scale
    out, sure = torch.empty((2, height, width), device=guide.device)
    grid = (triton.cdiv(height, ROWS), triton.cdiv(width, COLUMNS))
    _bilateral[grid](
        layers, guide.contiguous(), rows[0].int(), rows[1] * LOG2_E, columns[0].int(),
        columns[1] * LOG2_E, out, sure, height, width, w, h * w, scale, float(RANGE_FLOOR),
        config.min_support, config.diameter_px, ROWS, COLUMNS,
    )  # fmt: skip
    return out, sure


@triton.jit(do_not_specialize=["height", "width", "pitch", "plane"])
def _bilateral(
    layers, guide, rows, log_y, columns, log_x, out, sure, height, width, pitch, plane, scale,
    floor, support, diameter: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """A tile of fine pixels; ``layers`` are three colours, trust, trust times label."""
    v = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    u = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    tall, wide = v < height, u < width
    here = tall[:, None] & wide[None, :]
    at = v[:, None] * width + u[None, :]
    b = tl.load(guide + 3 * at, mask=here, other=0).to(tl.float32) * scale
    g = tl.load(guide + 3 * at + 1, mask=here, other=0).to(tl.float32) * scale
    r = tl.load(guide + 3 * at + 2, mask=here, other=0).to(tl.float32) * scale
    everything = tl.full((ROWS, COLUMNS), 0.0, tl.float32)
    known, trusted, value = everything, everything, everything
    for j in range(diameter):
        row = tl.load(rows + j * height + v, mask=tall, other=0) * pitch
        near_y = tl.load(log_y + j * height + v, mask=tall, other=0.0)
        for i in range(diameter):
            column = tl.load(columns + i * width + u, mask=wide, other=0)
            near_x = tl.load(log_x + i * width + u, mask=wide, other=0.0)
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


def reproject(
    px: Tensor, confidence: Tensor, geometry: Tensor, true: Tensor, size_px: tuple[int, int],
    min_confidence: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Depth and sigma (h, w) float32, as :func:`recon.backends.torch_depth.reproject`; Eq. 3."""
    width, height = size_px
    depth, sigma = torch.empty((2, height, width), device=px.device)
    grid = (triton.cdiv(height * width, PIXELS),)
    _reproject[grid](
        px.contiguous(), confidence.contiguous(), geometry, true, depth, sigma, height, width,
        px.shape[1], min_confidence, PIXELS,
    )  # fmt: skip
    return depth, sigma


@triton.jit
def _whole(x):
    """The nearest whole number, halves to the even one."""
    low = tl.floor(x)
    part = x - low
    odd = (low.to(tl.int32) & 1) == 1
    return low + tl.where((part > 0.5) | ((part == 0.5) & odd), 1.0, 0.0)


@triton.jit(do_not_specialize=["height", "width", "pitch"])
def _reproject(
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


def fuse(depth: Tensor, sigma: Tensor, config: FusionConfig) -> Tensor:
    """(3, h, w) float32 depth, sigma and views of pairs (P, h, w).

    A pixel where the pairs contradict each other has NaN depth and the views that agree.
    """
    pairs, height, width = depth.shape
    out = torch.empty((3, height, width), device=depth.device)
    grid = (triton.cdiv(height * width, FUSED_PIXELS),)
    _fuse[grid](
        depth.contiguous(), sigma.contiguous(), out, height * width, config.agree_sigmas,
        config.max_sigma_share, config.single_view_sigma, config.min_sigma_share, pairs,
        FUSED_PIXELS,
    )  # fmt: skip
    return out


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
def _fuse(
    depth, sigma, out, plane, agree, max_share, single, min_share, PAIRS: tl.constexpr,
    PIXELS: tl.constexpr,
):  # fmt: skip
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
    seen = seen & ~((views == 1) & (count > 1) & (close == 1))
    nan = float("nan")
    tl.store(out + at, tl.where(seen, z, nan).to(tl.float32), mask=here)
    e = tl.where(seen, tl.maximum(e, min_share * z), nan)
    tl.store(out + plane + at, e.to(tl.float32), mask=here)
    tl.store(out + 2 * plane + at, views.to(tl.float32), mask=here)
