"""Subtitle telemetry (.SRT) of DJI and Autel: one cue per video frame or per second.

The times are the video's own presentation times: the dates in these files are local time of
an unknown zone. Several layouts are read: ``[latitude: ..] [longitude: ..] [rel_alt: ..
abs_alt: ..]`` with optional ``[gb_yaw: .. gb_pitch: .. gb_roll: ..]``; ``GPS (lon, lat, n)`` or
``RTK (lon, lat, n)`` with ``H`` and ``F.PRY``, ``G.PRY``; ``GPS(lat,lon,..M) BAROMETER:``;
``GPS(lon,lat,n) Hb:``; Autel's ``GPS(E: lon, N: lat, ..m)``, whose height is not used, as nothing
says above what it is. A drone without a position writes zeros and still ``rel_alt``. ``focal_len``
is the 35 mm equivalent: in mm with decimals, in tenths of a millimetre without; ``dzoom_ratio`` is
a crop besides, 1.00 or 10000 for none. Decimals of named fields may follow a comma.
"""

from __future__ import annotations

import math
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TextIO

from mavlink.telemetry.decode import plausible_place
from mavlink.telemetry.history import M_PER_DEG, HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import TelemetryLog, finish, one_lens
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

NUMBER = r"(-?\d{1,9}(?:\.\d+)?)"
CUE = re.compile(r"(\d{1,4}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
FIELD = re.compile(r"\b(\w+)\s*:\s*(-?\d{1,9}(?:[.,]\d+)?)(?!\d)")
GPS = re.compile(
    rf"(?:GPS|RTK)\s*\(\s*{NUMBER}\s*,\s*{NUMBER}\s*,\s*{NUMBER}\s*(M?)", re.IGNORECASE
)
AUTEL = re.compile(r"GPS\s*\(\s*([EW])\s*:\s*(\d+[.,]\d+)\s*,\s*([NS])\s*:\s*(\d+[.,]\d+)")
FOCAL = re.compile(r"\bfocal_len\s*:\s*([1-9]\d{0,8})(?:[.,](\d+))?(?!\d)")
HEIGHT = re.compile(rf"\bH\s+{NUMBER}\s*m\b")
PRY = re.compile(rf"\b([FG])\.PRY\s*\(\s*{NUMBER}\W?\s*,\s*{NUMBER}\W?\s*,\s*{NUMBER}")
LONGEST_LINE, LONGEST_CUE = 4096, 64  # in letters and in lines; the rest of a cue is skipped

RESTART_NS = 1_000_000_000
"""A time that goes back to this long after the start, at most, begins again: joined files."""

UNIT_CROP, MAX_CROP = 1e4, 1e2
"""What some drones write where nothing is cropped; and no drone crops so far."""

NAN = math.nan


def load(path: Path, config: HistoryConfig) -> TelemetryLog:
    with path.open("rb") as head:
        encoding = "utf-16" if head.read(2) in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8"
    with path.open(encoding=encoding, errors="replace") as file:
        return of_cues(path, _cues(file), config)


def _cues(file: TextIO) -> Iterator[tuple[int, str]]:
    """(time in ns, text) of the cues in a file."""
    time_ns: int | None = None
    text: list[str] = []
    while line := file.readline(LONGEST_LINE):
        cue = CUE.match(line.strip())
        if cue is None:
            if len(text) < LONGEST_CUE:
                text.append(line)
            continue
        if time_ns is not None:
            yield time_ns, " ".join(text)
        text.clear()
        hours, minutes, seconds, fraction = cue.groups()
        ms = int(fraction.ljust(3, "0"))
        whole = int(hours) * 3600 + int(minutes) * 60 + int(seconds)
        time_ns = (whole * 1000 + ms) * 1_000_000
    if time_ns is not None:
        yield time_ns, " ".join(text)


def of_cues(path: Path, cues: Iterable[tuple[int, str]], config: HistoryConfig) -> TelemetryLog:
    """The history in the cues (time in ns, text) of ``path``; ValueError where they give none."""
    history = VehicleHistory(config)
    counts: Counter[str] = Counter()
    focals: list[float] = []
    last_ns = earlier_ns = step_ns = 0  # earlier: of the recordings before
    for cue_ns, text in cues:
        time_ns = earlier_ns + cue_ns
        if cue_ns <= RESTART_NS < last_ns - time_ns:
            counts["joined"] += 1
            time_ns = last_ns + step_ns
            earlier_ns = time_ns - cue_ns
        last_ns, step_ns = time_ns, time_ns - last_ns
        _cue(history, counts, focals, time_ns, text)
    if not counts["cues"]:
        raise ValueError(f"{path}: not a subtitle file; no cue was found")
    warnings = [f"{counts['unreadable']} cues without a position"] if counts["unreadable"] else []
    if counts["joined"]:
        warnings.append(
            f"times begin again {counts['joined']} time(s): joined, the rest follows on"
        )
    history.is_pressure_altitude = True
    focal = one_lens(focals, "mm (35 mm equivalent)", 0, warnings)
    return finish(path, history, counts, warnings, "video", focal_35mm=focal)


def _cue(
    history: VehicleHistory, counts: Counter[str], focals: list[float], time_ns: int, text: str
) -> None:
    """Add what one cue says to the history, its counts and its focal lengths in mm."""
    counts["cues"] += 1
    fields = {name.lower(): _decimal(v) for name, v in FIELD.findall(text)}
    if (focal := FOCAL.search(text)) is not None:
        whole, decimals = focal.groups()
        crop = fields.get("dzoom_ratio", 1.0)
        crop = crop if crop < MAX_CROP else crop / UNIT_CROP
        crop = crop if 1.0 <= crop < MAX_CROP else 1.0
        focals.append(crop * (float(f"{whole}.{decimals}") if decimals else float(whole) / 10.0))
    place = _place(text, fields)
    if place is None:
        counts["unreadable"] += 1
        if "rel_alt" in fields:
            history.add(PositionSample(None, NAN, NAN, None, fields["rel_alt"], None), time_ns)
    else:
        counts["positions"] += 1
        history.add(place[0], time_ns)
        history.add(place[1], time_ns)
    _attitudes(history, text, fields, time_ns)


def _decimal(text: str) -> float:
    return float(text.replace(",", "."))


def _place(text: str, fields: dict[str, float]) -> tuple[PositionSample, AccuracySample] | None:
    lat, lon = fields.get("latitude"), fields.get("longitude", fields.get("longtitude"))
    barometer = fields.get("barometer", fields.get("hb"))
    relative = fields.get("rel_alt", fields.get("altitude", barometer))
    coarse_m = 0.0
    gps = GPS.search(text)
    if (lat is None or lon is None) and gps is not None:
        first, second, _, metres = gps.groups()
        # Layouts with a unit give latitude first, those with a satellite count longitude.
        lat, lon = (float(first), float(second)) if metres else (float(second), float(first))
        if abs(lat) > 90.0:
            lat, lon = lon, lat
        coarse_m = 0.3 * M_PER_DEG * 10.0 ** -len(first.partition(".")[2])
        height = HEIGHT.search(text)
        relative = relative if height is None else float(height.group(1))
    if (autel := AUTEL.search(text)) is not None:
        letters, (lon, lat) = autel.group(1, 3), (_decimal(n) for n in autel.group(2, 4))
        lon, lat = (-v if at in "WS" else v for at, v in zip(letters, (lon, lat), strict=True))
    if lat is None or lon is None or not plausible_place(lat, lon):
        return None
    position = PositionSample(None, lat, lon, fields.get("abs_alt"), relative, None)
    sigma_h_m = math.hypot(RECEIVER_SIGMA_H_M, coarse_m)
    return position, AccuracySample(None, True, sigma_h_m, 8.0, is_claimed=False)


def _attitudes(history: VehicleHistory, text: str, fields: dict[str, float], time_ns: int) -> None:
    heads = []
    for which, *angles in PRY.findall(text):
        pitch, roll, yaw = map(float, angles)
        q = from_degrees(roll, pitch, yaw)
        if which == "F" and q is not None:
            history.add(AttitudeSample(None, q), time_ns)
        else:
            heads.append(q)
    heads.append(from_degrees(*(fields.get(name) for name in ("gb_roll", "gb_pitch", "gb_yaw"))))
    for head in filter(None, heads):
        history.add(GimbalSample(None, head, GimbalFrame.EARTH, CAMERA, 0), time_ns)
