"""Exchange with the autopilot: telemetry into the history, clocks, message rates, TIMESYNC.

It follows the autopilot that ``Presence`` has chosen and drops what other vehicles sent before.
A new link carries few messages until they are requested, and a ground station may lower the rates
for everyone, so messages that arrive too slowly are requested again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from mavlink.component import status as texts
from mavlink.component.presence import Presence
from mavlink.telemetry.clock import EVERYONE, BootClock, TimesyncFilter, WallTime
from mavlink.telemetry.decode import READERS, decode
from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.samples import OF_AUTOPILOT
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import ONBOARD
from mavlink.wire.framing import Packet
from mavlink.wire.messages import Address, SendQueue

S = 1_000_000_000
LOST_NS = 5 * S


class AutopilotLink:
    """One autopilot at a time. ``say`` gets severity and text for the operator."""

    def __init__(
        self,
        presence: Presence,
        history: VehicleHistory,
        outbox: SendQueue,
        say: Callable[[int, str], None],
        restarted: Callable[[], None] = lambda: None,
    ) -> None:
        """``restarted`` is called when the autopilot has restarted."""
        self.link: int | None = None  # where the autopilot was heard last
        self.timesync, self.wall_time = TimesyncFilter(), WallTime()
        self._presence, self._history, self._outbox, self._say = presence, history, outbox, say
        self._restarted = restarted
        self._rates = RateKeeper()
        self._clocks: dict[int, BootClock] = {}  # by component of our system
        self._followed = (presence.system, presence.autopilot)
        self._is_lost = False

    # Input.

    def hear(self, message: Any, packet: Packet, link: int, now_ns: int) -> None:
        """Process a message of any sender that may carry data of the autopilot or its clocks."""
        name = message.get_type()
        if name in READERS:
            self._hear_telemetry(name, message, packet, now_ns)
        elif name == "HEARTBEAT":
            self._presence.hear(message, now_ns)
            self.follow()
            if (packet.system, packet.component) == self._presence.autopilot:
                self.link = link
        elif name == "SYSTEM_TIME":
            if (packet.system, packet.component) == self._presence.autopilot:
                self._rates.heard(name)
                self.wall_time.hear(message.time_unix_usec, now_ns)
        elif name == "TIMESYNC":
            self._hear_timesync(message, packet, link, now_ns)

    def _hear_telemetry(self, name: str, message: Any, packet: Packet, now_ns: int) -> None:
        if packet.system != self._presence.system:
            return
        autopilot = self._presence.autopilot
        if autopilot is not None and packet.component == autopilot[1]:
            self._rates.heard(name)
        sample = decode(message)
        speaker = 1 if autopilot is None else autopilot[1]
        if sample is None or (packet.component != speaker and isinstance(sample, OF_AUTOPILOT)):
            return
        if sample.boot_ms is None:
            self._history.add(sample, now_ns)
            return
        clock = self._clocks.setdefault(packet.component, BootClock())
        reboots = clock.reboots
        time_ns = clock.time_of(sample.boot_ms, now_ns)
        if clock.reboots != reboots and autopilot is not None and packet.component == speaker:
            self._start_over()
            self._restarted()
            self._say(texts.WARNING, "Autopilot restarted; telemetry starts over")
        self._history.add(sample, time_ns)

    def follow(self) -> None:
        """Drop the data of another vehicle or component."""
        (system, autopilot), before = self._followed, self._followed
        self._followed = (self._presence.system, self._presence.autopilot)
        if self._followed == before or (self._followed[0] == system and autopilot is None):
            return
        self._clocks.clear()
        self._start_over()

    def _start_over(self) -> None:
        self._history.clear()
        self.timesync.reset()
        self._rates.restart()

    def _hear_timesync(self, message: Any, packet: Packet, link: int, now_ns: int) -> None:
        is_autopilot = (packet.system, packet.component) == self._presence.autopilot
        if message.tc1 == 0:  # a request: answer with our own time since boot
            reply = dialect.MAVLink_timesync_message(now_ns, message.ts1)
            if is_autopilot:
                self._outbox.put(ONBOARD, reply, link)
            return
        round_trip_ns = self.timesync.round_trip_of(message.ts1, now_ns)
        if round_trip_ns is not None:
            self._presence.answered(packet.system, packet.component, round_trip_ns)
        if is_autopilot and self.timesync.answer(message.tc1, message.ts1, now_ns):
            clock = self._clocks.setdefault(packet.component, BootClock())
            clock.set_timesync(self.timesync.offset_ns)

    # Output.

    def tick(self, now_ns: int) -> None:
        """Request the time and slow messages; report loss of telemetry."""
        autopilot, seen = self._presence.autopilot, self._presence.autopilot_seen_ns
        if autopilot is None or seen is None:
            if self._presence.others(now_ns):
                self._ask_time(now_ns)
            return
        is_lost = now_ns - seen > LOST_NS
        if is_lost and not self._is_lost:
            self._say(texts.WARNING, "Telemetry lost")
        elif self._is_lost and not is_lost:
            self._rates.restart()
            self._say(texts.NOTICE, "Telemetry recovered")
        self._is_lost = is_lost
        if is_lost:
            return
        for message in self._rates.tick(*autopilot, now_ns):
            self._outbox.put(ONBOARD, message)
        self._ask_time(now_ns)

    def _ask_time(self, now_ns: int) -> None:
        """Send TIMESYNC to our autopilot, or to all while it is not clear which one is ours."""
        target, link = EVERYONE, None
        autopilot = self._presence.autopilot
        if autopilot is not None and not self._presence.others(now_ns):
            target, link = Address(*autopilot), self.link
        request = self.timesync.request(now_ns, target)
        if request is not None:
            self._outbox.put(ONBOARD, request, link)

    @property
    def boot_offset_ns(self) -> int | None:
        """Our clock minus the autopilot's boot clock; None before it was heard."""
        autopilot = self._presence.autopilot
        clock = None if autopilot is None else self._clocks.get(autopilot[1])
        return None if clock is None else clock.offset_ns


WANTED_HZ: Mapping[str, float] = {
    "ATTITUDE_QUATERNION": 50.0,
    "GLOBAL_POSITION_INT": 20.0,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": 20.0,
    "DISTANCE_SENSOR": 10.0,
    "GPS_RAW_INT": 2.0,
    "TERRAIN_REPORT": 2.0,
    "SYSTEM_TIME": 1.0,
}
NUMBERS = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}
LOOK_NS = 10 * S
ENOUGH = 0.6  # of the rate wanted
PATIENCE = 5  # requests without an answer before the rate of requests drops
RARELY = 12  # checks between two such requests


@dataclass(slots=True)
class _Want:
    number: int
    hz: float
    heard: int = 0
    futile: int = 0  # checks in a row at which it had not come at all


class RateKeeper:
    """Counts received messages and returns the SET_MESSAGE_INTERVAL requests to send."""

    def __init__(self, wanted_hz: Mapping[str, float] = WANTED_HZ) -> None:
        self._wants = {n: _Want(NUMBERS[n], hz) for n, hz in wanted_hz.items()}
        self._looked_ns: int | None = None

    def heard(self, name: str) -> None:
        want = self._wants.get(name)
        if want is not None:
            want.heard += 1

    def restart(self) -> None:
        """Request everything again at the next check, as after a reboot."""
        self._looked_ns = None
        for want in self._wants.values():
            want.heard = want.futile = 0

    def tick(self, system: int, component: int, now_ns: int) -> list[Any]:
        """COMMAND_LONGs that request slow messages; empty between checks."""
        if self._looked_ns is not None and now_ns - self._looked_ns < LOOK_NS:
            return []
        passed_s = math.inf if self._looked_ns is None else (now_ns - self._looked_ns) / S
        self._looked_ns = now_ns
        return [
            dialect.MAVLink_command_long_message(
                system, component, 511, 0, want.number, round(1e6 / want.hz), 0, 0, 0, 0, 0
            )
            for want in self._wants.values()
            if self._must_ask(want, passed_s)
        ]

    def _must_ask(self, want: _Want, passed_s: float) -> bool:
        heard, want.heard = want.heard, 0
        if heard and heard >= ENOUGH * want.hz * passed_s:
            want.futile = 0
            return False
        want.futile = 0 if heard else want.futile + 1
        return want.futile <= PATIENCE or want.futile % RARELY == 0
