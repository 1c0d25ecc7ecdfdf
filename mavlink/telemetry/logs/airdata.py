"""Flight records of consumer drones as AirData.com exports them (``.csv``): ten rows a second.

Columns name their units, which follow the owner's settings. ``datetime(utc)`` counts whole seconds
and ``time(millisecond)`` those since the first row. Heights are the barometer's above the take-off
point, and with the altitude of that by a map. A gimbal that follows the nose counts its heading
from where it was switched on.
"""

from __future__ import annotations

import cmath
import csv
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path

from mavlink.telemetry.decode import plausible_place
from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import TelemetryLog, finish
from mavlink.telemetry.quaternion import from_degrees
from mavlink.telemetry.samples import (
    RECEIVER_SIGMA_H_M,
    AccuracySample,
    AttitudeSample,
    GimbalFrame,
    GimbalSample,
    PositionSample,
)
from mavlink.wire.first_beat import CAMERA

LONGEST_LINE = 16_384  # letters; the rest of a line is a line of its own
MAX_TIME_MS = 1e9  # eleven days

COLUMN = re.compile(r"\s*(\w+)\s*(?:\((\w+)\))?\s*")
READ = {
    "time", "datetime", "latitude", "longitude", "height_above_takeoff", "altitude_above_sealevel",
    "roll", "pitch", "compass_heading", "gimbal_roll", "gimbal_pitch", "gimbal_heading",
}  # fmt: skip
"""Columns; the other forty are not kept."""

METRES = {"feet": 0.3048, "ft": 0.3048, "meters": 1.0, "m": 1.0}
DATE = re.compile(r"\s*(20\d\d-\d\d-\d\d \d\d:\d\d:\d\d)")

SIGMA_V_M = 8.0  # of the take-off point's altitude

FOLLOWS_DEG, FOLLOWING = 15.0, 0.9
"""A gimbal follows the nose where so large a share of its headings is so close to one angle from
it; turns of the vehicle leave it behind for a moment."""

SAME_DEG = 3.0  # what a compass and a gimbal may differ by

Row = Mapping[str, str]
"""Texts of a row by the names of their columns, in lower case, without units."""


def load(path: Path, config: HistoryConfig) -> TelemetryLog:
    """The history in a record, on unix time when it has dates, otherwise since its first row."""
    rows = _rows(path)
    units = next(rows, {})
    if not {"time", "latitude", "longitude"} <= units.keys():
        raise ValueError(
            f"{path}: not a flight record of AirData: it has no columns time(millisecond), "
            "latitude and longitude"
        )
    counts: Counter[str] = Counter()
    timed = []
    start_ms = -math.inf  # unix time of time 0: dates leave out what is below a second
    for row in rows:
        time_ms = _number(row, "time")
        if time_ms is None or not 0.0 <= time_ms <= MAX_TIME_MS:
            counts["unreadable"] += 1
            continue
        timed.append((time_ms, row))
        date_ms = _date_ms(row.get("datetime", ""))
        start_ms = max(start_ms, -math.inf if date_ms is None else date_ms - time_ms)
    is_dated = math.isfinite(start_ms)
    history = VehicleHistory(config)
    off_deg = _gimbal_off_deg([row for _, row in timed])
    for time_ms, row in timed:
        time_ns = round(1e6 * (time_ms + (start_ms if is_dated else 0.0)))
        counts["rows"] += 1
        _add(history, counts, row, units, off_deg, time_ns)
    unreadable = counts["unreadable"]
    warnings = [f"{unreadable} lines are no rows of the record"] if unreadable else []
    if abs(off_deg) > SAME_DEG:
        warnings.append(f"the gimbal's headings are {off_deg:.0f} degrees off the nose: corrected")
    clock = "unix" if is_dated else "boot"
    return finish(path, history, counts, warnings, clock, may_lag=True)


def _rows(path: Path) -> Iterator[Row]:
    """The units by column, then the rows.

    Each line is one row: text in quotes may hold a comma, but a lost quote ends with its line.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        names: list[str] = []
        while line := file.readline(LONGEST_LINE):
            try:
                texts = next(csv.reader([line.replace("\0", "")]), [])
            except csv.Error:
                texts = []
            if not names:
                found = [COLUMN.match(text) for text in texts] or [None]
                names = ["" if one is None else one[1].lower() for one in found]
                texts = ["" if one is None else (one[2] or "").lower() for one in found]
            yield {name: text for name, text in zip(names, texts, strict=False) if name in READ}


def _gimbal_off_deg(rows: Sequence[Row]) -> float:
    """The angle of a gimbal that follows the nose to it, -180 to 180; 0 for another gimbal."""
    both = [(_number(row, "gimbal_heading"), _number(row, "compass_heading")) for row in rows]
    apart = [
        math.radians(head - nose) for head, nose in both if head is not None and nose is not None
    ]
    if not apart:
        return 0.0
    mean = cmath.phase(sum(cmath.rect(1.0, angle) for angle in apart))
    near = math.cos(math.radians(FOLLOWS_DEG))
    follows = sum(math.cos(angle - mean) > near for angle in apart) > FOLLOWING * len(apart)
    return math.degrees(mean) if follows else 0.0


def _add(
    history: VehicleHistory, counts: Counter[str], row: Row, units: Row, off_deg: float,
    time_ns: int,
) -> None:  # fmt: skip
    lat, lon = (_number(row, name) for name in ("latitude", "longitude"))
    relative_m = _metres(row, units, "height_above_takeoff")
    if lat is not None and lon is not None and plausible_place(lat, lon):
        counts["positions"] += 1
        alt_m = _metres(row, units, "altitude_above_sealevel")
        history.add(PositionSample(None, lat, lon, alt_m, relative_m, None), time_ns)
        accuracy = AccuracySample(None, True, RECEIVER_SIGMA_H_M, SIGMA_V_M, is_claimed=False)
        history.add(accuracy, time_ns)
    body = from_degrees(*(_number(row, name) for name in ("roll", "pitch", "compass_heading")))
    if body is not None:
        history.add(AttitudeSample(None, body), time_ns)
    heading = _number(row, "gimbal_heading")
    head = from_degrees(
        _number(row, "gimbal_roll"),
        _number(row, "gimbal_pitch"),
        None if heading is None else heading - off_deg,
    )
    if head is not None:
        history.add(GimbalSample(None, head, GimbalFrame.EARTH, CAMERA, 0), time_ns)


def _number(row: Row, name: str) -> float | None:
    try:
        value = float(row.get(name) or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _metres(row: Row, units: Row, name: str) -> float | None:
    """None without the height, and where nothing says what its unit is."""
    value, unit_m = _number(row, name), METRES.get(units.get(name, ""))
    return None if value is None or unit_m is None else value * unit_m


def _date_ms(text: str) -> float | None:
    found = DATE.match(text)
    if found is None:
        return None
    try:
        date = datetime.strptime(found.group(1), "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc)
        return 1e3 * date.timestamp()
    except ValueError:
        return None
