"""The threads of a process in one table: each is restarted when it fails, and reported.

The only place that catches every exception: a fault in one worker is logged with its
traceback and never ends another one.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from service.errors import SkyreliefError

log = logging.getLogger(__name__)

MAX_RESTARTS, WINDOW_S = 5, 60.0
"""A worker that fails more often than this within the window is not restarted any more."""
MAX_FAILED = 100
"""Workers that are no longer restarted, kept for the report."""
PAUSE_S = 0.5
"""From a fault to the restart."""


@dataclass(slots=True, eq=False)
class Worker:
    """One line of the table."""

    name: str
    work: Callable[[Worker], None]
    stall_s: float | None  # without a beat for so long it hangs; None: it may block
    is_essential: bool = True  # the process is of no use without it
    restarts: int = 0
    fault: str = ""  # the last exception, in one line
    has_failed: bool = False  # the budget of restarts is spent
    is_done: bool = False
    beat_at: float = field(default_factory=time.monotonic)
    stop: threading.Event = field(default_factory=threading.Event)
    thread: threading.Thread | None = None

    def beat(self) -> None:
        """Note that the worker makes progress."""
        self.beat_at = time.monotonic()

    @property
    def is_stalled(self) -> bool:
        """Whether it runs and has not made progress for ``stall_s``."""
        if self.stall_s is None or self.is_done:
            return False
        return time.monotonic() - self.beat_at > self.stall_s

    def join(self, timeout_s: float | None = None) -> bool:
        """Ask it to stop and wait for its end; False when it still runs."""
        self.stop.set()
        thread = self.thread
        if thread is None or thread is threading.current_thread():
            return True
        thread.join(timeout_s)
        return not thread.is_alive()


class Workers:
    """The table. Safe between threads."""

    def __init__(self, max_restarts: int = MAX_RESTARTS, pause_s: float = PAUSE_S) -> None:
        self._max_restarts, self._pause_s = max_restarts, pause_s
        self._lock = threading.Lock()
        self._workers: list[Worker] = []

    def start(
        self,
        name: str,
        work: Callable[[Worker], None],
        stall_s: float | None = None,
        is_essential: bool = True,
    ) -> Worker:
        """Run ``work(worker)`` on a thread until it returns; after an exception run it again.

        ``work`` ends soon after ``worker.stop`` is set.
        """
        worker = Worker(name, work, stall_s, is_essential)
        worker.thread = threading.Thread(
            target=self._supervise, args=(worker,), name=name, daemon=True
        )
        with self._lock:
            failed = [w for w in self._workers if w.has_failed and w.name != name]
            running = [w for w in self._workers if not w.is_done]
            self._workers = [*failed[-MAX_FAILED:], *running, worker]
        worker.thread.start()
        return worker

    @property
    def failed(self) -> list[Worker]:
        """Essential workers that are no longer restarted: the process should end."""
        return [worker for worker in self._table() if worker.has_failed and worker.is_essential]

    @property
    def stalled(self) -> list[Worker]:
        """Workers that hang."""
        return [worker for worker in self._table() if worker.is_stalled]

    def report(self) -> list[dict[str, Any]]:
        """One entry per worker: name, state, restarts, last fault."""
        return [
            {
                "name": worker.name,
                "state": _state(worker),
                "restarts": worker.restarts,
                "fault": worker.fault,
            }
            for worker in self._table()
        ]

    def _table(self) -> list[Worker]:
        with self._lock:
            return list(self._workers)

    def _supervise(self, worker: Worker) -> None:
        faults: deque[float] = deque()
        try:
            while True:
                worker.beat()
                fault = guarded(worker.name, lambda: worker.work(worker))
                if not fault or worker.stop.is_set():
                    return
                worker.fault = fault
                now = time.monotonic()
                faults.append(now)
                while faults[0] < now - WINDOW_S:
                    faults.popleft()
                if len(faults) > self._max_restarts:
                    worker.has_failed = True
                    log.critical("%s failed %d times; it stays off", worker.name, len(faults))
                    return
                worker.restarts += 1
                worker.stop.wait(self._pause_s)
        finally:
            worker.is_done = True


def guarded(name: str, work: Callable[[], None]) -> str:
    """Run ``work``; the exception that ended it in one line, empty when there was none."""
    try:
        work()
    except (SkyreliefError, OSError) as error:
        log.error("%s: %s", name, error)
        return str(error)
    except Exception as error:  # a fault of ours; it must not end anything else
        log.exception("fault in %s", name)
        return f"{type(error).__name__}: {error}".splitlines()[0][:200]
    return ""


def _state(worker: Worker) -> str:
    if worker.has_failed:
        return "failed"
    if worker.is_done:
        return "done"
    return "stalled" if worker.is_stalled else "running"
