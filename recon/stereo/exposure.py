"""Dark and flat pictures made matchable by a linear stretch."""

from __future__ import annotations

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
