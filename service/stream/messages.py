"""Messages of the datalink: records cut into paced parts, and small JSON messages.

A message of items is a sequence of parts; a part carries a piece of one record (a chunk layer, a
pose …). ``docs/wire.md`` specifies the bytes. Invalid bytes are dropped and counted. Every number
in the JSON messages has a plausible range; a message that violates one is invalid.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Annotated, TypeVar

import msgspec
from msgspec import Meta

from service.stream.codec import MAX_IMAGE_BYTES
from service.stream.naming import MAX_NAME, NAME
from service.stream.ranges import RangeSet, ranges_from_pairs
from service.stream.validity import MAX_HEADER_BYTES, MAX_SUMMARY_BYTES

_HEAD = struct.Struct("<2sBBIHHIII")
HEAD_BYTES = _HEAD.size
MAGIC = b"SK"
PART_VERSION = 1
MAX_RECORD_BYTES, MAX_FIRST_BYTES, MAX_SMALL_BYTES = 1 << 24, 1 << 16, 1024
MAX_BYTES = {
    "image": MAX_IMAGE_BYTES,
    "first": MAX_FIRST_BYTES,
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
MAX_OPEN_BYTES = 1 << 25  # above either limit unfinished records are dropped, the oldest first
PIECE_BYTES = 160  # memory per part beyond its payload

KINDS = {0: "header", 1: "summary", 2: "pose", 3: "repose", 4: "image", 5: "first"} | {
    16 + k: f"k{k}" for k in range(8)
}
"""Code of a part to the kind of its record: ``k0`` is the coarsest layer of a keyframe."""
CODES = {name: code for code, name in KINDS.items()}
WHOLE = ("header", "summary")  # kinds of which a scan has one; a new one replaces the previous one


@dataclass(frozen=True, slots=True)
class Part:
    kind: str
    number: int
    index: int
    count: int
    total_bytes: int
    crc: int  # of the whole record
    payload: bytes

    def pack(self) -> bytes:
        place = CODES[self.kind], self.number, self.index, self.count, self.total_bytes, self.crc
        return _HEAD.pack(MAGIC, PART_VERSION, *place, len(self.payload)) + self.payload


def split(kind: str, number: int, record: bytes, part_bytes: int) -> list[Part]:
    """The parts of ``record``, of equal size except the last, each at most ``part_bytes``."""
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
    """The parts in a message, up to the first invalid byte."""
    at = 0
    while at + HEAD_BYTES <= len(message):
        magic, version, code, number, index, count, total, crc, size = _HEAD.unpack_from(
            message, at
        )
        at += HEAD_BYTES
        if (
            magic != MAGIC
            or version != PART_VERSION
            or code not in KINDS
            or at + size > len(message)
        ):
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
    """Bytes of a part: all but the last have the same size, and only an empty record has an empty
    part. -1 when no record is cut like that."""
    step = max(1, -(-total // count))
    left = total - index * step
    if count > 1 and total - (count - 1) * step <= 0:
        return -1
    return min(step, left)


@dataclass(slots=True)
class _Open:
    cut: tuple[int, int, int]  # count of parts, bytes and CRC of the record
    pieces: dict[int, bytes] = field(default_factory=dict)
    held_bytes: int = 0
    touched: float = 0.0


class Assembler:
    """Collects parts in any order and returns each record once it is complete and valid."""

    def __init__(self, max_open_bytes: int = MAX_OPEN_BYTES) -> None:
        """Unfinished records take at most so much memory."""
        self._max_open_bytes = max_open_bytes
        self._open: dict[tuple[str, int], _Open] = {}
        self.held_bytes = 0  # memory used by unfinished records

    def add(self, part: Part, now: float) -> bytes | None:
        """The record that ``part`` completes, or None."""
        key = (part.kind, part.number)
        cut = part.count, part.total_bytes, part.crc
        entry = self._open.get(key)
        if entry is None or entry.cut != cut:
            self.forget(*key)
            entry = self._open[key] = _Open(cut)
        entry.touched = now
        if part.index in entry.pieces:
            return None
        entry.pieces[part.index] = part.payload
        entry.held_bytes += len(part.payload) + PIECE_BYTES
        self.held_bytes += len(part.payload) + PIECE_BYTES
        if len(entry.pieces) < part.count:
            self._make_room(key)
            return None
        record = b"".join(entry.pieces[k] for k in range(part.count))
        self.forget(*key)
        whole = len(record) == part.total_bytes and zlib.crc32(record) == part.crc
        return record if whole else None

    def missing_parts(self, kind: str, number: int) -> tuple[list[int], int]:
        """The missing parts of a record in progress, and its count of parts; ([], 0) for others."""
        entry = self._open.get((kind, number))
        if entry is None:
            return [], 0
        count, *_ = entry.cut
        return [k for k in range(count) if k not in entry.pieces], count

    def touched(self, kind: str, number: int) -> float:
        """Time of the last part of a record in progress; -inf for any other."""
        entry = self._open.get((kind, number))
        return -math.inf if entry is None else entry.touched

    def forget(self, kind: str, number: int) -> None:
        entry = self._open.pop((kind, number), None)
        if entry is not None:
            self.held_bytes -= entry.held_bytes

    def _make_room(self, keep: tuple[str, int]) -> None:
        while len(self._open) > MAX_OPEN_RECORDS or self.held_bytes > self._max_open_bytes:
            stalest: Iterable[tuple[str, int]] = (key for key in self._open if key != keep)
            key = min(stalest, key=lambda k: self._open[k].touched, default=keep)
            self.forget(*key)
            if key == keep:
                return


MAX_MESSAGE_BYTES = 262_144
MAX_KINDS = 64
MAX_RECEIVED_BYTES = 1 << 53

Numbers = dict[str, RangeSet]  # kind of item to the numbers of that kind
_Numbers = Annotated[Numbers, Meta(max_length=MAX_KINDS)]


class _Message(msgspec.Struct, frozen=True, eq=False, tag_field="v", tag=1):
    """A message as JSON; a tag other than ours is another version."""


class Head(_Message, frozen=True, eq=False):
    """The items of a scan that the drone has, and those it is about to send unrequested."""

    numbers: _Numbers
    live: _Numbers = {}
    finished: bool = False


class Held(_Message, frozen=True, eq=False):
    """Items of a scan that a ground station holds."""

    numbers: _Numbers
    received_bytes: Annotated[int, Meta(ge=0, le=MAX_RECEIVED_BYTES)] = 0  # since it started


class Ask(_Message, frozen=True, eq=False):
    """Details of a request for items: the sender and, for one record, its parts."""

    peer: Annotated[str, Meta(max_length=MAX_NAME, pattern=rf"^{NAME.pattern}\Z")]
    parts: RangeSet | None = None  # None for all
    parts_of: Annotated[int, Meta(ge=0, le=MAX_PARTS)] = 0  # the count that ``parts`` refers to


_Json = TypeVar("_Json", Head, Held, Ask)


def pack(message: Head | Held | Ask) -> bytes:
    """``message`` as JSON; kinds without any number are left out."""
    return msgspec.json.encode(message, enc_hook=_plain)


def unpack(data: bytes, kind: type[_Json]) -> _Json | None:
    """The message in ``data``, strict UTF-8; None for anything else.

    Unknown kinds of items are ignored. An implausible number makes the message invalid: a scan has
    one header, one summary, and numbers the rest.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        return None
    try:
        found = msgspec.json.decode(data.decode("utf-8"), type=kind, dec_hook=_ranges)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    if isinstance(found, Ask):
        fits = found.parts is None or found.parts.last < MAX_PARTS
        return found if fits else None
    sets = (found.numbers, found.live) if isinstance(found, Head) else (found.numbers,)
    return found if all(map(_are_plausible, sets)) else None


def _plain(value: object) -> object:
    assert isinstance(value, RangeSet)
    return value.pairs()


def _ranges(kind: type, value: object) -> RangeSet:
    found = ranges_from_pairs(value)
    if found is None:
        raise ValueError("not ranges")
    return found


def _are_plausible(numbers: Numbers) -> bool:
    """Whether these sets may be; unknown kinds are removed."""
    for kind in numbers.keys() - CODES.keys():
        del numbers[kind]
    return all(
        len(ranges) <= 1 if kind in WHOLE else ranges.last <= MAX_COUNTED
        for kind, ranges in numbers.items()
    )


def missing(wanted: Numbers, held: Numbers) -> Numbers:
    """Items in ``wanted`` and not in ``held``; kinds without any are left out."""
    lacks = {kind: ranges - held.get(kind, RangeSet()) for kind, ranges in wanted.items()}
    return {kind: ranges for kind, ranges in lacks.items() if ranges}


def count(numbers: Numbers) -> int:
    return sum(len(ranges) for ranges in numbers.values())
