"""Telemetry logs (.tlog), read and written: 8 bytes of unix microseconds before each packet."""

from __future__ import annotations

import logging
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from mavlink.wire.framing import Packet, check_packet, packet_length

log = logging.getLogger(__name__)

STAMP = 8
BLOCK = 1 << 16
LATEST_USEC = 4_102_444_800 * 10**6  # the year 2100
STEP_USEC = 3_600 * 10**6  # a longer gap between two packets needs confirmation


def packets(file: BinaryIO, counts: Counter[str]) -> Iterator[tuple[int, Packet]]:
    """(unix ns, packet) for each packet of a log; damage is skipped and counted in bytes."""
    buffer, at, last_usec, ended = bytearray(), 0, None, False
    while True:
        length = packet_length(buffer, at + STAMP) if len(buffer) > at + STAMP else None
        if length is None or at + STAMP + length > len(buffer):
            if not ended:
                del buffer[:at]
                at = 0
                block = file.read(BLOCK)
                buffer += block
                ended = not block
                continue
            if at >= len(buffer):
                return
            length = 0  # truncated
        usec = int.from_bytes(buffer[at : at + STAMP], "big")
        if length and usec < LATEST_USEC:
            end = at + STAMP + length
            packet = check_packet(bytes(buffer[at + STAMP : end]))
            if packet is not None and _stamp_stands(packet, usec, last_usec, buffer, end):
                last_usec, at = usec, end
                yield usec * 1000, packet
                continue
            counts["bad_checksums"] += 1
        counts["skipped_bytes"] += 1
        at += 1


def _stamp_stands(
    packet: Packet, usec: int, last_usec: int | None, buffer: bytearray, end: int
) -> bool:
    """True when the stamp continues the last one, or the next stamp continues it.

    So a clock that was set in mid-log is followed and a damaged stamp is not. A packet whose
    checksum is unknown here must also be followed by another packet.
    """
    steady = last_usec is not None and abs(usec - last_usec) < STEP_USEC
    if steady and packet.known:
        return True
    if end + STAMP >= len(buffer):
        return steady or last_usec is None
    following = int.from_bytes(buffer[end : end + STAMP], "big")
    return packet_length(buffer, end + STAMP) != 0 and abs(following - usec) < STEP_USEC


class TlogRecorder:
    """Writes a .tlog while one is open; thread-safe, and never raises on a full disk."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._file: BinaryIO | None = None
        self._unix_minus_monotonic_ns = 0
        self.packets = 0

    def open(self, path: Path, unix_offset_ns: int) -> None:
        """Start a log (OSError when it cannot be created); an open one is closed first.

        Stamps are monotonic times plus ``unix_offset_ns``, so that setting the clock in flight
        causes no jump in the log.
        """
        file = path.open("ab")
        with self._lock:
            self._close()
            self._file = file
            self._unix_minus_monotonic_ns = unix_offset_ns

    def close(self) -> None:
        with self._lock:
            self._close()

    def _close(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as error:
                log.error("the telemetry log was not closed cleanly: %s", error)

    def write(self, packet: bytes, monotonic_ns: int) -> None:
        def act(file: BinaryIO) -> None:
            usec = (monotonic_ns + self._unix_minus_monotonic_ns) // 1000
            file.write(usec.to_bytes(8, "big") + packet)
            self.packets += 1

        self._use(act)

    def sync(self) -> None:
        """Have what is written survive a power cut."""

        def act(file: BinaryIO) -> None:
            file.flush()
            os.fsync(file.fileno())

        self._use(act)

    def _use(self, act: Callable[[BinaryIO], None]) -> None:
        with self._lock:
            if self._file is None:
                return
            try:
                act(self._file)
            except OSError as error:
                log.error("the telemetry log ends here: %s", error)
                self._close()
