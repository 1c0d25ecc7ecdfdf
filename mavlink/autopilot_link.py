"""What passes between us and the autopilot: telemetry into the history, clocks, rates, TIMESYNC.

It follows the autopilot that :class:`~mavlink.presence.Presence` has chosen; what another vehicle
said before is dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mavlink import status as texts
from mavlink.clock import BootClock
from mavlink.decode import decode
from mavlink.framing import Packet
from mavlink.history import VehicleHistory
from mavlink.messages import ONBOARD, Address, Outbox
from mavlink.presence import Presence
from mavlink.rates import RateKeeper
from mavlink.samples import OF_AUTOPILOT
from mavlink.timesync import EVERYONE, TimesyncFilter
from mavlink.wall_time import WallTime
from mavlink.wire import dialect

S = 1_000_000_000
LOST_NS = 5 * S


class AutopilotLink:
    """One autopilot at a time. ``say`` gets severity and text for the operator."""

    def __init__(
        self,
        presence: Presence,
        history: VehicleHistory,
        outbox: Outbox,
        wanted_hz: Mapping[str, float],
        say: Callable[[int, str], None],
    ) -> None:
        self.link: int | None = None  # on which the autopilot was heard last
        self.samples = 0  # taken into the history
        self.timesync, self.wall_time = TimesyncFilter(), WallTime()
        self._presence, self._history, self._outbox, self._say = presence, history, outbox, say
        self._rates = RateKeeper(wanted_hz)
        self._clocks: dict[int, BootClock] = {}  # component of our system to its boot clock
        self._followed = (presence.system, presence.autopilot)
        self._is_lost = False

    # In.

    def hear_telemetry(self, name: str, message: Any, packet: Packet, now_ns: int) -> None:
        """Take in a message that :mod:`mavlink.decode` reads."""
        if packet.system != self._presence.system:
            return
        autopilot = self._presence.autopilot
        if autopilot is not None and packet.component == autopilot[1]:
            self._rates.heard(name)
        sample = decode(message)
        speaker = 1 if autopilot is None else autopilot[1]
        if sample is None or (packet.component != speaker and isinstance(sample, OF_AUTOPILOT)):
            return
        self.samples += 1
        if sample.boot_ms is None:
            self._history.add(sample, now_ns)
            return
        clock = self._clocks.setdefault(packet.component, BootClock())
        reboots = clock.reboots
        time_ns = clock.time_of(sample.boot_ms, now_ns)
        if clock.reboots != reboots:
            self._rebooted(packet.component)
        self._history.add(sample, time_ns)

    def follow(self) -> None:
        """Drop what another vehicle, or another component, said."""
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

    def _rebooted(self, component: int) -> None:
        autopilot = self._presence.autopilot
        if autopilot is None or component != autopilot[1]:
            return
        self._start_over()
        self._say(texts.WARNING, "Autopilot restarted; telemetry starts over")

    def hear_system_time(self, message: Any, packet: Packet, now_ns: int) -> None:
        """Take in a SYSTEM_TIME."""
        if (packet.system, packet.component) == self._presence.autopilot:
            self._rates.heard("SYSTEM_TIME")
            self.wall_time.hear(message.time_unix_usec, now_ns)

    def hear_timesync(self, message: Any, packet: Packet, link: int, now_ns: int) -> None:
        """Take in a TIMESYNC: a question of the autopilot, or anyone's answer to ours."""
        is_autopilot = (packet.system, packet.component) == self._presence.autopilot
        if message.tc1 == 0:  # a question; we answer with our own time since boot
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

    # Out.

    def tick(self, now_ns: int) -> None:
        """Ask for the time and for messages that come too slowly; report a loss."""
        autopilot, seen = self._presence.autopilot, self._presence.autopilot_seen_ns
        if autopilot is None or seen is None:
            if self._presence.others(now_ns):
                self._ask_time(now_ns)
            return
        is_lost = now_ns - seen > LOST_NS
        if is_lost and not self._is_lost:
            self._say(texts.WARNING, "Telemetry of the autopilot is lost")
        elif self._is_lost and not is_lost:
            self._rates.restart()
            self._say(texts.NOTICE, "Telemetry of the autopilot is back")
        self._is_lost = is_lost
        if is_lost:
            return
        for message in self._rates.tick(*autopilot, now_ns):
            self._outbox.put(ONBOARD, message)
        self._ask_time(now_ns)

    def _ask_time(self, now_ns: int) -> None:
        """Ask our autopilot; or every one, where the answers say which vehicle is ours."""
        target, link = EVERYONE, None
        autopilot = self._presence.autopilot
        if autopilot is not None and not self._presence.others(now_ns):
            target, link = Address(*autopilot), self.link
        request = self.timesync.request(now_ns, target)
        if request is not None:
            self._outbox.put(ONBOARD, request, link)

    def next_timers(self, now_ns: int) -> list[int]:
        """When :meth:`tick` has something to do, in ns."""
        if self._presence.autopilot is not None:
            return [self.timesync.next_timer(), self._rates.next_timer()]
        return [self.timesync.next_timer()] if self._presence.others(now_ns) else []

    def boot_clock(self) -> BootClock | None:
        """The autopilot's clock; None before it was heard."""
        autopilot = self._presence.autopilot
        return None if autopilot is None else self._clocks.get(autopilot[1])
