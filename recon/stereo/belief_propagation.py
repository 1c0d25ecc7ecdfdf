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

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numba import njit

from recon.image_quality import local_variance
from recon.parallel import parallel_for
from recon.stereo.exposure import equalised
from recon.stereo.lanes import LANES
from recon.stereo.matching_cost import (
    COST_UNIT,
    MatchingCostConfig,
    check_pair,
    matching_cost,
    plain,
)
from recon.stereo.message_passing import (
    Smoothness,
    advance,
    coarser_messages,
    edges_of,
    masks_of,
    pyramid_of,
    reach_of,
    ring_of,
)
from recon.types import F32, I16, U8, DisparityMap

SPECKLE_STEP = 16
"""Sixteenths of a label: neighbours further apart than one label belong to two surfaces."""

UNKNOWN = -32768
"""Where there is no label; none within 1024 comes near it."""


@dataclass(frozen=True, slots=True)
class BeliefPropagationConfig:
    """How the labels are found and which of them are accepted."""

    iterations: int = 5  # per level; one iteration updates one colour of the checkerboard
    levels: int = 5  # of the pyramid; fewer when the image is small
    smoothness_truncation: float = 2.5  # labels; a larger jump costs no more
    edge_floor: float = 0.2  # share of the smoothness that is left across strong edges
    edge_contrast: int = 32  # gray levels between neighbours that make a strong edge
    min_disparity: int = 0  # px, disparity of label 0
    cost: MatchingCostConfig = field(default_factory=MatchingCostConfig)
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
    right = equalised(left, right, labels, config.min_disparity)
    most = min(4 * config.truncation, 255)
    above, least = matching_cost(left, right, labels, config.cost, config.min_disparity, most)
    weights = pyramid_of(config.smoothness.weights(plain(left)), config.levels)
    px, confidence = _labels(above, least, weights, config)
    return drop_unreliable(left, px, confidence, config)


def drop_unreliable(
    left: U8, px: F32, confidence: F32, config: BeliefPropagationConfig
) -> DisparityMap:
    """Return the labels that pass the checks of contrast, visibility and surface size.

    ``px`` and ``confidence`` are changed in place. Every backend ends with this.
    """
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
def _round(px: Any, coarse: Any) -> None:  # pragma: no cover - compiled
    """Labels in ``1 / SPECKLE_STEP``, and UNKNOWN."""
    for v in range(px.shape[0]):
        for u in range(px.shape[1]):
            known = not np.isnan(px[v, u])
            coarse[v, u] = np.int16(px[v, u] * np.float32(SPECKLE_STEP)) if known else UNKNOWN


@njit(cache=True, nogil=True)
def _forget(coarse: Any, px: Any, confidence: Any) -> None:  # pragma: no cover - compiled
    """NaN and no confidence where the label is UNKNOWN."""
    for v in range(px.shape[0]):
        for u in range(px.shape[1]):
            known = coarse[v, u] != UNKNOWN
            px[v, u] = px[v, u] if known else np.float32(np.nan)
            confidence[v, u] = confidence[v, u] if known else np.float32(0)


RADIUS = 3
"""Radius of the window whose summed cost places the minimum between labels."""

PAD = 2
"""Cells beyond a row of cells that the window reaches."""

SURE_EVIDENCE = 0.6
"""Evidence of a well textured match; confidence grows up to it."""

FILLED_CONFIDENCE = 0.05
"""Confidence of a pixel that only its neighbours speak for."""

FAR = np.int16(16384)
"""Above any belief."""

NOISE = 0.2 * COST_UNIT
"""Mean cost below which a window is taken for plain."""


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
    px = np.empty((height, width), np.float32)
    confidence = np.empty((height, width), np.float32)

    def select(begin: int, end: int) -> None:
        _select(
            begin, end, above, least, coarser, edges, iterations, ring_of(above, iterations),
            config.min_disparity, 2 * config.truncation, float(config.min_evidence), px, confidence,
        )  # fmt: skip

    parallel_for(select, height, cells=above.size)
    return px, confidence


@njit(cache=True, nogil=True)
def _move_window(
    above: Any, least: Any, v: int, begin: int, sums: Any, low: Any
) -> None:  # pragma: no cover - compiled
    """Sums (L, 2, cells) over the rows around ``v``, from those around ``v - 1``; rows before
    ``begin`` are not in them, rows beyond the image count as nothing."""
    height, _, labels, cells = above.shape
    enters, leaves = v + RADIUS, v - RADIUS - 1
    for parity in range(2):
        if 0 <= enters < height:
            for label in range(labels):
                row, out = above[enters, parity, label], sums[label, parity, PAD : PAD + cells]
                for i in range(cells):
                    out[i] += np.int16(row[i])
            low[parity, PAD : PAD + cells] += least[enters, parity]
        if begin <= leaves:
            for label in range(labels):
                row, out = above[leaves, parity, label], sums[label, parity, PAD : PAD + cells]
                for i in range(cells):
                    out[i] -= np.int16(row[i])
            low[parity, PAD : PAD + cells] -= least[leaves, parity]


@njit(cache=True, nogil=True)
def _window(sums: Any, out: Any) -> None:  # pragma: no cover - compiled
    """Sums over columns, of both parities (2, cells), from those over rows (2, PAD + cells + PAD).

    Of seven columns three are of the one parity and four of the other.
    """
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
def _window_costs(
    sums: Any, width: int, min_disparity: int, box: Any, total: Any
) -> None:  # pragma: no cover - compiled
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


@njit(cache=True, nogil=True)
def _best_labels(
    above: Any, ring: Any, v: int, width: int, parity: int, belief: Any, best: Any, label_of: Any,
    second: Any,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Of one parity of a row: the least belief, its label, and the least belief of the labels not
    adjacent to it. Only without a branch do vector registers take the cells."""
    _, rows, _, labels, cells = ring.shape
    count = cells - 1
    before, here, after = v % rows, (v + 1) % rows, (v + 2) % rows
    best[:] = 32767
    label_of[:] = 0
    for label in range(labels):
        b = belief[label, :count]
        d = above[v, parity, label, :count]
        m0 = ring[0, after, parity, label, :count]
        m1 = ring[1, before, parity, label, :count]
        m2 = ring[2, here, 1 - parity, label, parity : parity + count]
        for i in range(count):
            b[i] = np.int16(np.int16(d[i]) + np.int16(m0[i])) + np.int16(
                np.int16(m1[i]) + np.int16(m2[i])
            )
        right = b[1 - parity :]  # nothing arrives from the left of a row's first cell
        m3 = ring[3, here, 1 - parity, label, : right.shape[0]]
        for i in range(right.shape[0]):
            right[i] += np.int16(m3[i])
        this = np.int16(label)
        for i in range(count):
            belief_here, least, label_before = b[i], best[i], label_of[i]
            label_of[i] = this if belief_here < least else label_before
            best[i] = min(belief_here, least)
    second[:] = 32767
    for label in range(labels):
        b, this = belief[label, :count], np.int16(label)
        for i in range(count):
            apart = np.int16(abs(np.int16(label_of[i] - this)))
            adjacent = FAR if apart <= np.int16(1) else np.int16(0)
            second[i] = min(second[i], np.int16(b[i] + adjacent))


@njit(cache=True, nogil=True)
def _note_winners(
    best: Any, label_of: Any, second: Any, box: Any, low: Any, total: Any, width: int, parity: int,
    min_disparity: int, winner: Any, around: Any, lead: Any, mean: Any,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Of each pixel of one parity of a row: the winner, its cost and that of the labels below and
    above it, by how much it leads, and the mean cost of the labels that the pixel sees. An
    outermost label has no such neighbours."""
    labels = box.shape[0]
    for i in range((width + 1 - parity) // 2):
        u, label = 2 * i + parity, np.int64(label_of[i])
        inner = 0 < label < labels - 1
        winner[u] = label
        lead[u] = np.int32(second[i]) - np.int32(best[i])
        around[0, u] = box[label - 1, parity, i] if inner else box[label, parity, i]
        around[1, u] = box[label, parity, i]
        around[2, u] = box[label + 1, parity, i] if inner else box[label, parity, i]
        seen_labels = min(labels - 1, u - min_disparity) - max(0, u - min_disparity - width + 1) + 1
        mean[0, u], mean[1, u] = total[parity, i], max(seen_labels, 1)
        mean[2, u] = low[parity, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _place_winners(
    winner: Any, around: Any, lead: Any, mean: Any, min_disparity: int, sure_lead: int,
    min_evidence: float, px: Any, confidence: Any,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Where between the labels the summed cost is least, an equiangular V, and how sure that is.

    Without a branch, so that a vector register takes several pixels.
    """
    width = px.shape[0]
    noise = np.float32((2 * RADIUS + 1) ** 2) * np.float32(NOISE)
    for u in range(width):
        here = around[1, u]
        a, b = np.float32(around[0, u] - here), np.float32(around[2, u] - here)
        steep = max(a, b)
        offset = (a - b) / (np.float32(2) * max(steep, np.float32(1)))
        offset = min(max(offset, np.float32(-0.5)), np.float32(0.5))
        offset = offset if steep > 0 else np.float32(0)
        partner = np.int32(u) - winner[u] - np.int32(min_disparity)
        visible = (partner >= 0) & (partner < np.int32(width))
        px[u] = np.float32(winner[u]) + offset if visible else np.float32(np.nan)
        typical = np.float32(mean[0, u] + mean[1, u] * mean[2, u]) / np.float32(mean[1, u])
        evidence = (typical - np.float32(here + mean[2, u])) / (typical + noise)
        enough = (lead[u] > 0) & ((evidence >= np.float32(min_evidence)) | (min_evidence <= 0))
        margin = min(np.float32(1), np.float32(lead[u]) / np.float32(sure_lead))
        sure = max(evidence, np.float32(0.01)) / np.float32(SURE_EVIDENCE)
        sure = margin * min(np.float32(1), sure)
        confidence[u] = sure if visible & enough else np.float32(0)


@njit(cache=True, nogil=True)
def _select(
    begin: int, end: int, above: Any, least: Any, coarser: Any, edges: Any, iterations: int,
    ring: Any, min_disparity: int, sure_lead: int, min_evidence: float, px: Any, confidence: Any,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Labels of the rows, each as soon as its messages are done."""
    height, _, labels, cells = above.shape
    width = px.shape[1]
    sums, low = (
        np.zeros((labels, 2, cells + 2 * PAD), np.int16),
        np.zeros((2, cells + 2 * PAD), np.int16),
    )
    box, low_box = np.empty((labels, 2, cells), np.int16), np.empty((2, cells), np.int16)
    total, mean = np.empty((2, cells), np.int32), np.empty((3, width), np.int32)
    belief = np.empty((labels, cells), np.int16)
    best = np.empty(cells, np.int16)  # each on its own: rows of one array lose their layout
    label_of, second = np.empty(cells, np.int16), np.empty(cells, np.int16)
    winner = np.empty(width, np.int32)
    lead = np.empty(width, np.int32)
    around = np.empty((3, width), np.int32)
    masks, scratch = masks_of(width, cells), np.empty((labels + 1) * 4 * LANES, np.int16)
    top = max(begin - RADIUS, 0)
    for v in range(begin - 2 * RADIUS, begin):
        if v + RADIUS >= top:
            _move_window(above, least, v, top, sums, low)
    first, last, start, stop = reach_of(begin, end, height, iterations)
    for front in range(start, stop):
        v = advance(
            front, first, last, above, coarser, edges, width, iterations, masks, scratch, ring
        )
        if not begin <= v < end:
            continue
        _move_window(above, least, v, top, sums, low)
        _window_costs(sums, width, min_disparity, box, total)
        _window(low, low_box)
        for parity in range(2):
            _best_labels(above, ring, v, width, parity, belief, best, label_of, second)
            _note_winners(
                best, label_of, second, box, low_box, total, width, parity, min_disparity,
                winner, around, lead, mean,
            )  # fmt: skip
        _place_winners(
            winner, around, lead, mean, min_disparity, sure_lead, min_evidence, px[v], confidence[v]
        )


@njit(cache=True, nogil=True)
def _check_visibility(
    px: Any, confidence: Any, min_disparity: int, tolerance: float, fill: bool
) -> None:  # pragma: no cover - compiled
    """NaN, in place, where the right view would see a nearer surface (by ``tolerance`` labels).

    Only accepted labels (confidence above 0) hide others. With ``fill`` a hidden pixel takes
    the farther of the nearest accepted labels of its row, at ``FILLED_CONFIDENCE``, unless its
    partner would lie outside the right image; so does an unknown strip to the left of a nearer
    surface that is no wider than the step in disparity. What is neither accepted nor filled
    becomes NaN.
    """
    height, width = px.shape
    for v in range(height):
        row = px[v]
        nearest = np.full(width, np.float32(-np.inf), np.float32)
        hidden = np.zeros(width, np.bool_)
        for u in range(width):
            if confidence[v, u] > 0:
                partner = u - int(row[u] + np.float32(0.5)) - min_disparity
                if 0 <= partner < width:
                    nearest[partner] = max(nearest[partner], row[u])
        for u in range(width):
            if not np.isnan(row[u]):
                partner = u - int(row[u] + np.float32(0.5)) - min_disparity
                hidden[u] = 0 <= partner < width and nearest[partner] > row[u] + tolerance
        for u in range(width):
            if hidden[u] or confidence[v, u] <= 0:
                row[u] = np.nan
                confidence[v, u] = 0
        if fill:
            _mark_strips(row, hidden, tolerance)
            _fill_row(row, confidence[v], hidden, min_disparity)


@njit(cache=True, nogil=True)
def _mark_strips(row: Any, hidden: Any, tolerance: float) -> None:  # pragma: no cover - compiled
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
def _fill_row(
    row: Any, confidence: Any, hidden: Any, min_disparity: int
) -> None:  # pragma: no cover - compiled
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
