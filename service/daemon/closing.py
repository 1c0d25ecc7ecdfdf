"""Whether the closing of a scan gets on, or hangs.

Closing a long scan takes minutes on a small board, and no time can be told beforehand. What
can be told is whether anything happens: the store is read or written, a file grows, a keyframe
is done. Nothing else counts as progress.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

OTHERS = ("scan.db", "link.tlog")


class ClosingWatch:
    """Feed it what :func:`marks` gives, often; it tells for how long that has been the same."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._marks: tuple[Any, ...] | None = None
        self._since_s = 0.0

    def look(self, marks: tuple[Any, ...] | None) -> float:
        """Seconds without progress; 0 when nothing is being closed (``marks`` is None)."""
        now_s = self._clock()
        if marks is None or marks != self._marks:
            self._marks, self._since_s = marks, now_s
        return 0.0 if marks is None else now_s - self._since_s


def sizes(folder: Path) -> tuple[tuple[str, int], ...]:
    """Name and bytes of each file that closing writes into a scan's folder.

    The store and the link's log are left out: others write them, too.
    """
    found = []
    try:
        for path in folder.iterdir():
            if not path.name.startswith(OTHERS):
                found.append((path.name, path.stat().st_size))
    except OSError:
        pass  # it is not there yet, or a file was renamed meanwhile
    return tuple(sorted(found))
