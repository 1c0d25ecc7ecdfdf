"""Keyframes for the benchmarks: relief, houses and texture as nature has them, from a seed."""

from __future__ import annotations

import cv2
import numpy as np

from recon import se3
from recon.types import F64, Bool, DepthMap, Keyframe, Pose

ALTITUDE_M = 72.0
WHITE_NOISE_M = 0.02
CORRELATED_NOISE_M = 0.08
OVERLAP = 0.8


def natural(h: int, w: int, slope: float, seed: int) -> F64:
    """(h, w) image of unit variance whose amplitude falls with frequency to ``-slope``."""
    rng = np.random.default_rng(seed)
    fy = np.fft.fftfreq(h)[:, None] * h
    fx = np.fft.rfftfreq(w)[None, :] * w
    amplitude = 1.0 / np.maximum(np.hypot(fx, fy), 1.0) ** slope
    spectrum = np.fft.rfft2(rng.normal(size=(h, w))) * amplitude
    image = np.fft.irfft2(spectrum, (h, w))
    return np.asarray((image - image.mean()) / image.std())


def make_keyframe(
    seq: int = 0, size_px: tuple[int, int] = (320, 180), fresh: Bool | None = None, seed: int = 1
) -> Keyframe:
    """A nadir keyframe with depths from about 50 to 95 m; noise 2 cm white, 8 cm correlated. At
    320x180 the image makes about 14 KB of JPEG at quality 80, as aerial photographs do."""
    w, h = size_px
    rng = np.random.default_rng(seed + 1000 * seq)
    ground = 8.0 * natural(h, w, 2.2, seed)
    u, v = np.meshgrid(np.arange(w) / w, np.arange(h) / h)
    houses = np.zeros((h, w))
    for x, y, height in rng.uniform((0.05, 0.05, 4), (0.85, 0.8, 14), (6, 3)):
        houses[(u > x) & (u < x + 0.1) & (v > y) & (v < y + 0.15)] = height
    blurred = np.asarray(cv2.GaussianBlur(rng.normal(size=(h, w)), (0, 0), 5.0 * w / 320), float)
    correlated = blurred * (CORRELATED_NOISE_M / blurred.std())
    depth = ALTITUDE_M - ground - houses + correlated + WHITE_NOISE_M * rng.normal(size=(h, w))
    luma = 120 + 45 * natural(h, w, 1.45, seed + 3)
    chroma = [12 * natural(h, w, 1.6, seed + 4 + k) for k in range(3)]
    bgr = np.clip(np.stack([luma + c for c in chroma], axis=-1), 0, 255).astype(np.uint8)
    views = np.clip(np.rint(4 + 2 * natural(h, w, 2.0, seed + 11)), 1, 9).astype(np.uint8)
    sigma = 0.003 * depth * np.exp(0.2 * natural(h, w, 1.5, seed + 12))
    K = np.array([[0.8 * w, 0, w / 2 - 0.5], [0, 0.8 * w, h / 2 - 0.5], [0, 0, 1]])
    T = se3.compose(np.diag([1.0, -1.0, -1.0]), np.array([10.0 * seq, 0.0, ALTITUDE_M]))
    return Keyframe(
        seq,
        0,
        DepthMap(depth.astype(np.float32), sigma.astype(np.float32), views, K, T),
        bgr,
        Pose(T, np.eye(6) * 1e-4, ("vision",)),
        np.ones((h, w), np.bool_) if fresh is None else fresh,
    )


def strip(size_px: tuple[int, int], seed: int = 1) -> Bool:
    """(h, w) new surface at 80 % overlap: a ragged strip along the leading edge, and specks of
    better surface elsewhere."""
    w, h = size_px
    edge = (1 - OVERLAP) * h + 4 * natural(1, w, 1.5, seed)[0]
    new = np.arange(h)[:, None] < edge[None, :]
    return np.asarray(new | (natural(h, w, 1.5, seed + 1) > 2.2))
