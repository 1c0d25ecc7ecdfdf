"""Stereo on real pairs with true disparity against OpenCV's semi-global matcher."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from bench_options import DataOptions
from bench_scenes import accuracy
from stereo_scenes import TruePair

from recon.types import F32, Bool
from service.bench import BenchResult
from service.commands.stereo import read_gray
from service.compute.backend_choice import choose_backend
from service.errors import InputError

OPENCV_SAMPLES = Path("/usr/share/doc/opencv-doc/examples/data")
"""Where Debian's opencv-doc puts them."""


def run(options: DataOptions) -> list[BenchResult]:
    """Shares of bad pixels on the pairs in ``options.data``."""
    if options.data is None:
        raise InputError("bench middlebury needs --data with the folder that holds the pairs")
    return accuracy(true_pairs(options.data), choose_backend(options.backend))


def true_pairs(folder: Path) -> list[TruePair]:
    """The pairs in a folder laid out as ``cones``, ``teddy``, ``cloth3``, ``motorcycle`` and
    ``aloe`` (of OpenCV's samples, at half size). Those that are missing are named."""
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
    found += aloe(folder / "aloe") or aloe(OPENCV_SAMPLES)
    missing = {"cones", "teddy", "cloth3", "motorcycle", "aloe"} - {pair.name for pair in found}
    if not found:
        raise InputError(f"{folder}: holds none of {', '.join(sorted(missing))}")
    if missing:
        print(f"not in {folder}: {', '.join(sorted(missing))}")
    return found


def aloe(folder: Path) -> list[TruePair]:
    """The pair of OpenCV's samples at half size, if it is there."""
    if not (folder / "aloeGT.png").is_file():
        return []
    truth = read_gray(folder / "aloeGT.png").astype(np.float32)[::2, ::2] / np.float32(2)
    truth[truth == 0] = np.nan
    left, right = (
        cv2.resize(
            read_gray(folder / f"aloe{side}.jpg"), truth.shape[::-1], interpolation=cv2.INTER_AREA
        ).astype(np.uint8)
        for side in "LR"
    )
    return [TruePair("aloe", left, right, truth, not_hidden(truth), 112)]


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
