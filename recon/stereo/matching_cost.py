"""Cost of a left pixel at a label: census and absolute difference, truncated.

Census (Zabih and Woodfill, https://doi.org/10.1007/BFb0028345) survives changes of exposure,
the absolute difference keeps edges in their place. Of full windows wider than 5x5 the edge of a
near surface decides about more of the background next to it. Costs are integers so that belief
propagation runs on SIMD lanes of 16 bits; ``COST_UNIT`` of them are one label of smoothness.
"""

from __future__ import annotations

import math
import threading
from typing import Any

import cv2
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from recon.parallel import parallel_for
from recon.stereo.lanes import LANES, Lanes, cells_of
from recon.types import I16, U8

COST_UNIT = 100  # integer cost of a disparity step of one label between neighbours
BIT_COST, MAX_BITS = 8, 16  # of each bit by which the census differs, and bits that count
LEVEL_COST, MAX_LEVELS = 4, 20  # of each gray level of difference, and levels that count
UNSEEN_COST = 100  # of a label whose partner is outside the image, above the best one
"""One byte holds the cost of any label, and 255 is that of one that is not seen."""

_NEAR = [(dv, du) for dv in range(-2, 3) for du in range(-2, 3) if dv or du]
_FAR = [(-3, -1), (-3, 1), (-1, -3), (-1, 3), (1, -3), (1, 3), (3, -1), (3, 1)]
CENSUS_OFFSETS = tuple(_NEAR + _FAR)
"""Row and column of the neighbours that a pixel is compared with: 5x5, and eight on a ring around
them, which tell weak texture from noise. They fill one 32-bit word."""

CENSUS_REACH = 3  # the farthest row or column of a neighbour
BORDER = 4  # columns before the first one, an even number not below the reach
MAX_SPARE = 8  # memory this many times larger than requested is released


def matching_cost(
    left: U8, right: U8, labels: int, min_disparity: int = 0, most: int = 255
) -> tuple[U8, U8]:
    """Cost of every label above the pixel's best one, (h, 2, labels, cells), and the best (h, 2,
    cells), in ``1 / COST_UNIT``; cells as in :mod:`recon.stereo.lanes`.

    Label ``l`` of left pixel (u, v) is compared with ``right[v, u - l - min_disparity]``. A
    partner outside the right image is unseen: it costs ``UNSEEN_COST`` more than the
    pixel's best seen label, so that neighbours decide. Seen ones cost ``most`` more at most. The
    arrays are used again by the next call of the same thread. Raises ValueError for bad shapes.
    """
    check_pair(left, right, labels)
    height, width = left.shape
    cells = cells_of(width)
    above = WORKSPACE.take_bytes("above", (height, 2, labels, cells))
    least = WORKSPACE.take_bytes("least", (height, 2, cells))
    parallel_for(
        _cost_volume, height, columns_apart(left), columns_apart(right), width,
        min_disparity, np.uint8(most), above, least, cells=above.size,
    )  # fmt: skip
    return above, least


def plain(array: Any) -> Any:
    """The array, or a copy: in C order and writeable, as the kernels are compiled for. Any other
    kind would be compiled in flight, which takes seconds."""
    return np.require(array, requirements=["C", "W"])


def check_pair(left: U8, right: U8, labels: int) -> None:
    """Raises ValueError when the two are not gray 8-bit images of one size."""
    for image in (left, right):
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f"a gray 8-bit image is needed, not {image.dtype} {image.shape}")
    if left.shape != right.shape or min(left.shape) < 1:
        raise ValueError(f"left {left.shape} and right {right.shape} must be of one size")
    if not 2 <= labels <= 1024:
        raise ValueError(f"labels must be 2 to 1024, not {labels}")


def columns_apart(image: U8) -> U8:
    """The even and the odd columns (2, h + 2 * CENSUS_REACH, cells + BORDER) of an image (h, w).

    Beyond the image its last rows and columns go on; cell 0 of a row of cells is cell BORDER / 2
    here.
    """
    reach = CENSUS_REACH
    border = (reach, reach, BORDER, BORDER)
    padded = cv2.copyMakeBorder(image, *border, cv2.BORDER_REPLICATE)
    apart = np.zeros((2, len(padded), cells_of(image.shape[1]) + BORDER), np.uint8)
    for parity in range(2):
        columns = padded[:, parity::2]
        apart[parity, :, : columns.shape[1]] = columns
    return apart


@intrinsic
def _census_block(typingctx: Any, own: Any, other: Any, step: Any, out: Any, stride: Any) -> Any:
    """Write the census of LANES cells, a bit where a neighbour is darker, and their gray levels.

    Addresses of: the cells, those of the other parity to their right, ``step`` bytes from row to
    row, and five rows of cells, ``stride`` bytes apart: four of eight neighbours each, the first
    of :data:`CENSUS_OFFSETS` in the highest bit, and the gray levels.
    """
    one = types.intp
    return types.void(one, one, one, one, one), _census_code


def _census_code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    own, other, step, out, stride = args
    word, lanes = own.type, Lanes(builder, 8, LANES)
    centre = lanes.load(own)
    for k in range(4):
        part = lanes.constant(0)
        for dv, du in CENSUS_OFFSETS[8 * k : 8 * k + 8]:
            start, cell = (other, (du - 1) // 2) if du % 2 else (own, du // 2)
            row = builder.add(start, builder.mul(step, ir.Constant(word, dv)))
            neighbour = lanes.load(builder.add(row, ir.Constant(word, cell)))
            darker = builder.icmp_unsigned("<", neighbour, centre)
            part = builder.sub(builder.add(part, part), builder.sext(darker, lanes.type))
        lanes.save(part, builder.add(out, builder.mul(stride, ir.Constant(word, k))))
    lanes.save(centre, builder.add(out, builder.mul(stride, ir.Constant(word, 4))))
    return context.get_dummy_value()


@njit(cache=True, nogil=True)
def census_row(apart: Any, v: int, row: Any, first: int) -> None:
    """Census and gray levels of a row of :func:`columns_apart` (2, at least 5, any) uint8, from
    ``first`` on."""
    _, rows, step = apart.shape
    cells = step - BORDER
    for parity in range(2):
        own = apart.ctypes.data + (parity * rows + v + CENSUS_REACH) * step + BORDER // 2
        other = apart.ctypes.data + ((1 - parity) * rows + v + CENSUS_REACH) * step + BORDER // 2
        out = row.ctypes.data + parity * row.shape[1] * row.shape[2] + first
        for block in range(0, cells, LANES):
            _census_block(own + block, other + parity + block, step, out + block, row.shape[2])


@intrinsic
def popcount(typingctx: Any, word: Any) -> Any:
    """How many bits of an integer are set, as one of its type."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return word(word), codegen


@intrinsic
def _cost_block(
    typingctx: Any, left: Any, right: Any, stride: Any, partners: Any, labels: Any, step: Any,
    most: Any, above: Any, least: Any,
) -> Any:  # fmt: skip
    """Write LANES cells of all labels, less their least, and that.

    Addresses of: the cells in the left row (four parts of census, gray levels, what lies beyond),
    ``stride`` bytes apart, the same cells of the right row, the byte of each label's partner
    relative to those, int64, the costs of label 0, ``step`` bytes from label to label, and the
    least costs. ``most`` is the most above the least.
    """
    one = types.intp
    return types.void(one, one, one, one, one, one, types.uint8, one, one), _cost_code


def _cost_code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    left, right, stride, partners, labels, step, most, above, least = args
    word, lanes = left.type, Lanes(builder, 8, LANES)
    most, none, all_bits = lanes.splat(most), lanes.constant(0), lanes.constant(255)

    def row(start: Any) -> list[Any]:
        at = (builder.mul(stride, ir.Constant(word, k)) for k in range(6))
        return [lanes.load(builder.add(start, offset)) for offset in at]

    *here, gray, beyond = row(left)
    low = lanes.variable(255)
    with cgutils.for_range(builder, labels) as loop:
        place = builder.add(partners, builder.mul(loop.index, ir.Constant(word, 8)))
        offset = builder.load(builder.inttoptr(place, word.as_pointer()))
        *there, partner_gray, outside = row(builder.add(right, offset))
        differ = [lanes.bits(builder.xor(a, b)) for a, b in zip(here, there, strict=True)]
        bits = builder.add(builder.add(*differ[:2]), builder.add(*differ[2:]))
        apart = builder.sub(lanes.most(gray, partner_gray), lanes.least(gray, partner_gray))
        value = builder.add(
            builder.mul(lanes.least(bits, lanes.constant(MAX_BITS)), lanes.constant(BIT_COST)),
            builder.mul(lanes.least(apart, lanes.constant(MAX_LEVELS)), lanes.constant(LEVEL_COST)),
        )
        value = builder.or_(value, outside)
        builder.store(lanes.least(builder.load(low), value), low)
        lanes.save(value, builder.add(above, builder.mul(loop.index, step)))
    best = builder.load(low)
    blind = builder.icmp_unsigned("==", best, all_bits)
    rise = builder.select(blind, none, lanes.constant(UNSEEN_COST))
    exists = builder.not_(beyond)
    with cgutils.for_range(builder, labels) as loop:
        at = builder.add(above, builder.mul(loop.index, step))
        value = lanes.load(at)
        over = lanes.least(builder.sub(value, best), most)
        over = builder.select(builder.icmp_unsigned("==", value, all_bits), rise, over)
        lanes.save(builder.and_(over, exists), at)
    lanes.save(builder.and_(builder.select(blind, none, best), exists), least)
    return context.get_dummy_value()


@njit(cache=True, nogil=True)
def _cost_volume(
    begin: int, end: int, left: Any, right: Any, width: int, min_disparity: int, most: Any,
    above: Any, least: Any,
) -> None:  # fmt: skip
    _, _, labels, cells = above.shape
    here, there = np.zeros((2, 6, 3 * cells), np.uint8), np.zeros((2, 6, 3 * cells), np.uint8)
    plane = 6 * 3 * cells
    partners = np.empty((2, labels), np.int64)
    for parity in range(2):
        for row in (here, there):
            row[parity, 5] = 255
            row[parity, 5, cells : cells + (width + 1 - parity) // 2] = 0
        for label in range(labels):
            column = parity - label - min_disparity
            cell = min(max(column // 2, -cells), cells)
            partners[parity, label] = (column % 2) * plane + cell
    for v in range(begin, end):
        census_row(left, v, here, cells)
        census_row(right, v, there, cells)
        for parity in range(2):
            for first in range(0, cells, LANES):
                _cost_block(
                    here.ctypes.data + parity * plane + cells + first,
                    there.ctypes.data + cells + first,
                    3 * cells,
                    partners.ctypes.data + parity * labels * 8,
                    labels,
                    cells,
                    most,
                    above.ctypes.data + (2 * v + parity) * labels * cells + first,
                    least.ctypes.data + (2 * v + parity) * cells + first,
                )


class Workspace(threading.local):
    """Memory for arrays per thread, by name: pairs differ in size, and fresh pages cost as much as
    the messages."""

    def __init__(self) -> None:
        self._kept: dict[str, I16] = {}

    def take(self, name: str, shape: tuple[int, ...]) -> I16:
        """An array whose values are undefined; it holds until the name is taken again."""
        size = math.prod(shape)
        memory = self._kept.get(name)
        if memory is None or not size <= memory.size <= MAX_SPARE * size:
            memory = self._kept[name] = np.empty(size + size // 8, np.int16)
        return memory[:size].reshape(shape)

    def take_bytes(self, name: str, shape: tuple[int, ...]) -> U8:
        """The same of uint8."""
        size = math.prod(shape)
        return self.take(name, ((size + 1) // 2,)).view(np.uint8)[:size].reshape(shape)


WORKSPACE = Workspace()
