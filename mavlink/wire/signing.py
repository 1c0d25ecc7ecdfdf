"""MAVLink 2 signing: 13 bytes after a packet (link, 48-bit time, 48 bits of SHA-256).

A packet is accepted when its signature is correct and its time is newer than the last one of its
stream (link, system, component), and, for a new stream, at most a minute behind ours.
Only verified packets advance the stream's time. The times survive restarts, so that a packet of the
run before is refused, too.
"""

from __future__ import annotations

import hashlib
import hmac
import threading
from pathlib import Path
from typing import Any

from mavlink.wire.framing import SIGNATURE_LENGTH, Packet

EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01
UNIT_PER_S = 100_000  # a unit of 10 us
LATE = 60 * UNIT_PER_S
MAX_STREAMS = 256
UNSIGNED_ALLOWED = frozenset({109})  # RADIO_STATUS: radios cannot sign
KEY_LENGTH = 32
LARGEST = 2**48 - 1
StreamTimes = dict[tuple[int, int, int], int]
"""(link, system, component) to the signing time of the newest packet of one key."""


def fingerprint(key: bytes) -> str:
    """Names a key without revealing it."""
    return hashlib.sha256(b"fingerprint" + key).hexdigest()[:16]


def read_key(path: Path) -> bytes:
    """The 32-byte key in a file (raw, or 64 hex digits) that only its owner may read."""
    try:
        if not path.is_file():
            raise ValueError(f"{path}: no such signing key file")
        if path.stat().st_mode & 0o077:
            raise ValueError(f"{path}: others may read the signing key; chmod 600 it")
        raw = path.read_bytes()
    except OSError as error:
        reason = f"the signing key cannot be read ({error.strerror}); chown it to this user"
        raise ValueError(f"{path}: {reason}") from error
    if len(raw) == KEY_LENGTH:
        return raw
    try:
        key = bytes.fromhex(raw.decode("ascii").strip())
    except ValueError:
        key = b""
    if len(key) != KEY_LENGTH:
        raise ValueError(f"{path}: a signing key is 32 bytes, or 64 hex digits")
    return key


def timestamp_of(unix_ns: int) -> int:
    """Signing time (10 us since 2015) of a unix time in ns."""
    return max(0, (unix_ns - EPOCH_UNIX_S * 10**9) // 10_000)


class Signing:
    """One key, the times of the streams received with it, and our own time. Thread-safe."""

    def __init__(self, key: bytes, timestamp: int = 0, streams: StreamTimes | None = None) -> None:
        """``timestamp`` and ``streams`` as they were in the run before."""
        if len(key) != KEY_LENGTH:
            raise ValueError(f"a signing key has {KEY_LENGTH} bytes, got {len(key)}")
        self._key = key
        self._lock = threading.Lock()
        self._streams: StreamTimes = dict(streams or {})
        self.timestamp = timestamp  # of the newest packet sent or verified
        self.refused = 0

    @property
    def streams(self) -> StreamTimes:
        with self._lock:
            return dict(self._streams)

    def prepare(self, encoder: Any, link: int, unix_ns: int, ahead: int | None = None) -> None:
        """Let an encoder of pymavlink sign its next packet; times increase strictly even when the
        clock steps back. One that is packed ``ahead``, as after so many others, may never be sent:
        :meth:`skip` counts those that were."""
        with self._lock:
            least = self.timestamp + 1 + (ahead or 0)
            timestamp = min(LARGEST, max(least, timestamp_of(unix_ns)))
            self.timestamp = timestamp if ahead is None else self.timestamp
            encoder.signing.timestamp = timestamp
        encoder.signing.secret_key, encoder.signing.link_id = self._key, link & 0xFF
        encoder.signing.sign_outgoing = True

    def skip(self, packets: int) -> None:
        """So many packets of each stream that were packed ahead have been sent."""
        with self._lock:
            self.timestamp = min(LARGEST, self.timestamp + packets)

    def accepts(self, packet: Packet) -> bool:
        with self._lock:
            if self._verify(packet):
                return True
        self.refused += 1
        return False

    def _verify(self, packet: Packet) -> bool:
        if not packet.is_signed:
            return packet.message_id in UNSIGNED_ALLOWED
        data = packet.data
        link = data[-SIGNATURE_LENGTH]
        timestamp = int.from_bytes(data[-12:-6], "little")
        stream = (link, packet.system, packet.component)
        last = self._streams.get(stream)
        if last is not None and timestamp <= last:
            return False
        if last is None and timestamp + LATE < self.timestamp:
            return False
        signature = hashlib.sha256(self._key + data[:-6]).digest()[:6]
        if not hmac.compare_digest(signature, data[-6:]):
            return False
        if last is None and len(self._streams) >= MAX_STREAMS:
            return False
        self._streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return True
