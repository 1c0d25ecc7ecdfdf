"""Messages of belief propagation on a checkerboard, 32 pixels of one label at a time.

Layout: the cells of one column parity of a row lie side by side, (row, parity, label, cell),
so that a SIMD register holds one label of neighbouring pixels of one colour and any number of
labels costs the same per label. A row of cells ends with at least one empty cell, and the
messages have an empty row above and below: what lies beyond the border says nothing.

Data are 16-bit integers, messages 8-bit ones: the caches hold twice as many. A cost further than
four truncations above its pixel's best cannot win its pixel (a message is at most one truncation),
so it is cut there, at every level before the next coarser one sums it, and no sum overflows.

The innermost step is written for vector registers: left to find them in loops over arrays, LLVM
checks the arrays for overlap at every label, which took ten times as long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from recon.parallel import parallel_for, shares
from recon.stereo.matching_cost import Workspace
from recon.types import I16, U8

LANES = 32
"""Cells that are updated together; LLVM spreads them over the registers that there are."""

PARTS = 2
"""Parts of them whose 16-bit envelopes the registers of AVX2 hold at once."""

_FAR = 16383


@intrinsic
def update_block(
    typingctx: Any,
    data: Any,
    arriving: Any,
    leaving: Any,
    mask: Any,
    scratch: Any,
    strides: Any,
    labels: Any,
    slopes: Any,
    cuts: Any,
) -> Any:
    """Write the four messages that leave LANES pixels of one colour of one row.

    Addresses of: the data of label 0, the four messages that arrive (from below, above,
    right, left), the four that leave (up, down, left, right), the lanes that exist (-1 or 0)
    and ``(labels + 1) * 4 * LANES`` int16 of scratch. ``strides`` are bytes from label to label
    of the data and of the messages; ``slopes`` and ``cuts`` are the addresses of the smoothness
    of the four edges.
    """
    addresses = types.UniTuple(types.intp, 4)
    one = types.intp
    two = types.UniTuple(types.intp, 2)
    signature = types.void(one, addresses, addresses, one, one, two, one, addresses, addresses)
    return signature, _code


def _code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """LLVM of :func:`update_block`: lower envelope up the labels, then down.

    Upwards in 16 bits, half the lanes at a time, whose envelopes stay in registers; downwards
    nothing is above a truncation, so that 8 bits hold it.
    """
    data, arriving, leaving, mask, scratch, strides, labels, slopes, cuts = args
    word = data.type
    data_stride, stride = cgutils.unpack_tuple(builder, strides, 2)
    m_from = cgutils.unpack_tuple(builder, arriving, 4)
    m_to = cgutils.unpack_tuple(builder, leaving, 4)
    slopes, cuts = (cgutils.unpack_tuple(builder, one, 4) for one in (slopes, cuts))
    sources = (m_from[1], m_from[0], m_from[3], m_from[2])  # what each message must leave out
    wide, narrow = _Lanes(builder, 16, LANES // PARTS), _Lanes(builder, 8, LANES)
    whole = _Lanes(builder, 16, LANES)

    def moved(address: Any, bytes_on: int) -> Any:
        return builder.add(address, ir.Constant(word, bytes_on))

    def place(label: Any, k: int) -> Any:
        row = builder.add(builder.mul(label, ir.Constant(word, 4)), ir.Constant(word, k))
        return builder.add(scratch, builder.mul(row, ir.Constant(word, 2 * LANES)))

    lowest = builder.add(scratch, builder.mul(labels, ir.Constant(word, 8 * LANES)))
    for part in range(PARTS):
        first = part * LANES // PARTS
        slope = [wide.load(moved(a, 2 * first)) for a in slopes]
        envelope, low = ([wide.variable(_FAR) for _ in range(4)] for _ in range(2))
        with cgutils.for_range(builder, labels) as loop:
            offset = moved(builder.mul(loop.index, stride), first)
            at = moved(builder.mul(loop.index, data_stride), 2 * first)
            total = wide.load(builder.add(data, at))
            arrived = {a: wide.load(builder.add(a, offset), 8) for a in m_from}
            for message in arrived.values():
                total = builder.add(total, message)
            for k in range(4):
                rest = builder.sub(total, arrived[sources[k]])
                builder.store(wide.least(builder.load(low[k]), rest), low[k])
                step = builder.add(builder.load(envelope[k]), slope[k])
                best = wide.least(rest, step)
                builder.store(best, envelope[k])
                wide.save(best, moved(place(loop.index, k), 2 * first))
        for k in range(4):
            wide.save(builder.load(low[k]), moved(lowest, 2 * (k * LANES + first)))
    exists = builder.trunc(whole.load(mask), narrow.type)
    slope, cut = ([narrow.cut(whole.load(a)) for a in of] for of in (slopes, cuts))
    low = [whole.load(moved(lowest, 2 * k * LANES)) for k in range(4)]
    after = [narrow.variable(255) for _ in range(4)]
    with cgutils.for_range(builder, labels) as loop:
        label = builder.sub(builder.sub(labels, loop.index), ir.Constant(word, 1))
        offset = builder.mul(label, stride)
        for k in range(4):
            best = narrow.cut(builder.sub(whole.load(place(label, k)), low[k]))
            most = narrow.least(narrow.sum(builder.load(after[k]), slope[k]), cut[k])
            best = narrow.least(best, most)
            builder.store(best, after[k])
            narrow.save(builder.and_(best, exists), builder.add(m_to[k], offset))
    return context.get_dummy_value()


class _Lanes:
    """Builds the instructions on some integers at once: signed ones of 16 bits, unsigned of 8."""

    def __init__(self, builder: Any, bits: int, count: int) -> None:
        self.builder, self.bits, self.count = builder, bits, count
        self.type = ir.VectorType(ir.IntType(bits), count)

    def load(self, address: Any, bits: int = 0) -> Any:
        """The lanes at an address, aligned or not; stored as so many ``bits``, if not as here."""
        stored = ir.VectorType(ir.IntType(bits or self.bits), self.count)
        lanes = self.builder.load(self.builder.inttoptr(address, stored.as_pointer()), align=1)
        return lanes if stored == self.type else self.builder.zext(lanes, self.type)

    def save(self, value: Any, address: Any) -> None:
        """Put the lanes at an address."""
        pointer = self.builder.inttoptr(address, self.type.as_pointer())
        self.builder.store(value, pointer, align=1)

    def cut(self, wide: Any) -> Any:
        """The lanes of 16 bits in 8, those above 255 as 255 and those below 0 as 0."""
        none, most = (ir.Constant(wide.type, [n] * self.count) for n in (0, 255))
        wide = self.builder.select(self.builder.icmp_signed(">", wide, none), wide, none)
        wide = self.builder.select(self.builder.icmp_signed("<", wide, most), wide, most)
        return self.builder.trunc(wide, self.type)

    def variable(self, value: int) -> Any:
        """A local variable with this value in all lanes."""
        variable = cgutils.alloca_once(self.builder, self.type)
        self.builder.store(ir.Constant(self.type, [value] * self.count), variable)
        return variable

    def sum(self, a: Any, b: Any) -> Any:
        """The sum of 8-bit lanes, 255 where it is more."""
        kind = ir.FunctionType(self.type, (self.type, self.type))
        name = f"llvm.uadd.sat.v{self.count}i{self.bits}"
        return self.builder.call(
            cgutils.get_or_insert_function(self.builder.module, kind, name), (a, b)
        )

    def least(self, a: Any, b: Any) -> Any:
        """The lesser of each lane."""
        compare = self.builder.icmp_unsigned if self.bits == 8 else self.builder.icmp_signed
        return self.builder.select(compare("<", a, b), a, b)


WEIGHT_BITS = np.int32(8)
FULL_WEIGHT = 256

UP, DOWN, LEFT, RIGHT = 0, 1, 2, 3
"""Where a message travels."""

_space = Workspace()


@dataclass(frozen=True, slots=True)
class Smoothness:
    """Cost of a step between neighbouring labels, in integer units.

    ``slope`` per label, ``truncation`` at most; both fall, with the contrast of the two
    pixels, to ``floor`` of that at ``full_contrast`` gray levels and above.
    """

    slope: int
    truncation: int
    floor: float
    full_contrast: int

    def weights(self, image: U8) -> I16:
        """Weight of the edge to the pixel above and to the left, (2, h, w) in 1 / FULL_WEIGHT."""
        contrast = np.arange(256, dtype=np.float64) / self.full_contrast
        table = np.maximum(1 - contrast * (1 - self.floor), self.floor) * FULL_WEIGHT
        return np.asarray(_weights(image, np.rint(table).astype(np.int16)))


@njit(cache=True, nogil=True)
def _weights(image: Any, table: Any) -> Any:  # pragma: no cover - compiled
    height, width = image.shape
    weights = np.full((2, height, width), np.int16(FULL_WEIGHT), np.int16)
    for v in range(height):
        for u in range(width):
            here = np.int16(image[v, u])
            if v > 0:
                weights[0, v, u] = table[abs(here - np.int16(image[v - 1, u]))]
            if u > 0:
                weights[1, v, u] = table[abs(here - np.int16(image[v, u - 1]))]
    return weights


@njit(cache=True, nogil=True)
def _coarser_weights(fine: Any) -> Any:  # pragma: no cover - compiled
    """Mean of the two edges that lie between two coarse pixels."""
    _, height, width = fine.shape
    coarse = np.empty((2, (height + 1) // 2, (width + 1) // 2), np.int16)
    for v in range(coarse.shape[1]):
        for u in range(coarse.shape[2]):
            right, below = min(2 * u + 1, width - 1), min(2 * v + 1, height - 1)
            coarse[0, v, u] = (fine[0, 2 * v, 2 * u] + fine[0, 2 * v, right]) // 2
            coarse[1, v, u] = (fine[1, 2 * v, 2 * u] + fine[1, below, 2 * u]) // 2
    return coarse


@njit(cache=True, nogil=True)
def _edges(
    weights: Any, cells: int, slope: int, truncation: int
) -> Any:  # pragma: no cover - compiled
    """Slope and truncation of each edge: (slope or cut, vertical or horizontal, row, parity, cell).

    A row and a cell beyond the border are never read for a pixel that exists.
    """
    _, height, width = weights.shape
    edges = np.zeros((2, 2, height + 2, 2, cells), np.int16)
    per_label, most = np.int32(slope), np.int32(truncation)
    for kind in range(2):
        for v in range(height):
            row = weights[kind, v]
            for parity in range(2):
                slopes, cuts = edges[0, kind, v + 1, parity], edges[1, kind, v + 1, parity]
                for i in range((width + 1 - parity) // 2):
                    w = np.int32(row[2 * i + parity])
                    slopes[i] = np.int16(np.int32(per_label * w) >> WEIGHT_BITS)
                    cuts[i] = np.int16(np.int32(most * w) >> WEIGHT_BITS)
    return edges


def propagate(
    cost: I16, image: U8, iterations: int, levels: int, smoothness: Smoothness
) -> tuple[I16, U8]:
    """Data (h, 2, L, cells) and messages (4, h + 2, 2, L, cells) of the finest level.

    ``cost`` is (h, L, w) int16, at least 0; ``image`` (h, w) uint8 says where surfaces may end.
    Coarse to fine, each level runs ``iterations``, each of which updates one colour of the
    checkerboard. The arrays are used again by the next call of the same thread.
    """
    truncation = smoothness.truncation
    height, labels, width = cost.shape
    cells = cells_of(width)
    pyramid = [_space.take("data", (height, 2, labels, cells))]
    shape = (4, height + 2, 2, labels, cells)
    coarse = _Coarse(_space.take_bytes("messages", shape).reshape(-1))
    parallel_for(_split, height, cost, truncation, pyramid[0], cells=cost.size)
    weights = [smoothness.weights(image)]
    while len(pyramid) < levels and min(weights[-1].shape[1:]) >= 8:
        weights.append(_coarser_weights(weights[-1]))
        _, h, w = weights[-1].shape
        pyramid.append(coarse.take((h, 2, labels, cells_of(w)), np.int16))
        parallel_for(_coarser, h, pyramid[-2], w, truncation, pyramid[-1], cells=pyramid[-2].size)
    messages = np.zeros((4, 1, 2, labels, 1), np.uint8)
    for level in range(len(pyramid) - 1, -1, -1):
        data, weight = pyramid[level], weights[level]
        h, _, _, cells = data.shape
        w = weight.shape[2]
        shape = (4, h + 2, 2, labels, cells)
        if level > 1:
            finer = coarse.take(shape, np.uint8)
        else:
            finer = _space.take_bytes("messages 1" if level else "messages", shape)
        parallel_for(_start, h + 2, messages, w, finer, cells=data.size)
        messages = finer
        edges = _edges(weight, cells, smoothness.slope, truncation)
        _sweeps(data, messages, edges, w, iterations)
    return pyramid[0], messages


class _Coarse:
    """The memory of the finest messages, as long as coarser levels are worked on.

    The messages of the second finest level, from which the finest ones start, are not in it.
    """

    def __init__(self, memory: U8) -> None:
        self._memory = memory

    def take(self, shape: tuple[int, ...], dtype: type[np.generic]) -> Any:
        """An array whose values are undefined, in memory of its own where there is no more."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if size > self._memory.size:
            return np.empty(shape, dtype)
        taken, self._memory = self._memory[:size], self._memory[size:]
        return taken.view(dtype).reshape(shape)


def cells_of(width: int) -> int:
    """Length of a row of cells of one parity: whole blocks, and at least one empty cell."""
    return ((width + 1) // 2 // LANES + 1) * LANES


@njit(cache=True, nogil=True)
def _blocks(width: int) -> int:  # pragma: no cover - compiled
    """Blocks of a row of cells that have pixels: all, or all but the last one."""
    return ((width + 1) // 2 + LANES - 1) // LANES


@njit(cache=True, nogil=True)
def _split(
    begin: int, end: int, cost: Any, truncation: int, data: Any
) -> None:  # pragma: no cover - compiled
    """(h, L, w) to (h, 2, L, cells), each pixel less its least cost and cut."""
    _, labels, width = cost.shape
    for v in range(begin, end):
        low = cost[v, 0].copy()
        for label in range(1, labels):
            row = cost[v, label]
            for u in range(width):
                low[u] = min(low[u], row[u])
        top = np.int16(4 * truncation)
        for label in range(labels):
            row = cost[v, label]
            for parity in range(2):
                out = data[v, parity, label]
                count = (width + 1 - parity) // 2
                for i in range(count):
                    u = 2 * i + parity
                    out[i] = min(np.int16(row[u] - low[u]), top)
                out[count:] = 0


@njit(cache=True, nogil=True)
def _coarser(
    begin: int, end: int, fine: Any, width: int, truncation: int, data: Any
) -> None:  # pragma: no cover - compiled
    """Sum of the costs of 2x2 pixels, less its least, cut again to what can matter."""
    fine_height, _, labels, _ = fine.shape
    sums, low = np.empty((labels, width), np.int16), np.empty(width, np.int16)
    top = np.int16(4 * truncation)
    for v in range(begin, end):
        low[:] = 32767
        for label in range(labels):
            row = sums[label]
            a, b = fine[2 * v, 0, label, :width], fine[2 * v, 1, label, :width]
            for u in range(width):
                row[u] = np.int16(a[u] + b[u])
            if 2 * v + 1 < fine_height:
                a, b = fine[2 * v + 1, 0, label, :width], fine[2 * v + 1, 1, label, :width]
                for u in range(width):
                    row[u] += np.int16(a[u] + b[u])
            for u in range(width):
                low[u] = min(low[u], row[u])
        for label in range(labels):
            row = sums[label]
            for parity in range(2):
                out = data[v, parity, label]
                count = (width + 1 - parity) // 2
                for i in range(count):
                    out[i] = min(np.int16(row[2 * i + parity] - low[2 * i + parity]), top)
                out[count:] = 0


@njit(cache=True, nogil=True)
def _start(
    begin: int, end: int, coarse: Any, width: int, messages: Any
) -> None:  # pragma: no cover - compiled
    """The messages that a level starts from: those of the coarser cells that it divides.

    Only the colour that the first sweep reads is filled; the sweep writes the other.
    """
    height, labels, cells = messages.shape[1] - 2, messages.shape[3], messages.shape[4]
    known, written = coarse.shape[4], _blocks(width) * LANES
    for r in range(begin, end):
        for direction in range(4):
            if r in (0, height + 1):
                messages[direction, r] = 0
                continue
            parity = r & 1  # row r - 1 + colour 1
            # The cell before the first one of the row's other parity is read as a neighbour.
            messages[direction, r, 1 - parity, labels - 1, cells - 1] = 0
            for label in range(labels):
                messages[direction, r, 1 - parity, label, written:] = 0
                out = messages[direction, r, parity, label]
                if known == 1:
                    out[:] = 0
                    continue
                even = coarse[direction, (r + 1) // 2, 0, label]
                odd = coarse[direction, (r + 1) // 2, 1, label]
                for i in range(cells // 2):
                    out[2 * i] = even[i]
                    out[2 * i + 1] = odd[i]
                out[(width + 1 - parity) // 2 :] = 0


@njit(cache=True, nogil=True)
def _update_row(
    data: Any, messages: Any, v: int, colour: int, edges: Any, blocks: int, masks: Any, scratch: Any
) -> None:  # pragma: no cover - compiled
    """Messages that leave the pixels of one colour of row ``v``."""
    _, _, labels, cells = data.shape
    parity = (v + colour) & 1
    row = labels * cells  # bytes of the messages of one parity
    base = messages.ctypes.data
    step = (data.shape[0] + 2) * 2 * row  # from direction to direction
    here = base + (2 * (v + 1) + parity) * row
    adjacent = base + (2 * (v + 1) + 1 - parity) * row
    d = data.ctypes.data + (2 * v + parity) * 2 * row
    line = 2 * cells  # bytes of the edges of one parity of a row
    side = (data.shape[0] + 2) * 2 * line  # from vertical to horizontal edges
    for block in range(blocks):
        at = 2 * LANES * block
        start = here + LANES * block
        beside = adjacent + LANES * block + parity
        arriving = (
            start + 2 * row + UP * step,
            start - 2 * row + DOWN * step,
            beside + LEFT * step,
            beside + RIGHT * step - 1,
        )
        leaving = (start, start + step, start + 2 * step, start + 3 * step)
        e = edges.ctypes.data + at
        # smoothness towards above, below, left and right
        places = (
            e + (2 * (v + 1) + parity) * line,
            e + (2 * (v + 2) + parity) * line,
            e + (2 * (v + 1) + parity) * line + side,
            e + (2 * (v + 1) + 1 - parity) * line + side + 2 * parity,
        )
        cut = 2 * side
        update_block(
            d + at,
            arriving,
            leaving,
            masks.ctypes.data + parity * 2 * cells + at,
            scratch.ctypes.data,
            (2 * cells, cells),
            labels,
            places,
            (places[0] + cut, places[1] + cut, places[2] + cut, places[3] + cut),
        )


@njit(cache=True, nogil=True)
def _masks(width: int, cells: int) -> Any:  # pragma: no cover - compiled
    """(2, cells) -1 where a cell of that parity is a pixel, else 0."""
    masks = np.zeros((2, cells), np.int16)
    masks[0, : (width + 1) // 2] = -1
    masks[1, : width // 2] = -1
    return masks


@njit(cache=True, nogil=True)
def _sweep_band(
    data: Any, messages: Any, edges: Any, width: int, iterations: int, band: int, bands: int
) -> None:  # pragma: no cover - compiled
    """All iterations of a band of rows, as far as it can go alone, in one pass of the memory.

    Iteration t of a row needs iteration t - 1 of the neighbouring rows, so a band does one row
    less at each inner edge per iteration.
    """
    height, _, labels, cells = data.shape
    masks, blocks = _masks(width, cells), _blocks(width)
    scratch = np.empty((labels + 1) * 4 * LANES, np.int16)
    first, last = height * band // bands, height * (band + 1) // bands
    for front in range(first, last + iterations):
        for t in range(iterations):
            v = front - t
            begin = first + t if band > 0 else 0
            end = last - t if band < bands - 1 else height
            if begin <= v < end:
                _update_row(data, messages, v, t & 1, edges, blocks, masks, scratch)


@njit(cache=True, nogil=True)
def _sweep_gap(
    data: Any, messages: Any, edges: Any, width: int, iterations: int, edge: int
) -> None:  # pragma: no cover - compiled
    """The messages that the bands on both sides of row ``edge`` left out."""
    labels, cells = data.shape[2], data.shape[3]
    masks, blocks = _masks(width, cells), _blocks(width)
    scratch = np.empty((labels + 1) * 4 * LANES, np.int16)
    for t in range(1, iterations):
        for v in range(edge - t, edge + t):
            _update_row(data, messages, v, t & 1, edges, blocks, masks, scratch)


def _sweeps(data: I16, messages: U8, edges: Any, width: int, iterations: int) -> None:
    """All iterations of a level, in bands of rows; then what the bands left out between them."""
    height = data.shape[0]
    bands = max(1, min(shares(data.size), height // (2 * iterations)))

    def sweep(begin: int, end: int) -> None:
        for band in range(begin, end):
            _sweep_band(data, messages, edges, width, iterations, band, bands)

    def close(begin: int, end: int) -> None:
        for band in range(begin, end):
            edge = height * (band + 1) // bands
            _sweep_gap(data, messages, edges, width, iterations, edge)

    parallel_for(sweep, bands)
    parallel_for(close, bands - 1)
