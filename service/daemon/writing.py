"""Writes the files of a finished scan, on a separate thread.

They take half a minute after a flight of five minutes; a flight that begins meanwhile does not wait
for them. The stored data is safe by then, and the next start writes files that are missing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.component.control import ACCEPTED, Answer, Result, Work
from service.errors import OutsideError
from service.workers import PROCESS, Worker, guarded

if TYPE_CHECKING:
    from service.stream.store import ScanStore

OTHERS = ("scan.db", "link.tlog")


@dataclass(slots=True, eq=False)
class _Writing:
    """One scan's files that are being written."""

    folder: Path
    store: ScanStore
    worker: Worker | None = None
    done: threading.Event = field(default_factory=threading.Event)  # successfully or not
    fault: str = ""  # why the files are not written; empty when they are
    is_left: bool = False  # no scan waits: the thread that writes does what is left to do
    work: Work | None = None  # then ends with the files


class Writings:
    """All files being written, of the last scan and of those before it."""

    def __init__(
        self,
        report: Callable[[str], None],
        write: Callable[[Path, ScanStore, Any], object] | None = None,
    ) -> None:
        """``report`` gets messages for the operator about files that no scan waited for;
        ``write`` writes a scan's files (default: its deliverables)."""
        self._report, self._write_files = report, write
        self._all: list[_Writing] = []
        self._lock = threading.Lock()  # between the end of writing and the end of waiting

    def __len__(self) -> int:
        return len(self._all)

    @property
    def names(self) -> set[str]:
        return {writing.folder.name for writing in tuple(self._all)}

    def marks(self) -> tuple[Any, ...]:
        """Values that change when one of them makes progress: uses of the store, bytes of files."""
        return tuple(
            (one.worker and one.store.database.uses[one.worker.thread_id], sizes(one.folder))
            for one in tuple(self._all)
        )

    def wait(self, seconds: float) -> None:
        """Wait for the oldest, at most this long."""
        for writing in tuple(self._all)[:1]:
            writing.done.wait(seconds)

    def write(
        self, folder: Path, store: ScanStore, is_next_wanted: Callable[[], bool],
        end_sender: Callable[[], None], hand_over: Callable[[], Work | None],
    ) -> None:  # fmt: skip
        """Write a scan's files, then ``end_sender`` and close its store.

        While ``is_next_wanted`` reports that another scan is wanted, no scan waits for the files:
        ``hand_over`` ends the sender, and the work that it returns is finished with the files.
        Raises OutsideError when they cannot be written.
        """
        writing = _Writing(folder, store)
        self._all.append(writing)
        writing.worker = PROCESS.start("files", lambda _: self._write(writing))
        while not writing.done.wait(0.1):
            if is_next_wanted():
                with self._lock:
                    if not writing.done.is_set():
                        writing.work, writing.is_left = hand_over(), True
                        return
        self._all.remove(writing)
        end_sender()
        store.close()
        if writing.fault:
            raise OutsideError(writing.fault)

    def _write(self, writing: _Writing) -> None:
        from service.scans.folder import write_deliverables

        name = writing.folder.name
        write = partial(self._write_files or write_deliverables, writing.folder, writing.store, {})
        writing.fault = guarded(f"files of {name}", write)
        with self._lock:
            writing.done.set()
        if not writing.is_left:
            return
        writing.store.close()
        self._all.remove(writing)
        answer = ACCEPTED
        if writing.fault:
            self._report(f"Scan {name} is stored, its files are not written: {writing.fault}")
            answer = Answer(Result.FAILED, writing.fault)
        if writing.work is not None:
            writing.work.finish(answer)


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
