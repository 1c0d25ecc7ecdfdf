"""The small JSON messages of the datalink: what a drone has, what a ground holds and asks."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from service.stream.parts import CODES
from service.stream.ranges import RangeSet, ranges_from_pairs

MAX_MESSAGE_BYTES = 262_144
VERSION = 1

Numbers = dict[str, RangeSet]
"""Kind of item to the numbers of that kind."""


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """What the drone has of a scan, and which of it is about to come by itself."""

    numbers: Numbers
    live: Numbers = field(default_factory=dict)
    finished: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """What a ground station holds of a scan."""

    numbers: Numbers
    received_bytes: int = 0  # of this scan, since the ground started


@dataclass(frozen=True, slots=True, eq=False)
class Ask:
    """What goes with a request for items: who asks and, for one record, which parts."""

    peer: str
    parts: RangeSet | None = None  # None for all
    parts_of: int = 0  # the count of parts that ``parts`` refers to


class _HeadJson(msgspec.Struct):
    v: int
    numbers: dict[str, list[tuple[int, int]]]
    live: dict[str, list[tuple[int, int]]]
    finished: bool


class _HeldJson(msgspec.Struct):
    v: int
    numbers: dict[str, list[tuple[int, int]]]
    received_bytes: int


class _AskJson(msgspec.Struct):
    v: int
    peer: str
    parts: list[tuple[int, int]] | None = None
    parts_of: int = 0


def pack_head(head: Head) -> bytes:
    """``head`` as JSON."""
    return msgspec.json.encode(
        _HeadJson(
            VERSION,
            pairs_of(head.numbers),
            pairs_of(head.live),
            head.finished,
        )
    )


def unpack_head(data: bytes) -> Head | None:
    """The head in ``data``; None for anything else."""
    try:
        if len(data) > MAX_MESSAGE_BYTES:
            return None
        raw = msgspec.json.decode(data, type=_HeadJson)
    except (msgspec.DecodeError, msgspec.ValidationError, RecursionError):
        return None
    numbers, live = numbers_from(raw.numbers), numbers_from(raw.live)
    if raw.v != VERSION or numbers is None or live is None:
        return None
    return Head(numbers, live, raw.finished)


def pack_held(held: Held) -> bytes:
    """``held`` as JSON."""
    return msgspec.json.encode(_HeldJson(VERSION, pairs_of(held.numbers), held.received_bytes))


def unpack_held(data: bytes) -> Held | None:
    """The report in ``data``; None for anything else."""
    try:
        if len(data) > MAX_MESSAGE_BYTES:
            return None
        raw = msgspec.json.decode(data, type=_HeldJson)
    except (msgspec.DecodeError, msgspec.ValidationError, RecursionError):
        return None
    numbers = numbers_from(raw.numbers)
    if raw.v != VERSION or numbers is None:
        return None
    return Held(numbers, raw.received_bytes)


def pack_ask(ask: Ask) -> bytes:
    """``ask`` as JSON."""
    parts = None if ask.parts is None else ask.parts.pairs()
    return msgspec.json.encode(_AskJson(VERSION, ask.peer, parts, ask.parts_of))


def unpack_ask(data: bytes) -> Ask | None:
    """The request in ``data``; None for anything else."""
    try:
        if len(data) > MAX_MESSAGE_BYTES:
            return None
        raw = msgspec.json.decode(data, type=_AskJson)
    except (msgspec.DecodeError, msgspec.ValidationError, RecursionError):
        return None
    parts = None if raw.parts is None else ranges_from_pairs(raw.parts)
    if raw.v != VERSION or (parts is None) != (raw.parts is None) or len(raw.peer) > 128:
        return None
    return Ask(raw.peer, parts, raw.parts_of)


def pairs_of(numbers: Numbers) -> dict[str, list[tuple[int, int]]]:
    """``numbers`` as plain pairs, for JSON."""
    return {kind: ranges.pairs() for kind, ranges in numbers.items() if ranges}


def numbers_from(raw: dict[str, list[tuple[int, int]]]) -> Numbers | None:
    """The sets in decoded JSON; kinds that this version does not know are passed over."""
    out: Numbers = {}
    for kind, pairs in raw.items():
        if kind in CODES:
            ranges = ranges_from_pairs(pairs)
            if ranges is None:
                return None
            out[kind] = ranges
    return out


def missing(wanted: Numbers, held: Numbers) -> Numbers:
    """What is in ``wanted`` and not in ``held``; kinds of which nothing lacks are left out."""
    lacks = {kind: ranges - held.get(kind, RangeSet()) for kind, ranges in wanted.items()}
    return {kind: ranges for kind, ranges in lacks.items() if ranges}


def count(numbers: Numbers) -> int:
    """How many items there are in all."""
    return sum(len(ranges) for ranges in numbers.values())
