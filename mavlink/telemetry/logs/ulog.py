"""PX4's onboard log (.ulg), read by pyulog (extra ``logs``)."""

from __future__ import annotations

import io
import math
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavlink.telemetry.decode import CLEARANCE_SIGMA_M, DOWNWARD, plausible_place, receiver_accuracy
from mavlink.telemetry.gimbal import frame_of_flags
from mavlink.telemetry.history import M_PER_DEG, HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import NEIGHBOUR_S, TelemetryLog, finish, values_near
from mavlink.telemetry.quaternion import Vector, normalised
from mavlink.telemetry.samples import (
    F64,
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

Columns = dict[str, Any]  # field name to array (N,)

Row = Callable[[str], float]
"""The value of a declared field; NaN where the log does not declare it."""

PLACES = ("vehicle_global_position", "vehicle_local_position", "vehicle_gps_position", "sensor_gps")
"""Topics with a position, best first; a later one gives them before and after those of a better
one: an estimate may begin long after the receiver's fixes, or end."""

NEAR_US = 250_000  # velocities are known so long before and after a sample of theirs


def load(path: Path, config: HistoryConfig) -> TelemetryLog:
    """The history in a .ulg log, on GPS time when the log has it, otherwise since boot."""
    topics, counts, warnings = _topics(path)
    history = VehicleHistory(config)
    offset_us = _unix_offset_us(topics)
    if offset_us is None:
        warnings.append("no GPS time in this log: its clock starts at boot")
    _complete(topics)
    placed: list[int] = []  # first and last time in us of a position so far
    for name, read in TABLE.items():
        columns = topics.get(name, {"timestamp": np.empty(0, np.int64)})
        times = columns["timestamp"].astype(np.int64) + (offset_us or 0)
        sound = np.flatnonzero((times >= 0) & (times < LATEST_USEC) & _is_beside(times))
        found = [(int(times[i]), sample) for i in sound for sample in read(_row(columns, i))]
        for time_us, sample in found:
            is_known = bool(placed) and placed[0] <= time_us <= placed[-1]
            if not (is_known and name in PLACES and isinstance(sample, OF_PLACE)):
                history.add(sample, time_us * 1000)
        at = [*placed, *(t for t, sample in found if isinstance(sample, PositionSample))]
        placed = [min(at), max(at)] if at else []
    return finish(path, history, counts, warnings, "boot" if offset_us is None else "unix")


OF_PLACE = (PositionSample, AccuracySample)


def _is_beside(times_us: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether a sample is close in time to the one before or after it; others are damaged."""
    if len(times_us) < 2:
        return np.ones(len(times_us), bool)
    is_close = np.abs(np.diff(times_us)) <= 1e6 * NEIGHBOUR_S
    return np.append(is_close, False) | np.insert(is_close, 0, False)


def _row(columns: Columns, i: int) -> Row:
    return lambda name: float(columns[name][i]) if name in columns else math.nan


def _complete(topics: dict[str, Columns]) -> None:
    """Add to global positions what has topics of its own: velocity since PX4 1.11, and home."""
    place, local, home = (topics.get(name, {}) for name in (*PLACES[:2], "home_position"))
    if not place:
        return
    if "vel_n" not in place:
        for name, filled in {"vx": "vel_n", "vy": "vel_e", "vz": "vel_d"}.items():
            place[filled] = _at(place, local, name, ("v_xy_valid", "v_z_valid"), NEAR_US)
    place["home_alt"] = _at(place, home, "alt", ("valid_alt",))


def _at(
    place: Columns, other: Columns, name: str, flags: tuple[str, ...], near_us: float = math.inf
) -> F64:
    """(N,) a field of another topic at the times of ``place``; NaN where it is not near."""
    at = place["timestamp"].astype(np.float64)
    if name not in other:
        return np.full(len(at), math.nan)
    values = other[name].astype(np.float64)
    sound = np.isfinite(values)
    for flag in flags:
        sound &= other.get(flag, 1) != 0
    order = np.argsort(other["timestamp"][sound], kind="stable")
    times = other["timestamp"][sound][order].astype(np.float64)
    return values_near(times, values[sound][order], at, near_us)


def _topics(path: Path) -> tuple[dict[str, Columns], Counter[str], list[str]]:
    with path.open("rb") as file:
        if file.read(len(HEADER)) != HEADER:
            raise ValueError(f"{path}: not a PX4 .ulg log")
    try:
        from pyulog import core  # type: ignore[import-untyped]
    except ImportError as error:
        raise ValueError(
            f"{path}: reading .ulg needs pyulog; pip install 'skyrelief[logs]'"
        ) from error
    core.print = lambda *_, **__: None  # a line for each damaged message
    try:
        with _LimitedFile(path) as file:
            log = core.ULog(file, [*TABLE, "home_position"])
    except (*BROKEN, core.ULogException) as error:
        raise ValueError(f"{path}: the .ulg log cannot be read ({error})") from error
    topics = {d.name: d.data for d in log.data_list if d.multi_id == 0 and "timestamp" in d.data}
    counts = Counter({name: len(data["timestamp"]) for name, data in topics.items()})
    dropouts, warnings = len(log.dropouts), list[str]()
    if dropouts:
        warnings.append(f"{dropouts} dropouts while logging")
    if log.file_corruption:
        warnings.append("the log is damaged: parts of it were skipped")
    return topics, counts, warnings


class _LimitedFile(io.BufferedReader):
    """A file with a limit on the bytes read. pyulog seeks back over a damaged message. Where the
    file is truncated within it, pyulog seeks too far back and would read the same bytes forever."""

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


def _attitude(row: Row) -> list[Sample]:
    q = normalised([row(f"q[{k}]") for k in range(4)])
    return [] if q is None else [AttitudeSample(None, q)]


def _global(row: Row) -> list[Sample]:
    lat, lon = row("lat"), row("lon")
    if not plausible_place(lat, lon) or row("lat_lon_valid") == 0:
        return []
    alt = math.nan if row("alt_valid") == 0 else row("alt")
    velocity = _velocity(row, "vel_n", "vel_e", "vel_d")
    return [
        PositionSample(None, lat, lon, alt, alt - row("home_alt"), velocity),
        receiver_accuracy(True, row("eph"), row("epv")),
    ]


def _velocity(row: Row, *names: str) -> Vector | None:
    north, east, down = map(row, names)
    return (north, east, down) if math.isfinite(north + east + down) else None


def _local(row: Row) -> list[Sample]:
    found: list[Sample] = []
    if row("dist_bottom_valid") == 1:
        found.append(TerrainSample(None, row("dist_bottom"), CLEARANCE_SIGMA_M))
    ref = row("ref_lat"), row("ref_lon")
    north, east, down = row("x"), row("y"), row("z")
    is_global = row("xy_global") == 1 and row("z_global") == 1
    if not (is_global and plausible_place(*ref) and math.isfinite(north + east)):
        return found
    lat = ref[0] + north / M_PER_DEG
    lon = ref[1] + east / (M_PER_DEG * math.cos(math.radians(ref[0])))
    velocity = _velocity(row, "vx", "vy", "vz")
    found.append(PositionSample(None, lat, lon, row("ref_alt") - down, -down, velocity))
    found.append(receiver_accuracy(True, row("eph"), row("epv")))
    return found


def _receiver(row: Row) -> list[Sample]:
    """A fix in degrees and metres, or, before PX4 1.14, in 1e-7 degrees and millimetres."""
    lat, lon, alt = row("latitude_deg"), row("longitude_deg"), row("altitude_msl_m")
    if math.isnan(lat):
        lat, lon, alt = 1e-7 * row("lat"), 1e-7 * row("lon"), 1e-3 * row("alt")
    if not (row("fix_type") >= 3 and plausible_place(lat, lon)):
        return [receiver_accuracy(False)]
    velocity = _velocity(row, "vel_n_m_s", "vel_e_m_s", "vel_d_m_s")
    velocity = None if row("vel_ned_valid") == 0 else velocity
    return [
        PositionSample(None, lat, lon, alt, None, velocity),
        receiver_accuracy(True, row("eph"), row("epv"), alt),
    ]


def _distance(row: Row) -> list[Sample]:
    distance = row("current_distance")
    is_within = row("min_distance") <= distance < row("max_distance")
    if row("orientation") != DOWNWARD or not is_within:
        return []
    return [RangeSample(None, distance)]


def _gimbal(row: Row) -> list[Sample]:
    q, flags = normalised([row(f"q[{k}]") for k in range(4)]), row("device_flags")
    if q is None or math.isnan(flags):
        return []
    return [GimbalSample(None, q, frame_of_flags(int(flags)), 154, 0)]


TABLE: dict[str, Callable[[Row], list[Sample]]] = {
    "vehicle_attitude": _attitude,
    "vehicle_global_position": _global,
    "vehicle_local_position": _local,
    "vehicle_gps_position": _receiver,
    "sensor_gps": _receiver,
    "distance_sensor": _distance,
    "gimbal_device_attitude_status": _gimbal,
}
"""Topic to reader. A new topic is one function and one line."""
