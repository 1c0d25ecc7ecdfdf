"""A half iteration of belief propagation (Eq. 1) as one Triton kernel, in place.

One colour of the checkerboard: a thread holds a pixel and goes through its labels twice, up
and down, which is the lower envelope of Felzenszwalb and Huttenlocher
(https://doi.org/10.1007/s11263-006-7899-4), for the four directions at once. All sums are
32-bit integers, what is stored are 16-bit ones, so the messages are exact.

Floor of L labels at h x w: costs and four arriving messages read, four written, 2 bytes each,
of every other pixel: 9 L h w bytes (8.3 MB at 320x180x16); 36 operations a label and pixel of
the colour. The way up leaves its envelope in the message's own place, another 16 bytes a label
and pixel that stay in the caches. Plain torch makes some 60 passes over all pixels.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs
# Triton reads annotations of a kernel as values of its own, so its arguments have none.
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

CELLS = 128
"""Pixels of one program."""


def sweep(data: Tensor, messages: Tensor, slope: Tensor, cut: Tensor, colour: int) -> None:
    """Renew the messages that leave the pixels of ``colour``, those of v + u = colour modulo 2.

    ``data`` (L, h, w) and ``messages`` (4, L, h, w) up, down, left and right, contiguous int16;
    ``slope`` and ``cut`` (4, h, w) int16 of the edge that each direction crosses.
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
