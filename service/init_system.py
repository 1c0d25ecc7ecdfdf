"""Notifications (sd_notify(3)) and log records to systemd, one datagram each, without packages.

Records have priority, logger and thread as separate fields. In the journal's native protocol a
record is lines of ``NAME=value``; values of several lines are preceded by their length.
"""

from __future__ import annotations

import logging
import logging.handlers
import os
import socket
import struct
import sys

from service.redaction import without_credentials

log = logging.getLogger(__name__)

EXTENSION_US = 30_000_000
"""systemd ends a service that closes its scan without progress for this long."""


class Notifier:
    """Notifications to systemd; no effect without it."""

    def __init__(self, address: str | None = None) -> None:
        """Send to ``address``, by default the one in NOTIFY_SOCKET."""
        address = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None

    @property
    def is_heard(self) -> bool:
        return self._socket is not None

    def status(self, text: str) -> None:
        self._send(f"STATUS={text}")

    def ready(self) -> None:
        self._send("READY=1")

    def alive(self, status: str = "") -> None:
        """Report progress, for the watchdog."""
        self._send("WATCHDOG=1" + (f"\nSTATUS={status}" if status else ""))

    def closing(self) -> None:
        """Report that closing makes progress: systemd waits for another :data:`EXTENSION_US`."""
        self._send(f"EXTEND_TIMEOUT_USEC={EXTENSION_US}")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError as error:
            log.debug("systemd does not listen: %s", error)


SOCKET = "/run/systemd/journal/socket"
PRIORITIES = (
    (logging.CRITICAL, 2),
    (logging.ERROR, 3),
    (logging.WARNING, 4),
    (logging.INFO, 6),
    (logging.DEBUG, 7),
)
MAX_BYTES = 100_000


class JournalHandler(logging.handlers.DatagramHandler):
    """Sends every record to the journal; rejected ones go to standard error."""

    def __init__(self, address: str = SOCKET) -> None:
        super().__init__(address, None)

    def makePickle(self, record: logging.LogRecord) -> bytes:
        return packed(record, self.format(record))

    def handleError(self, record: logging.LogRecord) -> None:
        print(f"{record.levelname} {record.name}: {self.format(record)}", file=sys.stderr)


def packed(record: logging.LogRecord, text: str) -> bytes:
    fields = {
        "MESSAGE": text[:MAX_BYTES],
        "PRIORITY": str(next((p for level, p in PRIORITIES if record.levelno >= level), 7)),
        "SYSLOG_IDENTIFIER": "skyrelief",
        "LOGGER": record.name,
        "THREAD_NAME": record.threadName or "",
        "CODE_FILE": record.pathname,
        "CODE_LINE": str(record.lineno),
        "CODE_FUNC": record.funcName or "",
    }
    return b"".join(_field(name, value) for name, value in fields.items())


def _field(name: str, value: str) -> bytes:
    data = value.encode(errors="replace")
    if b"\n" in data:
        return name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"
    return name.encode() + b"=" + data + b"\n"


class PublicFormatter(logging.Formatter):
    """Formats a record, including its traceback, with credentials hidden."""

    def format(self, record: logging.LogRecord) -> str:
        return without_credentials(super().format(record))


def log_handler() -> logging.Handler:
    """A handler for the journal if it reads our standard error, otherwise for standard error."""
    if journal_reads_us() and os.path.exists(SOCKET):
        handler: logging.Handler = JournalHandler()
        handler.setFormatter(PublicFormatter("%(message)s"))
        return handler
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PublicFormatter("%(levelname)s %(name)s: %(message)s"))
    return handler


def journal_reads_us() -> bool:
    """True when standard error is the stream that JOURNAL_STREAM names (device:inode)."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        found = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return (str(found.st_dev), str(found.st_ino)) == (device, inode)
