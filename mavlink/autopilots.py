"""Which heartbeats are an autopilot's, and which of several vehicles is the one we are on.

The vehicle that we are connected to answers our TIMESYNC questions, and sooner than others whose
messages it forwards; where no autopilot answers, it is the one that says most. Where that does
not decide either, nobody is followed and the operator is asked for ``mavlink.system_id``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mavlink.first_beat import NO_AUTOPILOT

S = 1_000_000_000
MS = 1_000_000
AUTOPILOT1 = 1  # MAV_COMP_ID_AUTOPILOT1
FIRST_DEVICE = 100  # from here on component ids are of cameras, gimbals, computers, receivers ...
NOT_VEHICLES = frozenset({5, 6, 18, 26, 27, 30, *range(31, 35), *range(36, 43), 44, 48, 49})
"""MAV_TYPE of antenna trackers, ground stations, onboard computers, gimbals, ADS-B, cameras,
charging stations, FLARM, servos, Open Drone ID, batteries, parachutes, loggers, OSDs, IMUs, GPS,
winches, illuminators, grippers and radios."""

LOOK_NS = 3 * S  # how long evidence is gathered before it is compared
PRESENT_NS = 5 * S  # an autopilot heard within this time takes part in a comparison
ENOUGH_ANSWERS = 2  # of TIMESYNC within one look
NEARER, NEARER_NS = 3, 5 * MS  # a round trip shorter by this factor and this much decides
LOUDER, LOUD = 4, 8  # so many times as many messages decide, from this many on
PROVEN_LOOKS = 10  # looks in a row that must speak against an autopilot that was proven ours


def is_autopilot(component: int, heartbeat: Any) -> bool:
    """True for the heartbeat of a vehicle's autopilot, not of any other component."""
    return (
        heartbeat.autopilot != NO_AUTOPILOT
        and heartbeat.type not in NOT_VEHICLES
        and 0 < component < FIRST_DEVICE
    )


@dataclass(slots=True)
class Autopilot:
    """One system's autopilot and what speaks for it in the current look."""

    system: int
    component: int
    firmware: int = 0  # MAV_AUTOPILOT
    seen_ns: int = 0
    is_armed: bool = False
    messages: int = 0
    answers: int = 0
    round_trip_ns: int = 0  # the shortest

    def forget_evidence(self) -> None:
        """Start a new look."""
        self.messages = self.answers = self.round_trip_ns = 0


class Autopilots:
    """Every autopilot heard, at most one per system id, and the one that is followed."""

    def __init__(self, given: int | None, remembered: int | None, wait_s: float) -> None:
        """``given`` is never left; ``remembered`` is waited for ``wait_s`` before others."""
        self.given = given
        self.remembered = remembered
        self.followed: Autopilot | None = None
        self.is_proven = False  # nothing spoke for another vehicle
        self._wait_ns = round(wait_s * S)
        self._heard: dict[int, Autopilot] = {}
        self._first_ns: int | None = None
        self._look_ns = 0
        self._against = 0  # looks in a row that spoke for another vehicle
        self._is_unclear = False
        self._news: list[str] = []

    @property
    def system(self) -> int:
        """The system id to use: the one followed, or the most likely one."""
        if self.followed is not None and self.given is None:
            return self.followed.system
        return self.given or self.remembered or 1

    @property
    def is_certain(self) -> bool:
        """False while the one followed was only the first that was heard."""
        followed = self.followed
        expected = followed is not None and followed.system in (self.given, self.remembered)
        return followed is None or self.is_proven or expected

    def hear(
        self, system: int, component: int, is_armed: bool, now_ns: int, firmware: int = 0
    ) -> None:
        """Take in an autopilot's heartbeat; component 1 goes before others of its system."""
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
        """True where the first heartbeat is enough."""
        if self.given is not None:
            return system == self.given
        if self._is_unclear or self._first_ns is None:
            return False
        expected = self.remembered in (None, system)
        return expected or now_ns - self._first_ns >= self._wait_ns

    def count(self, system: int, component: int) -> None:
        """Count a message; only those of autopilots speak for a vehicle."""
        known = self._heard.get(system)
        if known is not None and known.component == component:
            known.messages += 1

    def answered(self, system: int, component: int, round_trip_ns: int) -> None:
        """Take in an answer to one of our TIMESYNC questions."""
        known = self._heard.get(system)
        if known is None or known.component != component:
            return
        shortest = min(known.round_trip_ns, round_trip_ns) if known.answers else round_trip_ns
        known.answers, known.round_trip_ns = known.answers + 1, shortest

    def look(self, now_ns: int) -> None:
        """Compare the evidence when it is time; follow another vehicle if it speaks for that."""
        if self.given is not None or self._first_ns is None or now_ns < self._look_ns:
            return
        self._look_ns = now_ns + LOOK_NS
        present = [a for a in self._heard.values() if now_ns - a.seen_ns < PRESENT_NS]
        if present:
            self._decide(present)
        for autopilot in self._heard.values():
            autopilot.forget_evidence()

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
        """The remembered vehicle, where it is there; it decides a draw."""
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

    def take_news(self) -> list[str]:
        """What the operator must know, each once."""
        news, self._news = self._news, []
        return news

    def others(self, now_ns: int) -> list[int]:
        """The systems of present autopilots that are not followed, ascending."""
        present = (a for a in self._heard.values() if now_ns - a.seen_ns < PRESENT_NS)
        return sorted(a.system for a in present if a is not self.followed)


def clear_winner(present: Sequence[Autopilot]) -> Autopilot | None:
    """The autopilot that we are connected to by all evidence; None where it does not decide."""
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
