"""Measures how the running scan keeps up, asks the ladder, acts on it and tells the operator."""

from __future__ import annotations

import logging
import time
from typing import Any

from mavlink.control import Phase
from mavlink.status import CRITICAL, INFO, WARNING
from service.config import ComputeConfig
from service.daemon.degradation import Ladder, LadderConfig, Level, Move, Readings
from service.daemon.machine import Machine
from service.daemon.scanning import Scanning

log = logging.getLogger(__name__)

GRACE_S = 10.0
"""A scan that has just begun is late by its start alone."""


class LoadControl:
    """The ladder tied to a scanning service; ask it to :meth:`look` every few seconds."""

    def __init__(self, scanning: Scanning) -> None:
        self._scanning = scanning
        self._ladder = Ladder(_ladder_config(scanning.config.compute))
        self._counted: tuple[str, int, int, int, int] = ("", 0, 0, 0, 0)
        self._told_failure = ""
        self.readings = Readings()

    def look(self, machine: Machine, now_s: float | None = None) -> Move | None:
        """Take the readings, and the step that they ask for."""
        now_s = time.monotonic() if now_s is None else now_s
        compute = self._scanning.config.compute
        self._ladder.config = _ladder_config(compute)
        self._tell_failure()
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
        """Level, its name and reason, and what was counted in this scan, for the health page."""
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

    def _measure(self, machine: Machine, now_s: float) -> Readings:
        """Heat and memory always; lag of a scan that runs, since the last look."""
        fixed = Readings(
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
        return Readings(
            made + dropped,
            dropped,
            taken + late,
            late,
            gate.age_s if taken else 0.0,
            machine.temperature_c,
            machine.throttled,
            machine.memory_left_mib,
        )

    def _tell_failure(self) -> None:
        """Say once that the device has failed and the CPU goes on."""
        failure = self._scanning.backend_failure
        if failure and failure != self._told_failure:
            self._scanning.vehicle.statustext(f"Compute device failed: {failure}", CRITICAL)
        self._told_failure = failure


def _ladder_config(compute: ComputeConfig) -> LadderConfig:
    return LadderConfig(hottest_c=compute.hottest_c, least_memory_mib=compute.least_memory_mib)
