"""Gray levels of the right image become those of the left one, whatever the exposure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.stereo.brightness_transfer import match_brightness
from recon.types import F64, U8, Array

LABELS = 16


def pair(first: int = 0) -> tuple[U8, U8, Array]:
    """Two views of a textured step, and the columns of the right one that the left one sees."""
    rng = np.random.default_rng(4)
    noise = cv2.GaussianBlur(rng.normal(0, 1, (120, 320)), (0, 0), 1.2)
    canvas = 115 + 30 * noise / noise.std()
    v, u = np.mgrid[0:120, 0:200]
    partner = u - first - np.where(u > 100, 11, 4)
    left = canvas[v, partner + 60] + rng.normal(0, 1, u.shape)
    return levels(left), levels(canvas[:, 60:260] + rng.normal(0, 1, u.shape)), partner


def levels(image: Array) -> U8:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def apart(left: U8, right: U8, partner: Array) -> float:
    """Mean difference of the gray levels of one surface."""
    seen = (partner >= 0) & (partner < 200)
    there = np.take_along_axis(right.astype(int), partner.clip(0, 199), 1)
    return float(np.abs(left - there)[seen].mean())


def shaded(image: U8) -> F64:
    x = np.linspace(-1, 1, image.shape[1])
    return np.asarray(image * (1 - 0.3 * x * x), np.float64)


@pytest.mark.parametrize(
    "exposure",
    [
        lambda i: 0.75 * i, lambda i: 1.2 * i + 10, lambda i: 255 * (i / 255) ** 0.7,
        lambda i: 255 * (i / 255) ** 1.4, shaded,
    ],
    ids=["darker", "brighter", "gamma 0.7", "gamma 1.4", "vignetting"],
)  # fmt: skip
@pytest.mark.parametrize("first", [0, -9, 7])
def test_one_surface_gets_one_gray_level(exposure: object, first: int) -> None:
    left, right, partner = pair(first)
    changed = levels(exposure(right))  # type: ignore[operator]
    alike = apart(left, right, partner)
    assert apart(left, changed, partner) > alike + 6
    assert apart(left, match_brightness(left, changed, LABELS, first), partner) < alike + 1.2


def test_equal_exposures_are_left_as_they_are() -> None:
    left, right, _ = pair()
    assert np.abs(match_brightness(left, right, LABELS).astype(int) - right).max() <= 2
    np.testing.assert_array_equal(match_brightness(left, left, LABELS), left)


def test_without_clear_matches_nothing_changes() -> None:
    left, right = np.random.default_rng(0).integers(0, 256, (2, 120, 200), np.uint8)
    blank = np.full((120, 200), 90, np.uint8)
    for a, b in ((blank, blank), (left, blank), (left[:7, :9], right[:7, :9])):
        assert match_brightness(a, b, LABELS) is b
