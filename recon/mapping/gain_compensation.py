"""One brightness for all images of a flight, whatever automatic exposure and clouds do.

A colour times a gain is the same colour at another exposure. Most of what an image shows earlier
ones showed, too; a gain for each channel makes them agree. It is the same all over the image: one
that changes across it takes the lens's shading for an exposure, and adds it up along a line.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from recon.mapping.voxel_map import sampled, shared
from recon.types import F32, F64, I64, U8, DepthMap

IMAGES = 64  # number of images that are kept
MIN_COMMON = 60  # minimum number of samples in common with earlier images

KEPT = 0.95
"""Share of the logarithm of a gain that is kept from image to image. What has one side of all
images brighter, as sunlight does, adds up otherwise, as far as the fit takes it for one."""

LEVEL = 0.1
"""Weight of the same brightness on all sides of an image, over that of samples all over it."""

UNSEEN = 0.03
"""Smaller changes show in no seam and are left: what looks different from another side is no change
of exposure."""

SAME_SHARE = 0.02  # samples are of one surface where their depths differ by less than this share

FITTED, STEPS, HUBER = 2000, 6, 1.5
"""About so many samples are used; steps of the reweighted least squares; residuals of more medians
count less."""

BLUR_PX = 9  # side of the square that is a sample's colour: places are right to some pixels
DARK, BURNT = 5, 245  # beyond these levels a colour says nothing about exposure
KNEE = np.float32(224)  # levels that a gain lifts beyond this one approach white: none is burnt

MAX_LOG = float(np.log(3.0))


class GainCompensation:
    """Levels each new image with the last ones."""

    def __init__(self) -> None:
        self._earlier: deque[tuple[F32, F32, F64]] = deque(maxlen=IMAGES)
        # Places (N, 3) of some surface of each, m, in the segment's frame, the logarithms (N, 3) of
        # its levelled colours, NaN where a colour says nothing, and its places (N, 2) in the image.
        self._segment = -1
        self._gain = np.zeros(3)  # of the last image: logarithms for blue, green and red

    def __call__(self, segment: int, depth: DepthMap, bgr: U8) -> U8:
        """``bgr`` (h, w, 3) on the grid of the depth, levelled; it is remembered.

        ``depth`` is in the frame of its segment. Where no earlier image of that shows its ground,
        the camera's exposure is that of the last image.
        """
        if segment != self._segment:
            self._earlier.clear()
            self._segment = segment
        calm = np.asarray(cv2.boxFilter(bgr, cv2.CV_32F, (BLUR_PX, BLUR_PX)), np.float32)
        if self._earlier:
            points, before, seen_at = map(np.concatenate, zip(*self._earlier, strict=True))
            which, at, there = shared(depth, points)
            same = np.abs(depth.depth_m[at] / there - 1.0) < SAME_SHARE
            off = np.where(same[:, None], before[which] - _logs(calm[at]), np.nan)
            self._fit(off, _places(at, bgr.shape) - seen_at[which])
        self._gain *= KEPT
        at, points = sampled(depth)
        known = _logs(calm[at]) + self._gain
        seen = points.astype(np.float32), known.astype(np.float32), _places(at, bgr.shape)
        self._earlier.append(seen)
        return self.level(bgr)

    def level(self, bgr: U8) -> U8:
        """An image (h, w, 3) that has the exposure of the last one, levelled."""
        if not self._gain.any():
            return bgr
        gain = np.exp(self._gain).astype(np.float32)
        lit = np.arange(256, dtype=np.float32)[:, None] * gain
        above = KNEE + (lit - KNEE) * ((255 - KNEE) / np.maximum(255 * gain - KNEE, 255 - KNEE))
        table = cv2.convertScaleAbs(np.where(lit > KNEE, above, lit))
        return np.asarray(cv2.LUT(bgr, table[:, None]), np.uint8)

    def _fit(self, off: F64, moved: F64) -> None:
        """The gain by differences of logarithms (N, 3) of ground that ``moved`` (N, 2) over the
        image. What makes one side of all images brighter depends on that, and is no gain."""
        known = np.isfinite(off).all(axis=1)
        every = max(1, np.count_nonzero(known) // FITTED)
        off, moved = off[known][::every], moved[known][::every]
        if len(off) < MIN_COMMON:
            return
        terms = np.hstack([np.ones((len(off), 1)), moved])
        gain = np.zeros((3, 3))
        gain[0] = np.median(off, axis=0)
        for _ in range(STEPS):
            rest = np.linalg.norm(off - terms @ gain, axis=1)
            limit = HUBER * max(float(np.median(rest)), 1e-3)
            weighted = terms * np.minimum(1.0, limit / np.maximum(rest, limit))[:, None]
            level = LEVEL / 12.0 * weighted[:, 0].sum() * np.diag([0.0, 1.0, 1.0])
            gain = np.linalg.solve(weighted.T @ terms + level, weighted.T @ off)
        change = gain[0] - self._gain
        self._gain += np.sign(change) * np.maximum(np.abs(change) - UNSEEN, 0.0)
        self._gain = np.clip(self._gain, -MAX_LOG, MAX_LOG)


def _logs(colours: F32) -> F32:
    """Logarithms of colours (N, 3); NaN where one says nothing."""
    fair = ((colours > DARK) & (colours < BURNT)).all(axis=1, keepdims=True)
    return np.where(fair, np.log(np.maximum(colours, np.float32(1))), np.float32(np.nan))


def _places(at: tuple[I64, I64], shape: tuple[int, ...]) -> F64:
    """(N, 2) places across and down, from -0.5 to 0.5, of rows and columns."""
    v, u = at
    return np.stack([u / shape[1] - 0.5, v / shape[0] - 0.5], axis=-1)
