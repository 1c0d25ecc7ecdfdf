"""Blurred images are distinguished from sharp ones of the same scene."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.image_quality import BlurWatch, sharpness
from recon.types import U8


def scene(seed: int = 0) -> U8:
    rng = np.random.default_rng(seed)
    out = np.zeros((360, 640), np.float32)
    for cell in (2, 5, 15, 50):
        layer = rng.normal(0, 1, (360 // cell + 2, 640 // cell + 2)).astype(np.float32)
        out += cv2.resize(layer, (640, 360), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(120 + 25 * out, 0, 255), np.uint8)


def motion_blur(image: U8, length: int) -> U8:
    kernel = np.full((1, length), 1.0 / length)
    return np.asarray(cv2.filter2D(image, -1, kernel), np.uint8)


def test_blur_lowers_sharpness_but_contrast_and_brightness_do_not() -> None:
    sharp = scene()
    usual = sharpness(sharp)
    values = [sharpness(motion_blur(sharp, n)) for n in (5, 9, 17)]
    assert usual > values[0] > values[1] > values[2]
    darker = np.asarray(40 + 0.5 * sharp, np.uint8)
    assert sharpness(darker) == pytest.approx(usual, rel=0.05)
    assert np.isnan(sharpness(np.full((64, 64), 9, np.uint8)))


def test_a_blurred_frame_among_sharp_ones_is_reported() -> None:
    watch = BlurWatch()
    reported = []
    for i in range(30):
        image = scene(i)
        reported.append(watch.blurred(motion_blur(image, 15) if i in (12, 20) else image))
    assert [i for i, blurred in enumerate(reported) if blurred] == [12, 20]


def test_a_recording_that_is_soft_throughout_is_taken_as_it_is() -> None:
    watch = BlurWatch()
    assert not any(watch.blurred(motion_blur(scene(i), 15)) for i in range(12))
