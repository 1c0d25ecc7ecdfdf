"""A scan that is being received: its state, its deliverables, and which are yet to be written.

A marker file in the scan's folder shows that it grew since its files were written. It is renamed
while they are written and deleted afterwards, so a kill at any time leaves one of the two names.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from service.errors import InputError
from service.ground.intake import ScanIntake
from service.ground.storage import is_regular, scan_files
from service.scans.folder import write_deliverables
from service.scans.writing import files_due
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

MARK, BEGUN = ".files-due", ".files-begun"


def mark_due(folder: Path) -> None:
    try:
        (folder / MARK).touch()
    except OSError as error:  # a full disk is reported where the scan itself is written
        log.debug("%s: %s", folder, error)


def begin_files(folder: Path) -> None:
    """Note that its files are being written; later arrivals mark it again."""
    try:
        (folder / MARK).replace(folder / BEGUN)
    except OSError as error:
        log.debug("%s: %s", folder, error)


def end_files(folder: Path) -> None:
    """Writing has ended; the mark stays where the disk refused a file."""
    if not files_due(folder):
        (folder / BEGUN).unlink(missing_ok=True)


def folders_due(store: Path) -> list[Path]:
    """The folders with files yet to be written, those of the newest scans first."""
    found = {path.parent for name in (MARK, BEGUN) for path in scan_files(store, name)}
    sound = [folder for folder in found if is_regular(folder / "scan.db")]
    return sorted(sound, key=lambda folder: folder.name, reverse=True)


def write_left(folder: Path) -> None:
    """Write the files that a former process could not; its errors are passed on."""
    begin_files(folder)
    with ScanStore.open(folder / "scan.db") as store:
        write_deliverables(folder, store, {})
    end_files(folder)
    log.info("%s: files written that a former process had left", folder)


@dataclass(slots=True, eq=False)
class ReceivedScan:
    """One open scan of one drone; used by the drone's worker alone."""

    drone: str
    name: str  # on the datalink
    folder: Path
    intake: ScanIntake
    reported_at: float = -1e9
    used_at: float = 0.0
    changed: bool = True  # since the last report
    unwritten: bool = False  # since the last deliverables
    rest_until: float = 0.0
    write_at: float = 0.0  # deliverables, not before
    is_writing: bool = False
    is_written: bool = False
    radio_messages: int = 0
    trouble: str = ""  # why it does not grow, or has no deliverables

    def grew(self) -> None:
        """Something new was stored: its files are due, also for the next process."""
        if not self.unwritten:
            mark_due(self.folder)
        self.changed = self.unwritten = True

    @property
    def may_close(self) -> bool:
        """Whether nothing would be lost by closing it."""
        return not self.unwritten and not self.is_writing

    def progress(self) -> dict[str, Any]:
        """Items held and missing, bytes, lags and folder, for people and for JSON."""
        intake = self.intake
        held = intake.store.numbers()
        lags = {
            kind: round(median(lags), 3)
            for kind, lags in intake.lag_s.items()
            if lags and kind.startswith("k")
        }
        return {
            "drone": self.drone,
            "scan": self.folder.name,
            "folder": str(self.folder),
            "open": True,
            "held": {kind: len(numbers) for kind, numbers in held.items()},
            "missing": {kind: len(n) for kind, n in intake.missing().items()},
            "finished": "summary" in held,
            "complete": intake.complete and self.is_written and not self.is_writing,
            "received_bytes": intake.received_bytes,
            "duplicates": intake.duplicates,
            "unsound": intake.unsound,
            "refused": intake.store.refused,
            "radio_messages": self.radio_messages,
            "lag_s": lags,
            "heard_unix_s": round(time.time() - (time.monotonic() - self.used_at), 1),
            "trouble": self.trouble or None,
        }


def deliver(scan: ReceivedScan) -> None:
    """Write the scan's deliverables next to its database.

    Raises InputError that names those which could not be made, OutsideError for the disk.
    """
    failed = write_deliverables(scan.folder, scan.intake.store, {})["failed"]
    if failed:
        why = "; ".join(f"{name} ({reason})" for name, reason in failed.items())
        raise InputError(f"some could not be made: {why}")
