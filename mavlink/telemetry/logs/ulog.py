"""PX4's onboard log (.ulg), read by pyulog (extra ``logs``)."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mavlink.telemetry.decode import CLEARANCE_SIGMA_M, DOWNWARD, plausible_place
from mavlink.telemetry.gimbal import frame_of_flags
from mavlink.telemetry.history import M_PER_DEG, HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import TelemetryLog, finish
from mavlink.telemetry.quaternion import normalised
from mavlink.telemetry.samples import (
    AccuracySample,
    AttitudeSample,
    GimbalSample,
    PositionSample,
    RangeSample,
    Sample,
    TerrainSample,
)
from mavlink.wire.tlog import LATEST_USEC

HEADER = b"ULog\x01\x12\x35"
BROKEN = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    OSError,
    MemoryError,
    struct.error,
)
"""Errors that pyulog raises on damaged logs."""

Columns = dict[str, Any]
"""Field name to array (N,)."""


def load(path: Path, config: HistoryConfig) -> TelemetryLog:
    """The history in a .ulg log, on GPS time when the log has it, otherwise since boot."""
    topics, counts, warnings = _topics(path)
    history = VehicleHistory(config)
    offset_us = _unix_offset_us(topics)
    if offset_us is None:
        warnings.append("no GPS time in this log: its clock starts at boot")
    # The global position is the estimator's; older logs have only the local one.
    if len(topics.get("vehicle_global_position", {}).get("timestamp", ())):
        topics.pop("vehicle_local_position", None)
    for name, columns in topics.items():
        times = columns["timestamp"].astype(np.int64) + (offset_us or 0)
        for i in np.flatnonzero((times >= 0) & (times < LATEST_USEC)):  # others are damaged
            for sample in TABLE[name](columns, i):
                history.add(sample, int(times[i]) * 1000)
    return finish(path, history, counts, warnings, "boot" if offset_us is None else "unix")


def _topics(path: Path) -> tuple[dict[str, Columns], Counter[str], list[str]]:
    with path.open("rb") as file:
        if file.read(len(HEADER)) != HEADER:
            raise ValueError(f"{path}: not a PX4 .ulg log")
    try:
        from pyulog import ULog  # type: ignore[import-untyped]
        from pyulog.core import ULogException  # type: ignore[import-untyped]
    except ImportError as error:
        raise ValueError(
            f"{path}: reading .ulg needs pyulog; pip install 'skyrelief[logs]'"
        ) from error
    try:
        with _LimitedFile(path) as file:
            log = ULog(file, list(TABLE))
    except (*BROKEN, ULogException) as error:
        raise ValueError(f"{path}: the .ulg log cannot be read ({error})") from error
    counts = Counter({d.name: len(d.data["timestamp"]) for d in log.data_list if not d.multi_id})
    topics = {d.name: d.data for d in log.data_list if d.multi_id == 0}
    dropouts = len(log.dropouts)
    return topics, counts, [f"{dropouts} dropouts while logging"] if dropouts else []


class _LimitedFile(io.BufferedReader):
    """A file with a limit on the bytes read.

    pyulog seeks back over a damaged message. Where the file is truncated within it, pyulog seeks
    too far back and would read the same bytes forever.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._left = 2 * path.stat().st_size + 10_000

    def read(self, size: int | None = -1, /) -> bytes:
        """Read like any file; raises OSError when the reader loops."""
        self._left -= 1
        if self._left < 0:
            raise OSError("it is truncated within a damaged message")
        return super().read(size)


def _unix_offset_us(topics: dict[str, Columns]) -> int | None:
    for name in ("vehicle_gps_position", "sensor_gps"):
        columns = topics.get(name)
        if columns is None or "time_utc_usec" not in columns:
            continue
        utc = columns["time_utc_usec"].astype(np.int64)
        known = utc > 10**15
        if known.any():
            boot = columns["timestamp"].astype(np.int64)
            return int(np.median((utc - boot)[known]))
    return None


def _attitude(c: Columns, i: int) -> list[Sample]:
    q = normalised([float(c[f"q[{k}]"][i]) for k in range(4)])
    return [] if q is None else [AttitudeSample(None, q)]


def _global(c: Columns, i: int) -> list[Sample]:
    lat, lon = float(c["lat"][i]), float(c["lon"][i])
    if not plausible_place(lat, lon):
        return []
    v = (float(c["vel_n"][i]), float(c["vel_e"][i]), float(c["vel_d"][i]))
    found: list[Sample] = [PositionSample(None, lat, lon, float(c["alt"][i]), None, v)]
    if "eph" in c and "epv" in c:
        found.append(AccuracySample(None, True, float(c["eph"][i]), float(c["epv"][i])))
    return found


def _local(c: Columns, i: int) -> list[Sample]:
    found: list[Sample] = []
    if "dist_bottom_valid" in c and c["dist_bottom_valid"][i]:
        found.append(TerrainSample(None, float(c["dist_bottom"][i]), CLEARANCE_SIGMA_M))
    ref = float(c["ref_lat"][i]), float(c["ref_lon"][i])
    if not (c["xy_global"][i] and c["z_global"][i] and plausible_place(*ref)):
        return found
    north, east, down = float(c["x"][i]), float(c["y"][i]), float(c["z"][i])
    lat = ref[0] + north / M_PER_DEG
    lon = ref[1] + east / (M_PER_DEG * np.cos(np.radians(ref[0])))
    v = (float(c["vx"][i]), float(c["vy"][i]), float(c["vz"][i]))
    alt = float(c["ref_alt"][i]) - down
    found.append(PositionSample(None, lat, float(lon), alt, -down, v))
    found.append(AccuracySample(None, True, float(c["eph"][i]), float(c["epv"][i])))
    return found


def _distance(c: Columns, i: int) -> list[Sample]:
    distance = float(c["current_distance"][i])
    low, high = float(c["min_distance"][i]), float(c["max_distance"][i])
    if int(c["orientation"][i]) != DOWNWARD or not low <= distance < high:
        return []
    return [RangeSample(None, distance)]


def _gimbal(c: Columns, i: int) -> list[Sample]:
    q = normalised([float(c[f"q[{k}]"][i]) for k in range(4)])
    if q is None:
        return []
    return [GimbalSample(None, q, frame_of_flags(int(c["device_flags"][i])), 154, 0)]


def _nothing(_: Columns, __: int) -> list[Sample]:
    return []


TABLE: dict[str, Callable[[Columns, int], list[Sample]]] = {
    "vehicle_attitude": _attitude,
    "vehicle_global_position": _global,
    "vehicle_local_position": _local,
    "distance_sensor": _distance,
    "gimbal_device_attitude_status": _gimbal,
    "vehicle_gps_position": _nothing,  # read for its UTC alone
    "sensor_gps": _nothing,
}
"""Topic to reader. A new topic is one function and one line."""
