"""The right image with the gray levels of the left one: their brightness transfer function.

Auto exposure, tone curves and vignetting give one surface two gray levels. The matching cost
compares them, so the right image is corrected first: clear matches by census, which needs no equal
levels, say which pairs of levels belong together; a curve of the gray level, whose gain varies
smoothly over the image, is fitted to them by least squares with Tukey's weights. What it cannot
explain (highlights, shadows, wrong matches) counts as an outlier.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from recon.parallel import parallel_for
from recon.small_matrices import solve_symmetric
from recon.stereo.matching_cost import BORDER, census_row, columns_apart, plain, popcount
from recon.types import U8

SAMPLES = 2400  # about so many pixels, in a grid, are matched

MAX_BITS, MARGIN = 4, 4
"""A clear match: at most so many bits of census differ, and so many more at any other label."""

TERMS = 8  # 1, g, g^2, g x, g y, g x^2, g x y, g y^2 of the gray level and the place, -1 to 1
PRIOR = 0.1  # weight of no change, in samples

STEPS = 4
MIN_SAMPLES, FITTED = 64, 500  # clear matches that are needed, and at most used


def match_brightness(left: U8, right: U8, labels: int, min_disparity: int = 0) -> U8:
    """``right`` (h, w) with the gray levels that its surfaces have in ``left``.

    The labels are those of :func:`recon.stereo.matching_cost.matching_cost`. Returns ``right``
    itself where too little matches clearly.
    """
    height, width = left.shape
    step = max(2, round(float(np.sqrt(height * width / SAMPLES))))
    rows, columns = height // step, width // step
    if rows * columns < MIN_SAMPLES:
        return right
    left, right = plain(left), plain(right)
    partners = np.empty((rows, columns), np.int32)
    parallel_for(
        _match, rows, columns_apart(left), columns_apart(right), width, step, labels,
        min_disparity, partners, cells=rows * columns * labels,
    )  # fmt: skip
    clear = np.count_nonzero(partners >= 0)
    if clear < MIN_SAMPLES:
        return right
    change = np.empty((TERMS, 1))
    _fit(left, right, partners, step, clear // FITTED + 1, change)
    out = np.empty_like(right)
    parallel_for(_apply, height, right, change[:, 0].astype(np.float32), out, cells=right.size)
    return out


@njit(cache=True, nogil=True)
def _fit(left: Any, right: Any, partners: Any, step: int, every: int, solution: Any) -> None:
    """Coefficients of the terms (TERMS, 1), by reweighted least squares: towards the least sum of
    absolutes, then with Tukey's weights. Of the clear matches one of ``every`` counts."""
    rows, columns = partners.shape
    height, width = left.shape
    terms, change = np.empty((rows * columns, TERMS)), np.empty(rows * columns)
    clear = used = 0
    for n in range(rows):
        for k in range(columns):
            if partners[n, k] < 0:
                continue
            clear += 1
            if (clear - 1) % every:
                continue
            v, u, partner = n * step + step // 2, k * step + step // 2, partners[n, k]
            gray = float(right[v, partner])
            g, x, y = gray / 255, 2 * partner / width - 1, 2 * v / height - 1
            row = terms[used]
            row[0], row[1], row[2], row[3] = 1.0, g, g * g, g * x
            row[4], row[5], row[6], row[7] = g * y, g * x * x, g * x * y, g * y * y
            change[used] = left[v, u] - gray
            used += 1
    terms, change = terms[:used], change[:used]
    off = np.abs(change)
    normal = np.empty((TERMS, TERMS))
    for turn in range(STEPS):
        scale = max(1.5 * np.median(off), 1.0)
        normal[:] = 0
        solution[:] = 0
        for n in range(used):
            if turn < STEPS // 2:
                weight = min(1.0, scale / max(off[n], 1e-9))
            else:
                weight = max(1 - (off[n] / (4 * scale)) ** 2, 0.0) ** 2
            for i in range(TERMS):
                part = weight * terms[n, i]
                solution[i, 0] += part * change[n]
                for j in range(i + 1):
                    normal[i, j] += part * terms[n, j]
        for i in range(TERMS):
            normal[i, i] += PRIOR
        solve_symmetric(normal, solution)  # reads the lower half
        for n in range(used):
            rest = change[n]
            for i in range(TERMS):
                rest -= terms[n, i] * solution[i, 0]
            off[n] = abs(rest)


@njit(cache=True, nogil=True)
def _join(parts: Any, words: Any) -> None:
    """Four bytes of each column as a word: (2, 5, cells) by parity to (w,)."""
    for u in range(words.shape[0]):
        word = np.uint32(0)
        for k in range(4):
            word = np.uint32(word << np.uint32(8)) | np.uint32(parts[u & 1, k, u >> 1])
        words[u] = word


@njit(cache=True, nogil=True)
def _match(
    begin: int, end: int, left: Any, right: Any, width: int, step: int, labels: int,
    min_disparity: int, partners: Any,
) -> None:  # fmt: skip
    """Column in the right image of each sample's clear match; -1 without one."""
    here, there = np.empty(width, np.uint32), np.empty(width, np.uint32)
    parts = np.empty((2, 5, left.shape[2] - BORDER), np.uint8)
    differ = np.empty(labels, np.int32)
    for n in range(begin, end):
        v = n * step + step // 2
        for image, words in ((left, here), (right, there)):
            census_row(image, v, parts, 0)
            _join(parts, words)
        for k in range(partners.shape[1]):
            u = k * step + step // 2
            first = max(0, u - min_disparity - width + 1)
            last = min(labels, u - min_disparity + 1)
            least, best = np.int32(99), -1
            for label in range(first, last):
                differ[label] = popcount(np.uint32(here[u] ^ there[u - label - min_disparity]))
                if differ[label] < least:
                    least, best = differ[label], label
            clear = least <= MAX_BITS
            for label in range(first, last):
                clear &= abs(label - best) <= 1 or differ[label] >= least + MARGIN
            partners[n, k] = u - best - min_disparity if clear else -1


@njit(cache=True, nogil=True)
def _apply(begin: int, end: int, right: Any, change: Any, out: Any) -> None:
    height, width = right.shape
    one, half, most = np.float32(1), np.float32(0.5), np.float32(255)
    for v in range(begin, end):
        y = np.float32(2 * v / height) - one
        start = change[1] + y * (change[4] + change[7] * y)
        across = change[3] + change[6] * y
        for u in range(width):
            x = np.float32(2 * u) / np.float32(width) - one
            level = np.float32(right[v, u])
            g = level / most
            gain = start + change[2] * g + x * (across + change[5] * x)
            level += change[0] + g * gain + half
            out[v, u] = np.uint8(np.int32(min(max(level, np.float32(0)), most)))
