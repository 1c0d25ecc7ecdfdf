"""Notifications to the init system (sd_notify(3)): one datagram, no packages."""

from __future__ import annotations

import logging
import os
import socket

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
        """True when an init system listens."""
        return self._socket is not None

    def status(self, text: str) -> None:
        """Set the line of ``systemctl status``."""
        self._send(f"STATUS={text}")

    def ready(self) -> None:
        """Report that the service has started."""
        self._send("READY=1")

    def alive(self, status: str = "") -> None:
        """Report progress, for the watchdog."""
        self._send("WATCHDOG=1" + (f"\nSTATUS={status}" if status else ""))

    def closing(self) -> None:
        """Report that closing makes progress: systemd waits for another :data:`EXTENSION_US`."""
        self._send(f"EXTEND_TIMEOUT_USEC={EXTENSION_US}")

    def stopping(self) -> None:
        """Report that the service is stopping."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError as error:
            log.debug("systemd does not listen: %s", error)
