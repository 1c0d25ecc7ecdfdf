"""Our own messages at an interval: what SET_MESSAGE_INTERVAL of ours is about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mavlink.messages import Outbox
from mavlink.wire import dialect


@dataclass(slots=True)
class _Stream:
    default_us: int  # -1: not sent unless asked
    interval_us: int
    send: Callable[[], None]
    next_ns: int


class Streams:
    """A table of (component, message number) with an interval and a sender each."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._streams: dict[tuple[int, int], _Stream] = {}

    def add(self, component: int, number: int, default_us: int, send: Callable[[], None]) -> None:
        """Make a message repeatable."""
        self._streams[(component, number)] = _Stream(default_us, default_us, send, 0)

    def can_repeat(self, component: int, number: int) -> bool:
        """True for a message that was added."""
        return (component, number) in self._streams

    def set_interval(self, component: int, number: int, interval_us: int) -> None:
        """0 is the default interval, -1 (any negative) switches the stream off."""
        stream = self._streams[(component, number)]
        stream.interval_us = stream.default_us if interval_us == 0 else max(-1, interval_us)
        stream.next_ns = 0

    def send_interval(self, component: int, number: int, link: int) -> None:
        """Answer with MESSAGE_INTERVAL."""
        interval = self._streams[(component, number)].interval_us
        message = dialect.MAVLink_message_interval_message(number, interval)
        self._outbox.put(component, message, link)

    def tick(self, now_ns: int) -> None:
        """Send what is due."""
        for stream in self._streams.values():
            if stream.interval_us > 0 and now_ns >= stream.next_ns:
                stream.next_ns = now_ns + stream.interval_us * 1000
                stream.send()

    def next_timer(self) -> int | None:
        """When :meth:`tick` has something to do, in ns."""
        running = [s.next_ns for s in self._streams.values() if s.interval_us > 0]
        return min(running, default=None)
