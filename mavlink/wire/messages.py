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

from mavlink.wire.dialect import dialect, x25crc
from mavlink.wire.framing import SIGNED, Framer, Packet
from mavlink.wire.link import Link
from mavlink.wire.signing import Signing


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

    def __init__(self, limit: int = 2000) -> None:
        self._waiting: deque[OutgoingMessage] = deque(maxlen=limit)

    def put(self, component: int, message: Any, link: int | None = None) -> None:
        """Queue a message of one of our components."""
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

    def pack(self, system: int, outgoing: OutgoingMessage, unix_ns: int) -> bytes | None:
        """The packet; None when a value does not fit its field."""
        with self._lock:
            key = (system, outgoing.component)
            encoder = self._encoders.get(key)
            if encoder is None:
                encoder = self._encoders[key] = dialect.MAVLink(None, *key)
                encoder.seq = self._sequence
            try:
                data = bytes(outgoing.message.pack(encoder))
            except (struct.error, ValueError, TypeError, OverflowError) as error:
                log.error("%s cannot be sent: %s", outgoing.message.get_type(), error)
                return None
            encoder.seq = (encoder.seq + 1) % 256
            if self._signing is None:
                return data
            flagged = _with_signed_flag(data, outgoing.message.crc_extra)
            return self._signing.sign(flagged, self._link, unix_ns)


def _with_signed_flag(data: bytes, crc_extra: int) -> bytes:
    """The packet with the signed flag set and its checksum updated."""
    body = data[:2] + bytes((data[2] | SIGNED,)) + data[3:-2]
    crc: int = x25crc(body[1:] + bytes((crc_extra,))).crc
    return body + crc.to_bytes(2, "little")


@dataclass(slots=True)
class _Stream:
    default_us: int  # -1: only sent on request
    interval_us: int
    send: Callable[[], None]
    next_ns: int


class Streams:
    """A table of (component, message number), each with an interval and a sender."""

    def __init__(self, outbox: SendQueue) -> None:
        self._outbox = outbox
        self._streams: dict[tuple[int, int], _Stream] = {}

    def add(self, component: int, number: int, default_us: int, send: Callable[[], None]) -> None:
        """Make a message repeatable."""
        self._streams[(component, number)] = _Stream(default_us, default_us, send, 0)

    def can_repeat(self, component: int, number: int) -> bool:
        """True for a message that was added."""
        return (component, number) in self._streams

    def set_interval(self, component: int, number: int, interval_us: int) -> None:
        """0 is the default interval; -1 (any negative) stops the stream."""
        stream = self._streams[(component, number)]
        stream.interval_us = stream.default_us if interval_us == 0 else max(-1, interval_us)
        stream.next_ns = 0

    def send_interval(self, component: int, number: int, link: int) -> None:
        """Answer with MESSAGE_INTERVAL."""
        interval = self._streams[(component, number)].interval_us
        message = dialect.MAVLink_message_interval_message(number, interval)
        self._outbox.put(component, message, link)

    def tick(self, now_ns: int) -> None:
        """Send messages that are due."""
        for stream in self._streams.values():
            if stream.interval_us > 0 and now_ns >= stream.next_ns:
                stream.next_ns = now_ns + stream.interval_us * 1000
                stream.send()


@dataclass(frozen=True, slots=True)
class LinkReport:
    """State of one link."""

    name: str
    is_up: bool
    opened: int  # how many times
    received_bytes: int
    sent_bytes: int
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
        """Open them."""
        for link in self._links:
            link.start()

    def stop(self) -> None:
        """Close them."""
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

    def report(self) -> tuple[LinkReport, ...]:
        """State of each link."""
        return tuple(
            LinkReport(
                link.spec.name,
                link.is_up,
                link.opened,
                link.received_bytes,
                link.sent_bytes,
                dict(framer.packets),
                framer.skipped_bytes,
                link.last_error,
            )
            for link, framer in zip(self._links, self._framers, strict=True)
        )
