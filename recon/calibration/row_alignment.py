"""The rows of a pair that was rectified by a calibration which is a little off."""

from __future__ import annotations

import cv2
import numpy as np

from recon.tracking.matching import consensus
from recon.tracking.sift_features import features, mutual
from recon.types import F64, U8, Bool

MOST, WIDTH_PX = 3000, 1600  # features that are matched, and the width at which they are sought
MAX_SHARE = 0.02  # of the height; rows further apart are another pair, or not rectified
MIN_MATCHES, MIN_CONSENT = 60, 0.5  # features, and the share of them of the disparities
RANGE_PERCENTILES = 2.0, 98.0
MIN_COMPARED, MIN_IN_ROWS = 10, 0.7
"""Features that match, and the share of them in about the same row that those of a pair have. Of
two images with nothing in common some match by chance; where one is mirrored, half in a row."""
TOLERANCE_PX = 0.5  # by which places of features err
MIN_OFF_PX = 0.5  # rows that are less apart stay: matching bridges half a pixel


def features_apart(left: U8, right: U8) -> tuple[F64, F64]:
    """Features of two images (h, w) that match: (N, 2) px in ``right``, and how much farther right
    and lower ``left`` shows them, (N, 2) px."""
    a, b = (features(g, WIDTH_PX, MOST, are_strongest=True) for g in (left, right))
    rows_a, rows_b = mutual(a.descriptors, b.descriptors)
    return b.uv_px[rows_b], a.uv_px[rows_a] - b.uv_px[rows_b]


def in_rows(apart: F64, height: int) -> Bool:
    """(N,) which features ``apart`` (N, 2) px lie in about the same row of images so high."""
    return np.asarray(np.abs(apart[:, 1]) < MAX_SHARE * height)


def rows_missed(apart: F64, height: int) -> float | None:
    """How many px lower the right image shows most features ``apart`` (N, 2) px, where too few are
    in about the same row; NaN where they do not agree, None where enough are."""
    if len(apart) < MIN_COMPARED or in_rows(apart, height).mean() >= MIN_IN_ROWS:
        return None
    lower = -float(np.median(apart[:, 1]))
    is_common = np.mean(np.abs(apart[:, 1] + lower) < MAX_SHARE * height) >= MIN_IN_ROWS
    return lower if is_common else float("nan")


def range_missed(apart: F64, disparities: tuple[float, float]) -> tuple[float, float] | None:
    """Disparities that most of the features ``apart`` (N, 2) px have, where they are not those
    looked for; None where enough are."""
    found = apart[:, 0]
    if len(found) < MIN_MATCHES or _within(found, disparities).mean() >= MIN_CONSENT:
        return None
    low, high = np.percentile(found, RANGE_PERCENTILES)
    return float(low), float(high)


def _within(found: F64, disparities: tuple[float, float]) -> Bool:
    return (found >= disparities[0] - 1) & (found <= disparities[1] + 1)


def rows_apart(
    size: tuple[int, int], there: F64, apart: F64, disparities: tuple[float, float]
) -> F64 | None:
    """(3,) a, b, c: what the right image shows at (u, v) lies a + b u + c v px lower than in the
    left one, of this (h, w), by features in its rows whose disparity is within ``disparities``,
    ``there`` and ``apart`` as of :func:`features_apart`. None where rows surely do not differ, or
    too little agrees on how.
    """
    near = _within(apart[:, 0], disparities)
    if np.count_nonzero(near) < 2 * MIN_MATCHES:  # two in five agree
        return None
    lower = np.column_stack([-apart[:, 1], np.zeros(len(apart))])
    found = consensus(there, lower, near, TOLERANCE_PX)
    if found is None:
        return None
    fit, (h, w) = found[:, 0], size
    corners = np.array([[1, u, v] for u in (0, w) for v in (0, h)]) @ fit
    return fit if np.abs(corners).max() > MIN_OFF_PX else None


def rows_aligned(right: U8, apart: F64) -> U8:
    """``right`` (h, w) with its rows where the left image has them; ``apart`` by rows_apart."""
    a, b, c = apart
    M = np.array([[1.0, 0.0, 0.0], [b, 1.0 + c, a]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size = right.shape[1], right.shape[0]
    out = cv2.warpAffine(right, M, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, np.uint8)
