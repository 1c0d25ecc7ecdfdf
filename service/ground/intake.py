"""The ground's side of the datalink for one scan, without sockets or clocks.

A scan that a drone names gets a folder for a valid header only (:class:`Introduction`). From then
on :class:`ScanIntake` stores what arrives and decides what to request: items that the drone has
announced and that are not on their way, small records first, then the newest and coarsest.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from itertools import islice

from service.stream.messages import Ask, Assembler, Head, Held, Numbers, missing, parse
from service.stream.ranges import MAX_RANGES, RangeSet
from service.stream.records import ScanHeader, header_from_json
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

HEADER_REST_S = 1.0  # interval between two requests for the header
MAX_KEPT_BYTES = 1 << 18  # items that may come before the header


class Introduction:
    """Asks for the header of one scan and waits for it. Times are the caller's, in seconds."""

    def __init__(self, drone: str, name: str) -> None:
        self.drone, self.name = drone, name
        self.head: Head | None = None
        self.seen_at = 0.0
        self.number, self.record = 0, b""  # the header as it came
        self.kept: list[bytes] = []  # messages of items that wait for the header
        self._kept_bytes = 0
        self._assembler = Assembler()
        self._ask_at = 0.0

    def on_head(self, head: Head, now: float) -> None:
        self.head, self.seen_at = head, now

    def next_ask(self, now: float) -> RangeSet | None:
        wanted = None if self.head is None else self.head.numbers.get("header")
        if not wanted or now < self._ask_at:
            return None
        self._ask_at = now + HEADER_REST_S
        return wanted

    def on_items(self, message: bytes, now: float) -> ScanHeader | None:
        """The scan's header once it is whole, valid and names the drone and scan of its key."""
        wanted = RangeSet() if self.head is None else self.head.numbers.get("header", RangeSet())
        for part in parse(message):
            if part.kind != "header":
                self._keep(message)
                return None
            if part.number not in wanted or part.crc != part.number:
                continue
            record = self._assembler.add(part, now)
            header = None if record is None else header_from_json(record)
            if record is None or header is None:
                continue
            if (header.drone, header.name) == (self.drone, self.name):
                self.number, self.record = part.number, record
                return header
        return None

    def _keep(self, message: bytes) -> None:
        if self._kept_bytes + len(message) <= MAX_KEPT_BYTES:
            self._kept_bytes += len(message)
            self.kept.append(message)


SMALL, FINE = range(2)
"""The two requests that may be under way: small records and coarse layers; fine layers."""

GRACE_S = 1.0  # an item that the drone has had for less than this may still arrive unrequested
STALL_S = 4.0
SILENCE_S = 4.0
"""A drone silent for so long was away, or its link was down; it has forgotten all requests."""
TIMED, MAX_TIMED = 64, 4096
"""Number of new layers of one kind in a head that are timed, the newest, and of all."""
REST_S = 2.0  # pause after a request without an answer

BATCH = {"header": 1, "summary": 1, "repose": 64, "pose": 64, "k0": 8, "image": 8}
"""Items of a kind that one request names, in the order of asking."""
MAX_FINE = 16
BRIEF_S, LONG_S = 1.5, 4.0
"""Requests for fine layers name more of them when they are answered sooner, fewer when later,
so that neither the round trip nor what is newer waits long."""


@dataclass(slots=True)
class _Request:
    kind: str
    numbers: RangeSet
    serial: int
    began: float
    news_at: float
    brought: int = 0
    moved: bool = False  # a part came


class ScanIntake:
    """Reception of one scan. Times are the caller's: seconds, monotonic."""

    def __init__(self, store: ScanStore, peer: str) -> None:
        self.store = store
        self.received_bytes = 0
        self.duplicates = 0  # records that came although held
        self.unsound = 0  # records that are not valid, or not what their parts said
        self.lag_s: dict[str, deque[float]] = {}  # by kind, the last 200
        self.asked = 0  # requests made
        self.head: Head | None = None
        self.head_at = -1e9
        self._peer = peer
        self._assembler = Assembler()
        self._heads: deque[tuple[float, Head]] = deque()
        self._seen: dict[tuple[str, int], float] = {}
        self._requests: dict[int, _Request] = {}
        self._rest_until: dict[int, float] = {}
        self._fine_batch = 2
        self._given_up: Numbers = {}

    # What comes

    def on_head(self, head: Head, now: float) -> None:
        for kind, numbers in missing(head.numbers, self.store.numbers()).items():
            if kind.startswith("k"):
                for number in islice(numbers.newest_first(), TIMED):
                    self._seen.setdefault((kind, number), now)
        while len(self._seen) > MAX_TIMED:
            del self._seen[next(iter(self._seen))]
        if now - self.head_at > SILENCE_S:
            self._requests.clear()
            self._rest_until.clear()
        # The first head names items made before this station listened: they are due at once.
        self._heads.append((now - GRACE_S if self.head is None else now, head))
        self.head, self.head_at = head, now

    def on_items(self, message: bytes, now: float) -> bool:
        """Parts of records; True when something new was stored that is part of the scan. Raises
        OutsideError when the disk is full; the records will be asked for again."""
        self.received_bytes += len(message)
        news = False
        for part in parse(message):
            if part.number in self.store.numbers_of(part.kind):
                self.duplicates += part.index == 0
                continue
            for request in self._requests.values():
                if request.kind == part.kind:
                    request.news_at, request.moved = now, True
            record = self._assembler.add(part, now)
            if record is not None:
                is_new = self._store(part.kind, part.number, record, now)
                news = news or (is_new and part.kind != "first")  # no file shows a first depth
        return news

    def _store(self, kind: str, number: int, record: bytes, now: float) -> bool:
        refused = self.store.refused
        if not self.store.put_record(kind, number, record):
            if self.store.refused > refused:
                log.warning("quota reached: %s %d of %s is not kept", kind, number, self.store.path)
            else:
                self.unsound += 1
            self._give_up(kind, number)
            return False
        for request in self._requests.values():
            request.brought += request.kind == kind
        self._note_lag(kind, number, now)
        return True

    def _give_up(self, kind: str, number: int) -> None:
        """Stop requesting an item. Beyond a maximum they are forgotten, and requested again."""
        given_up = self._given_up.setdefault(kind, RangeSet())
        if given_up.range_count >= MAX_RANGES:
            given_up = self._given_up[kind] = RangeSet()
        given_up.add(number)

    def _note_lag(self, kind: str, number: int, now: float) -> None:
        """Note the time between an item's announcement and its arrival, if it was timed."""
        seen = self._seen.pop((kind, number), None)
        is_named = self.head is not None and number in self.head.numbers.get(kind, RangeSet())
        if seen is None and is_named:
            return
        lags_s = self.lag_s.setdefault(kind, deque(maxlen=200))
        lags_s.append(0.0 if seen is None else now - seen)

    # What to say

    def held(self) -> Held:
        return Held(self.store.numbers(), self.received_bytes)

    def missing(self) -> Numbers:
        """Items that the drone has and this side lacks, as far as they can be had."""
        if self.head is None:
            return {}
        return missing(missing(self.head.numbers, self.store.numbers()), self._given_up)

    @property
    def held_bytes(self) -> int:
        return self._assembler.held_bytes

    def forget_unfinished(self) -> None:
        """Drop the parts of unfinished records; they are requested again."""
        self._assembler = Assembler()

    @property
    def complete(self) -> bool:
        """Whether the scan is finished and all of it is here that can be had."""
        return self.head is not None and self.head.finished and not self.missing()

    def next_ask(self, slot: int, now: float) -> tuple[str, RangeSet, Ask] | None:
        """The next request for a free slot: kind, numbers, and payload."""
        if not self._free(slot, now):
            return None
        due = self._due(now)
        fine = sorted(kind for kind in due if kind.startswith("k") and kind != "k0")
        for kind in BATCH if slot == SMALL else fine:
            numbers = self._newest(kind, due.get(kind, RangeSet()), now)
            if not numbers:
                continue
            first = next(iter(numbers.newest_first()))
            parts, count = self._assembler.missing_parts(kind, first)
            ask = Ask(self._peer)
            if parts:
                numbers = RangeSet([(first, first)])
                ask = Ask(self._peer, RangeSet.of(parts), count)
            self.asked += 1
            self._requests[slot] = _Request(kind, numbers, self.asked, now, now)
            return kind, numbers, ask
        return None

    def answered(self, slot: int, serial: int, now: float) -> None:
        """The ``serial``-th request, made in ``slot``, is over, answered or not."""
        request = self._requests.get(slot)
        if request is None or request.serial != serial:
            return
        del self._requests[slot]
        if slot == FINE and now - request.began > LONG_S:
            self._fine_batch = max(1, self._fine_batch // 2)
        elif slot == FINE and request.brought and now - request.began < BRIEF_S:
            self._fine_batch = min(MAX_FINE, 2 * self._fine_batch)
        if request.brought == 0 and not request.moved:
            self._rest_until[slot] = now + REST_S

    def _free(self, slot: int, now: float) -> bool:
        request = self._requests.get(slot)
        if request is not None:
            if now - request.news_at < STALL_S:
                return False
            self.answered(slot, request.serial, now)
        return now >= self._rest_until.get(slot, 0.0)

    def _due(self, now: float) -> Numbers:
        """Missing items that the drone has had for a while and is not about to send itself."""
        if self.head is None:
            return {}
        while len(self._heads) > 1 and self._heads[1][0] <= now - GRACE_S:
            self._heads.popleft()
        at, ripe = self._heads[0]
        due = self.missing()
        if now - at < GRACE_S:
            return {kind: due[kind] for kind in ("header", "summary") if kind in due}
        young = missing(self.head.numbers, ripe.numbers)
        young.pop("header", None)
        young.pop("summary", None)
        return missing(missing(due, young), self.head.live)

    def _newest(self, kind: str, due: RangeSet, now: float) -> RangeSet:
        out = RangeSet()
        room = BATCH.get(kind, self._fine_batch)
        for number in due.newest_first():
            if now - self._assembler.touched(kind, number) >= GRACE_S:
                out.add(number)
            if len(out) >= room:
                break
        return out
