"""A companion among vehicles: what autopilots around it say and how soon they answer."""

from __future__ import annotations

from typing import Any

from autopilot import packed
from rehearsal import RehearsalControl

from mavlink.component.companion import Companion, CompanionConfig
from mavlink.component.link_watch import WatchConfig
from mavlink.component.presence import Presence, PresenceConfig
from mavlink.telemetry.history import VehicleHistory
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer

S = 1_000_000_000
GENERIC, ARDUPILOT = 0, 3
QUADROTOR = 2


class Vehicle:
    """An autopilot elsewhere: what it says every tick, and how soon it answers TIMESYNC."""

    def __init__(
        self,
        system: int,
        round_trip_s: float | None = None,
        chatter: int = 0,
        firmware: int = ARDUPILOT,
    ) -> None:
        self.system, self.round_trip_s, self.chatter = system, round_trip_s, chatter
        self.firmware, self.is_on = firmware, True


class Net:
    """A companion among vehicles; time passes in steps of 100 ms."""

    def __init__(
        self,
        *vehicles: Vehicle,
        given: int | None = None,
        remembered: int | None = None,
        watch: WatchConfig | None = None,
    ) -> None:
        self.vehicles = vehicles
        self.now_ns = 50 * S
        self.presence = Presence(
            PresenceConfig(system=given), 4711, self.now_ns, remembered=remembered
        )
        config = CompanionConfig(watch=watch or WatchConfig())
        self.companion = Companion(
            config, RehearsalControl(), self.presence, VehicleHistory(), self.now_ns
        )
        self.framer = Framer()
        self.texts: list[str] = []
        self.systems: set[int] = set()
        self._answers: list[tuple[int, int, bytes]] = []  # when, its place in the order, packet

    def feed(self, message: Any, source: tuple[int, int]) -> None:
        for packet in self.framer.feed(packed(message, source)):
            self.companion.receive(0, packet, self.now_ns)

    def beat(
        self,
        source: tuple[int, int],
        kind: int = QUADROTOR,
        autopilot: int = ARDUPILOT,
        armed: bool = False,
    ) -> None:
        mode = 128 if armed else 0
        self.feed(dialect.MAVLink_heartbeat_message(kind, autopilot, mode, 0, 4, 3), source)

    def wait(self, seconds: float) -> None:
        for step in range(round(seconds * 10)):
            end_ns = self.now_ns + S // 10
            for vehicle in self.vehicles:
                self._speak(vehicle, step)
            self._deliver(end_ns)
            self.now_ns = end_ns
            self.companion.tick(self.now_ns)
            self.systems.add(self.presence.system)
            for outgoing in self.companion.take():
                self._hear(outgoing.message)

    def _speak(self, vehicle: Vehicle, step: int) -> None:
        if not vehicle.is_on:
            return
        if step % 10 == 0:
            self.beat((vehicle.system, 1), autopilot=vehicle.firmware)
        for _ in range(vehicle.chatter):
            message = dialect.MAVLink_attitude_message(step * 100, 0.0, 0.0, 0.0, 0, 0, 0)
            self.feed(message, (vehicle.system, 1))

    def _hear(self, message: Any) -> None:
        if message.get_type() == "STATUSTEXT":
            text = message.text
            self.texts.append(text.decode() if isinstance(text, bytes) else text)
        if message.get_type() != "TIMESYNC" or message.tc1:
            return
        for vehicle in self.vehicles:
            if vehicle.is_on and vehicle.round_trip_s is not None:
                at_ns = self.now_ns + round(vehicle.round_trip_s * S)
                reply = dialect.MAVLink_timesync_message(at_ns - 7 * S, message.ts1)
                data = packed(reply, (vehicle.system, 1))
                self._answers.append((at_ns, len(self._answers), data))

    def _deliver(self, until_ns: int) -> None:
        due = sorted(a for a in self._answers if a[0] <= until_ns)
        self._answers = [a for a in self._answers if a[0] > until_ns]
        for at_ns, _, data in due:
            for packet in self.framer.feed(data):
                self.companion.receive(0, packet, at_ns)
