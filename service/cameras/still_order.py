"""The order of stills that state no time: the path along which neighbours are closest.

Tracking follows one still after the other, so each must show what the one before it shows. Names
usually count up in the order of flight; those that an archive or a program gave do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from recon.parallel import run_parallel
from recon.tracking.sift_features import SIGNATURE_WIDTH_PX, alike, signature
from recon.types import F64, U8

MOST = 200  # stills that are compared, each with each: 20,000 pairs in two minutes on one core
CHANCE = 5  # features that images of different places seem to share

AT_RANDOM = 0.25
"""Where a path along the names is longer than the shortest by less than this share of what a random
order is longer, the names count up in the order of flight, which may have breaks."""


def by_place(enu_m: F64) -> list[int]:
    """Indices of stills at (N, 3) metres in an order without detours."""
    return shortest_path(np.linalg.norm(enu_m[:, None] - enu_m, axis=2))


def by_likeness(paths: Sequence[Path]) -> list[int]:
    """Indices of stills so that each shows the ground of the one before; those that do not decode
    come last."""
    signatures = [_signature(path) for path in paths]
    n = len(paths)
    shared = np.zeros((n, n))

    def compare(i: int) -> None:
        for j in range(i):
            shared[i, j] = shared[j, i] = alike(signatures[i], signatures[j])

    run_parallel(*(lambda i=i: compare(i) for i in range(n)))
    # What two images share falls off exponentially with the way between them.
    return shortest_path(-np.log((np.maximum(shared - CHANCE, 0.0) + 1.0) / (shared.max() + 1.0)))


def shortest_path(apart: F64) -> list[int]:
    """An order in which the sum of ``apart`` (N, N), symmetric, of neighbours is small.

    The given order where that is none at random; else the nearest that is left each time, from the
    ends, improved by reversing parts (Croes 1958, doi:10.1287/opre.6.6.791).
    """
    n = len(apart)
    given = np.arange(n)
    if n < 3:
        return [int(i) for i in given]
    starts = [given, *(_nearest_first(apart, first) for first in np.argsort(-apart.sum(1))[:8])]
    best = min((_improved(apart, order) for order in starts), key=lambda o: _length(apart, o))
    shortest, at_random = _length(apart, best), float(apart.sum()) / n
    is_flown = _length(apart, given) - shortest <= AT_RANDOM * (at_random - shortest)
    return [int(i) for i in (given if is_flown else best)]


def _length(apart: F64, order: np.ndarray) -> float:
    return float(apart[order[:-1], order[1:]].sum())


def _nearest_first(apart: F64, first: int) -> np.ndarray:
    left = np.ones(len(apart), bool)
    order = [int(first)]
    left[first] = False
    while left.any():
        order.append(int(np.argmin(np.where(left, apart[order[-1]], np.inf))))
        left[order[-1]] = False
    return np.array(order)


def _improved(apart: F64, order: np.ndarray) -> np.ndarray:
    """``order`` after the best reversals of a part, while they shorten it."""
    n = len(order)
    i, j = np.triu_indices(n, 1)
    for _ in range(4 * n):
        # Before and after the part i..j; an end of the path has no neighbour there.
        padded = np.zeros((n + 1, n + 1))
        padded[:n, :n] = apart[np.ix_(order, order)]
        before, after = np.where(i > 0, i - 1, n), np.where(j < n - 1, j + 1, n)
        gain = padded[before, i] + padded[j, after] - padded[before, j] - padded[i, after]
        best = int(np.argmax(gain))
        if gain[best] <= 1e-12:
            break
        a, b = int(i[best]), int(j[best])
        order = np.concatenate([order[:a], order[a : b + 1][::-1], order[b + 1 :]])
    return order


def _signature(path: Path) -> U8:
    """(M, 128) descriptors of a still's largest features; none of one that does not decode."""
    try:
        data = np.fromfile(path, np.uint8)
        gray = cv2.imdecode(data, cv2.IMREAD_REDUCED_GRAYSCALE_4)
        if gray is None or max(gray.shape) < SIGNATURE_WIDTH_PX:
            gray = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):  # such as a size that OpenCV refuses
        gray = None
    none = np.zeros((0, 128), np.uint8)
    return none if gray is None else signature(np.asarray(gray, np.uint8))
