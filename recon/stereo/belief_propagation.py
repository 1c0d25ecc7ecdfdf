"""Stereo by hierarchical min-sum belief propagation on a grid (paper section 2.2, Eq. 1).

The energy is the matching cost plus a truncated linear smoothness, weaker where the image has
an edge; messages pass through the lower envelope of Felzenszwalb and Huttenlocher,
https://doi.org/10.1007/s11263-006-7899-4, coarse to fine, on a checkerboard: an iteration
updates the pixels of one colour from those of the other (:mod:`recon.stereo.message_passing`).

Here labels become a disparity map, unknown where nothing speaks for a label. Between labels the
offset is that of a V through the matching cost, summed over 7x7, of the winner and its two
neighbours: on slanted textured planes its bias stays below 0.06 px, against 0.14 px of a
parabola through the same costs and 0.3 px of one through the beliefs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from recon.image_quality import local_variance
from recon.parallel import parallel_for
from recon.stereo.brightness_transfer import match_brightness
from recon.stereo.lanes import LANES, PARTS, Lanes
from recon.stereo.matching_cost import COST_UNIT, check_pair, matching_cost, plain
from recon.stereo.message_passing import (
    Smoothness,
    advance,
    arriving_at,
    coarser_messages,
    edges_of,
    masks_of,
    pyramid_of,
    ring_of,
)
from recon.types import F32, I16, U8, DisparityMap

SPECKLE_STEP = 16
"""Sixteenths of a label: neighbours further apart than one label belong to two surfaces."""

UNKNOWN = -32768  # where there is no label; none within 1024 comes near it


@dataclass(frozen=True, slots=True)
class BeliefPropagationConfig:
    iterations: int = 5  # per level; one iteration updates one colour of the checkerboard
    levels: int = 5  # of the pyramid; fewer when the image is small
    smoothness_truncation: float = 2.5  # labels; a larger jump costs no more
    edge_floor: float = 0.2  # share of the smoothness that is left across strong edges
    edge_contrast: int = 32  # gray levels between neighbours that make a strong edge
    min_disparity: int = 0  # px, disparity of label 0
    min_evidence: float = 0.18  # how much better than the mean label, 0 to 1; 0: accept all
    min_contrast: float = 0.5  # gray levels of standard deviation in 9x9; 0: accept all
    occlusion_tolerance: float = 1.0  # labels; a surface seen behind another one; < 0: no check
    fill_occluded: bool = False  # with the farther neighbour of the row, at low confidence
    speckle_px: int = 24  # smaller islands are dropped; 0: none

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 1000:
            raise ValueError(f"iterations must be 1 to 1000, not {self.iterations}")
        if abs(self.min_disparity) > 32767:
            raise ValueError(f"min_disparity is out of range: {self.min_disparity}")

    @property
    def truncation(self) -> int:
        """The largest smoothness cost in integer units; a message holds 255."""
        return round(self.smoothness_truncation * COST_UNIT)

    @property
    def smoothness(self) -> Smoothness:
        """The smoothness term in integer units."""
        return Smoothness(COST_UNIT, self.truncation, self.edge_floor, self.edge_contrast)


def belief_propagation(
    left: U8, right: U8, labels: int, config: BeliefPropagationConfig
) -> DisparityMap:
    """Real-valued labels (0 to labels - 1) of the left view, (h, w), NaN where not trusted.

    ``left`` and ``right`` are rectified gray images (h, w) uint8; left pixel (u, v) at label
    ``l`` matches ``right[v, u - l - config.min_disparity]``. Raises ValueError for bad input.
    """
    check_pair(left, right, labels)
    right = match_brightness(left, right, labels, config.min_disparity)
    most = min(4 * config.truncation, 255)
    above, least = matching_cost(left, right, labels, config.min_disparity, most)
    weights = pyramid_of(config.smoothness.weights(plain(left)), config.levels)
    px, confidence = _labels(above, least, weights, config)
    return drop_unreliable(left, px, confidence, config)


def drop_unreliable(
    left: U8, px: F32, confidence: F32, config: BeliefPropagationConfig
) -> DisparityMap:
    """Return the labels that pass the checks of contrast, visibility and surface size. ``px`` and
    ``confidence`` are changed in place. Every backend ends with this."""
    if config.min_contrast > 0:
        confidence[local_variance(left, 9) < config.min_contrast**2] = 0
    if config.occlusion_tolerance >= 0:
        tolerance = float(config.occlusion_tolerance)
        _check_visibility(px, confidence, config.min_disparity, tolerance, config.fill_occluded)
    else:
        px[confidence <= 0] = np.nan
    coarse = np.empty(px.shape, np.int16)
    _round(px, coarse)
    if config.speckle_px > 0:
        cv2.filterSpeckles(coarse, UNKNOWN, config.speckle_px, SPECKLE_STEP)
    _forget(coarse, px, confidence)
    return DisparityMap(px, confidence)


@njit(cache=True, nogil=True)
def _round(px: Any, coarse: Any) -> None:
    """Labels in ``1 / SPECKLE_STEP``, and UNKNOWN."""
    for v in range(px.shape[0]):
        for u in range(px.shape[1]):
            known = not np.isnan(px[v, u])
            coarse[v, u] = np.int16(px[v, u] * np.float32(SPECKLE_STEP)) if known else UNKNOWN


@njit(cache=True, nogil=True)
def _forget(coarse: Any, px: Any, confidence: Any) -> None:
    """NaN and no confidence where the label is UNKNOWN."""
    for v in range(px.shape[0]):
        for u in range(px.shape[1]):
            known = coarse[v, u] != UNKNOWN
            px[v, u] = px[v, u] if known else np.float32(np.nan)
            confidence[v, u] = confidence[v, u] if known else np.float32(0)


RADIUS = 3  # radius of the window whose summed cost places the minimum between labels
PAD = 2  # cells beyond a row of cells that the window reaches
SURE_EVIDENCE = 0.6  # evidence of a well textured match; confidence grows up to it
FILLED_CONFIDENCE = 0.05  # confidence of a pixel that only its neighbours speak for
FAR = 16384  # above any belief
NOISE = 0.2 * COST_UNIT  # mean cost below which a window is taken for plain


def _labels(
    above: U8, least: U8, weights: list[I16], config: BeliefPropagationConfig
) -> tuple[F32, F32]:
    """Real-valued labels (h, w) and their confidence, 0 to 1; 0 where rejected.

    ``above`` and ``least`` come from :func:`recon.stereo.matching_cost.matching_cost`. Evidence is
    how far the winner's cost lies below the mean over the labels that
    are seen, relative to that mean: about 0.1 for unrelated images, 0.6 for texture. Not
    accepted are winners with less than ``min_evidence`` and those that tie with another
    label. NaN are those whose partner lies outside the right image.
    """
    _, height, width = weights[0].shape
    smoothness, iterations = config.smoothness, config.iterations
    coarser = coarser_messages(above, weights, iterations, smoothness)
    edges = edges_of(weights[0], smoothness)
    _, _, labels, cells = above.shape
    first = 2 * np.arange(cells) + [[0], [1]] - config.min_disparity  # partner of label 0
    seen = np.minimum(labels - 1, first) - np.maximum(0, first - width + 1) + 1
    seen = np.maximum(seen, 1).astype(np.int32)
    px = np.empty((height, width), np.float32)
    confidence = np.empty((height, width), np.float32)

    def select(begin: int, end: int) -> None:
        _select(
            begin, end, above, least, seen, coarser, edges, iterations, ring_of(above, iterations),
            config.min_disparity, 2 * config.truncation, float(config.min_evidence), px, confidence,
        )  # fmt: skip

    parallel_for(select, height, cells=above.size)
    return px, confidence


@njit(cache=True, nogil=True)
def _move_window(above: Any, least: Any, v: int, begin: int, sums: Any, low: Any) -> None:
    """Sums (L, 2, cells) over the rows around ``v``, from those around ``v - 1``; rows before
    ``begin`` are not in them, rows beyond the image count as nothing."""
    height, _, labels, cells = above.shape
    enters, leaves = v + RADIUS, v - RADIUS - 1
    none = np.zeros(cells, np.uint8)
    for parity in range(2):
        for label in range(labels):
            new = above[enters, parity, label] if enters < height else none
            old = above[leaves, parity, label] if begin <= leaves else none
            _slide(new, old, sums[label, parity])
        new = least[enters, parity] if enters < height else none
        _slide(new, least[leaves, parity] if begin <= leaves else none, low[parity])


@njit(cache=True, nogil=True)
def _slide(new: Any, old: Any, sums: Any) -> None:
    """Add a row of cells to sums (PAD + cells + PAD), and take one away."""
    out = sums[PAD : PAD + new.shape[0]]
    for i in range(new.shape[0]):
        out[i] += np.int16(np.int16(new[i]) - np.int16(old[i]))


@njit(cache=True, nogil=True)
def _window(sums: Any, out: Any) -> None:
    """Sums over columns, of both parities (2, cells), from those over rows (2, PAD + cells + PAD).
    Of seven columns three are of the one parity and four of the other."""
    cells = out.shape[1]
    even, odd = sums[0], sums[1]
    a, b, c, d = even[1:][:cells], even[2:][:cells], even[3:][:cells], even[4:][:cells]
    e, f, g, h = odd[:cells], odd[1:][:cells], odd[2:][:cells], odd[3:][:cells]
    first, second = out[0], out[1]
    for i in range(cells):
        one = np.int16(np.int16(a[i] + b[i]) + c[i])
        both = np.int16(one + np.int16(np.int16(f[i] + g[i]) + h[i]))
        first[i] = np.int16(both + e[i])
        second[i] = np.int16(both + d[i])


@njit(cache=True, nogil=True)
def _window_costs(sums: Any, width: int, min_disparity: int, box: Any, total: Any) -> None:
    """Summed cost (L, 2, cells) of a row, and its sum over the labels that each pixel sees."""
    labels = box.shape[0]
    total[:] = 0
    for label in range(labels):
        _window(sums[label], box[label])
        shift = label + min_disparity
        first, last = max(0, min(shift, width)), max(0, min(width, width + shift))
        for parity in range(2):
            begin, end = (first + 1 - parity) // 2, (last + 1 - parity) // 2
            seen, part = total[parity, begin:end], box[label, parity, begin:end]
            for i in range(seen.shape[0]):
                seen[i] += np.int32(part[i])


@intrinsic
def _best_block(
    typingctx: Any, above: Any, arriving: Any, cells: Any, labels: Any, belief: Any, best: Any,
    label_of: Any, second: Any,
) -> Any:  # fmt: skip
    """Write, int16, of LANES cells the least belief, its label, and the least belief of the labels
    not adjacent to it.

    Addresses of: the data of label 0, ``cells`` bytes from label to label, the messages that
    arrive, likewise, ``labels * LANES`` int16 of scratch, and what is written.
    """
    one = types.intp
    return types.void(one, types.UniTuple(one, 4), *(one,) * 6), _best_code


def _best_code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    above, arriving, cells, labels, belief, best, label_of, second = args
    word, lanes = above.type, Lanes(builder, 16, LANES // PARTS)
    sources = [above, *cgutils.unpack_tuple(builder, arriving, 4)]
    adjacent, far = lanes.constant(3), lanes.constant(FAR)

    def number(label: Any) -> Any:
        return lanes.splat(builder.trunc(label, ir.IntType(16)))

    def place(label: Any, start: int) -> Any:
        offset = builder.add(builder.mul(label, ir.Constant(word, LANES)), ir.Constant(word, start))
        return builder.add(belief, builder.mul(offset, ir.Constant(word, 2)))

    for start in range(0, LANES, lanes.count):
        least, winner, rest = lanes.variable(32767), lanes.variable(0), lanes.variable(32767)
        with cgutils.for_range(builder, labels) as loop:
            row = builder.add(builder.mul(loop.index, cells), ir.Constant(word, start))
            total = lanes.constant(0)
            for source in sources:
                total = builder.add(total, lanes.load(builder.add(source, row), 8))
            lanes.save(total, place(loop.index, start))
            before = builder.load(least)
            is_less = builder.icmp_signed("<", total, before)
            label = builder.select(is_less, number(loop.index), builder.load(winner))
            builder.store(label, winner)
            builder.store(lanes.least(total, before), least)
        with cgutils.for_range(builder, labels) as loop:
            apart = builder.sub(builder.load(winner), number(loop.index))
            near = builder.icmp_unsigned("<", builder.add(apart, lanes.constant(1)), adjacent)
            total = lanes.load(place(loop.index, start))
            total = builder.select(near, far, total)
            builder.store(lanes.least(total, builder.load(rest)), rest)
        for value, out in ((least, best), (winner, label_of), (rest, second)):
            lanes.save(builder.load(value), builder.add(out, ir.Constant(word, 2 * start)))
    return context.get_dummy_value()


@njit(cache=True, nogil=True)
def _best_labels(
    above: Any, ring: Any, v: int, parity: int, belief: Any, best: Any, label_of: Any, second: Any
) -> None:
    """:func:`_best_block` of one parity of a row."""
    _, _, labels, cells = above.shape
    data = above.ctypes.data + (2 * v + parity) * labels * cells
    first = arriving_at(ring, v, parity)
    for at in range(0, cells, LANES):
        _best_block(
            data + at,
            (first[0] + at, first[1] + at, first[2] + at, first[3] + at),
            cells,
            labels,
            belief.ctypes.data,
            best.ctypes.data + 2 * at,
            label_of.ctypes.data + 2 * at,
            second.ctypes.data + 2 * at,
        )


@njit(cache=True, nogil=True)
def _costs_around(
    label_of: Any, box: Any, parity: int, count: int, below: Any, here: Any, over: Any
) -> None:
    """Of each winner the cost, and that of the labels below and above it, which an outermost label
    has not."""
    last = box.shape[0] - 1
    for i in range(count):
        label = np.int64(label_of[i])
        side = np.int64(0 < label < last)
        below[i], here[i] = box[label - side, parity, i], box[label, parity, i]
        over[i] = box[label + side, parity, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _place_winners(
    label_of: Any, best: Any, second: Any, below: Any, here: Any, over: Any, low: Any, total: Any,
    seen: Any, first: int, width: int, sure_lead: int, min_evidence: float, px: Any,
    confidence: Any,
) -> None:  # fmt: skip
    """Where between the labels the summed cost is least, an equiangular V, and how sure that is.

    The partner of label 0 of cell 0 is at column ``first``, of the next cell two further. Without a
    branch, so that a vector register takes several pixels.
    """
    noise = np.float32((2 * RADIUS + 1) ** 2) * np.float32(NOISE)
    for i in range(px.shape[0]):
        cost = np.int32(here[i])
        a, b = np.float32(np.int32(below[i]) - cost), np.float32(np.int32(over[i]) - cost)
        steep = max(a, b)
        offset = (a - b) / (np.float32(2) * max(steep, np.float32(1)))
        offset = min(max(offset, np.float32(-0.5)), np.float32(0.5))
        offset = offset if steep > 0 else np.float32(0)
        partner = np.int32(np.int32(2 * i + first) - np.int32(label_of[i]))
        visible = (partner >= 0) & (partner < np.int32(width))
        px[i] = np.float32(label_of[i]) + offset if visible else np.float32(np.nan)
    for i in range(px.shape[0]):
        mean = np.float32(total[i] + seen[i] * np.int32(low[i])) / np.float32(seen[i])
        evidence = (mean - np.float32(np.int32(here[i]) + np.int32(low[i]))) / (mean + noise)
        lead = np.int32(second[i]) - np.int32(best[i])
        enough = (lead > 0) & ((evidence >= np.float32(min_evidence)) | (min_evidence <= 0))
        margin = min(np.float32(1), np.float32(lead) / np.float32(sure_lead))
        sure = max(evidence, np.float32(0.01)) / np.float32(SURE_EVIDENCE)
        sure = margin * min(np.float32(1), sure)
        confidence[i] = sure if enough & (px[i] == px[i]) else np.float32(0)


@njit(cache=True, nogil=True)
def _select(
    begin: int, end: int, above: Any, least: Any, seen: Any, coarser: Any, edges: Any,
    iterations: int, ring: Any, min_disparity: int, sure_lead: int, min_evidence: float, px: Any,
    confidence: Any,
) -> None:  # fmt: skip
    """Labels of the rows, each as soon as its messages are done."""
    _, _, labels, cells = above.shape
    width = px.shape[1]
    sums = np.zeros((labels, 2, cells + 2 * PAD), np.int16)
    low = np.zeros((2, cells + 2 * PAD), np.int16)
    box, low_box = np.empty((labels, 2, cells), np.int16), np.empty((2, cells), np.int16)
    total = np.empty((2, cells), np.int32)
    belief = np.empty((labels, LANES), np.int16)
    best = np.empty(cells, np.int16)  # each on its own: rows of one array lose their layout
    label_of, second = np.empty(cells, np.int16), np.empty(cells, np.int16)
    below, over = np.empty(cells, np.int16), np.empty(cells, np.int16)
    here = np.empty(cells, np.int16)
    labels_px, sure = np.empty((2, cells), np.float32), np.empty((2, cells), np.float32)
    masks, scratch = masks_of(width, cells), np.empty((labels + 1) * 4 * LANES, np.int16)
    top = max(begin - RADIUS, 0)
    for v in range(begin - 2 * RADIUS, begin):
        if v + RADIUS >= top:
            _move_window(above, least, v, top, sums, low)
    for front in range(begin - iterations - 1, end + iterations + 1):
        v = advance(
            front, begin, end, above, coarser, edges, width, iterations, masks, scratch, ring
        )
        if not begin <= v < end:
            continue
        _move_window(above, least, v, top, sums, low)
        _window_costs(sums, width, min_disparity, box, total)
        _window(low, low_box)
        for parity in range(2):
            count = (width + 1 - parity) // 2
            _best_labels(above, ring, v, parity, belief, best, label_of, second)
            _costs_around(label_of, box, parity, count, below, here, over)
            _place_winners(
                label_of, best, second, below, here, over, low_box[parity], total[parity],
                seen[parity], parity - min_disparity, width, sure_lead, min_evidence,
                labels_px[parity, :count], sure[parity, :count],
            )  # fmt: skip
            for i in range(count):
                px[v, 2 * i + parity] = labels_px[parity, i]
                confidence[v, 2 * i + parity] = sure[parity, i]


@njit(cache=True, nogil=True)
def _check_visibility(
    px: Any, confidence: Any, min_disparity: int, tolerance: float, fill: bool
) -> None:
    """NaN, in place, where the right view would see a nearer surface (by ``tolerance`` labels).

    Only accepted labels (confidence above 0) hide others. With ``fill`` a hidden pixel takes
    the farther of the nearest accepted labels of its row, at ``FILLED_CONFIDENCE``, unless its
    partner would lie outside the right image; so does an unknown strip to the left of a nearer
    surface that is no wider than the step in disparity. What is neither accepted nor filled
    becomes NaN.
    """
    height, width = px.shape
    nearest, hidden = np.empty(width, np.float32), np.empty(width, np.bool_)
    partner = np.empty(width, np.int32)
    for v in range(height):
        row, sure = px[v], confidence[v]
        nearest[:] = -np.inf
        for u in range(width):
            partner[u] = np.int32(u - min_disparity) - np.int32(row[u] + np.float32(0.5))
        for u in range(width):
            there = partner[u]
            if sure[u] > 0 and 0 <= there < width:
                nearest[there] = max(nearest[there], row[u])
        for u in range(width):
            there = partner[u]
            hidden[u] = 0 <= there < width and nearest[there] > row[u] + tolerance
        for u in range(width):
            known = (sure[u] > 0) & (not hidden[u])
            row[u] = row[u] if known else np.float32(np.nan)
            sure[u] = sure[u] if known else np.float32(0)
        if fill:
            _mark_strips(row, hidden, tolerance)
            _fill_row(row, sure, hidden, min_disparity)


@njit(cache=True, nogil=True)
def _mark_strips(row: Any, hidden: Any, tolerance: float) -> None:
    """Also hidden: an unknown strip left of a nearer surface, no wider than the step hides."""
    last = -1
    for u in range(row.shape[0]):
        if not np.isnan(row[u]):
            if 0 <= last < u - 1:
                step = row[u] - row[last]
                if step > tolerance and u - last - 1 <= step + 2:
                    hidden[last + 1 : u] = True
            last = u


@njit(cache=True, nogil=True)
def _fill_row(row: Any, confidence: Any, hidden: Any, min_disparity: int) -> None:
    """Give hidden pixels the farther of the nearest known labels to their left and right."""
    width = row.shape[0]
    known = np.float32(np.nan)
    farther = np.full(width, np.float32(np.inf), np.float32)
    for u in range(width):
        if hidden[u]:
            if not np.isnan(known):
                farther[u] = known
        elif not np.isnan(row[u]):
            known = row[u]
    known = np.float32(np.nan)
    for u in range(width - 1, -1, -1):
        if hidden[u]:
            label = min(farther[u], known) if not np.isnan(known) else farther[u]
            if np.isfinite(label) and 0 <= u - int(label + np.float32(0.5)) - min_disparity < width:
                row[u] = label
                confidence[u] = FILLED_CONFIDENCE
        elif not np.isnan(row[u]):
            known = row[u]
