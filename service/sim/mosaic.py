"""A patchwork of aerial photographs to lay over the simulated ground."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from recon.types import F32, U8
from service.errors import InputError

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
FEATHER = 0.08  # of a photograph's side that fades into its neighbour


def patchwork(folder: Path, size: tuple[int, int], seed: int) -> U8:
    """(H, W, 3) picture of ``size`` (W, H): photographs side by side at their own resolution.

    They are shuffled, flipped and brought to the same mean brightness, and fade into each
    other. InputError when the folder holds no readable photograph.
    """
    if not folder.is_dir():
        raise InputError(f"photos {folder}: no such folder")
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    rng = np.random.default_rng(seed + 2)
    photos = _Photos([paths[i] for i in rng.permutation(len(paths))], folder)
    W, H = size
    out = np.zeros((H, W, 3), np.uint8)
    step = [int(s * (1 - FEATHER)) for s in photos.size]
    count = 0
    for y in range(0, H, step[1]):
        for x in range(0, W, step[0]):
            flips = rng.integers(0, 2, 2)
            photo = photos.get(count)[:: 1 - 2 * int(flips[0]), :: 1 - 2 * int(flips[1])]
            _lay(out, photo, x, y)
            count += 1
    return out


class _Photos:
    """The readable photographs of a folder, all cut to one size and mean brightness."""

    def __init__(self, paths: list[Path], folder: Path) -> None:
        self.paths = paths
        self.images: list[U8] = []
        for path in paths[:24]:
            image = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if image is not None and min(image.shape[:2]) >= 64:
                self.images.append(np.asarray(image, np.uint8))
        if not self.images:
            raise InputError(f"photos {folder}: no readable photograph (jpg, png or tif)")
        h = min(i.shape[0] for i in self.images)
        w = min(i.shape[1] for i in self.images)
        mean = float(np.mean([i.mean() for i in self.images]))
        self.size = (w, h)
        self.images = [
            np.asarray(cv2.convertScaleAbs(i[:h, :w], alpha=mean / max(float(i.mean()), 1.0)))
            for i in self.images
        ]

    def get(self, index: int) -> U8:
        return self.images[index % len(self.images)]


def _ramp(length: int, fade: int) -> F32:
    """(length,) weight that rises over the first ``fade`` entries."""
    return np.minimum(1.0, (np.arange(length, dtype=np.float32) + 0.5) / max(fade, 1))


def _lay(out: U8, photo: U8, x: int, y: int) -> None:
    """Put a photograph with its corner at (x, y), fading in over what lies there."""
    h, w = min(photo.shape[0], out.shape[0] - y), min(photo.shape[1], out.shape[1] - x)
    fade_x = int(FEATHER * photo.shape[1]) if x else 0
    fade_y = int(FEATHER * photo.shape[0]) if y else 0
    weight = _ramp(h, fade_y)[:, None] * _ramp(w, fade_x)[None, :]
    there = out[y : y + h, x : x + w]
    mixed = there + weight[..., None] * (photo[:h, :w].astype(np.float32) - there)
    out[y : y + h, x : x + w] = np.round(mixed)
