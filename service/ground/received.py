"""A scan that is being received: what is known of it, and its deliverables."""

from __future__ import annotations

import logging
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from service.errors import InputError, SkyreliefError
from service.ground.intake import ScanIntake
from service.stream.naming import ROOT

log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class ReceivedScan:
    """One scan of one drone; used by the receiver's thread alone, but for :meth:`progress`."""

    drone: str
    name: str  # on the datalink
    folder: Path
    intake: ScanIntake
    reported_at: float = -1e9
    changed: bool = True  # since the last report
    unwritten: bool = False  # since the last deliverables
    rest_until: float = 0.0
    writing: Future[None] | None = None
    radio_messages: int = 0

    @property
    def key(self) -> str:
        """Where its messages are."""
        return f"{ROOT}/{self.drone}/{self.name}"

    @property
    def idle(self) -> bool:
        """True when its deliverables are not being written."""
        return self.writing is None or self.writing.done()

    def progress(self) -> dict[str, Any]:
        """Items held and missing, bytes, lags and folder, for people and for JSON."""
        intake = self.intake
        lags = {
            kind: round(median(lags), 3)
            for kind, lags in list(intake.progress.lag_s.items())
            if lags and kind.startswith("k")
        }
        return {
            "drone": self.drone,
            "scan": self.folder.name,
            "folder": str(self.folder),
            "held": {kind: len(n) for kind, n in intake.store.numbers().items()},
            "missing": {kind: len(n) for kind, n in intake.missing().items()},
            "finished": intake.store.finished,
            "complete": intake.complete and self.writing is not None and self.writing.done(),
            "received_bytes": intake.progress.received_bytes,
            "duplicates": intake.progress.duplicates,
            "refused": intake.store.refused,
            "radio_messages": self.radio_messages,
            "lag_s": lags,
        }


def deliver(scan: ReceivedScan) -> None:
    """Write the scan's deliverables beside its database; what goes wrong is logged."""
    from service.scans.folder import write_deliverables

    try:
        failed = write_deliverables(scan.folder, scan.intake.store, {})["failed"]
        if failed:
            why = "; ".join(f"{name} ({reason})" for name, reason in failed.items())
            raise InputError(f"some could not be made: {why}")
    except (SkyreliefError, OSError) as error:
        log.error("deliverables of %s not written: %s", scan.folder, error)
