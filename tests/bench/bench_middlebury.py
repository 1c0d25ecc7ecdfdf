"""Stereo on Middlebury's pairs against OpenCV's semi-global matcher: share of bad pixels.

The matcher is at its best: images padded on the left by the number of disparities, dense (no
uniqueness or left-right check), block size 3, and the better of its two-pass modes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from bench_options import DataOptions

from recon.types import F32, U8, Bool
from service.bench import BenchResult
from service.bench.stereo import ITERATIONS, semi_global
from service.compute.backend_choice import choose_backend
from service.compute.rectified_pair import matching_config, read_gray
from service.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class TruePair:
    """A rectified pair whose disparity is known."""

    name: str
    left: U8  # (h, w)
    right: U8  # (h, w)
    truth_px: F32  # (h, w), NaN = unknown
    visible: Bool  # (h, w) truth known and seen by both views
    labels: int


def run(options: DataOptions) -> list[BenchResult]:
    """Shares of bad pixels on the pairs in ``options.data``."""
    if options.data is None:
        raise InputError("bench middlebury needs --data with the folder that holds the pairs")
    backend = choose_backend(options.backend)
    results = []
    for pair in true_pairs(options.data):
        config = matching_config(ITERATIONS, 0, checked=False)
        ours = backend.belief_propagation(pair.left, pair.right, pair.labels, config).px
        theirs = min(
            (semi_global_disparity(pair, mode) for mode in (0, 2)),
            key=lambda px: bad_share(px, pair, 1.0),
        )
        for limit in (1.0, 0.5):
            results.append(
                BenchResult(
                    f"{pair.name}, bad-{limit}, not occluded",
                    100 * bad_share(ours, pair, limit),
                    "%",
                    peer="OpenCV SGBM, padded",
                    peer_value=100 * bad_share(theirs, pair, limit),
                    note=f"{pair.labels} labels",
                )
            )
    return results


def semi_global_disparity(pair: TruePair, mode: int) -> F32:
    """Disparity of the matcher on the padded pair, NaN where it found none."""
    pad = -(-pair.labels // 16) * 16
    left, right = (
        cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_REPLICATE)
        for image in (pair.left, pair.right)
    )
    found = semi_global(pair.labels, mode).compute(left, right)[:, pad:].astype(np.float32) / 16
    found[found < 0] = np.nan
    return np.asarray(found, np.float32)


def bad_share(px: F32, pair: TruePair, limit: float) -> float:
    """Share of the visible pixels that are unknown or wrong by more than ``limit`` px."""
    good = np.abs(px - pair.truth_px) <= limit
    return float(1 - good[pair.visible].mean())


def true_pairs(folder: Path) -> list[TruePair]:
    """The Middlebury pairs in a folder laid out as ``cones``, ``cloth3`` and ``motorcycle``."""
    found = []
    for name, left, right, truth, other, scale, labels in (
        ("cones", "im2", "im6", "disp2", "disp6", 4, 64),
        ("teddy", "im2", "im6", "disp2", "disp6", 4, 64),
        ("cloth3", "view1", "view5", "disp1", "disp5", 2, 96),
    ):
        place = folder / name
        if place.is_dir():
            truths = [
                read_gray(place / f"{f}.png").astype(np.float32) / np.float32(scale)
                for f in (truth, other)
            ]
            for px in truths:
                px[px == 0] = np.nan
            images = [read_gray(place / f"{f}.png") for f in (left, right)]
            visible = seen_by_both(truths[0], truths[1])
            found.append(TruePair(name, images[0], images[1], truths[0], visible, labels))
    place = folder / "motorcycle"
    if place.is_dir():
        with np.load(place / "motorcycle_disp.npz") as archive:
            px = archive["arr_0"].astype(np.float32)
        px[~np.isfinite(px)] = np.nan
        images = [read_gray(place / f"motorcycle_{side}.png") for side in ("left", "right")]
        found.append(TruePair("motorcycle", images[0], images[1], px, not_hidden(px), 64))
    if not found:
        raise InputError(f"{folder}: holds none of cones, teddy, cloth3, motorcycle")
    return found


def seen_by_both(left: F32, right: F32) -> Bool:
    """Pixels of the left truth whose partner in the right truth agrees within one pixel."""
    partner = np.arange(left.shape[1])[None, :] - np.rint(left)
    inside = np.isfinite(left) & (partner >= 0)
    back = np.take_along_axis(right, np.where(inside, partner, 0).astype(np.int64), axis=1)
    return np.asarray(inside & (np.abs(back - left) <= 1))


def not_hidden(left: F32) -> Bool:
    """Pixels of the left truth that no nearer surface covers in the right view."""
    partner = np.arange(left.shape[1])[None, :] - np.rint(left)
    v, u = np.nonzero(np.isfinite(left) & (partner >= 0))
    column = partner[v, u].astype(np.int64)
    nearest = np.full(left.shape, -np.inf, np.float32)
    np.maximum.at(nearest, (v, column), left[v, u])
    visible = np.zeros(left.shape, np.bool_)
    visible[v, u] = nearest[v, column] <= left[v, u] + 1
    return visible
