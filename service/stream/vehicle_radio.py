"""The narrow radio by way of MAVLink links that the daemon already holds.

A serial port has one owner: where the telemetry radio hangs on the autopilot, or on the same
port as it, the coarse map goes through the vehicle's own link.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from service.stream.radio_messages import PAYLOAD_TYPE

if TYPE_CHECKING:
    from mavlink.vehicle import VehicleLink


class VehicleRadio:
    """A carrier of one scan's tunnelled payloads after the other; made once per vehicle."""

    def __init__(self, vehicle: VehicleLink) -> None:
        self._vehicle = vehicle
        self._on_status: Callable[[int], None] | None = None
        vehicle.listen("RADIO_STATUS", self._heard)

    def open(self, on_status: Callable[[int], None]) -> None:
        """Begin; ``on_status`` gets the free share of the radio's buffer in percent."""
        self._on_status = on_status

    def beat(self) -> None:
        """Nothing: the vehicle's link has heartbeats of its own."""

    def send(self, payload: bytes) -> None:
        """Send a payload to everybody."""
        self._vehicle.send_tunnel(PAYLOAD_TYPE, payload)

    def close(self) -> None:
        """End; the link stays open."""
        self._on_status = None

    def _heard(self, message: Any) -> None:
        on_status = self._on_status
        if on_status is not None:
            on_status(int(message.txbuf))
