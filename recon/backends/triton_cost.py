"""Matching cost of all labels as three launches of two Triton kernels.

Census first: 49 comparisons of each pixel of both pictures, into two words of 24 bits. Then a
thread goes through the labels of its pixel: bits that differ, grey levels that differ, the best
of them, and a little more than that for partners outside the picture.

Floor of L labels at h x w: 8 bytes read and 8 written a pixel and picture, 4 written a label
(3.7 MB at 320x180x16); 98 operations a pixel and picture, 40 a label. Plain torch compares 48
layers of floats for each label, some 900 MB.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs
# Triton reads annotations of a kernel as values of its own, so its arguments have none.
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.backends.torch_cost import FAR
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.matching_cost import CENSUS_RADIUS, COST_UNIT

PIXELS = 128
"""Pixels of one program."""


def matching_cost(
    left: Tensor, right: Tensor, labels: int, true: Tensor, config: BeliefPropagationConfig
) -> Tensor:
    """As :func:`recon.backends.torch_cost.matching_cost`."""
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
    most_grey, grey_weight, unseen, far, PIXELS: tl.constexpr,
):  # fmt: skip
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    plane = height * width
    here = at < plane
    v, u = at // width, at % width
    rows, columns = tl.load(true).to(tl.int32), tl.load(true + 1).to(tl.int32)
    count = tl.load(true + 2).to(tl.int32)
    own = here & (v < rows) & (u < columns)
    grey = tl.load(left + at, mask=here, other=0.0)
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
        apart = tl.abs(grey - tl.load(right + there, mask=seen, other=0.0))
        value = bits.to(tl.float32) + tl.minimum(apart, most_grey) * grey_weight
        value = tl.where(seen, value, far)
        best = tl.minimum(best, value)
        tl.store(cost + label * plane + at, value, mask=here)
    tl.debug_barrier()  # what a thread stored is read again below
    instead = tl.where(best < far, best + unseen, 0.0)
    for label in range(labels):
        value = tl.load(cost + label * plane + at, mask=here, other=0.0)
        value = tl.where(value < far, value, instead)
        tl.store(cost + label * plane + at, tl.where(own, value, 0.0), mask=here)
