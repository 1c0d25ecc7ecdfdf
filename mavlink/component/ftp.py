"""MAVLink FTP, read-only: a few small files (camera definition, metadata) from memory.

Payload of FILE_TRANSFER_PROTOCOL, little endian: u16 sequence, u8 session, u8 opcode, u8 size,
u8 opcode answered, u8 burst complete, u8 padding, u32 offset, 239 bytes of data.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from mavlink.wire.dialect import dialect
from mavlink.wire.messages import Address, SendQueue

HEAD = struct.Struct("<HBBBBBBI")
ROOM = 239
PAYLOAD = 251
TERMINATE, RESET, LIST, OPEN, READ = 1, 2, 3, 4, 5
CRC32, BURST = 14, 15
ACK, NAK = 128, 129
BAD_SIZE, BAD_SESSION, END, UNKNOWN, PROTECTED, NOT_FOUND = 3, 4, 6, 7, 9, 10
WRITING = frozenset({6, 7, 8, 9, 10, 11, 12, 13})
MAX_SESSIONS = 8
MAX_CLIENTS = 16
BURST_PACKETS = 20
SELECTOR = re.compile(r"^/?\[;comp=\d{1,3}\]")
"""Prefix of an address before the path; some clients send it along with the path."""


def file_uri(component: int, name: str) -> str:
    """The address of a file of one of our components. It names the component, because an autopilot
    may forward our messages as its own."""
    return f"mftp://[;comp={component}]{name}"


def file_crc(data: bytes) -> int:
    """MAVLink's CRC32: it starts at zero and is not inverted at the end."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class FtpRequest:
    sequence: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes


def parse_request(payload: bytes) -> FtpRequest | None:
    if len(payload) < HEAD.size:
        return None
    sequence, session, opcode, size, _, _, _, offset = HEAD.unpack_from(payload)
    return FtpRequest(sequence, session, opcode, size, offset, payload[HEAD.size :][:ROOM])


class FileServer:
    """Serves files by name; every answer is a full payload. Where all sessions are open, a new one
    takes the place of the oldest of its client, or of all."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self._files = dict(files)
        self._sessions: dict[int, tuple[Address, bytes]] = {}
        self._last: dict[Address, tuple[FtpRequest, list[bytes]]] = {}  # to repeat lost answers

    def answer(self, payload: bytes, source: Address) -> list[bytes]:
        request = parse_request(payload)
        if request is None or request.opcode in (0, ACK, NAK):
            return []
        last = self._last.pop(source, None)
        is_repeated = last is not None and last[0] == request and request.opcode != BURST
        answers = last[1] if last is not None and is_repeated else self._serve(request, source)
        if len(self._last) >= MAX_CLIENTS:
            del self._last[next(iter(self._last))]
        self._last[source] = request, answers
        return answers

    def serve(self, message: Any, link: int, outbox: SendQueue) -> None:
        """Answer a FILE_TRANSFER_PROTOCOL message that is meant for one of our components."""
        source = Address(message.get_srcSystem(), message.get_srcComponent())
        for payload in self.answer(bytes(message.payload), source):
            reply = dialect.MAVLink_file_transfer_protocol_message(
                0, source.system, source.component, list(payload)
            )
            outbox.put(message.target_component, reply, link)

    def _serve(self, r: FtpRequest, source: Address) -> list[bytes]:
        if r.size > ROOM:
            return [_nak(r, BAD_SIZE)]
        if r.opcode == RESET:
            self._sessions = {n: s for n, s in self._sessions.items() if s[0] != source}
            return [_ack(r, b"")]
        if r.opcode == LIST:
            return [self._list(r)]
        if r.opcode in (OPEN, CRC32):
            return [self._by_name(r, source)]
        if r.opcode in WRITING:
            return [_nak(r, PROTECTED)]
        if r.opcode not in (TERMINATE, READ, BURST):
            return [_nak(r, UNKNOWN)]
        return self._by_session(r, source)

    def _list(self, r: FtpRequest) -> bytes:
        if _name(r).strip("/.") != "":
            return _nak(r, NOT_FOUND)
        entries = [f"F{n}\t{len(f)}\0".encode() for n, f in sorted(self._files.items())]
        if r.offset >= len(entries):
            return _nak(r, END)
        data = b""
        for entry in entries[r.offset :]:
            if len(data) + len(entry) > ROOM:
                break
            data += entry
        return _ack(r, data)

    def _by_name(self, r: FtpRequest, source: Address) -> bytes:
        file = self._files.get(_name(r).lstrip("/"))
        if file is None:
            return _nak(r, NOT_FOUND)
        if r.opcode == CRC32:
            return _ack(r, file_crc(file).to_bytes(4, "little"))
        if len(self._sessions) >= MAX_SESSIONS:  # clients that lost their link close none
            own = [n for n, session in self._sessions.items() if session[0] == source]
            del self._sessions[(own or list(self._sessions))[0]]
        free = next(n for n in range(MAX_SESSIONS) if n not in self._sessions)
        self._sessions[free] = (source, file)
        return _ack(r, len(file).to_bytes(4, "little"), session=free)

    def _by_session(self, r: FtpRequest, source: Address) -> list[bytes]:
        owner, file = self._sessions.get(r.session, (None, b""))
        if owner != source:
            return [_nak(r, BAD_SESSION)]
        if r.opcode == TERMINATE:
            del self._sessions[r.session]
            return [_ack(r, b"")]
        if r.offset >= len(file):
            return [_nak(r, END)]
        room = r.size or ROOM
        if r.opcode == READ:
            return [_ack(r, file[r.offset : r.offset + room])]
        end = min(len(file), r.offset + BURST_PACKETS * room)
        return [
            _ack(r, file[at : min(at + room, end)], k, at + room >= end, offset=at)
            for k, at in enumerate(range(r.offset, end, room))
        ]


def _name(r: FtpRequest) -> str:
    path = r.data[: r.size].partition(b"\0")[0].decode("ascii", "replace")
    return SELECTOR.sub("", path)


def _ack(r: FtpRequest, data: bytes, step: int = 0, last: bool = False, **changed: Any) -> bytes:
    """The answer; ``changed`` is the session or the offset where it is not the request's."""
    return _payload(replace(r, **changed), ACK, data, step, last)


def _nak(r: FtpRequest, error: int) -> bytes:
    return _payload(r, NAK, bytes((error,)))


def _payload(r: FtpRequest, code: int, data: bytes, step: int = 0, last: bool = False) -> bytes:
    sequence = (r.sequence + 1 + step) & 0xFFFF
    head = HEAD.pack(sequence, r.session, code, len(data), r.opcode, int(last), 0, r.offset)
    return (head + data).ljust(PAYLOAD, b"\0")
