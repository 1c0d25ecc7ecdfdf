"""The drone's side of the datalink, without sockets or clocks: what to send next, and when.

Lanes in order: status, pose, coarse live, requested small records and coarse layers, fine live,
requested fine layers. One token bucket limits all. Live lanes are short, newest first; items that
do not fit wait in the store until a ground station requests them.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

from service.stream.budget import RateEstimate, TokenBucket, wire_bytes
from service.stream.messages import (
    CODES,
    HEAD_BYTES,
    MAX_PARTS,
    Ask,
    Head,
    Held,
    Numbers,
    Part,
    count,
    missing,
    pack,
    split,
    split_in,
)
from service.stream.ranges import RangeSet
from service.stream.store import ScanStore

MAX_ASKED = 512  # maximum numbers answered per request; the ground requests the rest again


@dataclass(frozen=True, slots=True, eq=False)
class Outgoing:
    scan_id: str
    topic: str  # "head", or "item/<kind>/<numbers>"
    payload: bytes
    lane: int = 0
    token: Any = None  # the request that it answers; None for a live message
    peer: str = ""  # the station that it answers
    last: bool = False  # it completes that request


def load(store: ScanStore, kind: str, number: int, part_bytes: int) -> list[Part]:
    """The parts of a stored record; empty when the store does not hold it."""
    record = store.record(kind, number)
    return [] if record is None else split(kind, number, record, part_bytes)


class LiveLane:
    """New items to send unrequested; holds at most ``room``, then drops the oldest."""

    def __init__(self, room: int) -> None:
        self._queue: deque[tuple[ScanStore, str, int]] = deque(maxlen=room)
        self._messages: deque[Outgoing] = deque()
        self._current: tuple[ScanStore, str, int] | None = None

    def push(self, store: ScanStore, kind: str, number: int) -> None:
        self._queue.append((store, kind, number))

    def clear(self) -> None:
        """Drop everything: no station listens."""
        self._queue.clear()
        self._messages.clear()
        self._current = None

    def sending(self, store: ScanStore, kind: str, number: int) -> bool:
        """Whether parts of this item are being sent now."""
        return self._current == (store, kind, number)

    def discard(self, store: ScanStore, kind: str, number: int) -> None:
        """Remove an item that is about to be sent as an answer."""
        if (store, kind, number) in self._queue:
            self._queue.remove((store, kind, number))

    def numbers(self, store: ScanStore) -> dict[str, RangeSet]:
        """Items of ``store`` still queued."""
        out: dict[str, RangeSet] = {}
        for item in (*self._queue, self._current):
            if item is not None and item[0] is store:
                out.setdefault(item[1], RangeSet()).add(item[2])
        return out

    def peek(self, part_bytes: int) -> Outgoing | None:
        while not self._messages:
            self._current = None
            if not self._queue:
                return None
            self._current = store, kind, number = self._queue.pop()
            topic = f"item/{kind}/{number}"
            for part in load(store, kind, number, part_bytes):
                self._messages.append(Outgoing(store.header.name, topic, part.pack()))
        return self._messages[0]

    def pop(self) -> None:
        self._messages.popleft()
        if not self._messages:
            self._current = None


@dataclass(slots=True, eq=False)
class Request:
    store: ScanStore
    ask: Ask
    kind: str
    topic: str
    left: deque[int]
    token: Any  # whatever the link knows it by


class AskedLane:
    """Answers to each ground station in turn; one request of each at a time."""

    def __init__(self) -> None:
        self._turn: deque[Request] = deque()
        self._messages: deque[Outgoing] = deque()

    def push(self, request: Request) -> Any:
        """Queue a request; returns the token of the request it replaces, if any."""
        replaced = None
        for old in list(self._turn):
            if old.ask.peer == request.ask.peer and old.store is request.store:
                self._turn.remove(old)
                replaced = old.token
        self._messages = deque(m for m in self._messages if m.token != replaced)
        self._turn.append(request)
        return replaced

    def peek(self, part_bytes: int) -> Outgoing | None:
        while not self._messages and self._turn:
            request = self._turn.popleft()
            parts = self._some(request, part_bytes)
            self._messages.extend(_bundle(request, parts, part_bytes))
            if request.left:
                self._turn.append(request)
            elif self._messages:
                self._messages[-1] = replace(self._messages[-1], last=True)
            else:
                name = request.store.header.name
                self._messages.append(
                    Outgoing(name, request.topic, b"", 0, request.token, request.ask.peer, True)
                )
        return self._messages[0] if self._messages else None

    def pop(self) -> None:
        self._messages.popleft()

    def _some(self, request: Request, part_bytes: int) -> list[Part]:
        """Parts of the next record, or of as many small records as fill a message."""
        parts: list[Part] = []
        size = 0
        while request.left and size < part_bytes:
            loaded = _wanted(request, request.left.popleft(), part_bytes)
            parts += loaded
            size += sum(len(part.payload) + HEAD_BYTES for part in loaded)
        return parts


def _wanted(request: Request, number: int, part_bytes: int) -> list[Part]:
    """The parts of a record that the request names, cut as the station has it."""
    record = request.store.record(request.kind, number)
    if record is None:
        return []
    ask = request.ask
    if ask.parts is None or not 0 < ask.parts_of <= MAX_PARTS:
        return split(request.kind, number, record, part_bytes)
    cut = split_in(request.kind, number, record, ask.parts_of)
    return [part for part in cut if part.index in ask.parts or part.count != ask.parts_of]


def _bundle(request: Request, parts: list[Part], part_bytes: int) -> list[Outgoing]:
    """``parts`` in messages of about ``part_bytes``."""
    payloads: list[bytes] = []
    for part in parts:
        data = part.pack()
        if payloads and len(payloads[-1]) + len(data) <= part_bytes + HEAD_BYTES:
            payloads[-1] += data
        else:
            payloads.append(data)
    scan_id = request.store.header.name
    peer = request.ask.peer
    return [Outgoing(scan_id, request.topic, p, 0, request.token, peer) for p in payloads]


STATUS, POSE, COARSE, ASKED, FINE, BACKFILL = range(6)  # the lanes, most urgent first

PEER_TIMEOUT_S = 8.0
MAX_STATIONS = 8  # maximum ground stations served; another one waits until one of them is silent
MAX_ESTIMATES = 256  # rates of stations that are kept across sessions
HEAD_AFTER_NEWS_S = 0.5
HEAD_IDLE_S = 2.0
HEAD_COMPLETE_S = 10.0
FIRST_BYTES_S = 40_000.0  # a link that carries less than this is sent no first depths
POSE_ROOM, COARSE_ROOM, FINE_ROOM = 64, 32, 4
"""Capacity of each live lane; the last one carries image and fine layer of a keyframe."""


@dataclass(slots=True, eq=False)
class _Feed:
    store: ScanStore
    head_due: float
    head_sent: float = -1e9
    held: dict[str, Numbers] = field(default_factory=dict)
    sent_bytes: Counter[str] = field(default_factory=Counter)
    """Of its items: to each station on request, and to "" unrequested."""


class Outbox:
    """Decides what the drone sends. All times are the caller's: seconds, monotonic."""

    def __init__(self, rate_bytes_s: float, now: float) -> None:
        self.bucket = TokenBucket(rate_bytes_s, now)
        self._feeds: dict[str, _Feed] = {}
        self._live = {
            POSE: LiveLane(POSE_ROOM),
            COARSE: LiveLane(COARSE_ROOM),
            FINE: LiveLane(FINE_ROOM),
        }
        self._asked = {ASKED: AskedLane(), BACKFILL: AskedLane()}
        self._heard: dict[str, float] = {}
        self._estimates: dict[tuple[str, str], RateEstimate] = {}
        self._configured = rate_bytes_s
        self._head: Outgoing | None = None

    def add(self, store: ScanStore, now: float) -> None:
        """Offer a scan; it replaces a scan of the same id."""
        self._feeds[store.header.name] = _Feed(store, head_due=now)

    # Events

    def on_item(self, scan_id: str, kind: str, number: int, now: float) -> None:
        feed = self._feeds.get(scan_id)
        if feed is None:
            return
        feed.head_due = min(feed.head_due, max(now, feed.head_sent + HEAD_AFTER_NEWS_S))
        if kind in ("header", "summary") or not self.listened(now):
            return
        if kind == "first" and self.bucket.rate_bytes_s < FIRST_BYTES_S:
            return
        lane = POSE if kind in ("pose", "repose") else COARSE if kind in ("k0", "first") else FINE
        self._live[lane].push(feed.store, kind, number)

    def offers(self, scan_id: str) -> bool:
        return scan_id in self._feeds

    def serves(self, peer: str) -> bool:
        return peer in self._heard

    def on_held(self, scan_id: str, peer: str, report: Held, now: float) -> bool:
        """A ground station reports its items; False when it is not served."""
        feed = self._feeds.get(scan_id)
        is_first = not self.listened(now)
        if feed is None or not self._hear(peer, now):
            return False
        feed.held.pop(peer, None)
        feed.held[peer] = report.numbers
        for former in list(feed.held)[:-MAX_STATIONS]:
            del feed.held[former]
        if is_first:
            self._catch_up(feed, report.numbers)
        estimate = self._estimates.setdefault((scan_id, peer), RateEstimate(self._configured))
        estimate.report(feed.sent_bytes[""] + feed.sent_bytes[peer], report.received_bytes, now)
        self._adapt(now)
        return True

    def _catch_up(self, feed: _Feed, held: Numbers) -> None:
        """Queue the newest coarse layers that a new station lacks."""
        lacks = feed.store.numbers().get("k0", RangeSet()) - held.get("k0", RangeSet())
        for number in reversed(list(islice(lacks.newest_first(), COARSE_ROOM))):
            self._live[COARSE].push(feed.store, "k0", number)

    def reconnected(self, now: float) -> None:
        """The connection is new: no station was heard on it, and nothing is in flight."""
        self._heard.clear()
        self._estimates = dict(list(self._estimates.items())[-MAX_ESTIMATES:])
        for estimate in self._estimates.values():
            estimate.restart()
        self._clear_live()
        self.forget_requests()
        self._head = None
        for feed in self._feeds.values():
            feed.head_due = now
            feed.sent_bytes.clear()

    def forget_requests(self) -> None:
        self._asked = {ASKED: AskedLane(), BACKFILL: AskedLane()}

    def set_rate(self, rate_bytes_s: float, now: float) -> None:
        """Change the maximum rate; congestion may lower it."""
        self._configured = rate_bytes_s
        self._estimates.clear()
        self._adapt(now)

    def _adapt(self, now: float) -> None:
        """Adapt to the rate that the best supplied ground station receives."""
        rates = [
            estimate.rate_bytes_s
            for (_, peer), estimate in self._estimates.items()
            if now - self._heard.get(peer, -1e9) < PEER_TIMEOUT_S
        ]
        self.bucket.set_rate(max(rates, default=self._configured), now)

    def on_ask(
        self, scan_id: str, kind: str, numbers: RangeSet, ask: Ask, token: Any, now: float
    ) -> list[Any]:
        """A ground station requests items; returns the tokens of requests that this ends. A request
        replaces the station's previous one in its lane."""
        feed = self._feeds.get(scan_id)
        if feed is None or kind not in CODES or not self._hear(ask.peer, now):
            return [token]
        left: deque[int] = deque()
        for number in islice(numbers.newest_first(), MAX_ASKED):
            if not any(lane.sending(feed.store, kind, number) for lane in self._live.values()):
                left.append(number)
            for lane in self._live.values():
                lane.discard(feed.store, kind, number)
        small = kind == "k0" or not kind.startswith("k")
        topic = f"item/{kind}/{numbers.text()}"
        request = Request(feed.store, ask, kind, topic, left, token)
        replaced = self._asked[ASKED if small else BACKFILL].push(request)
        return [] if replaced is None else [replaced]

    def publish_heads(self, now: float) -> None:
        """Send the heads as soon as possible, for a new station."""
        for feed in self._feeds.values():
            feed.head_due = min(feed.head_due, max(now, feed.head_sent + HEAD_AFTER_NEWS_S))

    def _hear(self, peer: str, now: float) -> bool:
        """Note that a station listens; False when too many do."""
        if peer not in self._heard and len(self._heard) >= MAX_STATIONS:
            silent = min(self._heard, key=self._heard.__getitem__)
            if now - self._heard[silent] < PEER_TIMEOUT_S:
                return False
            del self._heard[silent]
            for key in [key for key in self._estimates if key[1] == silent]:
                del self._estimates[key]
            for feed in self._feeds.values():
                feed.sent_bytes.pop(silent, None)
        if not self.listened(now):
            self.publish_heads(now)
        self._heard[peer] = now
        return True

    # Output

    def next(self, now: float, sessions: int = 1) -> Outgoing | float:
        """The message to send now, or the seconds to wait; any event may shorten the wait. A live
        message goes over the link once for each of the ``sessions``, an answer once."""
        if not self.listened(now):
            self._clear_live()
        part_bytes = self.bucket.part_bytes
        for number in range(6):
            lane = self._live.get(number) or self._asked.get(number)
            message = self._peek_head(now) if lane is None else lane.peek(part_bytes)
            if message is None:
                continue
            size = wire_bytes(len(message.payload))
            wait = self.bucket.ready_in(size, now)
            if wait > 0:
                return wait
            size *= sessions if message.token is None else 1
            self.bucket.take(size, now)
            if lane is None:
                self._head = None
            else:
                lane.pop()
                if message.scan_id in self._feeds:
                    self._feeds[message.scan_id].sent_bytes[message.peer] += len(message.payload)
            return replace(message, lane=number)
        due = min((feed.head_due for feed in self._feeds.values()), default=now + 1.0)
        return min(1.0, max(0.001, due - now))

    def _clear_live(self) -> None:
        for lane in self._live.values():
            lane.clear()

    def _peek_head(self, now: float) -> Outgoing | None:
        if self._head is None:
            for scan_id, feed in self._feeds.items():
                if feed.head_due <= now:
                    feed.head_sent = now
                    feed.head_due = now + (
                        HEAD_COMPLETE_S if self.complete(scan_id) else HEAD_IDLE_S
                    )
                    self._head = Outgoing(scan_id, "head", pack(self.head(scan_id)))
                    break
        return self._head

    def head(self, scan_id: str) -> Head:
        """The head of an offered scan. Raises KeyError for any other."""
        store = self._feeds[scan_id].store
        live: Numbers = {}
        for lane in self._live.values():
            live.update(lane.numbers(store))
        return Head(store.numbers(), live, store.finished)

    def listened(self, now: float) -> bool:
        """Whether a ground station was heard recently."""
        return any(now - at < PEER_TIMEOUT_S for at in self._heard.values())

    def lacking(self, scan_id: str) -> Numbers:
        """Items of an offered scan that the best supplied ground station lacks."""
        best = self.best(scan_id)
        numbers = self._feeds[scan_id].store.numbers()
        return numbers if best is None else missing(numbers, best[1])

    def best(self, scan_id: str) -> tuple[str, Numbers] | None:
        """The best supplied ground station and its items; None without a report."""
        feed = self._feeds[scan_id]
        numbers = feed.store.numbers()
        return min(
            feed.held.items(), key=lambda entry: count(missing(numbers, entry[1])), default=None
        )

    def complete(self, scan_id: str) -> bool:
        """Whether some ground station holds all items of the scan so far."""
        return not self.lacking(scan_id)
