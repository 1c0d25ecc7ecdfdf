"""Load shedding in steps when the computer is too slow, too hot or short of memory.

:class:`Ladder` turns readings into steps: no clock, no file, no thread. It steps down quickly, one
step at a time with time to take effect; up slowly, and more slowly when the last step up failed.
:class:`LoadControl` measures the load of the running scan, queries the ladder, applies its steps
and reports them.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from mavlink.component.control import Phase
from mavlink.component.status import CRITICAL, INFO, WARNING
from service.config import ComputeConfig
from service.daemon.machine import Machine

if TYPE_CHECKING:
    from service.daemon.scanning import Scanning

log = logging.getLogger(__name__)

STRIDE = 2
"""From LOWER_RATE on, one of this many frames is tracked."""

NARROWER = 0.7

GRACE_S = 10.0
"""A scan that has just begun lags because of its start."""


class Level(IntEnum):
    """Load level; each includes the reductions of the levels before."""

    FULL = 0
    LOWER_RATE = 1  # every second frame, half the stereo pairs
    LOWER_RESOLUTION = 2  # the stereo pair at 0.7 of its width
    NO_UPSAMPLING = 3
    RECORD_ONLY = 4  # images are stored on disk, for later reconstruction

    @property
    def label(self) -> str:
        """Name for the operator."""
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


@dataclass(frozen=True, slots=True)
class LadderConfig:
    """Thresholds and times of the steps."""

    hottest_c: float = 90.0
    cooler_c: float = 8.0  # this far below before stepping up
    min_memory_mib: float = 300.0  # half of it: directly to the last step
    late_views: float = 0.25  # tolerated share of late views
    late_frames: float = 0.6  # tolerated share of missed frames
    oldest_s: float = 1.5  # tolerated age of a frame when its processing begins
    hopeless: float = 2.5  # at this multiple: only record
    patience_s: float = 6.0  # of overload before a step down, and between two
    heat_patience_s: float = 20.0  # the same for heat: cooling is slow
    calm_s: float = 30.0  # without overload before a step up; doubled when that failed
    longest_calm_s: float = 240.0


@dataclass(frozen=True, slots=True)
class Strain:
    """A cause of overload."""

    reason: str
    patience_s: float
    lowest: Level  # lowest level for this cause
    jump: bool = False  # step to ``lowest`` at once


@dataclass(frozen=True, slots=True)
class Move:
    """A step taken."""

    level: Level
    reason: str  # of a step down; empty on the way up

    @property
    def text(self) -> str:
        """Text for the operator."""
        if self.reason:
            return f"Load: {self.level.label} ({self.reason})"
        return f"Load: {self.level.label if self.level else 'full quality'} again"


class Ladder:
    """The current load level and its transitions."""

    def __init__(self, config: LadderConfig | None = None) -> None:
        self.config = config or LadderConfig()
        self.level = Level.FULL
        self.reason = ""  # cause of the last step down; empty at FULL
        self._strained_s = self._calm_since_s = math.nan  # start times; NaN: not now
        self._moved_s = -math.inf
        self._went_up = False
        self._calm_s = self.config.calm_s

    def update(self, readings: MachineReadings, now_s: float) -> Move | None:
        """The step to take at ``now_s`` of a monotonic clock, if any."""
        found = strain(readings, self.config)
        if found is not None:
            self._calm_since_s = math.nan
            if math.isnan(self._strained_s):
                self._strained_s = now_s
            return self._down(found, now_s)
        self._strained_s = math.nan
        if not is_calm(readings, self.config):
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
            self._calm_s = min(2.0 * self._calm_s, self.config.longest_calm_s)
        self.level = found.lowest if found.jump else Level(self.level + 1)
        self.reason = found.reason
        self._moved_s, self._went_up = now_s, False
        return Move(self.level, found.reason)

    def _up(self, now_s: float) -> Move | None:
        calm_s = now_s - max(self._calm_since_s, self._moved_s)
        if self.level is Level.FULL:
            if calm_s > self.config.longest_calm_s:
                self._calm_s = self.config.calm_s
            return None
        if calm_s < self._calm_s:
            return None
        self.level = Level(self.level - 1)
        self._moved_s, self._went_up = now_s, True
        if self.level is Level.FULL:
            self.reason = ""
        return Move(self.level, "")


def strain(readings: MachineReadings, config: LadderConfig) -> Strain | None:
    """The overload in ``readings``: memory before heat before lag; None without any."""
    memory, heat = readings.memory_free_mib, readings.temperature_c
    if memory is not None and memory < config.min_memory_mib:
        text = f"{memory:.0f} MiB memory free"
        short = memory < 0.5 * config.min_memory_mib
        return Strain(text, config.patience_s, Level.RECORD_ONLY, jump=short)
    if heat is not None and heat > config.hottest_c:
        return Strain(f"{heat:.0f} degrees", config.heat_patience_s, Level.RECORD_ONLY)
    if readings.throttled:
        return Strain("throttled", config.heat_patience_s, Level.NO_UPSAMPLING)
    return _lag(readings, config)


def _lag(readings: MachineReadings, config: LadderConfig) -> Strain | None:
    """The worst lag above its threshold, if any."""
    views, frames = late_shares(readings)
    found = (
        (views / config.late_views, f"{100 * views:.0f} % of the views late"),
        (readings.age_s / config.oldest_s, f"images {readings.age_s:.1f} s late"),
        (frames / config.late_frames, f"{100 * frames:.0f} % of the images missed"),
    )
    times, reason = max(found)
    if times <= 1.0:
        return None
    lowest = Level.RECORD_ONLY if times > config.hopeless else Level.NO_UPSAMPLING
    return Strain(reason, config.patience_s, lowest)


def late_shares(readings: MachineReadings) -> tuple[float, float]:
    """Shares of late views and frames, 0 to 1."""
    return (
        readings.late_views / max(readings.views, 1),
        readings.late_frames / max(readings.frames, 1),
    )


def is_calm(readings: MachineReadings, config: LadderConfig) -> bool:
    """True when everything is well below its threshold: a step up may be tried."""
    views, frames = late_shares(readings)
    heat, memory = readings.temperature_c, readings.memory_free_mib
    return (
        not readings.throttled
        and (heat is None or heat < config.hottest_c - config.cooler_c)
        and (memory is None or memory > 1.5 * config.min_memory_mib)
        and views < 0.5 * config.late_views
        and frames < 0.75 * config.late_frames
        and readings.age_s < 0.5 * config.oldest_s
    )


def lowered(compute: ComputeConfig, level: Level) -> ComputeConfig:
    """``compute`` reduced to ``level``."""
    if level >= Level.LOWER_RATE:
        compute = replace(compute, pairs=max(1, compute.pairs // 2))
    if level >= Level.LOWER_RESOLUTION:
        width = max(64, 16 * round(NARROWER * compute.stereo_width / 16))
        compute = replace(compute, stereo_width=min(width, compute.stereo_width))
    if level >= Level.NO_UPSAMPLING:
        compute = replace(compute, upsample=False)
    return compute


class LoadControl:
    """The ladder of a scanning service; call :meth:`look` every few seconds."""

    def __init__(self, scanning: Scanning) -> None:
        self._scanning = scanning
        self._ladder = Ladder(_ladder_config(scanning.config.compute))
        self._counted: tuple[str, int, int, int, int] = ("", 0, 0, 0, 0)
        self._reported_failure = ""
        self.readings = MachineReadings()

    def look(self, machine: Machine, now_s: float | None = None) -> Move | None:
        """Measure, and take the resulting step."""
        now_s = time.monotonic() if now_s is None else now_s
        compute = self._scanning.config.compute
        self._ladder.config = _ladder_config(compute)
        self._report_failure()
        if not compute.relief:
            self._set(Level.FULL)
            return None
        self.readings = self._measure(machine, now_s)
        move = self._ladder.update(self.readings, now_s)
        if move is not None:
            self._set(move.level)
            log.log(logging.WARNING if move.reason else logging.INFO, "%s", move.text)
            self._scanning.vehicle.statustext(move.text, WARNING if move.reason else INFO)
        return move

    def to_dict(self) -> dict[str, Any]:
        """Level, its name and reason, and the counts of this scan, for the health page."""
        gate, scan = self._scanning.gate, self._scanning.scan
        figures: dict[str, Any] = {
            "level": int(self._scanning.level),
            "name": self._scanning.level.label,
            "reason": self._ladder.reason,
        }
        if gate is not None and scan is not None:
            figures |= {
                "frame_age_s": round(gate.age_s, 3),
                "frames_late": gate.late,
                "views_late": scan.pipeline.dropped,
                "pictures_kept": gate.kept,
                "pictures_lost": gate.lost,
            }
        return figures

    def _set(self, level: Level) -> None:
        self._ladder.level = level
        if level is Level.FULL:
            self._ladder.reason = ""
        if self._scanning.level is not level:
            self._scanning.set_level(level)

    def _measure(self, machine: Machine, now_s: float) -> MachineReadings:
        """Measure heat and memory; for a running scan also lag since the last check."""
        fixed = MachineReadings(
            temperature_c=machine.temperature_c,
            throttled=machine.throttled,
            memory_free_mib=machine.memory_left_mib,
        )
        scan, gate = self._scanning.scan, self._scanning.gate
        if scan is None or gate is None or self._scanning.phase is not Phase.SCANNING:
            return fixed
        made, dropped = scan.recorder.keyframes, scan.pipeline.dropped
        counted = (scan.inputs.scan_id, made, dropped, gate.frames, gate.late)
        before = self._counted if self._counted[0] == counted[0] else (counted[0], 0, 0, 0, 0)
        self._counted = counted
        if now_s - self._scanning.started_s < GRACE_S:
            return fixed
        made, dropped = made - before[1], dropped - before[2]
        taken, late = gate.frames - before[3], gate.late - before[4]
        age_s = gate.age_s if taken else 0.0
        return replace(
            fixed, views=made + dropped, late_views=dropped, frames=taken + late, late_frames=late,
            age_s=age_s,
        )  # fmt: skip

    def _report_failure(self) -> None:
        """Report once that the device has failed and the CPU has replaced it."""
        failure = self._scanning.backend_failure
        if failure and failure != self._reported_failure:
            self._scanning.vehicle.statustext(f"Compute device failed: {failure}", CRITICAL)
        self._reported_failure = failure


def _ladder_config(compute: ComputeConfig) -> LadderConfig:
    return LadderConfig(hottest_c=compute.hottest_c, min_memory_mib=compute.least_memory_mib)
