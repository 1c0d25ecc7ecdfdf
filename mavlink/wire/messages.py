"""Outgoing messages: sender, addressee and interval; packed and sent on the links."""

from __future__ import annotations

import logging
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer, Packet
from mavlink.wire.link import Link
from mavlink.wire.signing import Signing
from mavlink.wire.stand_in import AFTER_S, Beat, Way


@dataclass(frozen=True, slots=True)
class Address:
    """A component of a system; 0 means all."""

    system: int
    component: int


@dataclass(frozen=True, slots=True)
class OutgoingMessage:
    """A message from one of our components, for one link or (None) for all."""

    component: int
    message: Any
    link: int | None = None


class SendQueue:
    """Messages waiting to be packed; a full queue drops the oldest."""

    def __init__(self) -> None:
        self._waiting: deque[OutgoingMessage] = deque(maxlen=2000)

    def put(self, component: int, message: Any, link: int | None = None) -> None:
        self._waiting.append(OutgoingMessage(component, message, link))

    def take(self) -> list[OutgoingMessage]:
        """Everything queued since the last call, in order."""
        taken = list(self._waiting)
        self._waiting.clear()
        return taken


log = logging.getLogger(__name__)


class Packer:
    """Packs for one link; thread-safe. Each component has its own sequence."""

    def __init__(self, link: int, signing: Signing | None = None, sequence: int = 0) -> None:
        self._link = link
        self._sequence = sequence  # of the first packet of each component
        self._signing = signing
        self._lock = threading.Lock()
        self._encoders: dict[tuple[int, int], Any] = {}

    def pack(
        self, system: int, outgoing: OutgoingMessage, unix_ns: int, ahead: int | None = None
    ) -> bytes | None:
        """The packet; None when a value does not fit its field. One that is packed ``ahead``, as
        after so many others, may never be sent."""
        with self._lock:
            key = (system, outgoing.component)
            encoder = self._encoders.get(key)
            if encoder is None:
                encoder = self._encoders[key] = dialect.MAVLink(None, *key)
                encoder.seq = self._sequence
            if self._signing is not None:
                self._signing.prepare(encoder, self._link, unix_ns, ahead)
            sequence = encoder.seq
            encoder.seq = (sequence + (ahead or 0)) % 256
            try:
                data = bytes(outgoing.message.pack(encoder))
            except (struct.error, ValueError, TypeError, OverflowError) as error:
                log.error("%s cannot be sent: %s", outgoing.message.get_type(), error)
                return None
            finally:
                encoder.seq = sequence
            encoder.seq = (sequence + (ahead is None)) % 256
            return data

    def skip(self, packets: int) -> None:
        """Another process has sent so many packets of each component."""
        if self._signing is not None:
            self._signing.skip(packets)
        with self._lock:
            self._sequence = (self._sequence + packets) % 256
            for encoder in self._encoders.values():
                encoder.seq = (encoder.seq + packets) % 256


MAX_SUBSCRIBERS = 16  # of one message; the oldest makes room


class Stream:
    """A repeated message. Each subscriber has an interval of its own; the shortest one counts."""

    def __init__(self, default_us: int, send: Callable[[], object]) -> None:
        """``default_us`` holds without subscribers; -1: only sent on request."""
        self._default_us, self._send = default_us, send
        self._wanted: dict[Address, int] = {}
        self._next_ns = 0

    @property
    def interval_us(self) -> int:
        """The interval in force; -1 where nothing is sent."""
        wanted = [us for us in self._wanted.values() if us > 0]
        return min(wanted) if wanted else -1 if self._wanted else self._default_us

    def set_interval(self, subscriber: Address, interval_us: int) -> None:
        """0 is the default interval; -1 (any negative) stops the stream."""
        self._wanted.pop(subscriber, None)
        while len(self._wanted) >= MAX_SUBSCRIBERS:
            del self._wanted[next(iter(self._wanted))]
        self._wanted[subscriber] = max(-1, interval_us or self._default_us)
        self._next_ns = 0

    def end(self) -> None:
        self._wanted.clear()

    def tick(self, now_ns: int) -> None:
        interval_us = self.interval_us
        if interval_us > 0 and now_ns >= self._next_ns:
            self._next_ns = now_ns + interval_us * 1000
            self._send()


@dataclass(frozen=True, slots=True)
class LinkReport:
    name: str
    is_up: bool
    opened: int  # how many times
    received_bytes: int
    packets: dict[int, int]  # by system id
    skipped_bytes: int
    last_error: str


class Links:
    """All links: delivers received packets in the reading threads; sends messages."""

    def __init__(
        self,
        links: Sequence[Link],
        on_packet: Callable[[int, Packet, int], None],
        signing: Signing | None = None,
        sequence: int = 0,
    ) -> None:
        """``on_packet`` gets the link's index, the packet and its monotonic time in ns."""
        self._links, self._on_packet = links, on_packet
        self._framers = [Framer() for _ in links]
        self._packers = [Packer(i, signing, sequence) for i in range(len(links))]
        for i, link in enumerate(links):
            link.on_data = partial(self._on_data, i)

    def start(self) -> None:
        for link in self._links:
            link.start()

    def stop(self) -> None:
        for link in self._links:
            link.stop()

    def _on_data(self, index: int, data: bytes, now_ns: int) -> None:
        for packet in self._framers[index].feed(data):
            self._on_packet(index, packet, now_ns)

    def send(self, system: int, messages: Sequence[OutgoingMessage]) -> list[bytes]:
        """Send each message on its links; returns the packets sent."""
        unix_ns, sent = time.time_ns(), []
        for outgoing in messages:
            for i, link in enumerate(self._links):
                if outgoing.link is not None and outgoing.link != i:
                    continue
                data = self._packers[i].pack(system, outgoing, unix_ns)
                if data is not None:
                    link.write(data)
                    sent.append(data)
        return sent

    def ahead(self, system: int, messages: Sequence[OutgoingMessage], now_s: float) -> list[Beat]:
        """For a stand-in: the messages on all links, and again, each at its time after now."""
        beats: list[Beat] = []
        for ahead, after_s in enumerate(AFTER_S):
            unix_ns = time.time_ns() + round(1e9 * after_s)
            sent = [
                (way, data)
                for link, packer in zip(self._links, self._packers, strict=True)
                for way in link.ways
                for outgoing in messages
                if (data := packer.pack(system, outgoing, unix_ns, ahead)) is not None
            ]
            beats.append((now_s + after_s, sent))
        return beats

    def ways(self) -> list[Way]:
        """To everyone on all links, for another process."""
        return [way for link in self._links for way in link.ways]

    def skip(self, packets: int) -> None:
        """Another process has sent so many packets of each component on each link."""
        for packer in self._packers:
            packer.skip(packets)

    def report(self) -> tuple[LinkReport, ...]:
        return tuple(
            LinkReport(
                link.spec.name,
                link.is_up,
                link.opened,
                link.received_bytes,
                dict(framer.packets),
                framer.skipped_bytes,
                link.last_error,
            )
            for link, framer in zip(self._links, self._framers, strict=True)
        )
