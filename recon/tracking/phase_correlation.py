"""The similarity between two overlapping pictures of the ground, with no prior knowledge.

Phase correlation (Kuglin and Hines 1975) of image b with image a turned and scaled in steps;
the sharpest peak wins, and how far it stands above the best of all other turns says how much
to trust it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.fft

from recon.types import F32, F64, U8

_WIDTH_PX = 160
_TURNS = 60  # 6 degrees apart


@dataclass(frozen=True, slots=True, eq=False)
class GlobalShift:
    """A similarity that takes pixels of image a to image b: ``uv_b = A uv_a + shift``."""

    A: F64  # (2, 2) scale times rotation; also the warp of a patch
    shift_px: F64  # (2,)
    rotation_rad: float  # of A, -pi to pi, positive from u (right) to v (down)
    scale: float
    confidence: float  # peak over the best peak of other turns; above 1.4 it can be relied on

    def apply(self, uv_px: F64) -> F64:
        """(N, 2) pixels of image b for the pixels ``uv_px`` (N, 2) of image a."""
        return np.asarray(uv_px @ self.A.T + self.shift_px)


class _Correlator:
    """Image b held as a spectrum, to be compared with many turned copies of image a."""

    def __init__(self, a: F32, b: F32) -> None:
        self.a, self.shape = a, a.shape
        h, w = a.shape
        self.window = np.outer(_taper(h), _taper(w)).astype(np.float32)
        fy = np.fft.fftfreq(h)[:, None]
        fx = np.fft.rfftfreq(w)[None, :]
        f2 = fx**2 + fy**2
        # Low frequencies carry shading, high ones what a turn between two steps smears.
        self.band = (np.exp(-f2 / (2 * 0.15**2)) * (1 - np.exp(-f2 / (2 * 0.02**2)))).astype(
            np.float32
        )
        self.spectrum_b = np.conj(scipy.fft.rfft2(self._flat(b)))

    def _flat(self, image: F32) -> F32:
        return np.asarray((image - image.mean()) * self.window, dtype=np.float32)

    def matrix(self, angle_rad: float, scale: float) -> F64:
        """(2, 3) map of a onto its copy turned by ``angle_rad`` about the centre."""
        h, w = self.shape
        centre = np.array([(w - 1) / 2, (h - 1) / 2])
        c, s = scale * np.cos(angle_rad), scale * np.sin(angle_rad)
        A = np.array([[c, -s], [s, c]])
        return np.column_stack([A, centre - A @ centre])

    def peaks(self, angles_rad: F64, scales: F64) -> tuple[F64, F64]:
        """Heights (k,) and places (k, 2) of the correlation peaks of k turned copies."""
        h, w = self.shape
        stack = np.empty((len(angles_rad), h, w), np.float32)
        mean = float(self.a.mean())
        for i, (angle, scale) in enumerate(zip(angles_rad, scales, strict=True)):
            turned = cv2.warpAffine(
                self.a, self.matrix(angle, scale), (w, h), borderValue=(mean,) * 4
            )
            stack[i] = self._flat(np.asarray(turned, np.float32))
        cross = np.conj(scipy.fft.rfft2(stack, workers=2)) * np.conj(self.spectrum_b)
        cross *= self.band / (np.abs(cross) + 1e-6)
        surface = scipy.fft.irfft2(cross, s=(h, w), workers=2)
        flat = surface.reshape(len(surface), -1)
        at = flat.argmax(axis=1)
        y, x = np.divmod(at, w)
        places = np.array(
            [_subpixel(s, int(i), int(j)) for s, i, j in zip(surface, y, x, strict=True)]
        )
        return flat[np.arange(len(flat)), at].astype(np.float64), places


def _subpixel(surface: F32, y: int, x: int) -> tuple[float, float]:
    """Place (u, v) of the peak by a parabola each way, wrapped to about zero."""
    h, w = surface.shape
    du = _vertex(surface[y, x - 1], surface[y, x], surface[y, (x + 1) % w])
    dv = _vertex(surface[y - 1, x], surface[y, x], surface[(y + 1) % h, x])
    return (x + du + w / 2) % w - w / 2, (y + dv + h / 2) % h - h / 2


def _vertex(left: float, middle: float, right: float) -> float:
    bend = float(left) - 2 * float(middle) + float(right)
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))


def global_shift(gray_a: U8, gray_b: U8) -> GlobalShift:
    """The turn, scale and shift between two overlapping nadir pictures.

    Both (H, W) uint8 of one size. Any turn; shifts up to about a third of the picture; scales
    0.95 to 1.05, and 0.85 to 1.2 where the ground has coarse structure. Accuracy is about 1 %
    of the width: a start for :func:`recon.tracking.matching.match`. Pictures without texture give
    no motion with confidence 0. Raises ValueError when the pictures differ in size.
    """
    if gray_a.shape != gray_b.shape or gray_a.ndim != 2:
        raise ValueError(f"pictures must be (H, W) of one size, got {gray_a.shape}, {gray_b.shape}")
    H, W = gray_a.shape
    size = (_WIDTH_PX, max(16, round(_WIDTH_PX * H / W)))
    small_a, small_b = (
        cv2.resize(g, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for g in (gray_a, gray_b)
    )
    if min(float(small_a.std()), float(small_b.std())) < 1.0:
        return GlobalShift(np.eye(2), np.zeros(2), 0.0, 1.0, 0.0)
    correlator = _Correlator(small_a, small_b)
    turns = np.linspace(0.0, 2 * np.pi, _TURNS, endpoint=False)
    heights, _ = correlator.peaks(turns, np.ones(_TURNS))
    best = int(heights.argmax())
    apart = np.abs((np.arange(_TURNS) - best + _TURNS // 2) % _TURNS - _TURNS // 2) > 2
    fine = np.asarray(turns[best] + np.radians(np.linspace(-6.0, 6.0, 9)), np.float64)
    scales = np.array([0.8, 0.87, 0.93, 1.0, 1.075, 1.15, 1.25])
    angle_grid, scale_grid = np.tile(fine, len(scales)), np.repeat(scales, len(fine))
    fine_heights, places = correlator.peaks(angle_grid, scale_grid)
    k = int(fine_heights.argmax())
    confidence = float(fine_heights[k] / max(float(heights[apart].max()), 1e-9))
    M = correlator.matrix(float(angle_grid[k]), float(scale_grid[k]))
    return _at_full_size(M[:, :2], M[:, 2] + places[k], W / size[0], H / size[1], confidence)


def _at_full_size(A: F64, shift: F64, sx: float, sy: float, confidence: float) -> GlobalShift:
    S = np.diag([sx, sy])
    offset = 0.5 * np.array([sx - 1, sy - 1])  # pixel centres are at integers
    full = S @ A @ np.linalg.inv(S)
    scale = float(np.sqrt(abs(np.linalg.det(full))))
    rotation = float(np.arctan2(full[1, 0] - full[0, 1], full[0, 0] + full[1, 1]))
    return GlobalShift(full, S @ shift + offset - full @ offset, rotation, scale, confidence)


def _taper(n: int) -> F64:
    """(n,) window that is flat but for a quarter at each end, so that far shifts still overlap."""
    edge = np.minimum(np.arange(n), np.arange(n)[::-1]) + 0.5
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.minimum(edge / (0.25 * n), 1.0)))
