"""Our two components, and their heartbeats before the heavy imports.

An autopilot may stay silent on a serial line until it receives MAVLink, and ArduPilot stops looking
for a camera a minute after boot. Dialect and NumPy take a while to import on a busy machine,
so these packets are packed by hand. :class:`~mavlink.component.vehicle.VehicleLink` takes over.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Sequence
from typing import Any

from pymavlink.generator.mavcrc import x25crc  # type: ignore[import-untyped]

from mavlink.wire.link import Link, parse_link
from mavlink.wire.stand_in import AFTER_S, Beat, StandIn, Way

ONBOARD = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
CAMERA = 100  # MAV_COMP_ID_CAMERA
TYPES = {ONBOARD: 18, CAMERA: 30}  # MAV_TYPE_ONBOARD_CONTROLLER, MAV_TYPE_CAMERA
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID
BOOT = 1  # MAV_STATE
HEARTBEAT, CRC_EXTRA, VERSION = 0, 50, 3
PERIOD_S = 1.0
LONGEST_S = 120.0  # a service that has not taken over by then is dead: stop


FIRST_DEVICE = 100  # from here on component ids are of cameras, gimbals, computers, receivers ...
INAV = 250  # MAV_COMP_ID_SYSTEM_CONTROL, as which flight controllers with INAV send
NOT_VEHICLES = frozenset({5, 6, 18, 26, 27, 30, *range(31, 35), *range(36, 43), 44, 48, 49})
"""MAV_TYPE of antenna trackers, ground stations, onboard computers, gimbals, ADS-B, cameras,
charging stations, FLARM, servos, Open Drone ID, batteries, parachutes, loggers, OSDs, IMUs, GPS,
winches, illuminators, grippers and radios."""


def is_autopilot(component: int, heartbeat: Any) -> bool:
    """True for the heartbeat of a vehicle's autopilot, not of any other component."""
    return (
        heartbeat.autopilot != NO_AUTOPILOT
        and heartbeat.type not in NOT_VEHICLES
        and (0 < component < FIRST_DEVICE or component == INAV)
    )


def heartbeat_packet(sequence: int, system: int, component: int, token: int) -> bytes:
    """The MAVLink 2 packet of a HEARTBEAT of one of our components that boots."""
    payload = struct.pack("<IBBBBB", token, TYPES[component], NO_AUTOPILOT, 0, BOOT, VERSION)
    head = struct.pack("<BBBBBB", len(payload), 0, 0, sequence & 0xFF, system, component)
    body = head + HEARTBEAT.to_bytes(3, "little") + payload
    crc: int = x25crc(body + bytes((CRC_EXTRA,))).crc
    return b"\xfd" + body + crc.to_bytes(2, "little")


class FirstBeats:
    """Opens links and sends a booting heartbeat once a second, until the service takes over."""

    def __init__(self, links: Sequence[str], system: int, token: int) -> None:
        """Raises ValueError for an invalid link."""
        self.system, self.token = system, token
        self.sequence = 0  # of the next packet of either component
        self.next_s = time.monotonic()
        self.links = [Link(parse_link(text)) for text in links]
        self.stand_in: StandIn | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="first beats", daemon=True)

    def start(self) -> None:
        for link in self.links:
            link.start()
        self._thread.start()
        self.stand_in = StandIn()

    def hand_over(self) -> list[Link]:
        """The open links; from now on the caller sends the heartbeats, and owns the stand-in."""
        self._stop.set()
        self._thread.join()
        return self.links

    def _run(self) -> None:
        end_s = self.next_s + LONGEST_S
        while not self._stop.is_set() and time.monotonic() < end_s:
            if self.stand_in is not None:
                self.sequence += self.stand_in.sent()
            for packet in self._packets(0):
                for link in self.links:
                    link.write(packet)
            self.sequence = (self.sequence + 1) & 0xFF
            if self.stand_in is not None:
                self.stand_in.plan(self._ahead(time.monotonic()), self._ways)
            self.next_s = max(self.next_s + PERIOD_S, time.monotonic())
            self._stop.wait(max(0.0, self.next_s - time.monotonic()))

    def _packets(self, ahead: int) -> list[bytes]:
        """A heartbeat of each component, as after so many others."""
        return [
            heartbeat_packet(self.sequence + ahead, self.system, component, self.token)
            for component in TYPES
        ]

    def _ahead(self, now_s: float) -> list[Beat]:
        ways = self._ways()
        return [
            (now_s + after_s, [(way, packet) for way in ways for packet in self._packets(ahead)])
            for ahead, after_s in enumerate(AFTER_S)
        ]

    def _ways(self) -> list[Way]:
        return [way for link in self.links for way in link.ways]
