"""GoPro's metadata track (GPMF, https://github.com/gopro/gpmf-parser): positions, attitude.

Items are nested: four letters, a type, the size of a structure, their number, and the data, padded
to four bytes. Read are GPS5 (HERO5 to 10) with GPSF and GPSP, GPS9 (HERO11 and later), and what
the drone Karma adds: GLPI (the autopilot's position) and GPRI (its receiver). The body's attitude
is not that of the camera, which a gimbal holds, and is not read. The image's attitude is that of
CORI (from the start of the recording to the camera), IORI (from the camera to the image, which the
camera's stabilisation turns) and GRAV (gravity in the camera), of HERO8 and later; its heading
counts from an unknown direction. Their axes are x right, y down, z ahead. Times are the video's
own; samples spread over the time of their packet, those of GPS9 and a drone by their own clock.
GPSU dates the recording, whose container has local time; a HERO13 writes no GPSU, but GPS9 has a
date of its own. Altitudes are above the ellipsoid unless GPSA says MSLV: those of a HERO5 to 7, a
Fusion and a MAX at the coast are 35 m below it, as the ellipsoid is there.
"""

from __future__ import annotations

import math
import struct
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from itertools import accumulate
from pathlib import Path
from statistics import median_low

from mavlink.telemetry.decode import HDOP_TO_M, plausible_place, receiver_accuracy
from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import ELLIPSOID, TelemetryLog, Track, finish
from mavlink.telemetry.quaternion import (
    Quaternion,
    Vector,
    conjugate,
    from_rpy,
    multiply,
    normalised,
)
from mavlink.telemetry.samples import (
    YEAR_2000_UNIX_S,
    GimbalFrame,
    GimbalSample,
    PositionSample,
    Sample,
)
from mavlink.wire.first_beat import CAMERA

Packet = tuple[int, int, bytes]  # time and duration in ns, and the bytes

MARK = b"DEVC"
MAX_DEPTH, MAX_ITEMS, MAX_SAMPLES = 4, 4096, 256
"""Of a packet, and of samples in an item; GPS5 has 18 a second."""

CODES = {ord(letter): code for letter, code in zip("bBsSlLjJfd", "bBhHiIqQfd", strict=True)}
"""GPMF's types as those of the struct module."""

TYPES = {
    b"GPS5": b"lllll", b"GPS9": b"lllllllSS", b"CORI": b"ssss", b"IORI": b"ssss", b"GRAV": b"sss",
}  # fmt: skip
"""Of structures, where the item itself does not declare them."""

COLUMNS = {
    b"GPS5": 5, b"GPS9": 9, b"GLPI": 8, b"GPRI": 9, b"CORI": 4, b"IORI": 4, b"GRAV": 3,
}  # fmt: skip
"""Of a structure, those that are read; an item that declares fewer is not."""

PLACES = (b"GLPI", b"GPS9", b"GPS5")  # best first; the first that has one gives them all

UNKNOWN_DOP, MAX_OWN_S = 99.0, 1e10
DRIFT_NS = 2_000_000_000
"""Gravity is averaged so long before and after: what else accelerates the camera averages out."""


@dataclass(slots=True)
class _Stream:
    """Declarations of a stream for the items that follow."""

    scale: tuple[float, ...] = (1.0,)
    kinds: bytes = b""
    fix: float = 3.0
    dop: float = math.nan
    utc_ns: int | None = None
    is_amsl: bool = False


def of_packets(path: Path, packets: Iterable[Packet], config: HistoryConfig) -> TelemetryLog:
    """The history in the packets of a metadata track; ValueError where they give none."""
    history, counts = VehicleHistory(config), Counter[str]()
    tracks: dict[bytes, Track] = defaultdict(Track)
    turned: dict[bytes, dict[int, tuple[float, ...]]] = {b"CORI": {}, b"IORI": {}, b"GRAV": {}}
    dates_ns, amsl = list[int](), set[bytes]()  # amsl: items whose altitudes are
    for time_ns, duration_ns, data in packets:
        counts["packets"] += 1
        for key, rows, stream in _streams(data):
            if stream.utc_ns is not None and stream.fix >= 2.0:
                dates_ns.append(stream.utc_ns - time_ns)
            amsl |= {key} if stream.is_amsl or key == b"GLPI" else set()
            if key in turned:
                times = (time_ns + i * duration_ns // len(rows) for i in range(len(rows)))
                turned[key] |= zip(times, rows, strict=True)
                counts[key.decode("ascii")] += len(rows)
                continue
            for i, row in enumerate(rows):
                own_s, samples = READERS[key](row, stream)
                at_ns = time_ns + i * duration_ns // len(rows)
                known_s = math.inf if own_s is None else own_s
                if key == b"GPS9" and _is_placed(samples) and 0.0 < known_s < MAX_OWN_S:
                    dates_ns.append(YEAR_2000_UNIX_S * 10**9 - at_ns + round(1e9 * known_s))
                own_ns = round(1e9 * known_s) if abs(known_s) < MAX_OWN_S else None
                tracks[key].add(at_ns, own_ns, samples)
                counts[key.decode("ascii")] += 1
    used = next((k for k in PLACES if any(map(_is_placed, tracks[k].samples))), b"")
    for name in (used, b"GPRI") if used == b"GLPI" else (used,):
        tracks[name].fill(history)
    for time_ns, head in _heads(turned):
        history.add(GimbalSample(None, head, GimbalFrame.EARTH, CAMERA, 0, False), time_ns)
    if used and used not in amsl:
        history.vertical_datum = ELLIPSOID
    start_ns = median_low(dates_ns) if dates_ns else None
    return finish(path, history, counts, [], "video", start_unix_ns=start_ns)


def _heads(
    turned: Mapping[bytes, Mapping[int, tuple[float, ...]]],
) -> Iterator[tuple[int, Quaternion]]:
    """Time and ``q_earth_image`` of each sample; north is some direction, the same for all.

    The mean direction of gravity in the axes of the start gives down; that of the seconds around a
    sample corrects what CORI, the sum of the gyroscope's rates, has drifted.
    """
    starts: list[tuple[int, Quaternion, Vector]] = []
    for time_ns, row in sorted(turned[b"CORI"].items()):
        camera = _ahead_first(row)
        image = _ahead_first(turned[b"IORI"].get(time_ns, (1.0, 0.0, 0.0, 0.0)))
        pull = turned[b"GRAV"].get(time_ns)
        if camera is None or image is None or pull is None or not 0.9 < math.hypot(*pull) < 1.1:
            continue
        x, y, z = pull
        down = _turned(conjugate(camera), (z, x, y))
        starts.append((time_ns, multiply(conjugate(camera), conjugate(image)), down))
    if not starts:
        return
    times = [time_ns for time_ns, _, _ in starts]
    sums = [list(accumulate((d[k] for _, _, d in starts), initial=0.0)) for k in range(3)]

    def mean(first: int, last: int) -> Vector:
        x, y, z = (one[last] - one[first] for one in sums)
        return x, y, z

    level = _levelled(mean(0, len(starts)))
    for time_ns, q_start_image, _ in starts:
        around = bisect_left(times, time_ns - DRIFT_NS), bisect_right(times, time_ns + DRIFT_NS)
        drift = _levelled(_turned(level, mean(*around)))
        yield time_ns, multiply(drift, multiply(level, q_start_image))


def _ahead_first(row: tuple[float, ...]) -> Quaternion | None:
    """A quaternion in the axes ahead, right, down; None where it is not one of unit length."""
    w, x, y, z = row
    return normalised((w, z, x, y))


def _levelled(down: Vector) -> Quaternion:
    """The rotation that takes a direction to (0, 0, 1), about horizontal axes."""
    x, y, z = down
    return from_rpy(math.atan2(y, z), math.atan2(-x, math.hypot(y, z)), 0.0)


def _turned(q: Quaternion, v: Vector) -> Vector:
    _, x, y, z = multiply(multiply(q, (0.0, *v)), conjugate(q))
    return x, y, z


def _is_placed(samples: list[Sample]) -> bool:
    return any(isinstance(sample, PositionSample) for sample in samples)


def _streams(data: bytes) -> Iterator[tuple[bytes, list[tuple[float, ...]], _Stream]]:
    """Name, scaled structures and context of the items of a packet that are read."""
    stream = _Stream()
    for key, kind, size, content in _items(data):
        if key == b"STRM":
            stream = _Stream()
        elif key == b"SCAL":
            stream.scale = tuple(v for row in _rows(bytes([kind]), size, content) for v in row)
        elif key == b"TYPE":
            stream.kinds = content[:64]
        elif key == b"GPSA":
            stream.is_amsl = content.startswith(b"MSLV")
        elif key == b"GPSU":
            stream.utc_ns = _utc_ns(content)
        elif key in (b"GPSF", b"GPSP"):
            for (value,) in _rows(bytes([kind]), size, content)[:1]:
                stream.fix, stream.dop = (
                    (value, stream.dop) if key == b"GPSF" else (stream.fix, value / 100.0)
                )
        elif key in COLUMNS:
            kinds = stream.kinds or TYPES.get(key, b"")
            if len(kinds) < COLUMNS[key]:
                continue  # damaged
            rows = _rows(kinds, size, content)
            scales = stream.scale * (len(kinds) if len(stream.scale) == 1 else 1)
            if len(scales) == len(kinds) and all(scales):
                scaled = [tuple(v / s for v, s in zip(r, scales, strict=True)) for r in rows]
                rows = [r[: COLUMNS[key]] for r in scaled if all(map(math.isfinite, r))]
                yield key, rows, stream


def _utc_ns(text: bytes) -> int | None:
    """Unix time of a date such as b"220920132938.299"."""
    try:
        moment = datetime.strptime(text[:16].decode("ascii"), "%y%m%d%H%M%S.%f")
    except ValueError:
        return None
    return round(moment.replace(tzinfo=timezone.utc).timestamp() * 1e3) * 10**6


def _items(data: bytes) -> Iterator[tuple[bytes, int, int, bytes]]:
    """(key, type, size of a structure, content) in order; of a nested one its items follow."""
    stack, left = [(0, len(data))], MAX_ITEMS
    while stack and left:
        at, end = stack.pop()
        if at + 8 > end:
            continue
        left -= 1
        key, kind, size = data[at : at + 4], data[at + 4], data[at + 5]
        count = int.from_bytes(data[at + 6 : at + 8], "big")
        length = size * count
        if at + 8 + length > end:
            continue  # damaged: the rest of this one is not read
        stack.append((at + 8 + -(-length // 4) * 4, end))
        content = data[at + 8 : at + 8 + length]
        yield key, kind, size, content
        if kind == 0 and len(stack) <= MAX_DEPTH:
            stack.append((at + 8, at + 8 + length))


def _rows(kinds: bytes, size: int, content: bytes) -> list[tuple[float, ...]]:
    """Structures of an item; none where its declaration is not one of numbers."""
    try:
        code = ">" + "".join(CODES[kind] for kind in kinds)
    except KeyError:
        return []
    width = struct.calcsize(code)
    if not width or size % width or (size != width and len(kinds) > 1):
        return []
    whole = min(len(content), MAX_SAMPLES * size) // width * width
    return [tuple(map(float, row)) for row in struct.iter_unpack(code, content[:whole])]


def _gps5(row: tuple[float, ...], stream: _Stream) -> tuple[None, list[Sample]]:
    lat, lon, alt = row[:3]
    return None, _fix(lat, lon, alt, stream.fix, stream.dop)


def _gps9(row: tuple[float, ...], _: _Stream) -> tuple[float, list[Sample]]:
    (lat, lon, alt), (days, second, dop, fix) = row[:3], row[5:9]
    return 86_400.0 * days + second, _fix(lat, lon, alt, fix, dop)


def _fix(lat: float, lon: float, alt: float, fix: float, dop: float) -> list[Sample]:
    if fix < 2.0 or not plausible_place(lat, lon):
        return [receiver_accuracy(False)]
    accuracy = receiver_accuracy(True, dop * HDOP_TO_M if dop < UNKNOWN_DOP else math.nan)
    height = alt if fix >= 3.0 else None
    return [PositionSample(None, lat, lon, height, None, None), replace(accuracy, is_claimed=False)]


def _karma(row: tuple[float, ...], _: _Stream) -> tuple[float, list[Sample]]:
    time_s, lat, lon, alt, relative, *ned = row[:8]
    if not plausible_place(lat, lon):
        return time_s, []
    north, east, down = ned
    return time_s, [PositionSample(None, lat, lon, alt, relative, (north, east, down))]


def _karma_receiver(row: tuple[float, ...], _: _Stream) -> tuple[float, list[Sample]]:
    time_s, across, up, fix = row[0], row[4], row[5], row[8]
    return time_s, [receiver_accuracy(fix >= 3.0, across, up)]


READERS = {b"GPS5": _gps5, b"GPS9": _gps9, b"GLPI": _karma, b"GPRI": _karma_receiver}
"""Item to reader of one structure. A new item is one function and one line."""
