"""Queues of messages from the drones, bounded so that none takes another's memory."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from service.ground.received import ReceivedScan
from service.stream.records import ScanHeader
from service.workers import Worker

if TYPE_CHECKING:
    import zenoh

MAX_ITEM_BYTES, MAX_ITEMS = 8 << 20, 4096
MAX_HEADS = 256
"""Scans of one drone whose newest head may wait."""
MAX_EVENTS = 2048
ITEM_BYTES = 200
"""Bytes that a kept message takes beyond its payload."""


class Radio(NamedTuple):
    """A message of the narrow radio."""

    header: ScanHeader
    kind: str
    number: int
    part: int
    data: bytes


class Answered(NamedTuple):
    """The ``serial``-th request of a scan, made in ``slot``, is over."""

    scan: str
    slot: int
    serial: int


class Written(NamedTuple):
    """The deliverables of a scan are written, or why they are not."""

    scan: ReceivedScan
    trouble: str
    is_due: bool = False  # the disk refused a file


Event = Radio | Answered | Written


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Messages since the last call, in order."""

    heads: dict[str, bytes] = field(default_factory=dict)  # scan to its newest head
    items: list[tuple[str, bytes]] = field(default_factory=list)  # scan and message of parts
    events: list[Event] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.heads or self.items or self.events)


class Inbox:
    """Takes messages from any thread; each method returns False when there is no room."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._batch = Batch()
        self._item_bytes = 0
        self.dropped = 0

    def put_head(self, scan_id: str, payload: bytes) -> bool:
        """A head; it takes the place of one of the same scan that waits."""
        with self._changed:
            heads = self._batch.heads
            has_room = scan_id in heads or len(heads) < MAX_HEADS
            if has_room:
                heads[scan_id] = payload
            return self._noted(has_room)

    def put_item(self, scan_id: str, payload: bytes) -> bool:
        with self._changed:
            size = len(payload) + ITEM_BYTES
            has_room = (
                self._item_bytes + size <= MAX_ITEM_BYTES and len(self._batch.items) < MAX_ITEMS
            )
            if has_room:
                self._item_bytes += size
                self._batch.items.append((scan_id, payload))
            return self._noted(has_room)

    def put_event(self, event: Event) -> bool:
        """Something else to do; only the radio's may be too many, as the others are of our own."""
        with self._changed:
            has_room = len(self._batch.events) < MAX_EVENTS or not isinstance(event, Radio)
            if has_room:
                self._batch.events.append(event)
            return self._noted(has_room)

    def take(self, timeout_s: float) -> Batch:
        """All waiting messages; without any, those that arrive within the timeout."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._batch), timeout_s)
            batch, self._batch = self._batch, Batch()
            self._item_bytes = 0
            return batch

    def _noted(self, has_room: bool) -> bool:
        if has_room:
            self._changed.notify()
        else:
            self.dropped += 1
        return has_room


CHANNEL = 256
"""Replies to one request that may wait."""
MAX_AT_ONCE = 64
"""Replies to one request that are taken before the next one's turn."""
POLL_S = 0.01


class Pending(NamedTuple):
    """A request under way: its replies go into the inbox as items of a scan, then their end."""

    replies: zenoh.handlers.Handler[Any]
    inbox: Inbox
    scan: str
    answered: Answered | None


class Replies:
    """The requests under way. :meth:`add` is safe from any thread."""

    def __init__(self) -> None:
        self._pending: deque[Pending] = deque()
        self._news = threading.Event()

    def add(self, request: Pending) -> None:
        self._pending.append(request)
        self._news.set()

    def run(self, worker: Worker) -> None:
        """Poll until the worker is to stop; then all are dropped."""
        while not worker.stop.is_set():
            worker.beat()
            if not self._pending:
                self._news.wait(0.1)
                self._news.clear()
            elif not self._poll():
                worker.stop.wait(POLL_S)
        self._pending.clear()

    def _poll(self) -> bool:
        """Take some replies of each request; whether there were any."""
        moved = False
        for _ in range(len(self._pending)):
            pending = self._pending.popleft()
            count, is_over = _take(pending)
            moved = moved or count > 0
            if not is_over:
                self._pending.append(pending)
            elif pending.answered is not None:
                pending.inbox.put_event(pending.answered)
        return moved


def _take(pending: Pending) -> tuple[int, bool]:
    """Number of replies, and whether that is all."""
    import zenoh

    for count in range(MAX_AT_ONCE):
        try:
            reply = pending.replies.try_recv()
        except zenoh.ZError:
            return count, True
        if reply is None:
            return count, False
        if reply.ok is not None:
            pending.inbox.put_item(pending.scan, reply.ok.payload.to_bytes())
    return MAX_AT_ONCE, False
