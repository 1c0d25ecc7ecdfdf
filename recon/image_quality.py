"""Contrast and sharpness: dark images are stretched, blurred ones make poor stereo views."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from recon.types import F32, U8, Bool

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
