"""How far one picture is displaced from another, patch by patch."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from recon.types import F32, F64, Bool

LEAST_KNOWN = 0.9
LEAST_LIKENESS = 0.5
LEAST_CONTRAST = 1.5
BROAD_PX = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class PatchShifts:
    """Where patches of a picture lie, against the same patches of the other."""

    middle_px: F64  # (N, 2) column and row
    shift_px: F64  # (N, 2) column and row: where the content is, less where it should be
    likeness: F64  # (N,) normalised correlation at that shift
    tried: int  # patches that are known and have texture

    @property
    def matched_share(self) -> float:
        """Share of the patches tried whose shift is known."""
        return len(self.likeness) / self.tried if self.tried else 0.0


def patch_shifts(
    found: F32, truth: F32, known: Bool, reach_px: int, patch_px: int = 64
) -> PatchShifts:
    """The displacement of ``found`` against ``truth``, (H, W) each, in patches half overlapping.

    Normalised cross-correlation over shifts of up to ``reach_px``, with a parabola through the
    peak. Shading broader than BROAD_PX is taken out of both first. A patch is tried where
    ``known`` holds nearly everywhere and the truth has texture; a peak at the end of the reach
    or below LEAST_LIKENESS is no match. Raises ValueError when the sizes differ.
    """
    if found.shape != truth.shape or found.shape != known.shape or found.ndim != 2:
        raise ValueError(f"sizes differ: {found.shape}, {truth.shape}, {known.shape}")
    a, b = (_fine(picture, known) for picture in (found, truth))
    rows, cols = known.shape
    middles, shifts, likenesses, tried = [], [], [], 0
    for top in range(reach_px, rows - patch_px - reach_px + 1, patch_px // 2):
        for left in range(reach_px, cols - patch_px - reach_px + 1, patch_px // 2):
            patch = np.s_[top : top + patch_px, left : left + patch_px]
            if known[patch].mean() < LEAST_KNOWN or b[patch].std() < LEAST_CONTRAST:
                continue
            tried += 1
            around = b[
                top - reach_px : top + patch_px + reach_px,
                left - reach_px : left + patch_px + reach_px,
            ]
            surface = cv2.matchTemplate(around, a[patch], cv2.TM_CCOEFF_NORMED)
            likeness, shift = _peak(np.asarray(surface, np.float32))
            if likeness >= LEAST_LIKENESS and np.isfinite(shift).all():
                middles.append([left + 0.5 * (patch_px - 1), top + 0.5 * (patch_px - 1)])
                shifts.append(reach_px - shift)
                likenesses.append(likeness)
    return PatchShifts(
        np.array(middles, np.float64).reshape(-1, 2),
        np.array(shifts, np.float64).reshape(-1, 2),
        np.array(likenesses, np.float64),
        tried,
    )


def _fine(picture: F32, known: Bool) -> F32:
    """The picture without its broad shading; zero where it is not known."""
    weight = known.astype(np.float32)
    values = np.where(known, picture, 0.0).astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(weight, (0, 0), BROAD_PX), 1e-3)
    mean = cv2.GaussianBlur(values, (0, 0), BROAD_PX) / share
    return np.asarray(np.where(known, values - mean, 0.0), np.float32)


def _peak(surface: F32) -> tuple[float, F64]:
    """(height, (column, row)) of the highest place; NaN at the border, where none was found."""
    row, col = np.unravel_index(int(surface.argmax()), surface.shape)
    height = float(surface[row, col])
    if not (0 < row < surface.shape[0] - 1 and 0 < col < surface.shape[1] - 1):
        return height, np.full(2, np.nan)
    du = _vertex(surface[row, col - 1 : col + 2])
    dv = _vertex(surface[row - 1 : row + 2, col])
    return height, np.array([col + du, row + dv])


def _vertex(three: F32) -> float:
    """Where the parabola through three equidistant heights has its top, from the middle one."""
    left, middle, right = (float(v) for v in three)
    bend = left - 2.0 * middle + right
    return 0.0 if bend >= 0.0 else float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))
