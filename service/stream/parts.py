"""Records cut into paced parts, and put together again.

A message on the datalink is a run of parts; a part carries a piece of one record (a chunk
layer, a pose …). Bytes are in ``docs/wire.md``. Foreign bytes are dropped and counted.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from service.stream.validity import MAX_HEADER_BYTES, MAX_SUMMARY_BYTES

_HEAD = struct.Struct("<2sBBIHHIII")
HEAD_BYTES = _HEAD.size
MAGIC = b"SK"
VERSION = 1
MAX_RECORD_BYTES, MAX_SMALL_BYTES = 1 << 24, 1024
MAX_BYTES = {
    "header": MAX_HEADER_BYTES,
    "summary": MAX_SUMMARY_BYTES,
    "pose": MAX_SMALL_BYTES,
    "repose": MAX_SMALL_BYTES,
}
"""Bytes of a record by kind; layers have MAX_RECORD_BYTES at most."""
MAX_PARTS = 65_535
MAX_COUNTED = (1 << 24) - 1
"""The highest number of a pose, re-pose or keyframe: ten a second for 19 days."""
MAX_OPEN_RECORDS = 64
MAX_OPEN_BYTES = 1 << 25
"""Unfinished records beyond either limit make way, the stalest first."""
PIECE_BYTES = 160
"""What keeping a part takes beyond its payload."""

KINDS = {0: "header", 1: "summary", 2: "pose", 3: "repose"} | {16 + k: f"k{k}" for k in range(8)}
"""Code of a part to the kind of its record: ``k0`` is the coarsest layer of a keyframe."""
CODES = {name: code for code, name in KINDS.items()}
WHOLE = ("header", "summary")
"""Kinds of which a scan has one; a new one replaces the former."""


@dataclass(frozen=True, slots=True)
class Part:
    """A piece of a record."""

    kind: str
    number: int
    index: int
    count: int
    total_bytes: int
    crc: int  # of the whole record
    payload: bytes

    def pack(self) -> bytes:
        """The part as bytes."""
        return (
            _HEAD.pack(
                MAGIC,
                VERSION,
                CODES[self.kind],
                self.number,
                self.index,
                self.count,
                self.total_bytes,
                self.crc,
                len(self.payload),
            )
            + self.payload
        )


def split(kind: str, number: int, record: bytes, part_bytes: int) -> list[Part]:
    """The parts of ``record``, equally large but for the last, each of at most ``part_bytes``."""
    count = max(1, -(-len(record) // max(part_bytes, 1)))
    return split_in(kind, number, record, min(count, MAX_PARTS))


def split_in(kind: str, number: int, record: bytes, count: int) -> list[Part]:
    """The ``count`` parts of ``record``; fewer when it has fewer bytes."""
    step = max(1, -(-len(record) // count))
    crc = zlib.crc32(record)
    pieces = [record[at : at + step] for at in range(0, max(1, len(record)), step)]
    return [
        Part(kind, number, k, len(pieces), len(record), crc, piece)
        for k, piece in enumerate(pieces)
    ]


def parse(message: bytes) -> Iterator[Part]:
    """The parts in a message, up to the first byte that does not belong."""
    at = 0
    while at + HEAD_BYTES <= len(message):
        magic, version, code, number, index, count, total, crc, size = _HEAD.unpack_from(
            message, at
        )
        at += HEAD_BYTES
        if magic != MAGIC or version != VERSION or code not in KINDS or at + size > len(message):
            return
        kind = KINDS[code]
        if kind not in WHOLE and number > MAX_COUNTED:
            return
        if index >= count or total > MAX_BYTES.get(kind, MAX_RECORD_BYTES):
            return
        if size != _size_of(index, count, total):
            return
        yield Part(kind, number, index, count, total, crc, message[at : at + size])
        at += size


def _size_of(index: int, count: int, total: int) -> int:
    """Bytes of a part: all but the last have the same size, and none is empty but that of an
    empty record. -1 when no record is cut like that."""
    step = max(1, -(-total // count))
    left = total - index * step
    if count > 1 and total - (count - 1) * step <= 0:
        return -1
    return min(step, left)


@dataclass(slots=True)
class _Open:
    count: int
    total_bytes: int
    crc: int
    pieces: dict[int, bytes]
    held_bytes: int = 0
    touched: float = 0.0

    def same(self, part: Part) -> bool:
        return (part.count, part.total_bytes, part.crc) == (self.count, self.total_bytes, self.crc)


class Assembler:
    """Collects parts in any order and gives each record once it is whole and sound."""

    def __init__(self) -> None:
        self._open: dict[tuple[str, int], _Open] = {}
        self._bytes = 0
        self.spoiled = 0  # records whose checksum failed
        self.repeated = 0  # parts that came twice

    def add(self, part: Part, now: float) -> bytes | None:
        """The record that ``part`` completes, or None."""
        key = (part.kind, part.number)
        entry = self._open.get(key)
        if entry is None or not entry.same(part):
            self.forget(*key)
            entry = self._open[key] = _Open(part.count, part.total_bytes, part.crc, {})
        entry.touched = now
        if part.index in entry.pieces:
            self.repeated += 1
            return None
        entry.pieces[part.index] = part.payload
        entry.held_bytes += len(part.payload) + PIECE_BYTES
        self._bytes += len(part.payload) + PIECE_BYTES
        if len(entry.pieces) < entry.count:
            self._make_room(key)
            return None
        record = b"".join(entry.pieces[k] for k in range(entry.count))
        self.forget(*key)
        if len(record) != entry.total_bytes or zlib.crc32(record) != entry.crc:
            self.spoiled += 1
            return None
        return record

    @property
    def held_bytes(self) -> int:
        """What the unfinished records take."""
        return self._bytes

    def missing_parts(self, kind: str, number: int) -> list[int] | None:
        """The parts still to come of a record that has begun; None when it has not."""
        entry = self._open.get((kind, number))
        if entry is None:
            return None
        return [k for k in range(entry.count) if k not in entry.pieces]

    def count(self, kind: str, number: int) -> int:
        """How many parts a record that has begun is cut into; 0 when it has not."""
        entry = self._open.get((kind, number))
        return 0 if entry is None else entry.count

    def touched(self, kind: str, number: int) -> float | None:
        """When a part of the record came last; None when it has not begun."""
        entry = self._open.get((kind, number))
        return None if entry is None else entry.touched

    def forget(self, kind: str, number: int) -> None:
        """Drop what came of a record."""
        entry = self._open.pop((kind, number), None)
        if entry is not None:
            self._bytes -= entry.held_bytes

    def _make_room(self, keep: tuple[str, int]) -> None:
        while len(self._open) > MAX_OPEN_RECORDS or self._bytes > MAX_OPEN_BYTES:
            stalest: Iterable[tuple[str, int]] = (key for key in self._open if key != keep)
            key = min(stalest, key=lambda k: self._open[k].touched, default=keep)
            self.forget(*key)
            if key == keep:
                return
