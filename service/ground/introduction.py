"""A scan that a drone names and that has no folder yet: it gets one for a valid header only."""

from __future__ import annotations

from service.stream.messages import Assembler, Head, parse
from service.stream.ranges import RangeSet
from service.stream.records import ScanHeader, header_from_json

REST_S = 1.0
"""From one request for the header to the next."""
MAX_KEPT_BYTES = 1 << 18
"""Items that may come before the header."""


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
        """The drone says what it has."""
        self.head, self.seen_at = head, now

    def next_ask(self, now: float) -> RangeSet | None:
        """The number of the header to ask for now, if any."""
        wanted = None if self.head is None else self.head.numbers.get("header")
        if not wanted or now < self._ask_at:
            return None
        self._ask_at = now + REST_S
        return wanted

    def on_items(self, message: bytes, now: float) -> ScanHeader | None:
        """The scan's header once it is whole, valid and says the drone and scan of its key."""
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
