"""The telemetry of every frame, with its age and sigma, kept next to the scan."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import TextIO

from mavlink.telemetry.samples import VehicleState

log = logging.getLogger(__name__)

FILE = "telemetry.csv"
SOURCES = ("attitude", "gimbal", "gnss", "agl")
SIGMAS = ("attitude_deg", "yaw_deg", "gimbal_deg", "horizontal_m", "vertical_m", "agl_m")
COLUMNS = (
    "time_unix_s",
    "sources",
    *(f"age_{name}_ms" for name in SOURCES),
    *(f"sigma_{name}" for name in SIGMAS),
)
HEIGHTS = ("rangefinder", "terrain", "relative")


class FrameTags:
    """A CSV with one line per frame that has telemetry; never raises."""

    def __init__(self, path: Path) -> None:
        self._file: TextIO | None = None
        try:
            self._file = path.open("w", encoding="ascii", buffering=1 << 16)
            self._file.write(",".join(COLUMNS) + "\n")
        except OSError as error:
            self._give_up(error)

    def write(self, time_unix_ns: int, state: VehicleState | None) -> None:
        """One frame, at its exposure."""
        if self._file is None or state is None:
            return
        try:
            self._file.write(_line(time_unix_ns, state))
        except OSError as error:
            self._give_up(error)

    def close(self) -> None:
        """End the file."""
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        log.error("%s ends here: %s", FILE, error.strerror or error)
        self._file = None


def _line(time_unix_ns: int, state: VehicleState) -> str:
    age = state.age_ms
    ages = (
        age.get("attitude"),
        age.get("gimbal"),
        age.get("gnss"),
        next((age[name] for name in HEIGHTS if name in age), None),
    )
    sigmas = (
        _degrees(state.sigma_attitude_rad),
        _degrees(state.sigma_yaw_rad),
        _degrees(state.sigma_gimbal_rad),
        state.sigma_h_m,
        state.sigma_v_m,
        state.sigma_agl_m,
    )
    seconds = f"{time_unix_ns // 10**9}.{time_unix_ns % 10**9:09}"
    cells = [seconds, " ".join(state.sources), *map(_ms, ages), *map(_cell, sigmas)]
    return ",".join(cells) + "\n"


def _degrees(value: float | None) -> float | None:
    return None if value is None else math.degrees(value)


def _ms(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
