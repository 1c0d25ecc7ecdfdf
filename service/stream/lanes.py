"""The lanes of the drone's outbox: each gives its next message, newest items first."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, replace

from service.stream.messages import Ask
from service.stream.parts import HEAD_BYTES, MAX_PARTS, Part, split, split_in
from service.stream.ranges import RangeSet
from service.stream.store import ScanStore

MAX_ASKED = 512
"""Numbers of one request that are answered; the ground asks again for the rest."""


@dataclass(frozen=True, slots=True, eq=False)
class Outgoing:
    """One message for the link."""

    scan_id: str
    topic: str  # "head", or "item/<kind>/<numbers>"
    payload: bytes
    lane: int = 0
    token: Hashable | None = None  # of the request that it answers; None for a live message
    last: bool = False  # no more will answer that request


def load(store: ScanStore, kind: str, number: int, part_bytes: int) -> list[Part]:
    """The parts of a stored record; none when the store does not hold it."""
    record = store.record(kind, number)
    return [] if record is None else split(kind, number, record, part_bytes)


class LiveLane:
    """New items on their way to whoever listens; at most ``room``, the oldest make way."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._queue: deque[tuple[ScanStore, str, int]] = deque()
        self._messages: deque[Outgoing] = deque()
        self._current: tuple[ScanStore, str, int] | None = None
        self.skipped = 0  # items that made way

    def push(self, store: ScanStore, kind: str, number: int) -> None:
        """Put a new item in front."""
        self._queue.append((store, kind, number))
        while len(self._queue) > self._room:
            self._queue.popleft()
            self.skipped += 1

    def clear(self) -> None:
        """Drop everything: nobody listens."""
        self.skipped += len(self._queue)
        self._queue.clear()
        self._messages.clear()
        self._current = None

    def sending(self, store: ScanStore, kind: str, number: int) -> bool:
        """Whether parts of this item are being sent right now."""
        return self._current == (store, kind, number)

    def discard(self, store: ScanStore, kind: str, number: int) -> None:
        """Take out an item that is about to travel as an answer."""
        if (store, kind, number) in self._queue:
            self._queue.remove((store, kind, number))

    def numbers(self, store: ScanStore) -> dict[str, RangeSet]:
        """What of ``store`` is still to come."""
        out: dict[str, RangeSet] = {}
        for item in (*self._queue, self._current):
            if item is not None and item[0] is store:
                out.setdefault(item[1], RangeSet()).add(item[2])
        return out

    def peek(self, part_bytes: int) -> Outgoing | None:
        """The next message, or None."""
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
        """Remove the message that :meth:`peek` gave."""
        self._messages.popleft()
        if not self._messages:
            self._current = None


@dataclass(slots=True, eq=False)
class Request:
    """Items of one kind that a ground station asked for."""

    store: ScanStore
    ask: Ask
    kind: str
    topic: str
    left: deque[int]
    token: Hashable


class AskedLane:
    """Answers, in turn to each ground station that asked; one request of each at a time."""

    def __init__(self) -> None:
        self._turn: deque[Request] = deque()
        self._messages: deque[Outgoing] = deque()

    def push(self, request: Request) -> Hashable | None:
        """Queue a request; the token of the one it takes the place of, if any."""
        replaced = None
        for old in list(self._turn):
            if old.ask.peer == request.ask.peer and old.store is request.store:
                self._turn.remove(old)
                replaced = old.token
        self._messages = deque(m for m in self._messages if m.token != replaced)
        self._turn.append(request)
        return replaced

    def peek(self, part_bytes: int) -> Outgoing | None:
        """The next message, or None."""
        while not self._messages and self._turn:
            request = self._turn.popleft()
            parts = self._some(request, part_bytes)
            self._messages.extend(_bundle(request, parts, part_bytes))
            if request.left:
                self._turn.append(request)
            elif self._messages:
                self._messages[-1] = replace(self._messages[-1], last=True)
            else:
                self._messages.append(
                    Outgoing(
                        request.store.header.name,
                        request.topic,
                        b"",
                        token=request.token,
                        last=True,
                    )
                )
        return self._messages[0] if self._messages else None

    def pop(self) -> None:
        """Remove the message that :meth:`peek` gave."""
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
    """The parts of a record that the request names, cut as the station knows it."""
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
    return [Outgoing(scan_id, request.topic, p, token=request.token) for p in payloads]
