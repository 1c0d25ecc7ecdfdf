"""Jobs for the protocol's thread: what is urgent at once, telemetry in batches.

Waking a thread costs more than what a telemetry message wants done, so messages that nobody
waits for are gathered for a moment. They carry their own stamps; nothing is lost by it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

GATHER_S = 0.02

Job = Callable[[], object]


class Inbox:
    """A bounded queue from many threads to one."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._jobs: deque[Job] = deque()
        self._wake = threading.Condition()
        self._urgent = False
        self.dropped = 0

    def put(self, job: Job, urgent: bool = True) -> None:
        """Add a job; dropped, and counted, when too many wait."""
        with self._wake:
            if len(self._jobs) >= self._limit:
                self.dropped += 1
                return
            self._jobs.append(job)
            first = len(self._jobs) == 1
            if urgent or first:
                self._urgent = self._urgent or urgent
                self._wake.notify()

    def take(self, timeout_s: float) -> list[Job]:
        """Every job that waits, after waiting for one at most ``timeout_s``."""
        with self._wake:
            if not self._jobs:
                self._wake.wait(timeout_s)
            if self._jobs and not self._urgent:
                self._wake.wait(min(GATHER_S, max(timeout_s, 0.001)))
            jobs = list(self._jobs)
            self._jobs.clear()
            self._urgent = False
            return jobs
