"""A scan that is being received: its state, and its deliverables."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from service.errors import InputError
from service.ground import files_due
from service.ground.intake import ScanIntake
from service.stream.naming import ROOT

log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class ReceivedScan:
    """One open scan of one drone; used by the drone's worker alone.

    The writer of deliverables sets ``is_written`` and ``is_writing``, and ``trouble`` when it
    fails.
    """

    drone: str
    name: str  # on the datalink
    folder: Path
    intake: ScanIntake
    reported_at: float = -1e9
    used_at: float = 0.0
    changed: bool = True  # since the last report
    unwritten: bool = False  # since the last deliverables
    rest_until: float = 0.0
    is_writing: bool = False
    is_written: bool = False
    radio_messages: int = 0
    trouble: str = ""  # why it does not grow, or has no deliverables

    @property
    def key(self) -> str:
        """Where its messages are."""
        return f"{ROOT}/{self.drone}/{self.name}"

    def grew(self) -> None:
        """Something new was stored: its files are due, also for the next process."""
        if not self.unwritten:
            files_due.mark(self.folder)
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
            for kind, lags in intake.progress.lag_s.items()
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
            "received_bytes": intake.progress.received_bytes,
            "duplicates": intake.progress.duplicates,
            "unsound": intake.progress.unsound,
            "refused": intake.store.refused,
            "radio_messages": self.radio_messages,
            "lag_s": lags,
            "trouble": self.trouble or None,
        }


def deliver(scan: ReceivedScan) -> None:
    """Write the scan's deliverables next to its database.

    Raises InputError that names those which could not be made, OutsideError for the disk.
    """
    from service.scans.folder import write_deliverables

    failed = write_deliverables(scan.folder, scan.intake.store, {})["failed"]
    if failed:
        why = "; ".join(f"{name} ({reason})" for name, reason in failed.items())
        raise InputError(f"some could not be made: {why}")
