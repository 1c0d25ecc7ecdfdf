"""A table that grows: structured rows in one array, so that all of them are computed at once."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Rows = npt.NDArray[Any]
"""(N,) of a structured type."""


class Table:
    """Rows of one structured type, in the order in which they came."""

    def __init__(self, kind: np.dtype[Any]) -> None:
        self._array = np.zeros(64, kind)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Rows:
        """(N,) all rows, to be read and changed in place until the next one is appended."""
        return self._array[: self._count]

    def append(self, rows: Rows) -> None:
        while self._count + len(rows) > len(self._array):
            self._array = np.concatenate([self._array, np.zeros_like(self._array)])
        self._array[self._count : self._count + len(rows)] = rows
        self._count += len(rows)
