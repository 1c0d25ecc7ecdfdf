"""Heartbeats of our two components, tied to the health of the service; and who else is there.

Of several vehicles, ours answers our TIMESYNC requests sooner than vehicles whose messages it
forwards. Without answers, the autopilot that sends the most messages is ours. If that is not
decisive either, no vehicle is followed and the operator is asked to set ``mavlink.system_id``.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import NO_AUTOPILOT, TYPES, is_autopilot
from mavlink.wire.messages import OutgoingMessage

S = 1_000_000_000
MS = 1_000_000
PERIOD_NS = S
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
RECENT_NS = 3 * S  # the autopilot's state is heard as often, or it is unknown


class Health(IntEnum):
    """MAV_STATE of our components."""

    BOOT = 1
    NOT_READY = 2  # MAV_STATE_CALIBRATING, "not flight-ready": the links lack something
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5


@dataclass(frozen=True, slots=True)
class PresenceConfig:
    system: int | None = None  # None: that of our vehicle
    latch_s: float = 3.0  # how long to wait for the vehicle of the last flight
    stale_s: float = 5.0  # health not confirmed for this long is CRITICAL
    dead_s: float = 20.0  # not confirmed for this long: heartbeats stop
    boot_s: float = 120.0  # the same during start-up

    def __post_init__(self) -> None:
        if self.system is not None and not 1 <= self.system <= 255:
            raise ValueError(f"system id is {self.system}; it must be 1 to 255, or none given")
        if not 0.0 < self.stale_s < self.dead_s:
            raise ValueError("presence needs 0 < stale_s < dead_s")


AUTOPILOT1 = 1  # MAV_COMP_ID_AUTOPILOT1
LOOK_NS = 3 * S  # how long evidence is collected before it is compared
PRESENT_NS = 5 * S  # an autopilot heard within this time takes part in a comparison
ENOUGH_ANSWERS = 2  # of TIMESYNC within one look
NEARER, NEARER_NS = 3, 5 * MS  # a round trip shorter by this factor and this much decides
LOUDER, LOUD = 4, 8  # this many times as many messages decide, from this count on
PROVEN_LOOKS = 10  # consecutive evaluations against a proven autopilot before it is dropped


@dataclass(slots=True)
class Autopilot:
    """One system's autopilot and its evidence in the current evaluation."""

    system: int
    component: int
    firmware: int = 0  # MAV_AUTOPILOT
    seen_ns: int = 0
    is_armed: bool = False
    messages: int = 0
    answers: int = 0
    round_trip_ns: int = 0  # the minimum


class Presence:
    """Our heartbeats, and who else is there: every autopilot heard, at most one per system id, and
    the one that is followed.

    One thread writes, others may read; heartbeats may be requested from another thread.
    """

    def __init__(
        self,
        config: PresenceConfig,
        token: int,
        now_ns: int,
        first_ns: int | None = None,
        remembered: int | None = None,
    ) -> None:
        """The first heartbeat is due at ``first_ns``, or now; ``remembered``: the last system."""
        self.config = config
        self.is_ready = True  # the links provide what a flight needs
        self.followed: Autopilot | None = None
        self.remembered = remembered
        self.is_proven = False  # no evidence for another vehicle
        self._token = token  # in custom_mode: distinguishes our echo from another companion
        self._lock = threading.RLock()  # of the heartbeats
        self._health = Health.BOOT
        self._confirmed_ns = now_ns
        self.next_ns = now_ns if first_ns is None else first_ns  # time of the next heartbeats
        self._heard: dict[int, Autopilot] = {}
        self._first_ns: int | None = None
        self._look_ns = 0
        self._against = 0  # consecutive evaluations in favour of another vehicle
        self._is_unclear = self._has_namesake = False
        self._news: list[str] = []

    def take_news(self) -> list[str]:
        news, self._news = self._news, []
        return news

    def hear(self, message: Any, now_ns: int) -> None:
        system, component = message.get_srcSystem(), message.get_srcComponent()
        if system and is_autopilot(component, message):  # system 0 is everybody
            armed = bool(message.base_mode & ARMED)
            self._hear_autopilot(system, component, armed, now_ns, message.autopilot)
        elif system == self.system and component in TYPES and not self._has_namesake:
            self._has_namesake = message.custom_mode != self._token
            if self._has_namesake:
                text = f"Another companion uses component {component} of this vehicle"
                self._news.append(text)

    # Our heartbeats.

    def confirm(self, health: Health, now_ns: int) -> None:
        """Confirm that the service is alive and in this state; repeat every few seconds."""
        with self._lock:
            self._health = health
            self._confirmed_ns = now_ns

    def health(self, now_ns: int) -> Health | None:
        """State for the heartbeat; None once the service must be considered dead."""
        with self._lock:
            health, silent = self._health, (now_ns - self._confirmed_ns) / S
        if health is Health.BOOT:
            return Health.BOOT if silent < self.config.boot_s else None
        if silent < self.config.stale_s:
            is_waiting = health is Health.STANDBY and not self.is_ready
            return Health.NOT_READY if is_waiting else health
        return Health.CRITICAL if silent < self.config.dead_s else None

    def due(self, now_ns: int) -> list[OutgoingMessage]:
        """The heartbeats to send now; the first call returns them at once."""
        with self._lock:
            if now_ns < self.next_ns:
                return []
            late = now_ns - self.next_ns
            self.next_ns = now_ns + PERIOD_NS - (late if late < PERIOD_NS else 0)
            state = self.health(now_ns)
            if state is None:
                return []
            return [
                OutgoingMessage(
                    component,
                    dialect.MAVLink_heartbeat_message(
                        kind, NO_AUTOPILOT, 0, self._token, int(state), 3
                    ),
                )
                for component, kind in TYPES.items()
            ]

    # The autopilot.

    @property
    def system(self) -> int:
        """The system id to use: the one followed, or the most likely one."""
        if self.followed is not None and self.config.system is None:
            return self.followed.system
        return self.config.system or self.remembered or 1

    @property
    def proven_system(self) -> int | None:
        """The system id to remember; None until the evidence is sufficient."""
        return self.system if self.is_proven else None

    @property
    def autopilot(self) -> tuple[int, int] | None:
        """(system, component) of our autopilot; None before it was heard."""
        followed = self.followed
        return None if followed is None else (followed.system, followed.component)

    @property
    def autopilot_seen_ns(self) -> int | None:
        followed = self.followed
        return None if followed is None else followed.seen_ns

    @property
    def is_certain(self) -> bool:
        """False while our autopilot was merely the first one heard: it may be another vehicle's."""
        followed = self.followed
        if followed is None or self.is_proven:
            return True
        return followed.system in (self.config.system, self.remembered)

    @property
    def is_armed(self) -> bool:
        followed = self.followed
        return followed is not None and followed.is_armed

    def is_disarmed(self, since_ns: int) -> bool:
        """True only where the autopilot, certainly ours, has reported it after ``since_ns``."""
        followed = self.followed
        if followed is None or followed.is_armed or not self.is_certain:
            return False
        return followed.seen_ns > since_ns

    def others(self, now_ns: int) -> list[int]:
        """The systems of present autopilots that are not followed, ascending."""
        return sorted(a.system for a in self._present(now_ns) if a is not self.followed)

    def _present(self, now_ns: int) -> list[Autopilot]:
        return [a for a in list(self._heard.values()) if now_ns - a.seen_ns < PRESENT_NS]

    def _hear_autopilot(
        self, system: int, component: int, is_armed: bool, now_ns: int, firmware: int
    ) -> None:
        """Component 1 is preferred within its system."""
        known = self._heard.get(system)
        if known is None or (known.component != component and component == AUTOPILOT1):
            fresh = self._heard[system] = Autopilot(system, component)
            if known is not None and self.followed is known:
                self.followed = fresh
            known = fresh
        elif known.component != component:
            return
        known.seen_ns, known.is_armed, known.firmware = now_ns, is_armed, firmware
        if self._first_ns is None:
            self._first_ns, self._look_ns = now_ns, now_ns + LOOK_NS
        if self.followed is None and self._may_follow(system, now_ns):
            self.followed = known

    def _may_follow(self, system: int, now_ns: int) -> bool:
        """True where the first heartbeat suffices."""
        if self.config.system is not None:
            return system == self.config.system
        if self._is_unclear or self._first_ns is None:
            return False
        expected = self.remembered in (None, system)
        return expected or now_ns - self._first_ns >= self.config.latch_s * S

    def count(self, system: int, component: int) -> None:
        """Count a message; only those of autopilots are evidence."""
        known = self._heard.get(system)
        if known is not None and known.component == component:
            known.messages += 1

    def answered(self, system: int, component: int, round_trip_ns: int) -> None:
        known = self._heard.get(system)
        if known is None or known.component != component:
            return
        shortest = min(known.round_trip_ns, round_trip_ns) if known.answers else round_trip_ns
        known.answers, known.round_trip_ns = known.answers + 1, shortest

    def look(self, now_ns: int) -> None:
        """Evaluate the evidence when due; follow another vehicle if it wins."""
        if self.config.system is not None or self._first_ns is None or now_ns < self._look_ns:
            return
        self._look_ns = now_ns + LOOK_NS
        if present := self._present(now_ns):
            self._decide(present)
        for autopilot in self._heard.values():
            autopilot.messages = autopilot.answers = autopilot.round_trip_ns = 0

    def _decide(self, present: Sequence[Autopilot]) -> None:
        best = clear_winner(present)
        followed = self.followed
        if best is None:
            if self._expected_among(present) is None and not self.is_proven:
                self._give_up(present)
            return
        if best is followed:
            answers = best.answers >= ENOUGH_ANSWERS
            self.is_proven |= answers or self.remembered in (None, best.system)
            self._against = 0
            return
        self._against += 1
        if followed is None or not self.is_proven or self._against >= PROVEN_LOOKS:
            self._follow(best)

    def _expected_among(self, present: Sequence[Autopilot]) -> Autopilot | None:
        """The remembered vehicle, if present; it decides a tie."""
        expected = next((a for a in present if a.system == self.remembered), None)
        if expected is not None and self.followed is not expected and not self.is_proven:
            self._follow(expected)
        return expected

    def _follow(self, autopilot: Autopilot) -> None:
        if self.followed is not None:
            self._news.append(f"Following system {autopilot.system}, not {self.followed.system}")
        self.followed, self._against = autopilot, 0
        self.is_proven = self._is_unclear = False

    def _give_up(self, present: Sequence[Autopilot]) -> None:
        self.followed = None
        if not self._is_unclear:
            names = ", ".join(str(a.system) for a in sorted(present, key=lambda a: a.system))
            self._news.append(f"Several autopilots ({names}): set mavlink.system_id")
        self._is_unclear = True


def clear_winner(present: Sequence[Autopilot]) -> Autopilot | None:
    """The autopilot that the evidence identifies as ours; None where it is not decisive."""
    if len(present) == 1:
        return present[0]
    answering = [a for a in present if a.answers >= ENOUGH_ANSWERS]
    if len(answering) == 1:
        return answering[0]
    if answering:
        near, far = sorted(answering, key=lambda a: a.round_trip_ns)[:2]
        apart_ns = far.round_trip_ns - near.round_trip_ns
        is_nearer = apart_ns >= NEARER_NS and far.round_trip_ns >= NEARER * near.round_trip_ns
        return near if is_nearer else None
    loud, quiet = sorted(present, key=lambda a: -a.messages)[:2]
    return loud if loud.messages >= max(LOUD, LOUDER * quiet.messages) else None
