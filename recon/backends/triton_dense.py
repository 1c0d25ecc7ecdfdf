"""The dense stages as Triton kernels: matching cost, propagation (Eq. 1), upsampling (Eq. 2)."""

# mypy: allow-untyped-defs, allow-incomplete-defs
# Triton reads annotations of a kernel as values of its own, so its arguments have none.
from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.backends.torch_depth import tap_layers, window
from recon.backends.torch_stereo import FAR
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.matching_cost import CENSUS_RADIUS, COST_UNIT
from recon.stereo.upsampling import RANGE_FLOOR, UpsamplingConfig

PIXELS = 128
"""Pixels of one program."""


def matching_cost(
    left: Tensor, right: Tensor, labels: int, true: Tensor, config: BeliefPropagationConfig
) -> Tensor:
    """As :func:`recon.backends.torch_stereo.matching_cost`, in three launches of two kernels.

    Census first: 49 comparisons of each pixel of both images, into two words of 24 bits. Then a
    thread goes through the labels of its pixel: bits that differ, gray levels that differ, the
    best of them, and a little more than that for partners outside the image.

    Floor of L labels at h x w: 8 bytes read and 8 written a pixel and image, 4 written a label
    (3.7 MB at 320x180x16); 98 operations a pixel and image, 40 a label. Plain torch compares 48
    layers of floats for each label, some 900 MB.
    """
    c = config.cost
    height, width = left.shape
    words = torch.empty((2, 2, height, width), dtype=torch.int32, device=left.device)
    grid = (triton.cdiv(height * width, PIXELS),)
    left, right = left.contiguous(), right.contiguous()
    for image, out in zip((left, right), words, strict=True):
        _census[grid](image, out, height, width, CENSUS_RADIUS, PIXELS)
    cost = torch.empty((labels, height, width), device=left.device)
    _cost[grid](
        left, right, words, true, cost, labels, height, width, config.min_disparity,
        c.census_truncation, round(c.census_weight * COST_UNIT), float(c.difference_truncation),
        round(c.difference_weight * COST_UNIT), round(c.unseen * COST_UNIT), FAR, PIXELS,
    )  # fmt: skip
    return cost


@triton.jit(do_not_specialize=["height", "width"])
def _census(image, words, height, width, radius, PIXELS: tl.constexpr):
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < height * width
    v, u = at // width, at % width
    centre = tl.load(image + at, mask=here, other=0.0)
    low = tl.full((PIXELS,), 0, tl.int32)
    high = tl.full((PIXELS,), 0, tl.int32)
    side = 2 * radius + 1
    half = side * side // 2
    for n in range(side * side):  # the centre itself, in the middle, is not darker
        y = tl.minimum(tl.maximum(v + n // side - radius, 0), height - 1)
        x = tl.minimum(tl.maximum(u + n % side - radius, 0), width - 1)
        darker = (tl.load(image + y * width + x, mask=here, other=0.0) < centre).to(tl.int32)
        first = n < half
        low = tl.where(first, 2 * low + darker, low)
        high = tl.where(first, high, 2 * high + darker)
    tl.store(words + at, low, mask=here)
    tl.store(words + height * width + at, high, mask=here)


@triton.jit
def _ones(word):
    """How many bits are set of 25."""
    word = word - ((word >> 1) & 0x55555555)
    word = (word & 0x33333333) + ((word >> 2) & 0x33333333)
    word = (word + (word >> 4)) & 0x0F0F0F0F
    return (word + (word >> 8) + (word >> 16) + (word >> 24)) & 63


@triton.jit(do_not_specialize=["labels", "height", "width", "first"])
def _cost(
    left, right, words, true, cost, labels, height, width, first, most_bits, bit_weight,
    most_gray, gray_weight, unseen, far, PIXELS: tl.constexpr,
):  # fmt: skip
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    plane = height * width
    here = at < plane
    v, u = at // width, at % width
    rows, columns = tl.load(true).to(tl.int32), tl.load(true + 1).to(tl.int32)
    count = tl.load(true + 2).to(tl.int32)
    own = here & (v < rows) & (u < columns)
    gray = tl.load(left + at, mask=here, other=0.0)
    low = tl.load(words + at, mask=here, other=0)
    high = tl.load(words + plane + at, mask=here, other=0)
    best = tl.full((PIXELS,), 0.0, tl.float32) + far
    for label in range(labels):
        shift = label + first
        partner = u - shift
        seen = here & (partner >= 0) & (partner < columns) & (partner < width)
        seen = seen & (label + 0 * partner < count)
        there = at - shift
        a = tl.load(words + 2 * plane + there, mask=seen, other=0) ^ low
        b = tl.load(words + 3 * plane + there, mask=seen, other=0) ^ high
        bits = tl.minimum(_ones(a) + _ones(b), most_bits) * bit_weight
        apart = tl.abs(gray - tl.load(right + there, mask=seen, other=0.0))
        value = bits.to(tl.float32) + tl.minimum(apart, most_gray) * gray_weight
        value = tl.where(seen, value, far)
        best = tl.minimum(best, value)
        tl.store(cost + label * plane + at, value, mask=here)
    tl.debug_barrier()  # what a thread stored is read again below
    instead = tl.where(best < far, best + unseen, 0.0)
    for label in range(labels):
        value = tl.load(cost + label * plane + at, mask=here, other=0.0)
        value = tl.where(value < far, value, instead)
        tl.store(cost + label * plane + at, tl.where(own, value, 0.0), mask=here)


CELLS = 128
"""Pixels of one program."""


def sweep(data: Tensor, messages: Tensor, slope: Tensor, cut: Tensor, colour: int) -> None:
    """Renew the messages that leave the pixels of ``colour``, those of v + u = colour modulo 2.

    ``data`` (L, h, w) and ``messages`` (4, L, h, w) up, down, left and right, contiguous int16;
    ``slope`` and ``cut`` (4, h, w) int16 of the edge that each direction crosses.

    A thread holds a pixel and goes through its labels twice, up and down, which is the lower
    envelope of Felzenszwalb and Huttenlocher (https://doi.org/10.1007/s11263-006-7899-4), for the
    four directions at once. Sums are 32-bit integers, what is stored 16-bit ones: exact.

    Floor of L labels at h x w: costs and four arriving messages read, four written, 2 bytes each,
    of every other pixel: 9 L h w bytes (8.3 MB at 320x180x16); 36 operations a label and pixel of
    the colour. The way up leaves its envelope in the message's own place, another 16 bytes a
    label and pixel that stay in the caches. Plain torch makes some 60 passes over all pixels.
    """
    labels, height, width = data.shape
    cells = height * ((width + 1) // 2)
    _sweep[(triton.cdiv(cells, CELLS),)](
        data, messages, slope, cut, colour, labels, height, width, CELLS
    )


@triton.jit(do_not_specialize=["colour", "labels", "height", "width"])
def _sweep(
    data, messages, slope, cut, colour, labels, height,
    width, CELLS: tl.constexpr,
):  # fmt: skip
    half = (width + 1) // 2
    cell = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    v = cell // half
    u = 2 * (cell % half) + (v + colour) % 2
    here = (v < height) & (u < width)
    at = v * width + u
    plane = height * width
    volume = labels * plane
    up, down = messages, messages + volume
    left, right = down + volume, down + 2 * volume
    slope_up = tl.load(slope + at, mask=here, other=0).to(tl.int32)
    slope_down = tl.load(slope + plane + at, mask=here, other=0).to(tl.int32)
    slope_left = tl.load(slope + 2 * plane + at, mask=here, other=0).to(tl.int32)
    slope_right = tl.load(slope + 3 * plane + at, mask=here, other=0).to(tl.int32)
    far = tl.full((CELLS,), 1 << 24, tl.int32)
    to_up, to_down, to_left, to_right = far, far, far, far
    low_up, low_down, low_left, low_right = far, far, far, far
    for label in range(labels):
        p = label * plane + at
        from_below = tl.load(up + p + width, mask=here & (v + 1 < height), other=0).to(tl.int32)
        from_above = tl.load(down + p - width, mask=here & (v > 0), other=0).to(tl.int32)
        from_right = tl.load(left + p + 1, mask=here & (u + 1 < width), other=0).to(tl.int32)
        from_left = tl.load(right + p - 1, mask=here & (u > 0), other=0).to(tl.int32)
        total = tl.load(data + p, mask=here, other=0).to(tl.int32)
        total += from_below + from_above + from_right + from_left
        low_up = tl.minimum(low_up, total - from_above)
        low_down = tl.minimum(low_down, total - from_below)
        low_left = tl.minimum(low_left, total - from_left)
        low_right = tl.minimum(low_right, total - from_right)
        to_up = tl.minimum(total - from_above, to_up + slope_up)
        to_down = tl.minimum(total - from_below, to_down + slope_down)
        to_left = tl.minimum(total - from_left, to_left + slope_left)
        to_right = tl.minimum(total - from_right, to_right + slope_right)
        tl.store(up + p, to_up.to(tl.int16), mask=here)
        tl.store(down + p, to_down.to(tl.int16), mask=here)
        tl.store(left + p, to_left.to(tl.int16), mask=here)
        tl.store(right + p, to_right.to(tl.int16), mask=here)
    tl.debug_barrier()  # what a thread stored is read again below
    cut_up = tl.load(cut + at, mask=here, other=0).to(tl.int32)
    cut_down = tl.load(cut + plane + at, mask=here, other=0).to(tl.int32)
    cut_left = tl.load(cut + 2 * plane + at, mask=here, other=0).to(tl.int32)
    cut_right = tl.load(cut + 3 * plane + at, mask=here, other=0).to(tl.int32)
    to_up, to_down, to_left, to_right = far, far, far, far
    for back in range(labels):
        p = (labels - 1 - back) * plane + at
        to_up = tl.minimum(tl.load(up + p, mask=here, other=0).to(tl.int32), to_up + slope_up)
        to_down = tl.minimum(
            tl.load(down + p, mask=here, other=0).to(tl.int32), to_down + slope_down
        )
        to_left = tl.minimum(
            tl.load(left + p, mask=here, other=0).to(tl.int32), to_left + slope_left
        )
        to_right = tl.minimum(
            tl.load(right + p, mask=here, other=0).to(tl.int32), to_right + slope_right
        )
        tl.store(up + p, tl.minimum(to_up - low_up, cut_up).to(tl.int16), mask=here)
        tl.store(down + p, tl.minimum(to_down - low_down, cut_down).to(tl.int16), mask=here)
        tl.store(left + p, tl.minimum(to_left - low_left, cut_left).to(tl.int16), mask=here)
        tl.store(right + p, tl.minimum(to_right - low_right, cut_right).to(tl.int16), mask=here)


ROWS, COLUMNS = 4, 64
"""Fine pixels of one program."""

LOG2_E = 1 / math.log(2)


def bilateral(
    px: Tensor, confidence: Tensor, taps: Tensor, guide: Tensor, true: Tensor,
    config: UpsamplingConfig,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As :meth:`recon.backends.torch_depth.JointBilateral.forward`; all sums in registers.

    Floor of a guide of H x W px: 3 bytes read and 8 written a pixel, 11 H W bytes (45 MB at
    2704x1520); 20 operations, one of them a power of two, for each of the D x D taps of a pixel
    (D = 10: 8.2 G operations). The coarse layers, 20 bytes a tap, and the two tables stay in the
    caches. Plain torch writes some 50 floats a tap and pixel instead.
    """
    h, w = px.shape
    height, width, _ = guide.shape
    scale = math.sqrt(0.5 * LOG2_E) / config.range_sigma
    layers = tap_layers(px, confidence, taps)[:5].contiguous()
    layers[:3] *= scale
    rows, log_y = window(h, height, true[0], true[2], config)
    columns, log_x = window(w, width, true[1], true[3], config)
    out, sure = torch.empty((2, height, width), device=px.device)
    grid = (triton.cdiv(height, ROWS), triton.cdiv(width, COLUMNS))
    _bilateral[grid](
        layers, guide.contiguous(), rows.int(), log_y * LOG2_E, columns.int(), log_x * LOG2_E,
        out, sure, height, width, w, h * w, scale, RANGE_FLOOR, config.min_support,
        config.diameter_px, ROWS, COLUMNS,
    )  # fmt: skip
    return out, sure


@triton.jit(do_not_specialize=["height", "width", "pitch", "plane"])
def _bilateral(
    layers, guide, rows, log_y, columns, log_x, out, sure,
    height, width, pitch, plane, scale, floor, support,
    diameter: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
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
