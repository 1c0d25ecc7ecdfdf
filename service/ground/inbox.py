"""What comes for one drone, from any thread, bounded so that no drone takes another's memory."""

from __future__ import annotations

import threading

from service.ground.drone import Event, Item, Radio

MAX_ITEM_BYTES, MAX_ITEMS = 8 << 20, 4096
MAX_HEADS = 256
"""Scans of one drone whose newest head may wait."""
ITEM_BYTES = 200
"""Bytes that a kept message takes beyond its payload."""


class Inbox:
    """Heads and events; what there is no room for is counted and dropped."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._heads: dict[str, bytes] = {}  # scan to its newest
        self._events: list[Event] = []
        self._bytes = 0
        self.dropped = 0

    def put_head(self, scan: str, payload: bytes) -> None:
        """A head; it takes the place of one of the same scan that waits."""
        with self._changed:
            has_room = scan in self._heads or len(self._heads) < MAX_HEADS
            if has_room:
                self._heads[scan] = payload
            self._note(has_room)

    def put(self, event: Event) -> None:
        """Anything else; only what a drone sends may be too much, as the rest is of our own."""
        with self._changed:
            size = len(event.data) + ITEM_BYTES if isinstance(event, Item | Radio) else 0
            is_full = self._bytes + size > MAX_ITEM_BYTES or len(self._events) >= MAX_ITEMS
            has_room = not size or not is_full
            if has_room:
                self._bytes += size
                self._events.append(event)
            self._note(has_room)

    def take(self, timeout_s: float) -> tuple[dict[str, bytes], list[Event]]:
        """Heads and events that wait; without any, those that arrive within the timeout."""
        with self._changed:
            self._changed.wait_for(lambda: self._heads or self._events, timeout_s)
            taken = self._heads, self._events
            self._heads, self._events, self._bytes = {}, [], 0
            return taken

    def _note(self, has_room: bool) -> None:
        self.dropped += not has_room
        self._changed.notify()
