"""The narrow radio on MAVLink: sends and receives TUNNEL, forwards RADIO_STATUS.

It uses an endpoint of its own or the links of the service: a serial port has one owner, so a
telemetry radio on the autopilot carries the coarse map through the vehicle's link.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mavlink.component.vehicle import VehicleLink
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Decoder, Framer
from mavlink.wire.link import Link, parse_link
from mavlink.wire.messages import OutgoingMessage, Packer
from service.errors import InputError
from service.stream.radio_messages import MAX_BYTES, PAYLOAD_TYPE

TUNNEL, RADIO_STATUS = 385, 109
DRONE = (1, 191, dialect.MAV_TYPE_ONBOARD_CONTROLLER)  # system, component, type
GROUND = (254, 190, dialect.MAV_TYPE_GCS)


class RadioLink:
    """One MAVLink endpoint that carries tunnelled payloads; has its own threads.

    ``on_payload`` gets the payloads of TUNNEL messages of our type, on the reading thread. Raises
    InputError for an invalid endpoint.
    """

    def __init__(
        self,
        endpoint: str,
        identity: tuple[int, int, int],
        on_payload: Callable[[bytes], None] = lambda _: None,
    ) -> None:
        try:
            self._link = Link(parse_link(endpoint), self._receive)
        except ValueError as error:
            raise InputError(f"MAVLink {error}") from error
        self._system, self._component, self._kind = identity
        self._packer = Packer(0)
        self._on_payload = on_payload
        self._on_status: Callable[[int], None] = lambda _: None
        self._framer = Framer()
        self._decoder = Decoder()

    def open(self, on_status: Callable[[int], None] = lambda _: None) -> None:
        """Open the endpoint, and reopen it whenever it fails. ``on_status`` gets the free share of
        the radio's buffer in percent, on the reading thread."""
        self._on_status = on_status
        self._link.start()

    def close(self) -> None:
        self._link.stop()

    def send(self, payload: bytes) -> None:
        padded = list(payload.ljust(MAX_BYTES, b"\0"))
        self._send(dialect.MAVLink_tunnel_message(0, 0, PAYLOAD_TYPE, len(payload), padded))

    def beat(self) -> None:
        """Send a heartbeat, so that routers forward messages to us."""
        self._send(dialect.MAVLink_heartbeat_message(self._kind, 8, 0, 0, 4, 3))

    def _send(self, message: Any) -> None:
        data = self._packer.pack(self._system, OutgoingMessage(self._component, message), 0)
        if data is not None:
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


class VehicleRadio:
    """Carries tunnelled payloads of one scan at a time on the vehicle's link."""

    def __init__(self, vehicle: VehicleLink) -> None:
        self._vehicle = vehicle
        self._on_status: Callable[[int], None] | None = None
        vehicle.listen("RADIO_STATUS", self._heard)

    def open(self, on_status: Callable[[int], None]) -> None:
        """Begin; ``on_status`` gets the free share of the radio's buffer in percent."""
        self._on_status = on_status

    def beat(self) -> None:
        """Nothing: the vehicle's link sends its own heartbeats."""

    def send(self, payload: bytes) -> None:
        self._vehicle.send_tunnel(PAYLOAD_TYPE, payload)

    def close(self) -> None:
        """End; the link stays open."""
        self._on_status = None

    def _heard(self, message: Any) -> None:
        on_status = self._on_status
        if on_status is not None:
            on_status(int(message.txbuf))
