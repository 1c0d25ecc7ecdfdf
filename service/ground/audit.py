"""The audit log: who changed what at the portal, when, from where, and with which answer."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from starlette.requests import HTTPConnection

log = logging.getLogger(__name__)

FILE = "audit.jsonl"
LARGEST_BYTES = 8_000_000
LONGEST_TEXT = 200
NOTED = "skyrelief.change"
"""Where a request's scope holds what its endpoint has noted."""


class AuditLog:
    """Appends lines of JSON to ``audit.jsonl`` (mode 600); the file before it is ``.1``.

    A disk that takes no line stops no order: it is logged.
    """

    def __init__(self, folder: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        self.path = folder / FILE
        self._largest_bytes = largest_bytes
        self._lock = threading.Lock()

    def write(self, who: str, where: str, action: str, status: int, **details: Any) -> None:
        """One line; texts are cut to 200 letters."""
        now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        entry = {"time": now, "who": who, "from": where, "action": action, "status": status}
        entry |= {name: _short(value) for name, value in details.items()}
        line = json.dumps(entry) + "\n"
        try:
            with self._lock:
                self._append(line.encode())
        except OSError as error:
            log.warning("%s takes no line (%s): %s", self.path, error.strerror, line.strip())

    def _append(self, line: bytes) -> None:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        handle = os.open(self.path, flags, 0o600)
        try:
            os.write(handle, line)
            size = os.fstat(handle).st_size
        finally:
            os.close(handle)
        if size > self._largest_bytes:
            os.replace(self.path, self.path.with_name(f"{FILE}.1"))


class Pace:
    """A token bucket: ``burst`` at once, then ``rate_hz`` a second."""

    def __init__(
        self, rate_hz: float, burst: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate_hz, self._burst, self._clock = rate_hz, float(burst), clock
        self._left, self._at = float(burst), clock()

    def take(self) -> bool:
        """Whether one more is allowed now."""
        now = self._clock()
        self._left = min(self._burst, self._left + (now - self._at) * self._rate_hz)
        self._at = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def note(connection: HTTPConnection, action: str, **details: Any) -> None:
    """Say what a changing request is about, for its line in the audit log."""
    noted = connection.scope.get(NOTED)
    if noted is not None:
        noted |= {"action": action, **details}


def _short(value: Any) -> Any:
    """``value`` as a line of the log holds it."""
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, (list, tuple)):
        return [_short(item) for item in value[:20]]
    return str(value)[:LONGEST_TEXT]
