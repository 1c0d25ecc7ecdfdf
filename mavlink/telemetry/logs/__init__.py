"""Recorded telemetry: ``load_telemetry(path)`` reads any supported log into a vehicle history."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from statistics import median, median_low
from typing import Any

import numpy as np

from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.samples import F64, Sample

READERS: dict[str, str] = {
    ".tlog": "mavlink.telemetry.logs.tlog:load",
    ".bin": "mavlink.telemetry.logs.dataflash:load",
    ".ulg": "mavlink.telemetry.logs.ulog:load",
    ".srt": "mavlink.telemetry.logs.srt:load",
    ".csv": "mavlink.telemetry.logs.airdata:load",
}
"""File name extension (lower case) to ``module:function``. A new format is one file, one line."""


@dataclass(frozen=True, slots=True, eq=False)
class TelemetryLog:
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
    """The vehicle history in a log, on the clock that it has, in ns.

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

MIN_SOUND = 0.95  # share of the samples whose own clock is not damaged


class Track:
    """Samples at the times of their packets, and at those of their own clock."""

    def __init__(self) -> None:
        self.samples: list[list[Sample]] = []
        self._times_ns: list[int] = []
        self._own_ns: list[int | None] = []

    def add(self, time_ns: int, own_ns: int | None, samples: list[Sample]) -> None:
        """``own_ns`` is None where the samples state no time."""
        self._times_ns.append(time_ns)
        self._own_ns.append(own_ns)
        self.samples.append(samples)

    def fill(self, history: VehicleHistory) -> int:
        """Add the samples to a history by their own clock; that clock at time 0 of the packets.

        Packets come late by what was in the way, so the offset is the median one. A few samples
        that state no time, or one that is far off, are damaged and left out; where they are more,
        the packets' times count, and 0 is returned.
        """
        known = [
            (own_ns, time_ns, samples)
            for own_ns, time_ns, samples in zip(
                self._own_ns, self._times_ns, self.samples, strict=True
            )
            if own_ns is not None
        ]
        start_ns = median_low(own_ns - time_ns for own_ns, time_ns, _ in known) if known else 0
        placed = [
            (own_ns - start_ns, samples)
            for own_ns, time_ns, samples in known
            if abs(own_ns - start_ns - time_ns) < MAX_APART_NS
        ]
        if len(placed) < MIN_SOUND * len(self.samples):
            start_ns, placed = 0, list(zip(self._times_ns, self.samples, strict=True))
        for time_ns, samples in placed:
            for sample in samples:
                history.add(sample, time_ns)
        return start_ns


ELLIPSOID = "ellipsoid"  # the datum of altitudes that are not above mean sea level

NEIGHBOUR_S = 10.0
"""Samples of a log follow each other that closely; one that is farther off both is damaged."""

SAME_LENS = 0.02  # relative tolerance of a lens that does not zoom


def one_lens(values: list[float], unit: str, digits: int, warnings: list[str]) -> float | None:
    """The median of a lens's figures; warns where it zooms. None without figures."""
    if not values:
        return None
    low, high = min(values), max(values)
    if high > (1.0 + SAME_LENS) * low:
        warnings.append(
            f"the lens zooms between {low:.{digits}f} and {high:.{digits}f} {unit}: one lens is "
            "used for all, so shapes and scale are wrong"
        )
    return median(values)


def values_near(times: Any, values: Any, at: Any, near: float) -> F64:
    """(N,) values interpolated at the times ``at``; NaN where no sample is within ``near``."""
    if not len(times):
        return np.full(len(at), math.nan)
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    around = times[np.minimum([after - 1, after], len(times) - 1)]
    is_near = np.abs(around - at).min(axis=0) <= near
    return np.where(is_near, np.interp(at, times, values), math.nan)


def finish(
    path: Path,
    history: VehicleHistory,
    counts: Mapping[str, int],
    warnings: list[str],
    clock: str = "unix",
    **more: Any,
) -> TelemetryLog:
    """The log of a filled history, with ``more`` of its fields; ValueError when it contains no
    usable data."""
    first, last = history.first_ns, history.last_ns
    if first is None or last is None:
        raise ValueError(f"{path}: no attitude and no position of a vehicle in this log")
    return TelemetryLog(history, clock, first, last, tuple(warnings), dict(counts), **more)
