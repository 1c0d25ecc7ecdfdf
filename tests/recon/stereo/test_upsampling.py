"""Joint bilateral upsampling against the plain reference, and what Eq. 2 promises."""

from __future__ import annotations

import cv2
import dense_reference as reference
import numpy as np
import pytest

from recon.stereo.upsampling import DIAMETER, RANGE_SIGMA, SPATIAL_SIGMA, upsample
from recon.types import U8, DisparityMap


def scene(
    coarse: tuple[int, int], fine: tuple[int, int], holes: float = 0.0, seed: int = 0
) -> tuple[DisparityMap, U8]:
    """A random coarse map with holes, and a guide of patches and noise."""
    rng = np.random.default_rng(seed)
    px = rng.uniform(0, 16, coarse).astype(np.float32)
    px[rng.random(coarse) < holes] = np.nan
    confidence = rng.random(coarse).astype(np.float32)
    confidence[np.isnan(px)] = 0
    patches = rng.integers(0, 256, (7, 9, 3), np.uint8)
    large = cv2.resize(patches, (fine[1], fine[0]), interpolation=cv2.INTER_NEAREST)
    guide = np.clip(large + rng.normal(0, 8, large.shape), 0, 255).astype(np.uint8)
    return DisparityMap(px, confidence), guide


@pytest.mark.parametrize(
    ("coarse", "fine", "holes"),
    [
        ((18, 32), (72, 128), 0.0), ((18, 32), (72, 128), 0.3), ((18, 32), (152, 270), 0.2),
        ((20, 30), (20, 30), 0.1), ((3, 5), (31, 47), 0.1), ((1, 1), (9, 9), 0.0),
        ((33, 21), (70, 130), 0.9),
    ],
)  # fmt: skip
def test_equals_the_reference(coarse: tuple[int, int], fine: tuple[int, int], holes: float) -> None:
    """Every tap in double precision: within 0.01 px of 16, and the same pixels known."""
    given, guide = scene(coarse, fine, holes)
    got, want = upsample(given, guide), reference.upsample(given, guide)
    assert got.px.shape == fine
    assert (np.isnan(got.px) != np.isnan(want.px)).mean() < 1e-3
    both = np.isfinite(got.px) & np.isfinite(want.px)
    np.testing.assert_allclose(got.px[both], want.px[both], atol=0.01)
    np.testing.assert_allclose(got.confidence[both], want.confidence[both], atol=1e-3)


def test_the_window_is_the_papers() -> None:
    """Filter 15 at 2704 px is 1.775 coarse pixels of 320; diameter 10 is ten taps a side."""
    assert (RANGE_SIGMA, DIAMETER) == (15, 10)
    assert pytest.approx(15 * 320 / 2704) == SPATIAL_SIGMA


def test_eq_2_for_one_pixel_by_hand() -> None:
    """A flat guide leaves only the spatial kernel: a Gaussian mean of known taps."""
    px = np.arange(12 * 12, dtype=np.float32).reshape(12, 12)
    given = DisparityMap(px, np.ones((12, 12), np.float32))
    guide = np.full((48, 48, 3), 77, np.uint8)
    x, y = 21, 26
    qx, qy = (x + 0.5) / 4 - 0.5, (y + 0.5) / 4 - 0.5
    total = weight = 0.0
    for j in range(2, 12):  # the nearest ten to 6.125
        for i in range(10):  # and to 4.875
            s = np.exp(-((i - qx) ** 2 + (j - qy) ** 2) / (2 * SPATIAL_SIGMA**2))
            total, weight = total + s * px[j, i], weight + s
    assert upsample(given, guide).px[y, x] == pytest.approx(total / weight, abs=0.02)


def test_a_constant_stays_and_values_are_not_rescaled() -> None:
    given = DisparityMap(np.full((18, 32), 7.25, np.float32), np.ones((18, 32), np.float32))
    _, guide = scene((18, 32), (72, 128))
    found = upsample(given, guide)
    np.testing.assert_allclose(found.px, 7.25, atol=2e-3)
    np.testing.assert_allclose(found.confidence, 1, atol=2e-3)


def test_depth_edge_follows_the_colour_edge() -> None:
    """A slanted step that the coarse grid can only draw in stairs comes out sharp."""
    y, x = np.mgrid[0:144, 0:256]
    near = x > 100 + 0.37 * y
    guide = np.where(near[..., None], (40, 60, 200), (90, 160, 70)).astype(np.uint8)
    rng = np.random.default_rng(0)
    guide = np.clip(guide + rng.normal(0, 4, guide.shape), 0, 255).astype(np.uint8)
    truth = np.where(near, 12.0, 5.0)
    stairs = cv2.resize(truth, (32, 18), interpolation=cv2.INTER_NEAREST).astype(np.float32)
    given = DisparityMap(stairs, np.ones((18, 32), np.float32))
    error = np.abs(upsample(given, guide).px - truth)
    linear = np.abs(cv2.resize(stairs, (256, 144)) - truth)
    assert (error > 1).mean() < 0.01 < 0.02 < (linear > 1).mean()


def test_holes_stay_holes_and_do_not_leak() -> None:
    px = np.full((18, 32), 4.0, np.float32)
    px[4:14, 8:24] = np.nan
    confidence = np.isfinite(px).astype(np.float32)
    guide = np.full((72, 128, 3), 120, np.uint8)
    found = upsample(DisparityMap(px, confidence), guide)
    assert np.isnan(found.px[28:44, 48:80]).all()
    assert np.isfinite(found.px[:8]).all()
    np.testing.assert_allclose(found.px[np.isfinite(found.px)], 4, atol=2e-3)
    assert (found.confidence[np.isnan(found.px)] == 0).all()
    unknown = DisparityMap(np.full((5, 6), np.nan, np.float32), np.zeros((5, 6), np.float32))
    assert np.isnan(upsample(unknown, guide).px).all()


def test_an_unsure_tap_counts_less() -> None:
    px = np.full((18, 32), 4.0, np.float32)
    confidence = np.ones((18, 32), np.float32)
    px[9, 16], confidence[9, 16] = 16.0, 0.01
    guide = np.full((72, 128, 3), 120, np.uint8)
    doubtful = upsample(DisparityMap(px, confidence), guide).px
    certain = upsample(DisparityMap(px, np.ones_like(px)), guide).px
    assert doubtful[38, 66] < 4.02 < 4.3 < certain[38, 66]


def test_bad_input_is_named() -> None:
    given, guide = scene((18, 32), (72, 128))
    with pytest.raises(ValueError, match="smaller"):
        upsample(given, guide[:10])
    with pytest.raises(ValueError, match="guide must be"):
        upsample(given, guide[:, :, 0])
