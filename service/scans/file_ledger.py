"""A ledger on disk, in an unnamed file that disappears with the process."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from recon.posegraph.ledger import Rows
from service.errors import OutsideError


class FileLedger:
    """A :class:`recon.posegraph.ledger.Ledger` on disk; OutsideError when the disk is full."""

    def __init__(self, kind: np.dtype[Any], folder: Path) -> None:
        self._kind, self._count = kind, 0
        self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115

    def __len__(self) -> int:
        return self._count

    def append(self, rows: Rows) -> None:
        """Append rows."""
        self.amend(self._count, rows)
        self._count += len(rows)

    def read(self, first: int, end: int) -> Rows:
        """A copy of the rows from ``first`` up to ``end``."""
        size = self._kind.itemsize
        count = max(min(end, self._count) - first, 0)
        data = os.pread(self._file.fileno(), count * size, first * size)
        return np.array(np.frombuffer(data, self._kind))

    def amend(self, first: int, rows: Rows) -> None:
        """Overwrite rows from ``first`` on."""
        data = rows.astype(self._kind, copy=False).tobytes()
        try:
            written = os.pwrite(self._file.fileno(), data, first * self._kind.itemsize)
        except OSError as error:
            raise OutsideError(f"poses cannot be stored with the scan: {error.strerror}") from error
        if written < len(data):
            raise OutsideError("poses cannot be stored with the scan: the disk is full")

    def close(self) -> None:
        """Close the file."""
        self._file.close()
