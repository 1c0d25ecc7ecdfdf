"""The vehicle that the portal shows: its figures, and the operator's orders with their answers."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

from service.errors import InputError, OutsideError
from service.ground.operator import Operator, order
from service.workers import Worker, Workers

log = logging.getLogger(__name__)

Button = Literal["start", "stop", "pause", "resume", "photo", "baseline"]
"""Commands that the portal offers; only ``baseline`` takes a value."""

SEARCH_S = 5.0
STALE_S = 10.0
HEARD = ("SYS_STATUS", "GPS_RAW_INT", "VFR_HUD", "ATTITUDE", "GLOBAL_POSITION_INT", "HOME_POSITION")
"""Messages kept for the figures."""


class Vehicle:
    """Looks for a companion on a MAVLink endpoint, on a thread of its own. ``connect`` makes the
    :class:`service.ground.operator.Operator`; it raises OutsideError while none is connected."""

    def __init__(
        self,
        endpoint: str,
        connect: Callable[[str], Operator] = lambda at: Operator(at, None, SEARCH_S),
        workers: Workers | None = None,
    ) -> None:
        self.endpoint = endpoint
        self._connect = connect
        self._operator: Operator | None = None
        self._lock = threading.Lock()  # of the operator's link
        self._one_order, self._one_stop = threading.Lock(), threading.Lock()
        self._workers = workers or Workers()
        self._searching: Worker | None = None
        self._heard: dict[str, tuple[float, dict[str, Any]]] = {}
        self._trouble = "looking for the companion"

    def start(self) -> None:
        self._searching = self._workers.start("vehicle", self._search)

    def close(self) -> None:
        if self._searching is not None:
            self._searching.join(2 * SEARCH_S)
        with self._one_order, self._one_stop, self._lock:
            if self._operator is not None:
                self._operator.__exit__(None, None, None)
                self._operator = None

    def order(self, action: Button, metres: float | None) -> dict[str, Any]:
        """Send an order and return its answer; one at a time, but a stop waits for no other.

        Raises InputError for metres where they are missing or too much, OutsideError when it was
        not carried out.
        """
        if (action == "baseline") != (metres is not None):
            raise InputError("baseline takes metres (0 follows the altitude); no other action does")
        with self._lock:
            operator = self._operator
        if operator is None:
            raise OutsideError(f"no vehicle: {self._trouble}")
        with self._one_stop if action == "stop" else self._one_order:
            return order(operator, action, metres)

    def figures(self) -> dict[str, Any]:
        """Battery, satellites, speed, height, attitude, distance from home; None if not heard."""
        status, gps, hud = (self._last(n) for n in ("SYS_STATUS", "GPS_RAW_INT", "VFR_HUD"))
        attitude, place = self._last("ATTITUDE"), self._last("GLOBAL_POSITION_INT")
        volts = _number(status, "voltage_battery")
        percent = _number(status, "battery_remaining")
        return {
            "connected": self._operator is not None,
            "trouble": None if self._operator is not None else self._trouble,
            "battery_percent": percent if percent is not None and percent >= 0 else None,
            "battery_volts": volts / 1000 if volts is not None and volts < 65535 else None,
            "satellites": _number(gps, "satellites_visible"),
            "speed_m_s": _number(hud, "groundspeed"),
            "height_above_home_m": _scaled(place, "relative_alt", 1e-3),
            "home_distance_m": _home_distance(place, self._last("HOME_POSITION")),
            **{
                f"{name}_deg": _scaled(attitude, name, 180 / math.pi)
                for name in ("roll", "pitch", "yaw")
            },
        }

    def _search(self, worker: Worker) -> None:
        while not worker.stop.is_set():
            try:
                operator = self._connect(self.endpoint)
            except (InputError, OutsideError) as error:
                if self._trouble != str(error):
                    log.warning("%s; still looking", error)
                self._trouble = str(error)
                worker.stop.wait(1.0)
                continue
            for name in HEARD:
                operator.subscribe(name, partial(self._keep, name))
            with self._lock:
                self._operator = operator
            log.info("companion of system %d found at %s", operator.system, self.endpoint)
            return

    def _keep(self, name: str, _: int, fields: dict[str, Any]) -> None:
        self._heard[name] = (time.monotonic(), fields)

    def _last(self, name: str) -> dict[str, Any]:
        """The last message of a kind; empty when it is old. Home does not grow old."""
        at, fields = self._heard.get(name, (0.0, {}))
        fresh = name == "HOME_POSITION" or time.monotonic() - at < STALE_S
        return fields if fresh else {}


def _number(fields: dict[str, Any], name: str) -> float | None:
    value = fields.get(name)
    usable = isinstance(value, (int, float)) and math.isfinite(value)
    return round(float(value), 3) if usable and value is not None else None


def _scaled(fields: dict[str, Any], name: str, unit: float) -> float | None:
    value = _number(fields, name)
    return None if value is None else round(value * unit, 2)


def _home_distance(place: dict[str, Any], home: dict[str, Any]) -> float | None:
    from pyproj import Geod

    lat, lon = _number(place, "lat"), _number(place, "lon")
    home_lat, home_lon = _number(home, "latitude"), _number(home, "longitude")
    if lat is None or lon is None or home_lat is None or home_lon is None:
        return None
    globe = Geod(ellps="WGS84")
    metres = globe.inv(1e-7 * home_lon, 1e-7 * home_lat, 1e-7 * lon, 1e-7 * lat)[2]
    return round(metres, 1) if math.isfinite(metres) else None
