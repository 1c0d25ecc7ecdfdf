"""Heartbeats of our two components, tied to the health of the service.

Also who else is there: which system we belong to, whether it is armed, and whether another
companion uses our ids. Called from several threads, so it guards its state with a lock.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from mavlink.autopilots import Autopilots, is_autopilot
from mavlink.first_beat import NO_AUTOPILOT, TYPES
from mavlink.messages import CAMERA, ONBOARD, Outgoing
from mavlink.wire import dialect

S = 1_000_000_000
PERIOD_NS = S
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
RECENT_NS = 3 * S  # an armed state older than this is not known any more


class Health(IntEnum):
    """MAV_STATE of our components."""

    BOOT = 1
    NOT_READY = 2  # MAV_STATE_CALIBRATING, "not flight-ready": the links lack something
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5


@dataclass(frozen=True, slots=True)
class PresenceConfig:
    """Our place on the network."""

    system: int | None = None  # None: that of the vehicle that we are connected to
    latch_s: float = 3.0  # how long the vehicle of the last flight is waited for before others
    stale_s: float = 5.0  # health not confirmed for longer is CRITICAL
    dead_s: float = 20.0  # not confirmed for longer: no heartbeat any more
    boot_s: float = 120.0  # the same for a service that has not come up

    def __post_init__(self) -> None:
        if self.system is not None and not 1 <= self.system <= 255:
            raise ValueError(f"system id is {self.system}; it must be 1 to 255, or none given")
        if not 0.0 < self.stale_s < self.dead_s:
            raise ValueError("presence needs 0 < stale_s < dead_s")


class Presence:
    """What we say of ourselves every second, and what others say of themselves."""

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
        self._token = token  # in custom_mode: tells our echo from another companion
        self._lock = threading.Lock()
        self._health = Health.BOOT
        self._confirmed_ns = now_ns
        self._next_ns = now_ns if first_ns is None else first_ns
        self._autopilots = Autopilots(config.system, remembered, config.latch_s)
        self._intruder = False
        self.is_ready = True  # the links have what a flight needs
        self._news: list[str] = []

    @property
    def system(self) -> int:
        """The system id that we use."""
        return self._autopilots.system

    @property
    def proven_system(self) -> int | None:
        """The system id to remember; None until the evidence speaks for one."""
        autopilots = self._autopilots
        return autopilots.system if autopilots.is_proven else None

    @property
    def autopilot(self) -> tuple[int, int] | None:
        """(system, component) of our autopilot; None before it was heard."""
        followed = self._autopilots.followed
        return None if followed is None else (followed.system, followed.component)

    @property
    def firmware(self) -> int | None:
        """MAV_AUTOPILOT of our autopilot; None before it was heard."""
        followed = self._autopilots.followed
        return None if followed is None else followed.firmware

    @property
    def autopilot_seen_ns(self) -> int | None:
        """When the autopilot's heartbeat was heard last."""
        followed = self._autopilots.followed
        return None if followed is None else followed.seen_ns

    @property
    def is_certain(self) -> bool:
        """False while our autopilot was only the first that was heard: it may be another's."""
        return self._autopilots.is_certain

    @property
    def is_armed(self) -> bool:
        """True while the autopilot says so."""
        followed = self._autopilots.followed
        return followed is not None and followed.is_armed

    def is_disarmed(self, now_ns: int) -> bool:
        """True only where what is certainly our autopilot said so a moment ago."""
        followed = self._autopilots.followed
        if followed is None or followed.is_armed or not self.is_certain:
            return False
        return now_ns - followed.seen_ns <= RECENT_NS

    def others(self, now_ns: int) -> list[int]:
        """The systems of autopilots that are heard but not followed."""
        with self._lock:
            return self._autopilots.others(now_ns)

    def confirm(self, health: Health, now_ns: int) -> None:
        """The service is alive and this is its state; to be said again every few seconds."""
        with self._lock:
            self._health = health
            self._confirmed_ns = now_ns

    def health(self, now_ns: int) -> Health | None:
        """What the heartbeat says now; None once the service must be taken for dead."""
        with self._lock:
            return self._state(now_ns)

    def _state(self, now_ns: int) -> Health | None:
        silent = (now_ns - self._confirmed_ns) / S
        if self._health is Health.BOOT:
            return Health.BOOT if silent < self.config.boot_s else None
        if silent < self.config.stale_s:
            is_waiting = self._health is Health.STANDBY and not self.is_ready
            return Health.NOT_READY if is_waiting else self._health
        return Health.CRITICAL if silent < self.config.dead_s else None

    def due(self, now_ns: int) -> list[Outgoing]:
        """The heartbeats to send now; the first call gives them at once."""
        with self._lock:
            if now_ns < self._next_ns:
                return []
            late = now_ns - self._next_ns
            self._next_ns = now_ns + PERIOD_NS - (late if late < PERIOD_NS else 0)
            state = self._state(now_ns)
            if state is None:
                return []
            return [Outgoing(c, self._heartbeat(c, state)) for c in (ONBOARD, CAMERA)]

    def _heartbeat(self, component: int, state: Health) -> Any:
        kind = TYPES[component]
        return dialect.MAVLink_heartbeat_message(kind, NO_AUTOPILOT, 0, self._token, int(state), 3)

    def next_timer(self) -> int:
        """When :meth:`due` has something again, in ns."""
        return self._next_ns

    def hear(self, message: Any, now_ns: int) -> None:
        """Take in anyone's heartbeat."""
        system, component = message.get_srcSystem(), message.get_srcComponent()
        with self._lock:
            if is_autopilot(component, message):
                armed = bool(message.base_mode & ARMED)
                self._autopilots.hear(system, component, armed, now_ns, message.autopilot)
            elif system == self.system and component in TYPES:
                self._hear_namesake(component, message.custom_mode)

    def count(self, system: int, component: int) -> None:
        """Count a message of someone."""
        with self._lock:
            self._autopilots.count(system, component)

    def answered(self, system: int, component: int, round_trip_ns: int) -> None:
        """Take in someone's answer to one of our TIMESYNC questions."""
        with self._lock:
            self._autopilots.answered(system, component, round_trip_ns)

    def look(self, now_ns: int) -> None:
        """Compare the autopilots that are heard, when it is time."""
        with self._lock:
            self._autopilots.look(now_ns)

    def _hear_namesake(self, component: int, token: int) -> None:
        if token == self._token or self._intruder:
            return
        self._intruder = True
        self._news.append(f"Another companion uses component {component} of this vehicle")

    def take_news(self) -> list[str]:
        """What the operator must know, each once."""
        with self._lock:
            news, self._news = self._news, []
            return self._autopilots.take_news() + news
