"""When a commanded scan begins or ends without a command: after a crash, and after landing.

A small file in the folder of scans marks a running commanded scan, so that it resumes after the
service or the computer crashed; its text identifies the boot of the computer.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from enum import Enum, auto
from pathlib import Path

from service.errors import OutsideError
from service.scans.writing import sync, write_whole

log = logging.getLogger(__name__)

MARK = ".scanning"
BOOT = Path("/proc/sys/kernel/random/boot_id")


class Left(Enum):
    """Work that the last run of the service left unfinished."""

    NOTHING = "nothing"
    BY_SERVICE = "the service ended while scanning"
    BY_COMPUTER = "the computer ended while scanning"


class Resumption:
    """The scan to resume; known until the operator starts or stops a scan."""

    def __init__(self, folder: Path, boot: Path = BOOT) -> None:
        """``boot``: a file with the id of this boot of the computer."""
        self._path, self._boot_id = folder / MARK, boot
        self.left = self._read()

    def _read(self) -> Left:
        try:
            boot = self._path.read_text(encoding="utf-8")
        except (OSError, ValueError):
            return Left.NOTHING
        return Left.BY_SERVICE if boot and boot == self._boot() else Left.BY_COMPUTER

    def note(self) -> None:
        """Mark a running scan that must resume after a crash."""
        self.left = Left.NOTHING
        try:
            write_whole(self._path, self._boot())
        except OutsideError as error:
            log.warning("a restart in flight will not resume the scan: %s", error)

    def forget(self) -> None:
        """Remove the mark: no scan runs, or none need resume. :meth:`settle` follows."""
        self.left = Left.NOTHING
        self._change(lambda: self._path.unlink(missing_ok=True))

    def settle(self) -> None:
        """Wait for the disk: else a power cut within seconds of a stop brings the mark back."""
        if self._path.parent.exists():
            self._change(lambda: sync(self._path.parent))

    def _change(self, work: Callable[[], object]) -> None:
        try:
            work()
        except OSError as error:
            log.warning("%s cannot be removed: %s", self._path, error.strerror)

    def is_due(self, is_heard: bool, is_armed: bool) -> bool:
        """True when a scan must be started now; queried until then, or until none is left.

        After a power cut only an armed autopilot proves that it was in flight; a disarmed one
        (``is_heard``) means that the battery was changed.
        """
        if self.left is Left.BY_COMPUTER and is_heard and not is_armed:
            self.forget()
            self.settle()
        return self.left is Left.BY_SERVICE or (self.left is Left.BY_COMPUTER and is_armed)

    def _boot(self) -> str:
        """Id of this boot of the computer; empty where the system has none."""
        try:
            return self._boot_id.read_text(encoding="ascii").strip()
        except OSError:
            return ""


class Landing(Enum):
    NOTHING = auto()
    LANDED = auto()  # announce the landing
    CLOSE = auto()  # close the scan


class LandingWatch:
    """Detects that the motors of a scan's flight have stopped for good; call :meth:`look` often."""

    def __init__(self) -> None:
        self._has_flown = False  # armed while this scan was wanted
        self._landed_s: float | None = None

    def look(
        self,
        wants_scan: bool,
        is_armed: bool,
        is_disarmed: bool,
        close_after_s: float,
        now_s: float,
    ) -> Landing:
        """Return the action at ``now_s`` of a monotonic clock. ``is_disarmed`` is the autopilot's
        report, False where none is heard. A ``close_after_s`` of 0 never closes."""
        if is_armed or not wants_scan or close_after_s <= 0.0:
            self._has_flown = wants_scan and (is_armed or self._has_flown)
            self._landed_s = None
        elif self._landed_s is None and self._has_flown and is_disarmed:
            self._landed_s = now_s
            return Landing.LANDED
        elif self._landed_s is not None and now_s - self._landed_s >= close_after_s:
            self._has_flown, self._landed_s = False, None
            return Landing.CLOSE
        return Landing.NOTHING
