"""What is wanted of the scan, whatever happens to it: nothing, a scan, or a scan that is paused.

Commands, arming and the configuration change it; retries follow it. So a stop ends every retry,
and a pause or a fault does not end what was asked for.
"""

from __future__ import annotations

import threading
from enum import Enum

FIRST_RETRY_S, LAST_RETRY_S = 1.0, 8.0
"""Waits between attempts at a scan; names of scans are whole seconds."""


class Wanted(Enum):
    """What the operator asked for last."""

    NOTHING = "nothing"
    SCAN = "scan"
    PAUSE = "pause"  # a scan that takes no frames for now


class Intent:
    """What is wanted, and when it may be tried next. Its owner guards it against other threads."""

    def __init__(self) -> None:
        self.wanted = Wanted.NOTHING
        self.failures = 0  # since the scan was asked for
        self.paused = threading.Event()  # set exactly while a pause is wanted
        self.is_over = False  # the service ends
        self._due_s = 0.0
        self._retry_s = FIRST_RETRY_S

    @property
    def wants_scan(self) -> bool:
        """True from start to stop, through pauses and retries."""
        return self.wanted is not Wanted.NOTHING

    def scan(self, now_s: float) -> None:
        """Want a scan, at once; this also ends a pause."""
        self._due_s, self.failures = now_s, 0
        self._retry_s = FIRST_RETRY_S
        self._want(Wanted.SCAN)

    def stop(self) -> None:
        """Want nothing: no scan, no retry, no pause."""
        self._want(Wanted.NOTHING)

    def pause(self) -> bool:
        """Want no frames until :meth:`resume`; False when no scan is wanted."""
        if self.wants_scan:
            self._want(Wanted.PAUSE)
        return self.wants_scan

    def resume(self) -> bool:
        """Want frames again; False unless a pause is wanted."""
        if self.wanted is not Wanted.PAUSE:
            return False
        self._want(Wanted.SCAN)
        return True

    def end(self) -> None:
        """Want nothing, for good: the service ends."""
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
        """Note that an attempt failed; return the seconds until the next one."""
        self.failures += 1
        wait_s, self._retry_s = self._retry_s, min(2 * self._retry_s, LAST_RETRY_S)
        self._due_s = now_s + wait_s
        return wait_s

    def succeeded(self) -> None:
        """Note that the attempt produces data, so the next fault is retried soon."""
        self._retry_s = FIRST_RETRY_S
