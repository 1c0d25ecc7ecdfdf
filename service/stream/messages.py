"""The small JSON messages of the datalink: what a drone has, what a ground holds and asks.

Every number in them is bounded by what it means. A message that breaks a bound is no message.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Final, Literal, TypeVar

import msgspec
from msgspec import Meta

from service.stream.naming import MAX_NAME, NAME
from service.stream.parts import CODES, MAX_COUNTED, MAX_PARTS, WHOLE
from service.stream.ranges import MAX_NUMBER, MAX_RANGES, Pairs, RangeSet, ranges_from_pairs

MAX_MESSAGE_BYTES = 262_144
VERSION: Final = 1
MAX_KINDS = 64
MAX_RECEIVED_BYTES = 1 << 53

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


_Pair = tuple[Annotated[int, Meta(ge=0, le=MAX_NUMBER)], Annotated[int, Meta(ge=0, le=MAX_NUMBER)]]
_Ranges = Annotated[list[_Pair], Meta(max_length=MAX_RANGES)]
_Numbers = Annotated[dict[str, _Ranges], Meta(max_length=MAX_KINDS)]
_Name = Annotated[str, Meta(max_length=MAX_NAME, pattern=rf"^{NAME.pattern}\Z")]


class _HeadJson(msgspec.Struct):
    v: Literal[1]
    numbers: _Numbers
    live: _Numbers
    finished: bool


class _HeldJson(msgspec.Struct):
    v: Literal[1]
    numbers: _Numbers
    received_bytes: Annotated[int, Meta(ge=0, le=MAX_RECEIVED_BYTES)]


class _AskJson(msgspec.Struct):
    v: Literal[1]
    peer: _Name
    parts: _Ranges | None = None
    parts_of: Annotated[int, Meta(ge=0, le=MAX_PARTS)] = 0


_Json = TypeVar("_Json", _HeadJson, _HeldJson, _AskJson)


def _decode(data: bytes, kind: type[_Json]) -> _Json | None:
    """The message in ``data``, strict UTF-8; None for anything else."""
    if len(data) > MAX_MESSAGE_BYTES:
        return None
    try:
        return msgspec.json.decode(data.decode("utf-8"), type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


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
    raw = _decode(data, _HeadJson)
    if raw is None:
        return None
    numbers, live = numbers_from(raw.numbers), numbers_from(raw.live)
    if numbers is None or live is None:
        return None
    return Head(numbers, live, raw.finished)


def pack_held(held: Held) -> bytes:
    """``held`` as JSON."""
    return msgspec.json.encode(_HeldJson(VERSION, pairs_of(held.numbers), held.received_bytes))


def unpack_held(data: bytes) -> Held | None:
    """The report in ``data``; None for anything else."""
    raw = _decode(data, _HeldJson)
    numbers = None if raw is None else numbers_from(raw.numbers)
    return None if raw is None or numbers is None else Held(numbers, raw.received_bytes)


def pack_ask(ask: Ask) -> bytes:
    """``ask`` as JSON."""
    parts = None if ask.parts is None else ask.parts.pairs()
    return msgspec.json.encode(_AskJson(VERSION, ask.peer, parts, ask.parts_of))


def unpack_ask(data: bytes) -> Ask | None:
    """The request in ``data``; None for anything else."""
    raw = _decode(data, _AskJson)
    if raw is None:
        return None
    if raw.parts is None:
        return Ask(raw.peer, None, raw.parts_of)
    parts = ranges_from_pairs(raw.parts, MAX_PARTS - 1)
    return None if parts is None else Ask(raw.peer, parts, raw.parts_of)


def pairs_of(numbers: Numbers) -> dict[str, Pairs]:
    """``numbers`` as plain pairs, for JSON."""
    return {kind: ranges.pairs() for kind, ranges in numbers.items() if ranges}


def numbers_from(raw: dict[str, Pairs]) -> Numbers | None:
    """The sets in decoded JSON; kinds that this version does not know are passed over.

    None when a number cannot be: a scan has one header, one summary, and counts the rest.
    """
    out: Numbers = {}
    for kind, pairs in raw.items():
        if kind not in CODES:
            continue
        ranges = ranges_from_pairs(pairs, MAX_NUMBER if kind in WHOLE else MAX_COUNTED)
        if ranges is None or (kind in WHOLE and len(ranges) > 1):
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
