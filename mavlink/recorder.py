"""A telemetry log of our own links: what came and what we sent, kept beside a scan."""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import BinaryIO

log = logging.getLogger(__name__)


class Recorder:
    """Writes a .tlog while one is open; safe between threads, and never raises on a full disk."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._file: BinaryIO | None = None
        self._unix_minus_monotonic_ns = 0
        self.packets = 0

    def open(self, path: Path, unix_offset_ns: int) -> None:
        """Start a log (OSError when it cannot be made); one that is open is closed first.

        The stamps are the monotonic clock's times with ``unix_offset_ns`` added, so that setting
        the clock in flight does not tear the log.
        """
        file = path.open("ab")
        with self._lock:
            self._close()
            self._file = file
            self._unix_minus_monotonic_ns = unix_offset_ns

    def close(self) -> None:
        """End the log, if one is open."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as error:
                log.error("the telemetry log was not closed well: %s", error)

    def write(self, packet: bytes, monotonic_ns: int) -> None:
        """Keep one packet."""
        if self._file is None:
            return
        with self._lock:
            if self._file is None:
                return
            usec = (monotonic_ns + self._unix_minus_monotonic_ns) // 1000
            try:
                self._file.write(usec.to_bytes(8, "big") + packet)
                self.packets += 1
            except OSError as error:
                log.error("the telemetry log ends here: %s", error)
                self._close()
