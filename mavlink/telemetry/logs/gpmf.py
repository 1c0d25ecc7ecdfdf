"""GoPro's metadata track (GPMF, https://github.com/gopro/gpmf-parser): positions, accuracies.

Items are nested: four letters, a type, the size of a structure, their number, and the data, padded
to four bytes. Read are GPS5 (HERO5 to 10) with GPSF and GPSP, GPS9 (HERO11 and later), and what
the drone Karma adds: GLPI (the autopilot's position) and GPRI (its receiver). The body's attitude
is not that of the camera, which a gimbal holds, and is not read. Times are the video's own;
samples spread over the time of their packet, those of a drone by its own clock.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

from mavlink.telemetry.decode import HDOP_TO_M, plausible_place, receiver_accuracy
from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import TelemetryLog, finish
from mavlink.telemetry.samples import PositionSample, Sample

Packet = tuple[int, int, bytes]
"""Time and duration in ns, and the bytes."""

MARK = b"DEVC"
MAX_DEPTH, MAX_ITEMS, MAX_SAMPLES = 4, 4096, 256
"""Of a packet, and of samples in an item; GPS5 has 18 a second."""

CODES = {ord(letter): code for letter, code in zip("bBsSlLjJfd", "bBhHiIqQfd", strict=True)}
"""GPMF's types as those of the struct module."""

TYPES = {b"GPS5": b"lllll", b"GPS9": b"lllllllSS"}
"""Of structures, where the item itself does not declare them."""

PLACES = (b"GLPI", b"GPS9", b"GPS5")
"""Best first; the first that has one gives them all."""

UNKNOWN_DOP = 99.0


@dataclass(slots=True)
class _Stream:
    """Declarations of a stream for the items that follow."""

    scale: tuple[float, ...] = (1.0,)
    kinds: bytes = b""
    fix: float = 3.0
    dop: float = math.nan


@dataclass(slots=True)
class _Track:
    """Samples of one item, at times in ns, and at those of their own clock where they have one."""

    times_ns: list[int] = field(default_factory=list)
    own_s: list[float | None] = field(default_factory=list)
    samples: list[list[Sample]] = field(default_factory=list)


def of_packets(path: Path, packets: Iterable[Packet], config: HistoryConfig) -> TelemetryLog:
    """The history in the packets of a metadata track; ValueError where they give none."""
    history, counts = VehicleHistory(config), Counter[str]()
    tracks: dict[bytes, _Track] = {}
    for time_ns, duration_ns, data in packets:
        counts["packets"] += 1
        for key, rows, stream in _streams(data):
            track = tracks.setdefault(key, _Track())
            for i, row in enumerate(rows):
                own_s, samples = READERS[key](row, stream)
                track.times_ns.append(time_ns + i * duration_ns // len(rows))
                track.own_s.append(own_s)
                track.samples.append(samples)
                counts[key.decode("ascii")] += 1
    used = next(
        (k for k in PLACES if k in tracks and any(map(_is_placed, tracks[k].samples))), None
    )
    for name in (used, b"GPRI") if used == b"GLPI" else (used,):
        track = tracks.get(name or b"", _Track())
        for time_ns, samples in zip(_times(track), track.samples, strict=True):
            for sample in samples:
                history.add(sample, time_ns)
    return replace(finish(path, history, counts, []), clock="video")


def _is_placed(samples: list[Sample]) -> bool:
    return any(isinstance(sample, PositionSample) for sample in samples)


def _times(track: _Track) -> list[int]:
    """By the samples' own clock, whose offset is the median one, where all state it."""
    own_ns = [round(1e9 * own) for own in track.own_s if own is not None]
    if len(own_ns) < len(track.times_ns) or not own_ns:
        return track.times_ns
    offset = round(median(at - own for at, own in zip(track.times_ns, own_ns, strict=True)))
    times = [own + offset for own in own_ns]
    apart = max(abs(a - b) for a, b in zip(times, track.times_ns, strict=True))
    return times if apart < 2_000_000_000 and min(times) >= 0 else track.times_ns


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
        elif key in (b"GPSF", b"GPSP"):
            for (value,) in _rows(bytes([kind]), size, content)[:1]:
                stream.fix, stream.dop = (
                    (value, stream.dop) if key == b"GPSF" else (stream.fix, value / 100.0)
                )
        elif key in READERS:
            kinds = stream.kinds or TYPES.get(key, b"")
            rows = _rows(kinds, size, content)
            scales = stream.scale * (len(kinds) if len(stream.scale) == 1 else 1)
            if len(scales) == len(kinds) and all(scales):
                scaled = [tuple(v / s for v, s in zip(r, scales, strict=True)) for r in rows]
                yield key, [r for r in scaled if all(map(math.isfinite, r))], stream


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


def _gps9(row: tuple[float, ...], _: _Stream) -> tuple[None, list[Sample]]:
    (lat, lon, alt), (dop, fix) = row[:3], row[7:9]
    return None, _fix(lat, lon, alt, fix, dop)


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
