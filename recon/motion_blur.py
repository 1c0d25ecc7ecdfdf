"""How far the image moves while the shutter is open, from the images themselves.

Blur by motion spreads each edge along the motion and not across it, so gradients along the
motion stay alike over the streak's length (after Yitzhaky and Kopeika 1997, "Identification of
blur parameters from motion blurred images", doi:10.1006/gmip.1997.0435).
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from recon.types import F64, U8

LAGS = 64  # longest streak that is looked for, in px
SIDE_SHARE = 0.7  # side of the square looked at over the image's shorter side: fits turned

BOX_PER_ZERO = 1.25
"""Streak over the first zero of its gradients' autocorrelation. Without other blur it would be 1;
this is for images with detail at all scales, measured on photos blurred by 3 to 20 px."""

SHOWN_PX = 2.0
"""Motion between two frames below which a streak says nothing, and median streak below which
images are sharp."""

SLOW_PX = 5.0
"""A median streak beyond it is a shutter too slow. Fields and roads have a direction of their own:
sharp images show 1 px typically, and up to 5."""

MOTION_SHARE = 1.5
"""A median streak beyond so many times the motion from image to image is none of motion, as no
shutter is open for longer: strong compression or noise reduction smears, too."""

KEPT, MIN_KNOWN = 15, 5  # keyframes that the exposure time is of, at most and at least


def streak_px(gray: U8, direction: F64) -> float:
    """Length in px by which an image (H, W) is smeared along a ``direction`` (2,) in it. Blur in
    all directions cancels. NaN without texture."""
    along, across = (_first_zero(gray, d) for d in (direction, direction[::-1] * [-1.0, 1.0]))
    return float(BOX_PER_ZERO * np.sqrt(max(along**2 - across**2, 0.0)))


def _first_zero(gray: U8, direction: F64) -> float:
    """Lag in px at which gradients along a direction cease to be alike; NaN without one."""
    H, W = gray.shape
    side = int(SIDE_SHARE * min(H, W))
    angle_deg = float(np.degrees(np.arctan2(direction[1], direction[0])))
    middle = (0.5 * (W - 1), 0.5 * (H - 1))
    turn: F64 = np.asarray(cv2.getRotationMatrix2D(middle, angle_deg, 1.0), np.float64)
    turn[:, 2] += [0.5 * (side - W), 0.5 * (side - H)]
    turned = cv2.warpAffine(gray, turn, (side, side))[:: 1 + side // 256]
    gradient = np.diff(turned.astype(np.float32), axis=1)
    power = np.abs(np.fft.rfft(gradient, side + LAGS, axis=1)) ** 2
    alike = np.fft.irfft(power.sum(axis=0), side + LAGS)[:LAGS]
    negative = np.flatnonzero(alike <= 0.0)
    if not alike[0] > 0.0 or not negative.size:
        return float("nan")
    k = int(negative[0])
    return float(k - alike[k] / (alike[k] - alike[k - 1]))


class ExposureTimeWatch:
    """Finds the exposure time by the streaks of keyframes and how fast their images moved."""

    def __init__(self) -> None:
        self._streaks: deque[tuple[float, float]] = deque(maxlen=KEPT)  # px, px/s
        self._over_motion: deque[float] = deque(maxlen=KEPT)  # streak over that of an open shutter
        self.exposure_s: float | None = None  # by the images; None while too few show it
        self.shown_s = 0.0  # the exposure where it smears the images; 0: as sharp as others
        self.blur_px = 0.0  # median streak of the last keyframes; 0 where it does no harm
        # The strongest ``blur_px`` so far, and ``exposure_s`` then; None while images are sharp.
        self.strongest: tuple[float, float] | None = None
        self.is_of_motion = True  # the strongest

    def add(self, gray: U8, px_s: F64, gap_s: float, image_gap_s: float) -> None:
        """Take a keyframe (H, W), the motion (2,) in it, the time since the frame before and that
        since the image before, which may not have been tracked."""
        speed = float(np.linalg.norm(px_s))
        if speed * gap_s < SHOWN_PX:
            return
        streak = streak_px(gray, px_s / speed)
        if not np.isfinite(streak):
            return
        self._streaks.append((min(streak, speed * gap_s), speed))  # exposed until the next at most
        self._over_motion.append(streak / (speed * image_gap_s))
        if len(self._streaks) < MIN_KNOWN:
            return
        px, speeds = np.array(self._streaks).T
        typical, self.exposure_s = float(np.median(px)), float(np.median(px / speeds))
        self.shown_s = self.exposure_s if typical > SHOWN_PX else 0.0
        self.blur_px = typical if typical > SLOW_PX else 0.0
        if self.blur_px > (self.strongest or (0.0, 0.0))[0]:
            self.strongest = self.blur_px, self.exposure_s
            self.is_of_motion = float(np.median(self._over_motion)) < MOTION_SHARE
