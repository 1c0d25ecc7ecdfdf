"""The odometry's landmarks: points with lasting numbers, the oldest forgotten."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.types import F64, Bool

I64 = npt.NDArray[np.int64]


class Landmarks:
    """Points (x, y, z) of one segment by number; a dropped point is NaN.

    Numbers only grow; :meth:`forget_before` frees those that no keyframe refers to.
    """

    def __init__(self) -> None:
        self._xyz = np.full((1024, 3), np.nan)
        self._first = 0
        self._end = 0

    def __len__(self) -> int:
        """How many are held, dropped ones included."""
        return self._end - self._first

    def add(self, points: F64) -> I64:
        """Enter points (N, 3); returns their (N,) numbers."""
        need = len(self) + len(points)
        if need > len(self._xyz):
            grown = np.full((2 * need, 3), np.nan)
            grown[: len(self)] = self._xyz[: len(self)]
            self._xyz = grown
        self._xyz[len(self) : need] = points
        numbers = np.arange(self._end, self._end + len(points), dtype=np.int64)
        self._end += len(points)
        return numbers

    def __getitem__(self, numbers: I64) -> F64:
        """(N, 3) points of the (N,) numbers."""
        return np.asarray(self._xyz[numbers - self._first])

    def __setitem__(self, numbers: I64, points: F64 | float) -> None:
        self._xyz[numbers - self._first] = points

    def known(self, numbers: I64) -> Bool:
        """(N,) True for numbers (-1: none) whose point is held and not dropped."""
        held = numbers >= self._first
        out = np.zeros(len(numbers), np.bool_)
        out[held] = np.isfinite(self._xyz[numbers[held] - self._first, 0])
        return out

    def scale_about(self, origin: F64, factor: float) -> None:
        """Stretch all points away from ``origin`` (3,) by ``factor``."""
        self._xyz = origin + (self._xyz - origin) * factor

    def forget_before(self, number: int) -> None:
        """Free all points with smaller numbers."""
        gone = min(number, self._end) - self._first
        if gone > 0:
            kept = self._xyz[gone : len(self)].copy()
            self._xyz[: len(kept)] = kept
            self._xyz[len(kept) :] = np.nan
            self._first += gone
