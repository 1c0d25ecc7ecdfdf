"""The rows of a pair that was rectified by a calibration which is a little off."""

from __future__ import annotations

import cv2
import numpy as np

from recon.tracking.sift_features import features, mutual
from recon.types import F64, U8

MOST, WIDTH_PX = 3000, 1600  # features that are matched, and the width at which they are sought
MAX_SHARE = 0.02  # of the height; rows further apart are another pair, or not rectified
MIN_MATCHES, MIN_CONSENT = 60, 0.5  # that agree, and their share of those within reach
GATE_SIGMAS, FLOOR_PX, ROUNDS = 3.0, 0.25, 8
MIN_OFF_PX = 0.5  # rows that are less apart stay: matching bridges half a pixel


def rows_apart(left: U8, right: U8, disparities: tuple[float, float]) -> F64 | None:
    """(3,) a, b, c: what ``right`` (h, w) shows at (u, v) lies a + b u + c v px lower than in
    ``left``, by features whose disparity is within ``disparities``. None where rows surely do not
    differ, or too little agrees on how.
    """
    a, b = (features(g, WIDTH_PX, MOST, are_strongest=True) for g in (left, right))
    rows_a, rows_b = mutual(a.descriptors, b.descriptors)
    there, apart = b.uv_px[rows_b], a.uv_px[rows_a] - b.uv_px[rows_b]
    lower = -apart[:, 1]
    near = (apart[:, 0] >= disparities[0] - 1) & (apart[:, 0] <= disparities[1] + 1)
    near &= np.abs(lower) < MAX_SHARE * left.shape[0]
    there, lower = there[near], lower[near]
    if len(lower) < MIN_MATCHES:
        return None
    terms = np.column_stack([np.ones(len(there)), there])
    fit = np.array([np.median(lower), 0.0, 0.0])
    for _ in range(ROUNDS):
        off = np.abs(lower - terms @ fit)
        good = off < GATE_SIGMAS * max(1.4826 * float(np.median(off)), FLOOR_PX)
        if good.sum() < max(MIN_MATCHES, MIN_CONSENT * len(lower)):
            return None
        fit = np.linalg.lstsq(terms[good], lower[good], rcond=None)[0]
    h, w = left.shape
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
