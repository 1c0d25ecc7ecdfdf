"""The intended state: no scan, a scan, or a paused scan.

Commands, arming and the configuration change it; retries follow it. So a stop ends every retry,
and a pause or a fault does not cancel a requested scan. A small file in the folder of scans marks
a running commanded scan, so that it resumes after the service or the computer crashed; its text
identifies the boot of the computer.
"""

from __future__ import annotations

import logging
import os
import threading
from enum import Enum, auto
from pathlib import Path

log = logging.getLogger(__name__)

FIRST_RETRY_S, LAST_RETRY_S = 1.0, 8.0
"""Waits between attempts at a scan."""

MARK = ".scanning"
BOOT = Path("/proc/sys/kernel/random/boot_id")


class Wanted(Enum):
    """The operator's last request."""

    NOTHING = "nothing"
    SCAN = "scan"
    PAUSE = "pause"  # a scan that currently takes no frames


class Intent:
    """The intended state, and when to try it next. Its owner guards it against other threads."""

    def __init__(self, first_s: float = FIRST_RETRY_S, last_s: float = LAST_RETRY_S) -> None:
        """The wait between two attempts grows from ``first_s`` to ``last_s``."""
        self.wanted = Wanted.NOTHING
        self.failures = 0  # since the scan was requested
        self.paused = threading.Event()  # set while a pause is wanted
        self.is_over = False  # the service ends
        self._due_s = 0.0
        self._first_s, self._last_s, self._retry_s = first_s, last_s, first_s

    @property
    def wants_scan(self) -> bool:
        """True from start to stop, including pauses and retries."""
        return self.wanted is not Wanted.NOTHING

    def scan(self, now_s: float) -> None:
        """Request a scan now; also ends a pause."""
        self._due_s, self.failures = now_s, 0
        self._retry_s = self._first_s
        self._want(Wanted.SCAN)

    def stop(self) -> None:
        """Request nothing: no scan, no retry, no pause."""
        self._want(Wanted.NOTHING)

    def pause(self) -> bool:
        """Take no frames until :meth:`resume`; False when no scan is wanted."""
        if self.wants_scan:
            self._want(Wanted.PAUSE)
        return self.wants_scan

    def resume(self) -> bool:
        """Take frames again; False unless a pause is wanted."""
        if self.wanted is not Wanted.PAUSE:
            return False
        self._want(Wanted.SCAN)
        return True

    def end(self) -> None:
        """Request nothing, permanently: the service ends."""
        self.stop()
        self.is_over = True

    def _want(self, wanted: Wanted) -> None:
        if self.is_over:
            return
        self.wanted = wanted
        if wanted is Wanted.PAUSE:
            self.paused.set()
        else:
            self.paused.clear()

    def is_due(self, now_s: float) -> bool:
        """True when an attempt at the scan should start now."""
        return self.wants_scan and now_s >= self._due_s

    def failed(self, now_s: float) -> float:
        """Note a failed attempt; return the seconds until the next one."""
        self.failures += 1
        wait_s, self._retry_s = self._retry_s, min(2 * self._retry_s, self._last_s)
        self._due_s = now_s + wait_s
        return wait_s

    def succeeded(self) -> None:
        """Note that the attempt produces data, so that the next fault is retried soon."""
        self._retry_s = self._first_s


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
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("w", encoding="utf-8") as file:
                file.write(self._boot())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            log.warning("%s: a restart in flight will not resume the scan: %s", self._path, error)

    def forget(self) -> None:
        """Remove the mark: no scan runs, or none need resume."""
        self.left = Left.NOTHING
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            log.warning("%s cannot be removed: %s", self._path, error.strerror)

    def is_due(self, is_heard: bool, is_armed: bool) -> bool:
        """True when a scan must be started now; queried until then, or until none is left.

        After a power cut only an armed autopilot proves that it was in flight; a disarmed one
        (``is_heard``) means that the battery was changed.
        """
        if self.left is Left.BY_COMPUTER and is_heard and not is_armed:
            self.forget()
        return self.left is Left.BY_SERVICE or (self.left is Left.BY_COMPUTER and is_armed)

    def _boot(self) -> str:
        """Id of this boot of the computer; empty where the system has none."""
        try:
            return self._boot_id.read_text(encoding="ascii").strip()
        except OSError:
            return ""


class Landing(Enum):
    """Action after a check."""

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
        """Return the action at ``now_s`` of a monotonic clock.

        ``is_disarmed`` is the autopilot's report, False where none is heard. A ``close_after_s`` of
        0 never closes.
        """
        if is_armed or not wants_scan or close_after_s <= 0.0:
            self._has_flown = wants_scan and (is_armed or self._has_flown)
            self._landed_s = None
            return Landing.NOTHING
        if self._landed_s is None:
            if not (self._has_flown and is_disarmed):
                return Landing.NOTHING
            self._landed_s = now_s
            return Landing.LANDED
        if now_s - self._landed_s < close_after_s:
            return Landing.NOTHING
        self._has_flown, self._landed_s = False, None
        return Landing.CLOSE
