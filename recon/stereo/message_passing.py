"""Messages of belief propagation on a checkerboard, in the layout of :mod:`recon.stereo.lanes`.

What lies beyond the border says nothing. Messages are 8-bit integers, data 8-bit ones at the finest
level and 16-bit ones at the coarser levels, the sums of finer ones. A cost further than four
truncations above its pixel's best cannot win its pixel (a message is at most one truncation), so
it is cut there at every level and no sum overflows.

All iterations go down the rows at once, each a row behind the one before: the messages of a few
rows are all that the finest level keeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from recon.parallel import parallel_for
from recon.stereo.lanes import LANES, PARTS, Lanes, cells_of
from recon.stereo.matching_cost import Workspace
from recon.types import I16, U8

_FAR = 16383


@intrinsic
def update_block(
    typingctx: Any,
    data: Any,
    sample: Any,
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

    Addresses of: the data of label 0, of the type of ``sample``, the four messages that arrive
    (from below, above, right, left), the four that leave (up, down, left, right), the lanes that
    exist (-1 or 0) and ``(labels + 1) * 4 * LANES`` int16 of scratch. ``strides`` are bytes from
    label to label of the data and of the messages; ``slopes`` and ``cuts`` are the addresses of
    the smoothness of the four edges.
    """
    addresses = types.UniTuple(types.intp, 4)
    one = types.intp
    two = types.UniTuple(types.intp, 2)
    signature = types.void(
        one, sample, addresses, addresses, one, one, two, one, addresses, addresses
    )
    return signature, _code


def _code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """LLVM of :func:`update_block`: lower envelope up the labels, then down.

    Upwards in 16 bits, half the lanes at a time, whose envelopes stay in registers; downwards
    nothing is above a truncation, so that 8 bits hold it.
    """
    data, sample, arriving, leaving, mask, scratch, strides, labels, slopes, cuts = args
    data_bits = sample.type.width
    word = data.type
    data_stride, stride = cgutils.unpack_tuple(builder, strides, 2)
    m_from = cgutils.unpack_tuple(builder, arriving, 4)
    m_to = cgutils.unpack_tuple(builder, leaving, 4)
    slopes, cuts = (cgutils.unpack_tuple(builder, one, 4) for one in (slopes, cuts))
    sources = (m_from[1], m_from[0], m_from[3], m_from[2])  # what each message must leave out
    wide, narrow = Lanes(builder, 16, LANES // PARTS), Lanes(builder, 8, LANES)
    whole = Lanes(builder, 16, LANES)

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
            at = moved(builder.mul(loop.index, data_stride), data_bits // 8 * first)
            total = wide.load(builder.add(data, at), data_bits)
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


WEIGHT_BITS = np.int32(8)
FULL_WEIGHT = 256

UP, DOWN, LEFT, RIGHT = 0, 1, 2, 3  # where a message travels

WORKSPACE = Workspace()


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
def _weights(image: Any, table: Any) -> Any:
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
def _coarser_weights(fine: Any) -> Any:
    """Mean of the two edges that lie between two coarse pixels."""
    _, height, width = fine.shape
    coarse = np.empty((2, (height + 1) // 2, (width + 1) // 2), np.int16)
    for v in range(coarse.shape[1]):
        for u in range(coarse.shape[2]):
            right, below = min(2 * u + 1, width - 1), min(2 * v + 1, height - 1)
            coarse[0, v, u] = (fine[0, 2 * v, 2 * u] + fine[0, 2 * v, right]) // 2
            coarse[1, v, u] = (fine[1, 2 * v, 2 * u] + fine[1, below, 2 * u]) // 2
    return coarse


def edges_of(weights: I16, smoothness: Smoothness) -> I16:
    """Slope and truncation of each edge: (slope or cut, vertical or horizontal, row, parity, cell).
    A row and a cell beyond the border are never read for a pixel that exists."""
    cells = cells_of(weights.shape[2])
    return np.asarray(_edges(weights, cells, smoothness.slope, smoothness.truncation))


@njit(cache=True, nogil=True)
def _edges(weights: Any, cells: int, slope: int, truncation: int) -> Any:
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


def propagate(data: U8 | I16, weights: list[I16], iterations: int, smoothness: Smoothness) -> U8:
    """Messages (4, h + 2, 2, L, cells) of the level with this ``data`` (h, 2, L, cells).

    ``weights`` are the edges of this level and of the coarser ones, whose messages it starts from.
    An iteration updates one colour of the checkerboard.
    """
    _, height, width = weights[0].shape
    coarser = coarser_messages(data, weights, iterations, smoothness)
    edges = edges_of(weights[0], smoothness)
    out = WORKSPACE.take_bytes(f"messages {len(weights)}", (4, height + 2, *data.shape[1:]))

    def sweep(begin: int, end: int) -> None:
        ring = out if end - begin == height else ring_of(data, iterations)
        _propagate(begin, end, data, coarser, edges, width, iterations, ring, out)

    parallel_for(sweep, height, cells=data.size)
    return out


def coarser_messages(
    data: U8 | I16, weights: list[I16], iterations: int, smoothness: Smoothness
) -> U8:
    """The messages that a level starts from; empty ones where there is no coarser level."""
    if len(weights) == 1:
        return np.zeros((4, 1, 2, data.shape[2], 1), np.uint8)
    _, height, width = weights[1].shape
    shape = (height, 2, data.shape[2], cells_of(width))
    coarse = WORKSPACE.take(f"data {len(weights)}", shape)
    parallel_for(_coarser, height, data, width, smoothness.truncation, coarse, cells=data.size)
    return propagate(coarse, weights[1:], iterations, smoothness)


def pyramid_of(weights: I16, levels: int) -> list[I16]:
    """Weights of the edges of all levels, the finest first."""
    pyramid = [weights]
    while len(pyramid) < levels and min(pyramid[-1].shape[1:]) >= 8:
        pyramid.append(_coarser_weights(pyramid[-1]))
    return pyramid


def ring_of(data: U8 | I16, iterations: int) -> U8:
    """Memory for the messages of as many rows as are in work at a time, or all of the image; a
    thread uses it again."""
    height, _, labels, cells = data.shape
    return WORKSPACE.take_bytes("ring", (4, min(iterations + 3, height + 2), 2, labels, cells))


@njit(cache=True, nogil=True)
def _blocks(width: int) -> int:
    """Blocks of a row of cells that have pixels: all, or all but the last one."""
    return ((width + 1) // 2 + LANES - 1) // LANES


@njit(cache=True, nogil=True)
def _coarser(begin: int, end: int, fine: Any, width: int, truncation: int, data: Any) -> None:
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
                row[u] = np.int16(a[u]) + np.int16(b[u])
            if 2 * v + 1 < fine_height:
                a, b = fine[2 * v + 1, 0, label, :width], fine[2 * v + 1, 1, label, :width]
                for u in range(width):
                    row[u] += np.int16(a[u]) + np.int16(b[u])
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


@intrinsic
def _interleave(
    typingctx: Any, even: Any, odd: Any, coarse_cells: Any, out: Any, rest: Any, cells: Any,
    labels: Any, pixels: Any,
) -> Any:  # fmt: skip
    """Copy rows of cells ``even`` and ``odd`` of all labels to every other cell of ``out``; zero
    LANES cells of ``rest``, and cell ``pixels``.

    Addresses of label 0; ``coarse_cells`` and ``cells`` are bytes from label to label.
    """
    return types.void(*(types.intp,) * 8), _interleave_code


def _interleave_code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    even, odd, coarse_cells, out, rest, cells, labels, pixels = args
    word, half, lanes = even.type, Lanes(builder, 8, LANES // 2), Lanes(builder, 8, LANES)
    order = [n // 2 + (n % 2) * (LANES // 2) for n in range(LANES)]
    mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), order)
    blocks = builder.udiv(cells, ir.Constant(word, LANES))
    with cgutils.for_range(builder, labels) as label:
        coarse, fine = (builder.mul(label.index, stride) for stride in (coarse_cells, cells))
        to = builder.add(out, fine)
        with cgutils.for_range(builder, blocks) as block:
            at = builder.add(coarse, builder.mul(block.index, ir.Constant(word, LANES // 2)))
            both = (half.load(builder.add(row, at)) for row in (even, odd))
            pair = builder.shuffle_vector(*both, mask)
            lanes.save(pair, builder.add(to, builder.mul(block.index, ir.Constant(word, LANES))))
        lanes.save(lanes.constant(0), builder.add(rest, fine))
        byte = builder.inttoptr(builder.add(to, pixels), ir.IntType(8).as_pointer())
        builder.store(ir.Constant(ir.IntType(8), 0), byte)
    return context.get_dummy_value()


@njit(cache=True, nogil=True)
def _start_row(coarse: Any, v: int, height: int, width: int, ring: Any) -> None:
    """The messages that row ``v`` starts from: those of the coarser cells that it divides. Only the
    colour that the first sweep reads is filled; the sweep writes the other."""
    _, rows, _, labels, cells = ring.shape
    row = ring[:, (v + 1) % rows]
    if v > height:
        return
    if not 0 <= v < height or coarse.shape[4] == 1:
        row[:] = 0
        return
    parity = (v + 1) & 1  # of colour 1
    cc, plane = coarse.shape[4], labels * cells
    for direction in range(4):
        start = ring.ctypes.data + ((direction * rows + (v + 1) % rows) * 2) * plane
        even = coarse.ctypes.data + (direction * coarse.shape[1] + v // 2 + 1) * 2 * labels * cc
        # The last cell of the row's other parity is read as the neighbour before a first one.
        rest = start + (1 - parity) * plane + cells - LANES
        _interleave(
            even, even + labels * cc, cc, start + parity * plane, rest, cells, labels,
            (width + 1 - parity) // 2,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def arriving_at(ring: Any, v: int, parity: int) -> Any:
    """Addresses of the messages from below, above, right and left to the first cell of a row."""
    _, rows, _, labels, cells = ring.shape
    row = labels * cells
    base, step = ring.ctypes.data, rows * 2 * row
    beside = base + (2 * ((v + 1) % rows) + 1 - parity) * row + parity
    return (
        base + (2 * ((v + 2) % rows) + parity) * row + UP * step,
        base + (2 * (v % rows) + parity) * row + DOWN * step,
        beside + LEFT * step,
        beside + RIGHT * step - 1,
    )


@njit(cache=True, nogil=True)
def _update_row(
    data: Any, ring: Any, v: int, colour: int, edges: Any, blocks: int, masks: Any, scratch: Any
) -> None:
    """Messages that leave the pixels of one colour of row ``v``."""
    height, _, labels, cells = data.shape
    parity = (v + colour) & 1
    rows, row = ring.shape[1], labels * cells  # bytes of the messages of one parity
    step = rows * 2 * row  # from direction to direction
    line = 2 * cells  # bytes of the edges of one parity of a row
    side = (height + 2) * 2 * line  # from vertical to horizontal edges
    arriving = arriving_at(ring, v, parity)
    here = ring.ctypes.data + (2 * ((v + 1) % rows) + parity) * row
    for block in range(blocks):
        at = LANES * block
        start = here + at
        e = edges.ctypes.data + 2 * at
        # smoothness towards above, below, left and right
        places = (
            e + (2 * (v + 1) + parity) * line,
            e + (2 * (v + 2) + parity) * line,
            e + (2 * (v + 1) + parity) * line + side,
            e + (2 * (v + 1) + 1 - parity) * line + side + 2 * parity,
        )
        cut = 2 * side
        update_block(
            data.ctypes.data + ((2 * v + parity) * row + at) * data.itemsize,
            data[0, 0, 0, 0],
            (arriving[0] + at, arriving[1] + at, arriving[2] + at, arriving[3] + at),
            (start, start + step, start + 2 * step, start + 3 * step),
            masks.ctypes.data + parity * 2 * cells + 2 * at,
            scratch.ctypes.data,
            (cells * data.itemsize, cells),
            labels,
            places,
            (places[0] + cut, places[1] + cut, places[2] + cut, places[3] + cut),
        )


@njit(cache=True, nogil=True)
def masks_of(width: int, cells: int) -> Any:
    """(2, cells) -1 where a cell of that parity is a pixel, else 0."""
    masks = np.zeros((2, cells), np.int16)
    masks[0, : (width + 1) // 2] = -1
    masks[1, : width // 2] = -1
    return masks


@njit(cache=True, nogil=True)
def advance(
    front: int, begin: int, end: int, data: Any, coarse: Any, edges: Any, width: int,
    iterations: int, masks: Any, scratch: Any, ring: Any,
) -> int:  # fmt: skip
    """Start row ``front`` and give each row behind it its next iteration, so that the messages stay
    in the caches; the row that is done, with both its neighbours.

    For rows ``begin`` to ``end`` the front goes ``iterations + 1`` rows further at both ends:
    iteration t of a row needs iteration t - 1 of its neighbours.
    """
    height = data.shape[0]
    _start_row(coarse, front, height, width, ring)
    for t in range(iterations):
        v = front - 1 - t
        if max(begin - iterations, 0) <= v < min(end + iterations, height):
            _update_row(data, ring, v, t & 1, edges, _blocks(width), masks, scratch)
    return front - iterations - 1


@njit(cache=True, nogil=True)
def _propagate(
    begin: int, end: int, data: Any, coarse: Any, edges: Any, width: int, iterations: int,
    ring: Any, out: Any,
) -> None:  # fmt: skip
    """Copy the rows that are done to ``out`` (4, h + 2, 2, L, cells), unless it is the ring."""
    _, _, labels, cells = data.shape
    masks, scratch = masks_of(width, cells), np.empty((labels + 1) * 4 * LANES, np.int16)
    for front in range(begin - iterations - 1, end + iterations + 1):
        v = advance(front, begin, end, data, coarse, edges, width, iterations, masks, scratch, ring)
        if begin <= v < end and ring.ctypes.data != out.ctypes.data:
            for direction in range(4):
                for parity in range(2):
                    for label in range(labels):
                        done = ring[direction, (v + 1) % ring.shape[1], parity, label]
                        kept = out[direction, v + 1, parity, label]
                        for i in range(kept.shape[0]):
                            kept[i] = done[i]
