"""Cost of a left pixel at a label: census and absolute difference, truncated.

Census (Zabih and Woodfill, https://doi.org/10.1007/BFb0028345) survives changes of exposure,
the absolute difference keeps edges in their place. Of full windows wider than 5x5 the edge of a
near surface decides about more of the background next to it. Costs are integers so that belief
propagation runs on SIMD lanes of 16 bits; ``COST_UNIT`` of them are one label of smoothness.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numba.extending import intrinsic

from recon.parallel import parallel_for
from recon.types import I16, U8

COST_UNIT = 100
"""Integer cost of a disparity step of one label between neighbours."""

_NEAR = [(dv, du) for dv in range(-2, 3) for du in range(-2, 3) if dv or du]
_FAR = [(-3, -1), (-3, 1), (-1, -3), (-1, 3), (1, -3), (1, 3), (3, -1), (3, 1)]
CENSUS_OFFSETS = tuple(_NEAR + _FAR)
"""Row and column of the neighbours that a pixel is compared with: 5x5, and eight on a ring around
them, which tell weak texture from noise. They fill one 32-bit word."""

MAX_COST = 668
"""The sum over a window of 7x7 fits 16 bits."""

CENSUS_REACH = 3
"""The farthest row or column of a neighbour."""

MAX_SPARE = 8
"""Memory this many times larger than requested is released."""


@dataclass(frozen=True, slots=True)
class MatchingCostConfig:
    """Weights of the data term, in units of one label of smoothness.

    A census bit adds ``census_weight``, a gray level of difference ``difference_weight``;
    each part stops growing at its truncation. Raises ValueError where they exceed MAX_COST.
    """

    census_weight: float = 0.08
    census_truncation: int = 16  # bits
    difference_weight: float = 0.04
    difference_truncation: int = 20  # gray levels
    unseen: float = 1.0  # of a label whose partner is outside the image, above the best one

    def __post_init__(self) -> None:
        most = (
            round(self.census_weight * COST_UNIT) * self.census_truncation
            + round(self.difference_weight * COST_UNIT) * self.difference_truncation
            + round(self.unseen * COST_UNIT)
        )
        if most > MAX_COST:
            raise ValueError(f"costs of up to {most} are too large, at most {MAX_COST}")


def matching_cost(
    left: U8,
    right: U8,
    labels: int,
    config: MatchingCostConfig,
    min_disparity: int = 0,
    out: I16 | None = None,
) -> I16:
    """Cost of every label of every left pixel, (h, labels, w) int16 in ``1 / COST_UNIT``.

    Label ``l`` of left pixel (u, v) is compared with ``right[v, u - l - min_disparity]``. A
    partner outside the right image is unseen: it costs ``config.unseen`` more than the
    pixel's best seen label, so that neighbours decide. ``out`` is filled and returned when it
    is given. Raises ValueError for bad shapes.
    """
    check_pair(left, right, labels)
    height, width = left.shape
    cost = np.empty((height, labels, width), np.int16) if out is None else out
    parallel_for(
        _cost_volume, height, bordered(left), bordered(right), min_disparity,
        round(config.census_weight * COST_UNIT), config.census_truncation,
        round(config.difference_weight * COST_UNIT), config.difference_truncation,
        round(config.unseen * COST_UNIT), cost, cells=cost.size,
    )  # fmt: skip
    return cost


def plain(array: Any) -> Any:
    """The array, or a copy: in C order and writeable, as the kernels are compiled for.

    Any other kind would be compiled in flight, which takes seconds.
    """
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


def bordered(image: U8) -> Any:
    """The image and, as far as census reaches beyond it, its last row and column again."""
    reach = CENSUS_REACH
    return cv2.copyMakeBorder(image, reach, reach, reach, reach, cv2.BORDER_REPLICATE)


@njit(cache=True, nogil=True)
def census_row(padded: Any, v: int, parts: Any) -> None:  # pragma: no cover - compiled
    """Census of a row's pixels: a bit is set where a neighbour is darker.

    ``padded`` is a :func:`bordered` image. ``parts`` (4, w) uint8 holds eight neighbours each, the
    first of :data:`CENSUS_OFFSETS` in the highest bit: of bytes a vector register holds the most.
    """
    width = parts.shape[1]
    centre = padded[v + CENSUS_REACH, CENSUS_REACH : CENSUS_REACH + width]
    for bit, (dv, du) in enumerate(CENSUS_OFFSETS):
        start = CENSUS_REACH + du
        shifted = padded[v + CENSUS_REACH + dv, start : start + width]
        row = parts[bit // 8]
        for u in range(width):
            row[u] = np.uint8(row[u] << 1) | np.uint8(shifted[u] < centre[u])


@intrinsic
def popcount(typingctx: Any, word: Any) -> Any:
    """How many bits of an integer are set, as one of its type."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return word(word), codegen


@njit(cache=True, nogil=True)
def _count_bits(
    a: Any, b: Any, first: int, shift: int, bits: Any
) -> None:  # pragma: no cover - compiled
    """Bits of census (4, w) of the left row ``a`` from column ``first`` on that differ from the
    right row's, ``shift`` columns further left."""
    count = bits.shape[0]
    for k in (0, 2):
        a0, b0 = a[k, first : first + count], b[k, first - shift : first - shift + count]
        a1, b1 = a[k + 1, first : first + count], b[k + 1, first - shift : first - shift + count]
        for i in range(count):
            differ = popcount(np.uint8(a0[i] ^ b0[i])) + popcount(np.uint8(a1[i] ^ b1[i]))
            bits[i] = np.uint8(differ + (bits[i] if k else np.uint8(0)))


@njit(cache=True, nogil=True)
def _add_up(
    bits: Any, a: Any, b: Any, weights: Any, cost: Any, low: Any
) -> None:  # pragma: no cover - compiled
    """Cost of pixels by the bits that differ and the gray levels; and the least so far."""
    per_bit, max_bits, per_level, max_levels = weights
    for i in range(cost.shape[0]):
        apart = np.int16(abs(np.int16(a[i]) - np.int16(b[i])))
        value = np.int16(min(np.int16(bits[i]), max_bits) * per_bit)
        value = np.int16(value + np.int16(min(apart, max_levels) * per_level))
        cost[i] = value
        low[i] = min(low[i], value)


@njit(cache=True, nogil=True)
def _cost_volume(
    begin: int,
    end: int,
    left: Any,
    right: Any,
    min_disparity: int,
    census_weight: int,
    census_truncation: int,
    difference_weight: int,
    difference_truncation: int,
    unseen: int,
    cost: Any,
) -> None:  # pragma: no cover - compiled
    _, labels, width = cost.shape
    parts_left, parts_right = np.empty((4, width), np.uint8), np.empty((4, width), np.uint8)
    bits = np.empty(width, np.uint8)
    best = np.empty(width, np.int16)
    weights = (
        np.int16(census_weight),
        np.int16(census_truncation),
        np.int16(difference_weight),
        np.int16(difference_truncation),
    )
    for v in range(begin, end):
        census_row(left, v, parts_left)
        census_row(right, v, parts_right)
        gray_left = left[v + CENSUS_REACH, CENSUS_REACH : CENSUS_REACH + width]
        gray_right = right[v + CENSUS_REACH, CENSUS_REACH : CENSUS_REACH + width]
        best[:] = 32767
        for label in range(labels):
            shift = label + min_disparity
            first = min(max(0, shift), width)
            count = max(min(width, width + shift) - first, 0)
            differ = bits[:count]
            _count_bits(parts_left, parts_right, first, shift, differ)
            row, low = cost[v, label, first : first + count], best[first : first + count]
            a = gray_left[first : first + count]
            b = gray_right[first - shift : first - shift + count]
            _add_up(differ, a, b, weights, row, low)
        for u in range(width):
            best[u] = np.int16(best[u] + unseen) if best[u] < 32767 else np.int16(0)
        for label in range(labels):
            shift = label + min_disparity
            for u in range(min(max(0, shift), width)):
                cost[v, label, u] = best[u]
            for u in range(max(min(width, width + shift), 0), width):
                cost[v, label, u] = best[u]


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
