"""Common features of two images, whatever turn, zoom or shift lies between them.

SIFT features (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94) with the square root of their
descriptors (Arandjelovic and Zisserman 2012, doi:10.1109/CVPR.2012.6248018), found on a small
image with its contrast leveled. It is the start where no prediction holds: stills, turns, gaps,
places seen before. The search for Harris corners makes it exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from recon.tracking import robust_geometry
from recon.types import F32, F64, U8

WIDTH_PX = 480  # width of the image in which features are detected: 0.1 s on one core
MOST = 1000  # features of an image

FINE_WIDTH_PX, FINE_MOST = 960, 3000
"""For stills that share too few of those: treetops look alike, or different, in a small image."""

RATIO = 0.8  # distance to the best descriptor over that to the second best, at most
GATE_SHARE = 0.015  # of the width, by which relief may move a match off the common homography

MIN_MATCHES, MIN_MATCH_SHARE = 14, 0.5
"""That follow one homography, and their share of all matches; strangers have 7 of 27."""

NEAR_SHARE = 0.06
"""Matches within this share of the width say how far a place is off the homography."""

FEATURE_SHARES = (0.01, 0.03)
"""Search radii around places that features predict, as shares of the width, in the order in which
they are tried: where texture repeats, as the rows of a field do, a wide search finds a second place
as good."""

SIGNATURE_WIDTH_PX, SIGNATURE, SIGNATURE_STEPS = 320, 200, 400.0
"""Image width and number of features that describe the look of an image, and levels of a
descriptor's byte."""


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Distinct places of one image with their descriptors, the largest first."""

    uv_px: F64  # (N, 2) of the full image
    descriptors: F32  # (N, 128) unit length
    width_px: int  # of the full image


@dataclass(frozen=True, slots=True, eq=False)
class FeatureMatches:
    """The ground that two images share, as a homography and the matches that follow it."""

    H: F64  # (3, 3) pixels of image a to pixels of image b
    uv_a: F64  # (M, 2)
    uv_b: F64  # (M, 2)
    width_px: int  # of image a

    def __len__(self) -> int:
        return len(self.uv_a)

    def carry(self, uv_px: F64) -> F64:
        """(N, 2) pixels of image b for the pixels ``uv_px`` (N, 2) of image a.

        By the homography, corrected by the matches at the three nearest places if there are any.
        SIFT may describe one place several times; it counts once.
        """
        there = cv2.perspectiveTransform(uv_px[:, None].astype(np.float64), self.H)[:, 0]
        _, once = np.unique(self.uv_a, axis=0, return_index=True)
        if len(once) < 3:
            return np.asarray(there, np.float64)
        uv_a = self.uv_a[once]
        off = self.uv_b[once] - cv2.perspectiveTransform(uv_a[:, None], self.H)[:, 0]
        apart = np.linalg.norm(uv_px[:, None] - uv_a, axis=2)
        nearest = np.argpartition(apart, 2, axis=1)[:, :3]
        is_near = np.take_along_axis(apart, nearest, axis=1).max(axis=1) < (
            NEAR_SHARE * self.width_px
        )
        correction = np.median(off[nearest], axis=1)
        return np.asarray(there + correction * is_near[:, None], np.float64)

    def predict(self, uv_px: F64) -> tuple[F64, F64]:
        """Where (N, 2) the pixels ``uv_px`` (N, 2) of image a are in image b, and the warps
        (N, 2, 2) of offsets there."""
        return self.carry(uv_px), robust_geometry.by_homography(self.H, uv_px)[1]


def features(
    gray: U8, width_px: int = WIDTH_PX, most: int = MOST, are_strongest: bool = False
) -> Features:
    """The ``most`` largest features of ``gray`` (H, W) uint8, looked for at ``width_px``; none
    where it shows nothing.

    Large ones are found again from elsewhere, where the strongest are leaves and glints.
    ``are_strongest``: those of the highest contrast instead, as their places are more exact.
    """
    H, W = gray.shape
    size = (min(width_px, W), max(16, round(min(width_px, W) * H / W)))
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    level = cv2.createCLAHE(4.0, (8, 8)).apply(small)
    # Without the precise upscale all places are a quarter of a pixel too far right and down.
    sift = cv2.SIFT.create(0, contrastThreshold=0.01, enable_precise_upscale=True)
    places = sorted(
        sift.detect(level, None), key=lambda p: -(p.response if are_strongest else p.size)
    )
    found, descriptors = sift.compute(level, places[:most])
    if descriptors is None or len(found) == 0:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), W)
    uv = np.array([point.pt for point in found], np.float64)
    total = np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
    root = np.sqrt(descriptors / total)
    scale = np.array([W / size[0], H / size[1]])
    return Features((uv + 0.5) * scale - 0.5, np.asarray(root, np.float32), W)


def match_features(a: Features, b: Features) -> FeatureMatches | None:
    """The features that images ``a`` and ``b`` share, or None when none are certain."""
    rows_a, rows_b = mutual(a.descriptors, b.descriptors)
    if len(rows_a) < MIN_MATCHES:
        return None
    uv_a, uv_b = a.uv_px[rows_a], b.uv_px[rows_b]
    found = robust_geometry.homography(uv_a, uv_b, GATE_SHARE * b.width_px)
    if found is None:
        return None
    H, good = found
    if good.sum() < max(MIN_MATCHES, MIN_MATCH_SHARE * len(rows_a)):
        return None
    if not _is_sound(H, uv_a[good]):
        return None
    return FeatureMatches(H, uv_a[good], uv_b[good], a.width_px)


def mutual(a: F32, b: F32) -> tuple[np.ndarray, np.ndarray]:
    """Rows of ``a`` and ``b`` that are each other's best match, and clearly so."""
    none = np.zeros(0, np.int64)
    if min(len(a), len(b)) < MIN_MATCHES:
        return none, none
    likeness = a @ b.T
    best, highest = likeness.argmax(axis=1), likeness.max(axis=0)  # argmax of columns is slow
    rows = np.arange(len(a))
    top = likeness[rows, best]
    likeness[rows, best] = -1.0
    closest, next_one = (
        np.sqrt(np.maximum(2.0 - 2.0 * one, 0.0)) for one in (top, likeness.max(axis=1))
    )
    good = np.flatnonzero((top == highest[best]) & (closest < RATIO * next_one))
    _, first = np.unique(best[good], return_index=True)  # of rows that are equally good
    good = good[np.sort(first)]
    return rows[good], best[good]


def _is_sound(H: F64, uv: F64) -> bool:
    """False where a homography mirrors, folds, or shrinks the matches (N, 2) onto a spot."""
    w = uv @ H[2, :2] + H[2, 2]
    if not (np.all(w > 0) or np.all(w < 0)):
        return False
    growth = np.linalg.det(H) / w**3  # of areas
    return bool(np.all((growth > 1.0 / 36.0) & (growth < 36.0)))


def alike(a: U8, b: U8) -> int:
    """How many features two signatures (N, 128) have in common, each surely the other's."""
    rows, _ = mutual(a.astype(np.float32) / SIGNATURE_STEPS, b.astype(np.float32) / SIGNATURE_STEPS)
    return len(rows)


def signature(gray: U8) -> U8:
    """(N, 128) descriptors of the largest features of an image, in 26 kB."""
    largest = features(gray, SIGNATURE_WIDTH_PX).descriptors[:SIGNATURE]
    return np.asarray(np.clip(np.rint(largest * SIGNATURE_STEPS), 0, 255), np.uint8)
