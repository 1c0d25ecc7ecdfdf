"""Contrast and sharpness: dark images are stretched, blurred ones make poor stereo views."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from recon.types import U8, Bool

WANTED_SPREAD = 45.0
"""Standard deviation in grey levels that a picture of a well-lit scene has."""

MOST_GAIN = 8.0
"""Beyond it noise is all that grows."""


def stretch(grey: U8, seen: Bool | None = None) -> U8:
    """The picture (H, W) with its contrast raised to that of a well-lit scene.

    One gain for the whole picture, so that places are not moved; a picture with contrast
    enough comes back as it is. ``seen`` (H, W) says which pixels count.
    """
    sample = grey[::4, ::4] if seen is None else grey[::4, ::4][seen[::4, ::4]]
    if sample.size == 0:
        return grey
    spread = float(sample.std())
    if spread >= WANTED_SPREAD:
        return grey
    gain = min(WANTED_SPREAD / max(spread, 1e-3), MOST_GAIN)
    levels = (np.arange(256) - float(sample.mean())) * gain + 128.0
    table = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(grey, table), np.uint8)


def sharpness(grey: U8) -> float:
    """Fine detail over coarse detail of ``grey`` (H, W) uint8: falls when the picture is blurred.

    Mean absolute Laplacian of the picture at half its size over that at an eighth. The ratio
    cancels contrast and exposure; what the scene shows stays in it, so that only pictures of
    the same scene compare. NaN for a picture without any detail.
    """
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    eighth = cv2.resize(half, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    fine, coarse = (float(np.abs(cv2.Laplacian(p, cv2.CV_16S)).mean()) for p in (half, eighth))
    return fine / coarse if coarse > 0 else float("nan")


class BlurWatch:
    """Tells blurred pictures from the usual ones of a recording."""

    def __init__(self, least_share: float = 0.6, window: int = 31, least_known: int = 5) -> None:
        """Blurred is less than ``least_share`` of the median sharpness of ``window`` frames."""
        if not 0.0 < least_share < 1.0 or window < least_known or least_known < 1:
            raise ValueError("0 < least_share < 1 and 1 <= least_known <= window must hold")
        self._least_share, self._least_known = least_share, least_known
        self._values: deque[float] = deque(maxlen=window)

    def blurred(self, grey: U8) -> bool:
        """True when the picture (H, W) is much less sharp than those before it."""
        value = sharpness(grey)
        if not np.isfinite(value):
            return False
        known = len(self._values) >= self._least_known
        low = known and value < self._least_share * float(np.median(self._values))
        self._values.append(value)
        return low
