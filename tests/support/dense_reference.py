"""The heavy operations in a few lines of NumPy: slow, plain, and what every backend must match.

Unbounded integers and double precision; no layout, no bands of rows, no tables.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.stereo.message_passing import FULL_WEIGHT, Smoothness
from recon.stereo.upsampling import (
    DIAMETER,
    MIN_CONFIDENCE,
    MIN_SUPPORT,
    RANGE_FLOOR,
    RANGE_SIGMA,
    SPATIAL_SIGMA,
    guide_at_taps,
)
from recon.types import F64, I64, U8, DisparityMap


def beliefs(
    cost: npt.NDArray[np.int16], image: U8, iterations: int, levels: int, smoothness: Smoothness
) -> I64:
    """Belief of each label (h, w, L), less is better: data plus arriving messages (Eq. 1)."""
    data = [_cut(np.moveaxis(cost.astype(np.int64), 1, 2), smoothness)]
    weights = [smoothness.weights(image).astype(np.int64)]
    while len(data) < levels and min(data[-1].shape[:2]) >= 8:
        data.append(_cut(_pool(data[-1]), smoothness))
        weights.append(_pool_weights(weights[-1]))
    messages = np.zeros((4, *data[-1].shape), np.int64)
    for level in range(len(data) - 1, -1, -1):
        h, w, _ = data[level].shape
        if messages.shape[1:3] != (h, w):
            messages = messages.repeat(2, axis=1).repeat(2, axis=2)[:, :h, :w]
        colour = np.add.outer(np.arange(h), np.arange(w)) % 2
        for t in range(iterations):
            fresh = _outgoing(data[level], messages, weights[level], smoothness)
            messages = np.where((colour == t % 2)[..., None], fresh, messages)
    return np.asarray(data[0] + sum(_arriving(messages)), np.int64)


def _cut(data: I64, smoothness: Smoothness) -> I64:
    """Cost above the pixel's best, cut where a label cannot win however the neighbours speak."""
    above = data - data.min(axis=2, keepdims=True)
    return np.asarray(np.minimum(above, 4 * smoothness.truncation), np.int64)


def _arriving(messages: I64) -> list[I64]:
    """Messages to each pixel from below, above, right and left; none from beyond the border."""
    padded = np.pad(messages, ((0, 0), (1, 1), (1, 1), (0, 0)))
    return [padded[0, 2:, 1:-1], padded[1, :-2, 1:-1], padded[2, 1:-1, 2:], padded[3, 1:-1, :-2]]


def _outgoing(data: I64, messages: I64, weights: I64, smoothness: Smoothness) -> I64:
    """Messages up, down, left and right: truncated linear lower envelope of all other news."""
    arriving = _arriving(messages)
    total = data + sum(arriving)
    edge = np.pad(weights, ((0, 0), (0, 1), (0, 1)))
    to = (edge[0, :-1, :-1], edge[0, 1:, :-1], edge[1, :-1, :-1], edge[1, :-1, 1:])
    labels = np.arange(data.shape[2])
    step = np.abs(labels[:, None] - labels[None, :])
    sent = []
    for weight, excluded in zip(to, (1, 0, 3, 2), strict=True):
        slope = smoothness.slope * weight // FULL_WEIGHT
        cut = smoothness.truncation * weight // FULL_WEIGHT
        price = np.minimum(step * slope[..., None, None], cut[..., None, None])
        message = (price + (total - arriving[excluded])[..., None, :]).min(axis=-1)
        sent.append(message - message.min(axis=-1, keepdims=True))
    return np.stack(sent)


def _pool(data: I64) -> I64:
    """Sums over 2x2 pixels; the border counts what there is."""
    h, w, _ = data.shape
    even = np.pad(data, ((0, h % 2), (0, w % 2), (0, 0)))
    return np.asarray(even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])


def _pool_weights(weights: I64) -> I64:
    """Mean weight of the two edges between coarse pixels, (2, h, w)."""
    _, h, w = weights.shape
    even = np.pad(weights, ((0, 0), (0, h % 2), (0, w % 2)), mode="edge")
    above = (even[0, ::2, ::2] + even[0, ::2, 1::2]) // 2
    left = (even[1, ::2, ::2] + even[1, 1::2, ::2]) // 2
    return np.stack([above, left])


def upsample(coarse: DisparityMap, guide: U8) -> DisparityMap:
    """Joint bilateral upsampling (Eq. 2), one tap of the window at a time."""
    (h, w), (height, width) = coarse.px.shape, guide.shape[:2]
    first_y, log_y = _axis(h, height)
    first_x, log_x = _axis(w, width)
    known = np.isfinite(coarse.px)
    trust = np.where(known, np.maximum(coarse.confidence, MIN_CONFIDENCE), 0)
    colour = guide_at_taps(guide, (h, w)).astype(np.float64)
    sums = np.zeros((4, height, width))
    for j in range(DIAMETER):
        for i in range(DIAMETER):
            y, x = np.ix_(np.clip(first_y + j, 0, h - 1), np.clip(first_x + i, 0, w - 1))
            inside = np.logical_and.outer(first_y + j == y[:, 0], first_x + i == x[0])
            distance = ((guide - colour[y, x]) ** 2).sum(axis=2)
            near = np.exp(log_y[:, j, None] + log_x[None, :, i])
            alike = np.exp(-distance / (2 * RANGE_SIGMA**2))
            weight = inside * near * np.maximum(alike, 2.0**RANGE_FLOOR)
            c = weight * trust[y, x]
            sums += np.stack(
                [weight, weight * known[y, x], c, c * np.where(known, coarse.px, 0)[y, x]]
            )
    good = sums[1] > MIN_SUPPORT * sums[0]
    with np.errstate(invalid="ignore"):
        px = np.where(good, sums[3] / sums[2], np.nan)
    sure = np.where(good, sums[2] / sums[0], 0)
    return DisparityMap(px.astype(np.float32), sure.astype(np.float32))


def _axis(taps: int, fine: int) -> tuple[I64, F64]:
    """First tap of each fine pixel along an axis and the log of s at each of its taps."""
    q = (np.arange(fine) + 0.5) * taps / fine - 0.5
    first = np.ceil(q - DIAMETER / 2).astype(np.int64)
    distance = first[:, None] + np.arange(DIAMETER) - q[:, None]
    return first, -0.5 * (distance / SPATIAL_SIGMA) ** 2
