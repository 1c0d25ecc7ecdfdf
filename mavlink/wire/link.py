"""Links: reopened whenever they fail, stamped at the read; sending never blocks.

:class:`LinkInbox` passes received packets to the protocol's thread. Waking a thread costs more than
processing a telemetry message, so messages that need no quick answer are batched briefly. They
keep their own stamps.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from mavlink.wire.ports import PORTS, LinkSpec, Port, parse_link
from mavlink.wire.stand_in import Way

__all__ = ["Link", "LinkSpec", "parse_link"]

log = logging.getLogger(__name__)

BACKOFF_S = (0.2, 5.0)
QUEUE = 512
KEPT_WHILE_DOWN = 8  # messages kept for a link that is down; older ones are stale


class Link:
    """A port that is reopened whenever it fails, with a reading and a writing thread.
    ``on_data(data, monotonic_ns)`` is called in the reading thread for all received data."""

    def __init__(
        self, spec: LinkSpec, on_data: Callable[[bytes, int], None] = lambda data, now_ns: None
    ) -> None:
        self.spec = spec
        self.on_data = on_data
        self._stop = threading.Event()
        self._wake = threading.Condition()
        self._waiting: deque[bytes] = deque(maxlen=QUEUE)
        self._port: Port | None = None
        self._threads: list[threading.Thread] = []
        self.opened = 0  # how many times
        self.received_bytes = 0
        self.last_error = ""

    @property
    def is_up(self) -> bool:
        return self._port is not None

    @property
    def ways(self) -> list[Way]:
        """To everyone at the other end, for another process; none while it is down."""
        port = self._port
        with contextlib.suppress(OSError):  # it is being closed
            return [] if port is None else port.ways
        return []

    def start(self) -> None:
        if self._threads:
            return
        for target in (self._read, self._write):
            thread = threading.Thread(
                target=target,
                name=f"mavlink {self.spec.name} {target.__name__.strip('_')}",
                daemon=True,
            )
            self._threads.append(thread)
            thread.start()

    def stop(self) -> None:
        """Send queued data, close the port and end both threads."""
        deadline = time.monotonic() + 0.5
        while self._waiting and self.is_up and time.monotonic() < deadline:
            time.sleep(0.01)
        self._stop.set()
        with self._wake:
            self._wake.notify_all()
        for thread in self._threads:
            thread.join(timeout=5.0)

    def write(self, data: bytes) -> None:
        """Send or queue data; never blocks. A full queue drops its oldest entries."""
        port = self._port
        if port is not None and port.is_quick:
            port.write(data)
            return
        with self._wake:
            self._waiting.append(data)
            while self._port is None and len(self._waiting) > KEPT_WHILE_DOWN:
                self._waiting.popleft()
            self._wake.notify()

    def _read(self) -> None:
        pause_s = BACKOFF_S[0]
        while not self._stop.is_set():
            try:
                port = PORTS[self.spec.kind](self.spec)
            except (OSError, ValueError) as error:
                self._complain(error)
                self._stop.wait(pause_s)
                pause_s = min(BACKOFF_S[1], 2.0 * pause_s)
                continue
            pause_s = BACKOFF_S[0]
            self._serve(port)
            self._stop.wait(pause_s)

    def _serve(self, port: Port) -> None:
        self.opened += 1
        self.last_error = ""
        log.info("link %s is open", self.spec.name)
        with self._wake:
            self._port = port
            self._wake.notify_all()
        try:
            while not self._stop.is_set() and self._port is port:
                data = port.read()
                if data:
                    now_ns = time.monotonic_ns()
                    self.received_bytes += len(data)
                    self.on_data(data, now_ns)
        except (OSError, ValueError) as error:
            self._complain(error)
        finally:
            with self._wake:
                self._port = None
            with contextlib.suppress(OSError):
                port.close()

    def _complain(self, error: Exception) -> None:
        text = str(error) or type(error).__name__
        if text != self.last_error:
            log.warning("link %s: %s; trying again", self.spec.name, text)
        self.last_error = text

    def _write(self) -> None:
        while not self._stop.is_set():
            with self._wake:
                while not self._stop.is_set() and not (self._waiting and self._port):
                    self._wake.wait(0.5)
                if self._stop.is_set():
                    return
                port, data = self._port, self._waiting.popleft()
            if port is None:
                continue
            try:
                port.write(data)
            except OSError as error:
                self._complain(error)
                with self._wake:
                    if self._port is port:
                        self._port = None  # the reading thread reopens it


Job = Callable[[], object]
T = TypeVar("T")


class LinkInbox(Generic[T]):
    """A bounded queue from many threads to one, of jobs and of telemetry."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._jobs: deque[Job] = deque()
        self._telemetry: deque[T] = deque()
        self._wake = threading.Condition()
        self.dropped = 0

    def put(self, job: Job) -> None:
        """Add a job and wake the consumer; dropped and counted when the queue is full."""
        with self._wake:
            if len(self._jobs) >= self._limit:
                self.dropped += 1
                return
            self._jobs.append(job)
            self._wake.notify()

    def gather(self, telemetry: T) -> None:
        """Add telemetry, which is taken within a moment; dropped when the queue is full."""
        if len(self._telemetry) >= self._limit:
            self.dropped += 1
            return
        self._telemetry.append(telemetry)

    def take(self, timeout_s: float) -> tuple[list[T], list[Job]]:
        """Queued telemetry and jobs, after waiting briefly for a job."""
        with self._wake:
            if not self._jobs:
                self._wake.wait(timeout_s)
            jobs = list(self._jobs)
            self._jobs.clear()
        telemetry = [self._telemetry.popleft() for _ in range(len(self._telemetry))]
        return telemetry, jobs
