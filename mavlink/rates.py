"""Which messages we need of the autopilot, how often, and asking again when they fade.

A new link carries little until asked, and a ground station may slow streams down for all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mavlink.wire import dialect

S = 1_000_000_000
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
PATIENCE = 5  # requests without a single message before we ask only rarely
RARELY = 12  # looks between two such requests


@dataclass(slots=True)
class _Want:
    number: int
    hz: float
    heard: int = 0
    futile: int = 0
    wait: int = 0


class RateKeeper:
    """Counts what comes and says which SET_MESSAGE_INTERVAL to send."""

    def __init__(self, wanted_hz: Mapping[str, float] = WANTED_HZ) -> None:
        unknown = [name for name in wanted_hz if name not in NUMBERS]
        if unknown:
            raise ValueError(f"no MAVLink message is called {unknown[0]}")
        self._wants = {n: _Want(NUMBERS[n], hz) for n, hz in wanted_hz.items()}
        self._looked_ns: int | None = None

    def heard(self, name: str) -> None:
        """Count a message of the autopilot."""
        want = self._wants.get(name)
        if want is not None:
            want.heard += 1

    def restart(self) -> None:
        """Ask for everything again at the next look, as after a reboot."""
        self._looked_ns = None
        for want in self._wants.values():
            want.heard = want.futile = want.wait = 0

    def tick(self, system: int, component: int, now_ns: int) -> list[Any]:
        """COMMAND_LONGs to the autopilot for what comes too slowly; none between looks."""
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
        if want.futile <= PATIENCE:
            return True
        want.wait = (want.wait + 1) % RARELY
        return want.wait == 0

    def next_timer(self) -> int:
        """When :meth:`tick` looks again, in ns."""
        return 0 if self._looked_ns is None else self._looked_ns + LOOK_NS
