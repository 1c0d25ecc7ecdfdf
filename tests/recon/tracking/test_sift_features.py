"""Features of images: the largest first, kept by their frame, compared by their look."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from painted_ground import pose, still

from recon.tracking import sift_features
from recon.tracking.frame import NO_IMAGE, Frame
from recon.tracking.localisation import match_images
from recon.tracking.sift_features import (
    alike,
    features,
    mutual,
    signature,
)
from recon.types import F64, U8


def noisy(image: U8, seed: int) -> U8:
    noise = np.random.default_rng(seed).normal(0.0, 12.0, image.shape)
    return np.asarray(np.clip(image + noise, 0, 255), np.uint8)


def test_the_largest_features_come_first() -> None:
    """They survive noise better than the smallest ones."""
    image = still(pose(0.0))
    one, other = (features(noisy(image, seed)) for seed in (1, 2))
    apart_px = np.linalg.norm(one.uv_px[:, None] - other.uv_px, axis=2).min(axis=1)
    found = apart_px < 0.5
    assert found[:200].mean() > found[-200:].mean() + 0.15


@pytest.mark.parametrize("share", [1, 2])
def test_features_stay_where_they_are_in_an_image_upside_down(share: int) -> None:
    image = still(pose(0.0))
    h, w = image.shape
    here = features(image, w // share).uv_px
    there = (w - 1, h - 1) - features(np.ascontiguousarray(image[::-1, ::-1]), w // share).uv_px
    off = here[:, None] - there
    nearest = off[np.arange(len(here)), np.linalg.norm(off, axis=2).argmin(axis=1)]
    same = nearest[np.linalg.norm(nearest, axis=1) < 1.5]
    assert len(same) > 0.5 * len(here)
    assert np.abs(np.median(same, axis=0)).max() < 0.05 * share


def test_a_look_is_that_of_the_place_whatever_the_turn() -> None:
    here, turned, elsewhere = (
        signature(still(T)) for T in (pose(0.0), pose(6.0, 130.0, seed=1), pose(80.0))
    )
    assert alike(here, turned) > 20 > 8 > alike(here, elsewhere)
    assert here.dtype == np.uint8 and here.nbytes <= 200 * 128


def textured(shared_px: float, own_px: float, own: float) -> list[U8]:
    """Two images 100 px apart: structure of one size is shared, that of another is each's own."""
    rng = np.random.default_rng(3)

    def texture(size_px: float, width: int = 1280) -> F64:
        noise = cv2.GaussianBlur(rng.normal(size=(720, width)), (0, 0), size_px)
        return np.asarray(noise / noise.std(), np.float64)

    shared = texture(shared_px, 1380)
    return [
        np.asarray(np.clip(120 + 35 * seen + own * texture(own_px), 0, 255), np.uint8)
        for seen in (shared[:, :1280], shared[:, 100:])
    ]


@pytest.mark.slow
def test_stills_that_share_fine_detail_alone_are_compared_in_fine_detail() -> None:
    a, b = (
        Frame(NO_IMAGE, 0, seq, pyramid=(image,))
        for seq, image in enumerate(textured(shared_px=1.8, own_px=8.0, own=20.0))
    )
    assert match_images(a, b, low_frame_rate=False) is None
    view = match_images(a, b, low_frame_rate=True)
    assert view is not None
    np.testing.assert_allclose(view.carry(np.array([[640.0, 360.0]])), [[540.0, 360.0]], atol=2.0)


def test_a_frame_keeps_its_features() -> None:
    a, b = (
        Frame(NO_IMAGE, 0, seq, pyramid=(still(pose(dx)),)) for seq, dx in enumerate((0.0, 6.0))
    )
    found = match_images(a, b, low_frame_rate=False)
    a, b = (replace(image, pyramid=()) for image in (a, b))
    again = match_images(a, b, low_frame_rate=False)
    assert found is not None and again is not None
    np.testing.assert_array_equal(again.uv_a, found.uv_a)


def test_masses_tie_images_whose_leaves_differ() -> None:
    a, b = textured(shared_px=16.0, own_px=2.0, own=30.0)
    largest, strongest = (
        sift_features.match_features(*(features(image, are_strongest=one) for image in (a, b)))
        for one in (False, True)
    )
    assert largest is not None
    np.testing.assert_allclose(
        largest.carry(np.array([[640.0, 360.0]])), [[540.0, 360.0]], atol=2.0
    )
    assert strongest is None or len(largest) > 3 * len(strongest)


def test_a_place_is_carried_as_far_off_the_plane_as_the_matches_next_to_it() -> None:
    """A roof 5 px off the ground's homography, seen by three of six matches."""
    uv_a = np.array([[100.0, 100], [104, 100], [100, 104], [600, 400], [604, 400], [600, 404]])
    off = np.array([[5.0, 0.0]] * 3 + [[0.0, 0.0]] * 3)
    view = sift_features.FeatureMatches(np.eye(3), uv_a, uv_a + off, 640)
    carried = view.carry(np.array([[101.0, 101.0], [601.0, 401.0], [350.0, 250.0]]))
    np.testing.assert_allclose(carried, [[106.0, 101.0], [601.0, 401.0], [350.0, 250.0]])


def test_mutual_matches_are_those_of_a_search_both_ways() -> None:
    rng = np.random.default_rng(3)
    a = np.abs(rng.normal(size=(60, 128)))
    b = np.vstack([a[20:50], np.abs(rng.normal(size=(20, 128)))]) + 0.1 * rng.random((50, 128))
    a[40] = a[30]  # equally good: the first counts
    a, b = (one / np.linalg.norm(one, axis=1, keepdims=True) for one in (a, b))
    apart = np.linalg.norm(a[:, None] - b, axis=2)
    expected = []
    for i, row in enumerate(apart):
        j = int(row.argmin())
        if row[j] < sift_features.RATIO * np.delete(row, j).min() and apart[:, j].argmin() == i:
            expected.append((i, j))
    rows_a, rows_b = mutual(a.astype(np.float32), b.astype(np.float32))
    assert 20 < len(expected) < 30
    assert list(zip(rows_a, rows_b, strict=True)) == expected
