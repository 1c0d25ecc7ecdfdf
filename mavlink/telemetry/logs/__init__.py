"""Recorded telemetry: ``load_telemetry(path)`` reads any supported log into a vehicle history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from statistics import median_low
from typing import Any

from mavlink.telemetry.history import HistoryConfig, VehicleHistory

READERS: dict[str, str] = {
    ".tlog": "mavlink.telemetry.logs.tlog:load",
    ".bin": "mavlink.telemetry.logs.dataflash:load",
    ".ulg": "mavlink.telemetry.logs.ulog:load",
    ".srt": "mavlink.telemetry.logs.srt:load",
}
"""File name extension (lower case) to ``module:function``. A new format is one file, one line."""


@dataclass(frozen=True, slots=True, eq=False)
class TelemetryLog:
    """A log's history and what its reader reports."""

    history: VehicleHistory
    clock: str  # "unix", or "boot" when the log has no date, or "video": since the video's start
    first_ns: int
    last_ns: int
    warnings: tuple[str, ...]
    counts: Mapping[str, int]  # messages by name, skipped_bytes, bad_checksums
    focal_35mm: float | None = None  # the camera's, as the 35 mm equivalent in mm
    hfov_deg: float | None = None  # the camera's field of view from side to side
    start_unix_ns: int | None = None  # of the video, by the log's own date
    may_lag: bool = False  # its times come from another device than the images


def load_telemetry(path: str | Path, config: HistoryConfig | None = None) -> TelemetryLog:
    """The vehicle history in a .tlog, .BIN, .ulg or DJI .SRT file, on the unix clock in ns.

    ValueError in one line when there is no such file, or when it contains no usable attitude and
    position. Damaged parts are skipped and counted.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such telemetry file")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: the telemetry file is empty")
    target = READERS.get(path.suffix.lower())
    if target is None:
        kinds = ", ".join(READERS)
        raise ValueError(f"{path}: not a telemetry file; supported extensions: {kinds}")
    module, _, function = target.partition(":")
    load: Any = getattr(import_module(module), function)
    log: TelemetryLog = load(path, config or HistoryConfig())
    return log


MAX_APART_NS = 2_000_000_000
"""What a sample's own clock may differ from its packet's time, beyond a constant."""


def by_own_clock(times_ns: Sequence[int], own_ns: Sequence[int | None]) -> tuple[list[int], int]:
    """Times of samples by their own clock, and that clock at time 0 of the packets.

    ``times_ns``: those of their packets, which come late by what was in the way. The offset is the
    median one. Where a sample states no time, or one that is far off, the packets' times, and 0.
    """
    stated = [own for own in own_ns if own is not None]
    if not stated or len(stated) < len(times_ns):
        return list(times_ns), 0
    start_ns = median_low(own - at for at, own in zip(times_ns, stated, strict=True))
    times = [own - start_ns for own in stated]
    apart_ns = max(abs(a - b) for a, b in zip(times, times_ns, strict=True))
    return (times, start_ns) if apart_ns < MAX_APART_NS else (list(times_ns), 0)


def finish(
    path: Path,
    history: VehicleHistory,
    counts: Mapping[str, int],
    warnings: list[str],
    clock: str = "unix",
) -> TelemetryLog:
    """The log of a filled history; ValueError when it contains no usable data."""
    first, last = history.first_ns, history.last_ns
    if first is None or last is None:
        raise ValueError(f"{path}: no attitude and no position of a vehicle in this log")
    return TelemetryLog(history, clock, first, last, tuple(warnings), dict(counts))
