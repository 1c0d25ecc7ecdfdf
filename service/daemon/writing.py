"""Writes the files of a finished scan, on a separate thread.

They take half a minute after a flight of five minutes; a flight that begins meanwhile does not wait
for them. The stored data is safe by then, and the next start writes files that are missing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.component.control import ACCEPTED, Answer, Result, Work
from service.errors import OutsideError
from service.workers import PROCESS, guarded

if TYPE_CHECKING:
    from service.stream.store import ScanStore

OTHERS = ("scan.db", "link.tlog")


class Writing:
    """Writes a finished scan's files, starting when it is created."""

    def __init__(self, folder: Path, store: ScanStore, left: Callable[[Writing], None]) -> None:
        """The thread that waits for the end closes the ``store``; after :meth:`leave` none waits,
        so the store is closed here and ``left`` is called.
        """
        self.name = folder.name
        self.fault = ""  # why the files are not written; empty when they are
        self.work: Work | None = None  # work that ends with the files
        self._folder, self._store = folder, store
        self._lock, self._done = threading.Lock(), threading.Event()
        self._left, self._is_left = left, False
        self._worker = PROCESS.start("files", lambda _: self._write())

    def wait(self, seconds: float) -> bool:
        """True when it has ended, successfully or not."""
        return self._done.wait(seconds)

    def leave(self, hand_over: Callable[[], Work | None]) -> bool:
        """Stop waiting, and take over the work that ``hand_over`` returns. False, without any
        effect, when the files are written already.
        """
        with self._lock:
            if self._done.is_set():
                return False
            self.work = hand_over()
            self._is_left = True
            return True

    def marks(self) -> tuple[Any, ...]:
        """Values that change when it makes progress: uses of the store, bytes of files."""
        return (self._store.uses(self._worker.thread_id), sizes(self._folder))

    def _write(self) -> None:
        from service.scans.folder import write_deliverables

        write = partial(write_deliverables, self._folder, self._store, {})
        self.fault = guarded(f"files of {self.name}", write)
        with self._lock:
            self._done.set()
        if self._is_left:
            self._store.close()
            self._left(self)


class Writings:
    """All files being written, of the last scan and of those before it."""

    def __init__(self, report: Callable[[str], None]) -> None:
        """``report`` gets messages for the operator about files that no scan waited for."""
        self._report = report
        self._all: list[Writing] = []

    def __len__(self) -> int:
        return len(self._all)

    @property
    def names(self) -> set[str]:
        """Names of the scans."""
        return {writing.name for writing in tuple(self._all)}

    def marks(self) -> tuple[Any, ...]:
        """Values that change when one of them makes progress."""
        return tuple(writing.marks() for writing in tuple(self._all))

    def wait(self, seconds: float) -> None:
        """Wait for the oldest, at most this long."""
        for writing in tuple(self._all)[:1]:
            writing.wait(seconds)

    def write(
        self, folder: Path, store: ScanStore, in_haste: Callable[[], bool],
        land: Callable[[], None], hand_over: Callable[[], Work | None],
    ) -> None:  # fmt: skip
        """Write a scan's files, then ``land`` its sender and close its store.

        While ``in_haste`` reports that another scan is wanted, no scan waits for the files:
        ``hand_over`` ends the sender, and the work that it returns is finished with the files.
        Raises OutsideError when they cannot be written.
        """
        writing = Writing(folder, store, self._written)
        self._all.append(writing)
        while not writing.wait(0.1):
            if in_haste() and writing.leave(hand_over):
                return
        self._all.remove(writing)
        land()
        store.close()
        if writing.fault:
            raise OutsideError(writing.fault)

    def _written(self, writing: Writing) -> None:
        """Finish files that no scan waited for, or report that they failed."""
        self._all.remove(writing)
        answer = ACCEPTED
        if writing.fault:
            self._report(
                f"Scan {writing.name} is stored, its files are not written: {writing.fault}"
            )
            answer = Answer(Result.FAILED, writing.fault)
        if writing.work is not None:
            writing.work.finish(answer)


class ClosingWatch:
    """Measures how long the values of :func:`marks` have not changed; call :meth:`look` often."""

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

    The store and the link's log are left out, because others write them too.
    """
    found = []
    try:
        for path in folder.iterdir():
            if not path.name.startswith(OTHERS):
                found.append((path.name, path.stat().st_size))
    except OSError:
        pass  # it is not there yet, or a file was renamed meanwhile
    return tuple(sorted(found))
