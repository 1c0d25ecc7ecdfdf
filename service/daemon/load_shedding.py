"""Load shedding in steps when the computer is too slow, too hot or short of memory.

:class:`Ladder` turns readings into steps: no clock, no file, no thread. It steps down quickly, one
step at a time with time to take effect; up slowly, and more slowly when the last step up failed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

from service.config import ComputeConfig

STRIDE = 2  # from LOWER_RATE on, one of this many frames is tracked

NARROWER = 0.7

GRACE_S = 10.0  # a scan that has just begun lags because of its start


class Level(IntEnum):
    """Load level; each includes the reductions of the levels before."""

    FULL = 0
    LOWER_RATE = 1  # every second frame, half the stereo pairs
    LOWER_RESOLUTION = 2  # the stereo pair at 0.7 of its width
    NO_UPSAMPLING = 3
    RECORD_ONLY = 4  # images are stored on disk, for later reconstruction

    @property
    def label(self) -> str:
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True, slots=True)
class MachineReadings:
    """Measurements since the last check; None where the machine has none."""

    views: int = 0  # views due for reconstruction
    late_views: int = 0  # of these, dropped in favour of newer ones
    frames: int = 0  # frames of the camera
    late_frames: int = 0  # of these, never processed
    age_s: float = 0.0  # age of the newest frame when its processing began
    temperature_c: float | None = None
    throttled: bool | None = None
    memory_free_mib: float | None = None  # below the limit of the service or the machine


COOLER_C = 8.0  # so far below compute.hottest_c a step up is tried
LATE_VIEWS, LATE_FRAMES, OLDEST_S = 0.25, 0.6, 1.5
"""Tolerated shares of late views and missed frames, and age of a frame as its processing begins."""
HOPELESS = 2.5  # at this multiple of them images are only recorded
PATIENCE_S, HEAT_PATIENCE_S = 6.0, 20.0
"""Of overload before a step down, and between two; of heat, since cooling is slow."""
CALM_S, LONGEST_CALM_S = 30.0, 240.0
"""Without overload before a step up; doubled when that failed, up to the longest."""


@dataclass(frozen=True, slots=True)
class Strain:
    """A reading as a multiple of its limit: above 1 it is an overload."""

    times: float
    calm: float  # below it, as all others are, a step up may be tried
    reason: str
    patience_s: float
    lowest: Level  # lowest level for this cause
    jump: bool = False  # step to ``lowest`` at once


@dataclass(frozen=True, slots=True)
class Move:
    level: Level
    reason: str  # of a step down; empty on the way up

    @property
    def text(self) -> str:
        if self.reason:
            return f"Load: {self.level.label} ({self.reason})"
        return f"Load: {self.level.label if self.level else 'full quality'} again"


class Ladder:
    def __init__(self, config: ComputeConfig) -> None:
        self.config = config
        self.level = Level.FULL
        self.reason = ""  # cause of the last step down; empty at FULL
        self._strained_s = self._calm_since_s = math.nan  # start times; NaN: not now
        self._moved_s = -math.inf
        self._went_up = False
        self._calm_s = CALM_S

    def update(self, readings: MachineReadings, now_s: float) -> Move | None:
        """The step to take at ``now_s`` of a monotonic clock, if any."""
        if not self.config.relief:
            self.level, self.reason = Level.FULL, ""
            return None
        found = strains(readings, self.config)
        worst = next((strain for strain in found if strain.times > 1.0), None)
        if worst is not None:
            self._calm_since_s = math.nan
            if math.isnan(self._strained_s):
                self._strained_s = now_s
            return self._down(worst, now_s)
        self._strained_s = math.nan
        if not all(strain.times < strain.calm for strain in found):
            self._calm_since_s = math.nan
            return None
        if math.isnan(self._calm_since_s):
            self._calm_since_s = now_s
        return self._up(now_s)

    def _down(self, found: Strain, now_s: float) -> Move | None:
        waited_s = now_s - max(self._strained_s, self._moved_s)
        if self.level >= found.lowest or (waited_s < found.patience_s and not found.jump):
            return None
        if self._went_up and now_s - self._moved_s < 2.0 * self._calm_s:
            self._calm_s = min(2.0 * self._calm_s, LONGEST_CALM_S)
        self.level = found.lowest if found.jump else Level(self.level + 1)
        self.reason = found.reason
        self._moved_s, self._went_up = now_s, False
        return Move(self.level, found.reason)

    def _up(self, now_s: float) -> Move | None:
        calm_s = now_s - max(self._calm_since_s, self._moved_s)
        if self.level is Level.FULL:
            if calm_s > LONGEST_CALM_S:
                self._calm_s = CALM_S
            return None
        if calm_s < self._calm_s:
            return None
        self.level = Level(self.level - 1)
        self._moved_s, self._went_up = now_s, True
        if self.level is Level.FULL:
            self.reason = ""
        return Move(self.level, "")


def strains(readings: MachineReadings, config: ComputeConfig) -> list[Strain]:
    """Those that were measured: memory before heat before lag, of which the worst is first."""
    found = []
    memory, heat = readings.memory_free_mib, readings.temperature_c
    if memory is not None:
        times = config.least_memory_mib / max(memory, 1e-6)
        text = f"{memory:.0f} MiB memory free"
        found.append(Strain(times, 1 / 1.5, text, PATIENCE_S, Level.RECORD_ONLY, times > 2.0))
    if heat is not None:
        times, text = 1.0 + (heat - config.hottest_c) / COOLER_C, f"{heat:.0f} degrees"
        found.append(Strain(times, 0.0, text, HEAT_PATIENCE_S, Level.RECORD_ONLY))
    if readings.throttled:
        found.append(Strain(math.inf, 0.0, "throttled", HEAT_PATIENCE_S, Level.NO_UPSAMPLING))
    views = readings.late_views / max(readings.views, 1)
    frames = readings.late_frames / max(readings.frames, 1)
    lags = (
        (views / LATE_VIEWS, 0.5, f"{100 * views:.0f} % of the views late"),
        (readings.age_s / OLDEST_S, 0.5, f"images {readings.age_s:.1f} s late"),
        (frames / LATE_FRAMES, 0.75, f"{100 * frames:.0f} % of the images missed"),
    )
    for times, calm, text in sorted(lags, reverse=True):
        lowest = Level.RECORD_ONLY if times > HOPELESS else Level.NO_UPSAMPLING
        found.append(Strain(times, calm, text, PATIENCE_S, lowest))
    return found


def lowered(compute: ComputeConfig, level: Level) -> ComputeConfig:
    if level >= Level.LOWER_RATE:
        compute = replace(compute, pairs=max(1, compute.pairs // 2))
    if level >= Level.LOWER_RESOLUTION:
        width = max(64, 16 * round(NARROWER * compute.stereo_width / 16))
        compute = replace(compute, stereo_width=min(width, compute.stereo_width))
    if level >= Level.NO_UPSAMPLING:
        compute = replace(compute, upsample=False)
    return compute
