"""The files of a scan that has ended, written on a thread of their own.

They take half a minute after a flight of five; a flight that begins meanwhile need not wait for
them. What is stored is safe by then, and the next start writes what this one could not.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.component.control import ACCEPTED, Answer, Result, Work
from service.compute.threading_layer import kernels_may_overlap
from service.errors import OutsideError
from service.workers import PROCESS, guarded

if TYPE_CHECKING:
    from service.stream.store import ScanStore

OTHERS = ("scan.db", "link.tlog")


class Writing:
    """Writes a finished scan's files, from its making on."""

    def __init__(self, folder: Path, store: ScanStore, left: Callable[[Writing], None]) -> None:
        """Whoever waits for the end closes the ``store``; where nobody does, because of
        :meth:`leave`, it is closed here and ``left`` is called.
        """
        self.name = folder.name
        self.fault = ""  # why the files are not written; empty when they are
        self.work: Work | None = None  # that ends with the files
        self._folder, self._store = folder, store
        self._lock, self._done = threading.Lock(), threading.Event()
        self._left, self._is_left = left, False
        self._worker = PROCESS.start("files", lambda _: self._write())

    def wait(self, seconds: float) -> bool:
        """True when it is done, well or not."""
        return self._done.wait(seconds)

    def leave(self, hand_over: Callable[[], Work | None]) -> bool:
        """Wait for it no longer, and take over the work that ``hand_over`` gives. False when it
        is done already, and nothing of that happens.
        """
        with self._lock:
            if self._done.is_set():
                return False
            self.work = hand_over()
            self._is_left = True
            return True

    def marks(self) -> tuple[Any, ...]:
        """What changes when it gets on: uses of the store, bytes of files."""
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
    """All files that are being written, of the last scan and of those before it."""

    def __init__(self, report: Callable[[str], None]) -> None:
        """``report`` gets what the operator should know of files that no scan waited for."""
        self._report = report
        self._all: list[Writing] = []

    def __len__(self) -> int:
        return len(self._all)

    @property
    def names(self) -> set[str]:
        """Of the scans."""
        return {writing.name for writing in tuple(self._all)}

    def marks(self) -> tuple[Any, ...]:
        """What changes when one of them gets on."""
        return tuple(writing.marks() for writing in tuple(self._all))

    def wait(self, seconds: float) -> None:
        """Until the oldest is done, but no longer."""
        for writing in tuple(self._all)[:1]:
            writing.wait(seconds)

    def write(
        self, folder: Path, store: ScanStore, in_haste: Callable[[], bool],
        land: Callable[[], None], hand_over: Callable[[], Work | None],
    ) -> None:  # fmt: skip
        """Write a scan's files, then ``land`` its sender and close its store.

        While ``in_haste`` says that another scan is wanted, and kernels may run on two threads at
        once, no scan waits for the files: ``hand_over`` ends the sender, and the work that it
        gives is finished with the files. Raises OutsideError when they cannot be written.
        """
        writing = Writing(folder, store, self._written)
        self._all.append(writing)
        while not writing.wait(0.1):
            if in_haste() and kernels_may_overlap() and writing.leave(hand_over):
                return
        self._all.remove(writing)
        land()
        store.close()
        if writing.fault:
            raise OutsideError(writing.fault)

    def _written(self, writing: Writing) -> None:
        """The files are there that no scan waited for, or never will be in this life."""
        self._all.remove(writing)
        answer = ACCEPTED
        if writing.fault:
            self._report(f"Scan {writing.name} is kept, its files are not written: {writing.fault}")
            answer = Answer(Result.FAILED, writing.fault)
        if writing.work is not None:
            writing.work.finish(answer)


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
