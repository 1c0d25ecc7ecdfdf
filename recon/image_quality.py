"""Contrast, sharpness and motion blur: dark images are stretched, blurred ones make poor stereo
views.

Blur by motion spreads each edge along the motion and not across it, so gradients along the
motion stay alike over the streak's length (after Yitzhaky and Kopeika 1997, "Identification of
blur parameters from motion blurred images", doi:10.1006/gmip.1997.0435).
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from recon.types import F32, F64, U8, Bool

WANTED_SPREAD = 45.0  # standard deviation in gray levels that an image of a well-lit scene has
MAX_GAIN = 8.0  # beyond it noise is all that grows


def halved(image: U8, ratio: float) -> U8:
    """``image`` halved until ``ratio`` of its pixels to those wanted is at most 1.9."""
    while ratio > 1.9:
        half = (image.shape[1] // 2, image.shape[0] // 2)
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
        ratio /= 2
    return image


def stretch(gray: U8, seen: Bool | None = None) -> U8:
    """The image (H, W) with its contrast raised to that of a well-lit scene.

    One gain for the whole image, so that places are not moved; an image with contrast enough comes
    back as it is. Only pixels in ``seen`` (H, W) count.
    """
    mask = None if seen is None else seen[::4, ::4].astype(np.uint8)
    mean, spread = (float(v[0, 0]) for v in cv2.meanStdDev(gray[::4, ::4], mask=mask))
    if spread >= WANTED_SPREAD:
        return gray
    gain = min(WANTED_SPREAD / max(spread, 1e-3), MAX_GAIN)
    levels = (np.arange(256) - mean) * gain + 128.0
    table = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(gray, table), np.uint8)


def local_variance(gray: U8, side: int) -> F32:
    """(H, W) variance of the gray levels in ``side`` x ``side`` pixels; rounding may make it
    negative."""
    mean = cv2.boxFilter(gray, cv2.CV_32F, (side, side), borderType=cv2.BORDER_REPLICATE)
    square = cv2.sqrBoxFilter(gray, cv2.CV_32F, (side, side), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(square - mean * mean, np.float32)


def sharpness(gray: U8) -> float:
    """Fine detail over coarse detail of ``gray`` (H, W) uint8: falls when the image is blurred.

    Mean absolute Laplacian of the image at half its size over that at an eighth. The ratio cancels
    contrast and exposure but not the scene's content, so only images of the same scene compare. NaN
    for an image without any detail.
    """
    half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    eighth = cv2.resize(half, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    fine, coarse = (
        cv2.norm(cv2.Laplacian(p, cv2.CV_16S), cv2.NORM_L1) / p.size for p in (half, eighth)
    )
    return fine / coarse if coarse > 0 else float("nan")


MIN_APART_PX, MAX_APART_PX = 0.55, 4.0
"""Sigma of a blur in which two images of one scene may differ, and of the widest sought."""

NOISY, NOISE_PX = 18.0, 0.8
"""Fine detail above which an image is mostly noise: the sharpest photos have 14, and 20 or more
with noise of 10 gray levels. And the sigma of the blur that suppresses it."""


def alike(left: U8, right: U8) -> tuple[U8, U8, float, float]:
    """Two gray images (h, w) of one scene, equally sharp and with little noise, and the sigmas in
    px of the blur that each of them got for it; 0 where an image is as it was."""
    detail = _fine_detail(left), _fine_detail(right)
    if min(detail) > NOISY:
        sigma = [NOISE_PX, NOISE_PX]
    else:
        sharper = int(detail[1] > detail[0])
        sigma = [0.0, 0.0]
        sigma[sharper] = _apart((left, right)[sharper], min(detail))
    left, right = (
        i if s == 0 else _blurred(i, s) for i, s in zip((left, right), sigma, strict=True)
    )
    return left, right, sigma[0], sigma[1]


def _apart(sharper: U8, detail: float) -> float:
    """Sigma in px of the narrowest blur with which an image has no more than this fine detail; 0
    where they are as sharp, or differ in more. Of the widest, rounded gray levels are all that is
    left, as fine as noise."""
    sigma = MIN_APART_PX
    while _fine_detail(_blurred(sharper, sigma)) > detail:
        sigma *= 1.1
        if sigma > MAX_APART_PX:
            return 0.0
    return sigma if sigma > MIN_APART_PX else 0.0


def _blurred(gray: U8, sigma_px: float) -> U8:
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), sigma_px), np.uint8)


def _fine_detail(gray: U8) -> float:
    """Like :func:`sharpness`, at the image's own size: it falls with any blur. NaN without any."""
    image = gray.astype(np.float32)
    blurred = cv2.GaussianBlur(image, (0, 0), 2.0)
    fine, coarse = (cv2.norm(cv2.Laplacian(i, cv2.CV_32F), cv2.NORM_L1) for i in (image, blurred))
    return fine / coarse if coarse > 0 else float("nan")


BLURRED_SHARE = 0.6  # of the median sharpness of the last images: less is blurred
BLUR_WINDOW, MIN_KNOWN = 31, 5  # images that the median is of, at most and at least


class BlurWatch:
    """Detects images that are blurred compared with the others of a recording."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=BLUR_WINDOW)

    def blurred(self, gray: U8) -> bool:
        """True when the image (H, W) is much less sharp than those before it."""
        value = sharpness(gray)
        if not np.isfinite(value):
            return False
        known = len(self._values) >= MIN_KNOWN
        low = known and value < BLURRED_SHARE * float(np.median(self._values))
        self._values.append(value)
        return low


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

STREAKS, MIN_STREAKS = 15, 5  # keyframes that the exposure time is of, at most and at least


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
        self._streaks: deque[tuple[float, float]] = deque(maxlen=STREAKS)  # px, px/s
        # Each streak over that of a shutter that is always open.
        self._over_motion: deque[float] = deque(maxlen=STREAKS)
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
        if len(self._streaks) < MIN_STREAKS:
            return
        px, speeds = np.array(self._streaks).T
        typical, self.exposure_s = float(np.median(px)), float(np.median(px / speeds))
        self.shown_s = self.exposure_s if typical > SHOWN_PX else 0.0
        self.blur_px = typical if typical > SLOW_PX else 0.0
        if self.blur_px > (self.strongest or (0.0, 0.0))[0]:
            self.strongest = self.blur_px, self.exposure_s
            self.is_of_motion = float(np.median(self._over_motion)) < MOTION_SHARE
