"""A scan that is being received: the state of its files, and its figures."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from statistics import median
from typing import Any

from service.ground.due import FILES
from service.ground.intake import ScanIntake


class Files(Enum):
    """Those next to the database of an open scan."""

    WRITTEN = "written"
    DUE = "due"  # the scan grew
    BEGUN = "being written"
    BEHIND = "behind"  # being written, and the scan grew meanwhile
    REFUSED = "refused"  # by the disk


class Change(Enum):
    GREW = "grew"
    BEGIN = "begin"
    END = "end"
    REFUSE = "refuse"


TRANSITIONS: dict[Files, dict[Change, Files]] = {
    Files.WRITTEN: {Change.GREW: Files.DUE},
    Files.DUE: {Change.BEGIN: Files.BEGUN},
    Files.BEGUN: {
        Change.GREW: Files.BEHIND, Change.END: Files.WRITTEN, Change.REFUSE: Files.REFUSED
    },
    Files.BEHIND: {Change.END: Files.DUE, Change.REFUSE: Files.REFUSED},
    Files.REFUSED: {Change.BEGIN: Files.BEGUN},
}  # fmt: skip
"""The next state; a change that is not listed changes nothing."""


@dataclass(slots=True, eq=False)
class ReceivedScan:
    """One open scan of one drone; used by the drone's worker alone."""

    drone: str
    name: str  # on the datalink
    folder: Path
    intake: ScanIntake
    used_at: float
    files: Files = Files.WRITTEN
    write_at: float = 0.0  # its files, not before
    changed: bool = True  # since the last report
    reported_at: float = -1e9
    rest_until: float = 0.0
    radio_messages: int = 0
    trouble: str = ""  # why it does not grow, or has no deliverables

    def grew(self) -> None:
        """Something new was stored: its files are due, also for the next process."""
        if not self.is_due:
            FILES.mark(self.folder)
        self.changed = True
        self.note(Change.GREW)

    def note(self, change: Change) -> None:
        self.files = TRANSITIONS[self.files].get(change, self.files)

    @property
    def is_due(self) -> bool:
        """Its files lack something, also once those being written are."""
        return Change.GREW not in TRANSITIONS[self.files]

    @property
    def is_writing(self) -> bool:
        return Change.END in TRANSITIONS[self.files]

    def progress(self) -> dict[str, Any]:
        """Items held and missing, bytes, lags and folder, for people and for JSON."""
        intake = self.intake
        held = intake.store.numbers()
        return {
            "drone": self.drone,
            "scan": self.folder.name,
            "folder": str(self.folder),
            "open": True,
            "held": {kind: len(numbers) for kind, numbers in held.items()},
            "missing": {kind: len(n) for kind, n in intake.missing().items()},
            "finished": "summary" in held,
            "complete": intake.complete and self.files in (Files.WRITTEN, Files.REFUSED),
            "received_bytes": intake.received_bytes,
            "duplicates": intake.duplicates,
            "unsound": intake.unsound,
            "refused": intake.store.refused,
            "radio_messages": self.radio_messages,
            "lag_s": {
                kind: round(median(lags), 3)
                for kind, lags in intake.lag_s.items()
                if lags and kind.startswith("k")
            },
            "heard_unix_s": round(time.time() - (time.monotonic() - self.used_at), 1),
            "trouble": self.trouble or None,
        }
