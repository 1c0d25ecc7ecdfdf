"""The narrow radio on a real MAVLink link: TUNNEL out and in, RADIO_STATUS heeded."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from mavlink.framing import Decoder, Framer
from mavlink.link import Link, parse_link
from mavlink.wire import dialect
from service.errors import InputError
from service.stream.radio_messages import MAX_BYTES, PAYLOAD_TYPE
from service.stream.store import ScanStore
from service.stream.tunnel import TunnelConfig, TunnelSender

log = logging.getLogger(__name__)

HEARTBEAT_S = 1.0
TUNNEL, RADIO_STATUS = 385, 109
DRONE = (1, 191)  # system and component: the onboard computer
GROUND = (254, 190)


class Carrier(Protocol):
    """What takes tunnelled payloads to the ground."""

    def open(self, on_status: Callable[[int], None]) -> None:
        """Begin; ``on_status`` gets the free share of the radio's buffer in percent."""

    def beat(self) -> None:
        """Say that we are there; asked every second."""

    def send(self, payload: bytes) -> None:
        """Send a payload to everybody."""

    def close(self) -> None:
        """End."""


class RadioLink:
    """One MAVLink endpoint that carries tunnelled payloads; threads of its own.

    ``on_payload`` gets the payloads of TUNNEL messages of our type, ``on_status`` the free
    share of the radio's buffer in percent; both are called on the reading thread. Raises
    InputError for an endpoint that cannot be.
    """

    def __init__(
        self,
        endpoint: str,
        identity: tuple[int, int],
        on_payload: Callable[[bytes], None],
        on_status: Callable[[int], None] = lambda _: None,
    ) -> None:
        try:
            self._link = Link(parse_link(endpoint), self._receive)
        except ValueError as error:
            raise InputError(f"MAVLink {error}") from error
        self._encoder = dialect.MAVLink(None, *identity)
        self._on_payload = on_payload
        self._on_status = on_status
        self._framer = Framer()
        self._decoder = Decoder()

    def start(self) -> None:
        """Open the endpoint, again and again until it is there."""
        self._link.start()

    def close(self) -> None:
        """Close it."""
        self._link.stop()

    def send(self, payload: bytes) -> None:
        """Send a payload to everybody."""
        padded = list(payload.ljust(MAX_BYTES, b"\0"))
        self._send(dialect.MAVLink_tunnel_message(0, 0, PAYLOAD_TYPE, len(payload), padded))

    def beat(self, kind: int) -> None:
        """Send a heartbeat as a vehicle part of MAV_TYPE ``kind``, so that links route to us."""
        self._send(dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3))

    def _send(self, message: Any) -> None:
        data = bytes(message.pack(self._encoder))
        self._encoder.seq = (self._encoder.seq + 1) % 256
        self._link.write(data)

    def _receive(self, data: bytes, _: int) -> None:
        for packet in self._framer.feed(data):
            if packet.message_id not in (TUNNEL, RADIO_STATUS):
                continue
            message = self._decoder.message(packet)
            if message is None:
                continue
            if packet.message_id == RADIO_STATUS:
                self._on_status(int(message.txbuf))
            elif message.payload_type == PAYLOAD_TYPE and message.payload_length <= MAX_BYTES:
                self._on_payload(bytes(message.payload[: message.payload_length]))


class EndpointCarrier:
    """A radio on a MAVLink endpoint of our own; InputError for one that cannot be."""

    def __init__(self, endpoint: str) -> None:
        self._on_status: Callable[[int], None] = lambda _: None
        self._link = RadioLink(endpoint, DRONE, lambda _: None, lambda free: self._on_status(free))

    def open(self, on_status: Callable[[int], None]) -> None:
        """Open the endpoint."""
        self._on_status = on_status
        self._link.start()

    def beat(self) -> None:
        """Send a heartbeat, so that routers on the way know the path."""
        self._link.beat(dialect.MAV_TYPE_ONBOARD_CONTROLLER)

    def send(self, payload: bytes) -> None:
        """Send a payload to everybody."""
        self._link.send(payload)

    def close(self) -> None:
        """Close the endpoint."""
        self._link.close()


class RadioSender:
    """Sends a scan's coarse tiles and poses over the radio while ``needed`` says so."""

    def __init__(
        self,
        store: ScanStore,
        config: TunnelConfig,
        carrier: Carrier,
        needed: Callable[[], bool] = lambda: True,
    ) -> None:
        try:
            self._tunnel = TunnelSender(store, config, time.monotonic())
        except ValueError as error:
            raise InputError(str(error)) from error
        self._events: deque[Callable[[float], None]] = deque(maxlen=10_000)
        self._store = store
        self._needed = needed
        self._stop = threading.Event()
        self._carrier = carrier
        self._thread = threading.Thread(target=self._run, name="radio", daemon=True)
        store.listen(self._news)
        carrier.open(self._status)
        self._thread.start()

    @property
    def sent_bytes(self) -> int:
        """Bytes handed to the radio."""
        return self._tunnel.sent_bytes

    @property
    def all_sent(self) -> bool:
        """Whether everything has been sent at least once; nobody confirms it on the radio."""
        return not self._events and self._tunnel.all_sent

    def close(self) -> None:
        """Stop sending."""
        self._stop.set()
        self._thread.join(5.0)
        self._store.unlisten(self._news)
        self._carrier.close()

    def _news(self, kind: str, number: int) -> None:
        self._events.append(lambda _: self._tunnel.news(kind, number))

    def _status(self, free_percent: int) -> None:
        self._events.append(lambda now: self._tunnel.radio_status(free_percent, now))

    def _run(self) -> None:
        beat_at = 0.0
        while not self._stop.is_set():
            now = time.monotonic()
            while self._events:
                self._events.popleft()(now)
            if now >= beat_at:
                self._carrier.beat()
                beat_at = now + HEARTBEAT_S
            todo = self._tunnel.next(now) if self._needed() else 0.5
            if isinstance(todo, bytes):
                self._carrier.send(todo)
            else:
                self._stop.wait(min(todo, 0.1))
