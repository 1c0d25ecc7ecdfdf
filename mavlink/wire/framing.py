"""Bytes into whole MAVLink packets, and packets into messages; damage is skipped and counted.

Handles MAVLink 1 and 2. After a packet with a wrong checksum the search continues one byte further,
so that a packet inside the damage is found.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

from mavlink.wire.dialect import CRC_EXTRA, dialect, x25crc

MAGIC_V1 = 0xFE
MAGIC_V2 = 0xFD
SIGNATURE_LENGTH = 13
SIGNED = 0x01

Message = Any  # a message object of a pymavlink dialect


class Packet(NamedTuple):
    """One packet with a correct checksum, or of a kind whose checksum cannot be verified here."""

    data: bytes
    message_id: int
    system: int
    component: int
    known: bool  # its checksum can be, and was, verified

    @property
    def is_signed(self) -> bool:
        """True when a signature of 13 bytes ends the packet."""
        return self.data[0] == MAGIC_V2 and bool(self.data[2] & SIGNED)


def packet_length(data: bytes | bytearray, at: int) -> int | None:
    """Length in bytes of the packet that starts at ``at``; 0 when no packet can start there. None
    when there are too few bytes to decide."""
    if at >= len(data):
        return None
    magic = data[at]
    if magic == MAGIC_V1:
        return data[at + 1] + 8 if at + 1 < len(data) else None
    if magic != MAGIC_V2:
        return 0
    if at + 2 >= len(data):
        return None
    if data[at + 2] & ~SIGNED:
        return 0  # an incompatible flag that we do not know
    return data[at + 1] + 12 + (SIGNATURE_LENGTH if data[at + 2] & SIGNED else 0)


def check_packet(data: bytes) -> Packet | None:
    """The packet that fills ``data``, or None when its checksum is wrong."""
    if data[0] == MAGIC_V1:
        message_id, system, component, end = data[5], data[3], data[4], len(data)
    else:
        message_id = data[7] | data[8] << 8 | data[9] << 16
        system, component = data[5], data[6]
        end = len(data) - (SIGNATURE_LENGTH if data[2] & SIGNED else 0)
    extra = CRC_EXTRA.get(message_id)
    if extra is None:
        return Packet(data, message_id, system, component, False)
    crc = x25crc(data[1 : end - 2] + bytes((extra,))).crc
    if crc != data[end - 2] | data[end - 1] << 8:
        return None
    return Packet(data, message_id, system, component, True)


def _starts_whole(data: bytes) -> bool:
    """True when a whole packet with a correct checksum is at the start."""
    length = packet_length(data, 0)
    if not length or length > len(data):
        return False
    packet = check_packet(data[:length])
    return packet is not None and packet.known


class Decoder:
    """Packets into message objects; never raises."""

    def __init__(self) -> None:
        self._parser = dialect.MAVLink(None)

    def message(self, packet: Packet) -> Message | None:
        """The message object, or None when it is unknown or its payload is malformed."""
        if packet.message_id not in dialect.mavlink_map:
            return None
        try:
            return self._parser.decode(bytearray(packet.data))
        except (dialect.MAVError, ValueError, TypeError):
            return None


class Framer:
    """Splits a byte stream into packets; keeps at most one unfinished packet.

    Noise may look like the start of a long packet. If the next data begins with a whole packet,
    that start is discarded; otherwise a single command would wait for the next hundred bytes.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.packets: Counter[int] = Counter()  # by system id
        self.skipped_bytes = 0

    def feed(self, data: bytes) -> list[Packet]:
        buffer = self._buffer
        if not buffer and packet_length(data, 0) == len(data):  # a datagram, most of the time
            whole = check_packet(data)
            if whole is not None:
                self.packets[whole.system] += 1
                return [whole]
        if buffer and _starts_whole(data):  # then the buffered bytes are noise or truncated
            self.skipped_bytes += len(buffer)
            buffer.clear()
        buffer += data
        found: list[Packet] = []
        at = 0
        while True:
            length = packet_length(buffer, at)
            if length is None or (length and at + length > len(buffer)):
                break
            packet = check_packet(bytes(buffer[at : at + length])) if length else None
            if packet is None:
                self.skipped_bytes += 1
                at += 1
            else:
                found.append(packet)
                self.packets[packet.system] += 1
                at += length
        del buffer[:at]
        return found
