"""Jobs for the protocol's thread: what is urgent at once, telemetry in batches.

Waking a thread costs more than what a telemetry message wants done, so messages that nobody
waits for are gathered for a moment. They carry their own stamps; nothing is lost by it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

GATHER_S = 0.04

Job = Callable[[], object]
T = TypeVar("T")


class Inbox(Generic[T]):
    """A bounded queue from many threads to one, of jobs and of telemetry."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._jobs: deque[Job] = deque()
        self._telemetry: deque[T] = deque()
        self._wake = threading.Condition()
        self.dropped = 0

    def put(self, job: Job) -> None:
        """Add a job and wake who takes it; dropped, and counted, when too many wait."""
        with self._wake:
            if len(self._jobs) >= self._limit:
                self.dropped += 1
                return
            self._jobs.append(job)
            self._wake.notify()

    def gather(self, telemetry: T) -> None:
        """Add telemetry, to be taken within a moment; dropped when too much waits."""
        if len(self._telemetry) >= self._limit:
            self.dropped += 1
            return
        self._telemetry.append(telemetry)

    def take(self, timeout_s: float) -> tuple[list[T], list[Job]]:
        """The telemetry and the jobs that wait, after waiting for a job for a moment at most."""
        with self._wake:
            if not self._jobs:
                self._wake.wait(min(GATHER_S, timeout_s))
            jobs = list(self._jobs)
            self._jobs.clear()
        telemetry = [self._telemetry.popleft() for _ in range(len(self._telemetry))]
        return telemetry, jobs
