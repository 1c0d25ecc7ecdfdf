"""Stereo by hierarchical min-sum belief propagation on a grid (paper section 2.2, Eq. 1).

The energy is the matching cost plus a truncated linear smoothness; messages pass through the
lower envelope of Felzenszwalb and Huttenlocher, https://doi.org/10.1007/s11263-006-7899-4,
coarse to fine, on a checkerboard: an iteration updates the pixels of one colour from those of
the other.

Layout: cells of one colour parity of a row lie side by side, (row, parity, label, column), so
that a SIMD register holds one label of many pixels and any number of labels costs the same
per label. Everything is a 16-bit integer: a cost further than four truncations above a
pixel's best can never matter, so it is cut there and no sum can overflow.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from recon.matching_cost import COST_UNIT, MatchingCostConfig, check_pair, matching_cost
from recon.types import U8, DisparityMap

I16 = npt.NDArray[np.int16]

UP, DOWN, LEFT, RIGHT = 0, 1, 2, 3
"""Where a message travels."""


@dataclass(frozen=True, slots=True)
class BeliefPropagationConfig:
    """How the labels are found and which of them are believed."""

    iterations: int = 5  # per level; one iteration updates one colour of the checkerboard
    levels: int = 5  # of the pyramid; fewer when the image is small
    smoothness_truncation: float = 2.5  # labels; a larger jump costs no more
    min_disparity: int = 0  # px, disparity of label 0
    cost: MatchingCostConfig = field(default_factory=MatchingCostConfig)
    occlusion_tolerance: float = 1.0  # labels between left and right view; < 0: no check
    min_texture: float = 0.1  # margin of the best label, in labels of smoothness
    speckle_px: int = 20  # smaller islands are dropped; 0: none

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 1000 or not 1 <= self.levels <= 16:
            raise ValueError("iterations must be 1 to 1000 and levels 1 to 16")
        if not 0 < self.smoothness_truncation <= 24:
            raise ValueError(
                f"smoothness_truncation is 0 to 24 labels, not {self.smoothness_truncation}"
            )
        if abs(self.min_disparity) > 32767:
            raise ValueError(f"min_disparity {self.min_disparity} is out of range")

    @property
    def truncation(self) -> int:
        """The largest smoothness cost in integer units."""
        return max(1, round(self.smoothness_truncation * COST_UNIT))


def belief_propagation(
    left: U8, right: U8, labels: int, config: BeliefPropagationConfig
) -> DisparityMap:
    """Real-valued labels (0 to labels - 1) of the left view, (h, w), NaN where not trusted.

    ``left`` and ``right`` are rectified grey images (h, w) uint8; left pixel (u, v) at label
    ``l`` matches ``right[v, u - l - config.min_disparity]``. Raises ValueError for bad input.
    """
    check_pair(left, right, labels)
    cost = matching_cost(left, right, labels, config.cost, config.min_disparity)
    return disparity_of(beliefs(cost, config), config)


def beliefs(cost: I16, config: BeliefPropagationConfig) -> I16:
    """Belief (min-marginal up to a constant) of each label, (h, labels, w) int16; less is better.

    ``cost`` is (h, labels, w) int16 in ``1 / COST_UNIT``.
    """
    height, _, width = cost.shape
    data = [_split(cost, config.truncation)]
    sizes = [(height, width)]
    while len(data) < config.levels and min(sizes[-1]) >= 8:
        h, w = sizes[-1]
        sizes.append(((h + 1) // 2, (w + 1) // 2))
        data.append(_coarser(data[-1], w, *sizes[-1], config.truncation))
    messages = None
    for level in range(len(data) - 1, -1, -1):
        rows, _, labels, cells = data[level].shape
        finer = np.zeros((4, rows + 2, 2, labels, cells), np.int16)
        if messages is not None:
            _refine(messages, finer, *sizes[level])
        messages = finer
        for t in range(config.iterations):
            _sweep(data[level], messages, sizes[level][1], t & 1, COST_UNIT, config.truncation)
    assert messages is not None
    total = np.empty(cost.shape, np.int16)
    _collect(data[0], messages, total)
    return total


def disparity_of(belief: I16, config: BeliefPropagationConfig) -> DisparityMap:
    """Sub-pixel labels and their confidence from beliefs (h, labels, w)."""
    height, _, width = belief.shape
    px = np.empty((height, width), np.float32)
    confidence = np.empty((height, width), np.float32)
    _winners(belief, config.min_disparity, config.truncation, px, confidence)
    if config.occlusion_tolerance >= 0:
        _drop_occluded(belief, config.min_disparity, config.occlusion_tolerance, px)
    confidence[np.isnan(px)] = 0
    return DisparityMap(px, confidence)


@njit(cache=True, nogil=True, parallel=True)
def _split(cost: Any, truncation: int) -> Any:  # pragma: no cover - compiled
    """(h, L, w) to (h, 2, L, cells): even and odd columns, one empty cell at each end."""
    height, labels, width = cost.shape
    cells = (width + 1) // 2 + 2
    data = np.zeros((height, 2, labels, cells), np.int16)
    for v in prange(height):
        low = np.empty(width, np.int16)
        low[:] = cost[v, 0]
        for label in range(1, labels):
            row = cost[v, label]
            for u in range(width):
                low[u] = min(low[u], row[u])
        top = np.int16(4 * truncation)
        for label in range(labels):
            row = cost[v, label]
            for parity in range(2):
                out = data[v, parity, label]
                for i in range((width + 1 - parity) // 2):
                    u = 2 * i + parity
                    out[i + 1] = min(np.int16(row[u] - low[u]), top)
    return data


@njit(cache=True, nogil=True, parallel=True)
def _coarser(
    fine: Any, fine_width: int, height: int, width: int, truncation: int
) -> Any:  # pragma: no cover - compiled
    """Sum of the costs of 2x2 cells, cut again to what can matter."""
    fine_height, _, labels, _ = fine.shape
    cells = (width + 1) // 2 + 2
    data = np.zeros((height, 2, labels, cells), np.int16)
    for v in prange(height):
        below = 2 * v + 1 < fine_height
        for parity in range(2):
            count = (width + 1 - parity) // 2
            low = np.full(count, np.int16(32767), np.int16)
            for label in range(labels):
                out = data[v, parity, label]
                a = fine[2 * v, 0, label]
                b = fine[2 * v, 1, label]
                for i in range(count):
                    k = 2 * i + parity + 1
                    out[i + 1] = np.int16(a[k] + b[k])
                if below:
                    a = fine[2 * v + 1, 0, label]
                    b = fine[2 * v + 1, 1, label]
                    for i in range(count):
                        k = 2 * i + parity + 1
                        out[i + 1] += np.int16(a[k] + b[k])
                for i in range(count):
                    low[i] = min(low[i], out[i + 1])
            top = np.int16(4 * truncation)
            for label in range(labels):
                out = data[v, parity, label]
                for i in range(count):
                    out[i + 1] = min(np.int16(out[i + 1] - low[i]), top)
    return data


@njit(cache=True, nogil=True, parallel=True)
def _refine(coarse: Any, fine: Any, height: int, width: int) -> None:  # pragma: no cover - compiled
    """Start the messages of a level from those of its coarser cells."""
    labels = fine.shape[3]
    for v in prange(height):
        for direction in range(4):
            for parity in range(2):
                for label in range(labels):
                    out = fine[direction, v + 1, parity, label]
                    even = coarse[direction, v // 2 + 1, 0, label]
                    odd = coarse[direction, v // 2 + 1, 1, label]
                    for i in range((width + 1 - parity) // 2):
                        # fine column 2 i + parity lies in coarse column i
                        out[i + 1] = odd[i // 2 + 1] if i & 1 else even[i // 2 + 1]


@njit(cache=True, nogil=True)
def _pass_message(
    total: Any, arriving: Any, scratch: Any, low: Any, out: Any, first: int, slope: Any, cut: Any
) -> None:  # pragma: no cover - compiled
    """Message to the neighbour that ``arriving`` came from: lower envelope of all the rest."""
    labels, count = total.shape
    for label in range(labels):
        s = scratch[label]
        t = total[label]
        a = arriving[label, first : first + count]
        if label == 0:
            for i in range(count):
                s[i] = np.int16(t[i] - a[i])
                low[i] = s[i]
        else:
            before = scratch[label - 1]
            for i in range(count):
                h = np.int16(t[i] - a[i])
                low[i] = min(low[i], h)
                s[i] = min(h, np.int16(before[i] + slope))
    for label in range(labels - 1, -1, -1):
        s = scratch[label]
        o = out[label, 1 : 1 + count]
        if label == labels - 1:
            for i in range(count):
                o[i] = min(np.int16(s[i] - low[i]), cut)
        else:
            after = out[label + 1, 1 : 1 + count]
            for i in range(count):
                o[i] = min(min(np.int16(s[i] - low[i]), np.int16(after[i] + slope)), cut)


@njit(cache=True, nogil=True, parallel=True)
def _sweep(
    data: Any, messages: Any, width: int, colour: int, slope: int, truncation: int
) -> None:  # pragma: no cover - compiled
    """Update the messages that leave the cells with (row + column) of one parity."""
    height, _, labels, _ = data.shape
    up, down, left, right = messages[0], messages[1], messages[2], messages[3]
    s = np.int16(slope)
    cut = np.int16(truncation)
    for v in prange(height):
        parity = (v + colour) & 1
        count = (width + 1 - parity) // 2
        total = np.empty((labels, count), np.int16)
        scratch = np.empty((labels, count), np.int16)
        low = np.empty(count, np.int16)
        r = v + 1
        from_below = up[r + 1, parity]
        from_above = down[r - 1, parity]
        from_right = left[r, 1 - parity]
        from_left = right[r, 1 - parity]
        after = 1 + parity  # cell of the column to the right
        before = parity
        for label in range(labels):
            t = total[label]
            d = data[v, parity, label, 1 : 1 + count]
            m0 = from_below[label, 1 : 1 + count]
            m1 = from_above[label, 1 : 1 + count]
            m2 = from_right[label, after : after + count]
            m3 = from_left[label, before : before + count]
            for i in range(count):
                t[i] = np.int16(d[i] + np.int16(np.int16(m0[i] + m1[i]) + np.int16(m2[i] + m3[i])))
        _pass_message(total, from_above, scratch, low, up[r, parity], 1, s, cut)
        _pass_message(total, from_below, scratch, low, down[r, parity], 1, s, cut)
        _pass_message(total, from_left, scratch, low, left[r, parity], before, s, cut)
        _pass_message(total, from_right, scratch, low, right[r, parity], after, s, cut)


@njit(cache=True, nogil=True, parallel=True)
def _collect(data: Any, messages: Any, belief: Any) -> None:  # pragma: no cover - compiled
    """Data cost plus the four arriving messages, back in (h, L, w)."""
    height, labels, width = belief.shape
    for v in prange(height):
        r = v + 1
        for label in range(labels):
            for parity in range(2):
                d = data[v, parity, label]
                m0 = messages[0, r + 1, parity, label]
                m1 = messages[1, r - 1, parity, label]
                m2 = messages[2, r, 1 - parity, label]
                m3 = messages[3, r, 1 - parity, label]
                for i in range((width + 1 - parity) // 2):
                    belief[v, label, 2 * i + parity] = (
                        d[i + 1] + m0[i + 1] + m1[i + 1] + m2[i + 1 + parity] + m3[i + parity]
                    )


@njit(cache=True, nogil=True, parallel=True)
def _winners(
    belief: Any, min_disparity: int, truncation: int, px: Any, confidence: Any
) -> None:  # pragma: no cover - compiled
    """Best label with parabola refinement; confidence from the margin to the next minimum."""
    height, labels, width = belief.shape
    for v in prange(height):
        for u in range(width):
            best = 0
            low = belief[v, 0, u]
            for label in range(1, labels):
                if belief[v, label, u] < low:
                    low = belief[v, label, u]
                    best = label
            second = np.int32(32767)
            for label in range(labels):
                if abs(label - best) > 1:
                    second = min(second, np.int32(belief[v, label, u]))
            offset = np.float32(0)
            if 0 < best < labels - 1:
                a = np.float32(belief[v, best - 1, u] - low)
                b = np.float32(belief[v, best + 1, u] - low)
                if a + b > 0:
                    offset = (a - b) / (np.float32(2) * (a + b))
            confidence[v, u] = min(np.float32(1), np.float32(second - low) / np.float32(truncation))
            partner = u - best - min_disparity
            if partner < 0 or partner >= width or second <= low:
                px[v, u] = np.nan
            else:
                px[v, u] = best + offset


@njit(cache=True, nogil=True, parallel=True)
def _drop_occluded(
    belief: Any, min_disparity: int, tolerance: float, px: Any
) -> None:  # pragma: no cover - compiled
    """NaN where the right view, asked the same way, sees another surface."""
    height, labels, width = belief.shape
    for v in prange(height):
        low = np.full(width, np.int16(32767), np.int16)
        seen = np.zeros(width, np.int16)
        for label in range(labels):
            shift = label + min_disparity
            for u in range(max(0, shift), min(width, width + shift)):
                b = belief[v, label, u]
                if b < low[u - shift]:
                    low[u - shift] = b
                    seen[u - shift] = label
        for u in range(width):
            if not np.isnan(px[v, u]):
                label = int(px[v, u] + 0.5)
                partner = min(max(u - label - min_disparity, 0), width - 1)
                if abs(px[v, u] - seen[partner]) > tolerance + 0.5:
                    px[v, u] = np.nan
