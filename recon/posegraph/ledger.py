"""Rows of one kind, in the order of a number: appended, read and amended by their place."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.types import I64

Rows = npt.NDArray[Any]
"""(N,) of a structured type whose first field is ``seq``."""


class Ledger:
    """Rows that grow in number; ``seq`` grows from row to row."""

    def __init__(self, kind: np.dtype[Any]) -> None:
        self._rows = np.zeros(64, kind)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, rows: Rows) -> None:
        """Put rows after the last one."""
        while self._count + len(rows) > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count : self._count + len(rows)] = rows
        self._count += len(rows)

    def read(self, first: int, end: int) -> Rows:
        """A copy of the rows from ``first`` up to ``end``."""
        return np.array(self._rows[first : min(end, self._count)])

    def pick(self, places: I64) -> Rows:
        """A copy of the rows at these places (N,)."""
        return self._rows[places]

    def amend(self, first: int, rows: Rows) -> None:
        """Write over rows from ``first`` on."""
        self._rows[first : first + len(rows)] = rows
