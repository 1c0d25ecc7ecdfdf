"""Our messages into bytes for one link: sequence numbers, signature, nothing that raises."""

from __future__ import annotations

import logging
import struct
import threading
from typing import Any

from mavlink.messages import Outgoing
from mavlink.signing import Signing
from mavlink.wire import dialect, x25crc

log = logging.getLogger(__name__)

SIGNED = 0x01
HEADER = 10


class Packer:
    """Packs for one link; safe between threads. Each component counts its own packets."""

    def __init__(self, link: int, signing: Signing | None = None, sequence: int = 0) -> None:
        self._link = link
        self._sequence = sequence  # of the first packet of each component
        self._signing = signing
        self._lock = threading.Lock()
        self._encoders: dict[tuple[int, int], Any] = {}
        self.refused = 0

    def pack(self, system: int, outgoing: Outgoing, unix_ns: int) -> bytes | None:
        """The packet; None (and a count) when a value does not fit its field."""
        with self._lock:
            key = (system, outgoing.component)
            encoder = self._encoders.get(key)
            if encoder is None:
                encoder = self._encoders[key] = dialect.MAVLink(None, *key)
                encoder.seq = self._sequence
            try:
                data = bytes(outgoing.message.pack(encoder))
            except (struct.error, ValueError, TypeError, OverflowError) as error:
                self.refused += 1
                log.error("%s cannot be sent: %s", outgoing.message.get_type(), error)
                return None
            encoder.seq = (encoder.seq + 1) % 256
            if self._signing is None:
                return data
            flagged = _with_signed_flag(data, outgoing.message.crc_extra)
            return self._signing.sign(flagged, self._link, unix_ns)


def _with_signed_flag(data: bytes, crc_extra: int) -> bytes:
    """The packet saying that a signature follows, and its checksum for that."""
    body = data[:2] + bytes((data[2] | SIGNED,)) + data[3:-2]
    crc: int = x25crc(body[1:] + bytes((crc_extra,))).crc
    return body + crc.to_bytes(2, "little")
