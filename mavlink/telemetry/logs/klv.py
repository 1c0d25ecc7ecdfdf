"""MISB metadata in a video: the local set of ST 0601 and the universal set of EG 0104.

A set is a key of 16 bytes, a BER length, and items of key, length, value: of the local set a tag
and an integer over the item's range, of the universal set 16 bytes and a float. Read are the
sensor's place, the platform's attitude, the sensor's direction, and the slant range, which gives
the height above the ground that it sees. Of altitudes above the ellipsoid and above mean sea level
those count that most sets of the recording state. A set may stand behind a header (synchronous
metadata, MISB ST 1402) and behind sets that are not read. Of asynchronous metadata, whose packets
have no time, the order in the file gives one; the sets' own time stamps space them evenly, and date
the video.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from mavlink.telemetry.decode import plausible_place
from mavlink.telemetry.history import MAX_AGL_M, HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import ELLIPSOID, TelemetryLog, Track, finish, one_lens
from mavlink.telemetry.logs.gpmf import Packet
from mavlink.telemetry.quaternion import from_degrees, from_rpy, multiply
from mavlink.telemetry.samples import (
    YEAR_2000_UNIX_S,
    AttitudeSample,
    GimbalFrame,
    GimbalSample,
    PositionSample,
    Sample,
    TerrainSample,
)
from mavlink.wire.first_beat import CAMERA

MARK = bytes.fromhex("060e2b34")
LOCAL_SET = bytes.fromhex("060e2b34020b01010e01030101000000")
UNIVERSAL_SET = bytes.fromhex("060e2b34020101010e01010201010000")
MAX_SETS, MAX_ITEMS, CHECKSUM, STAMP = 16, 256, 1, 2


AGL_SHARE = 0.05
"""Relative sigma of the ground's height below, which is that of what the sensor sees."""

LOCAL: dict[int, tuple[str, float, float]] = {
    5: ("heading", 0.0, 360.0),
    6: ("pitch", -20.0, 20.0),
    7: ("roll", -50.0, 50.0),
    13: ("lat", -90.0, 90.0),
    14: ("lon", -180.0, 180.0),
    15: ("alt", -900.0, 19_000.0),
    16: ("hfov", 0.0, 180.0),
    18: ("azimuth", 0.0, 360.0),
    19: ("elevation", -180.0, 180.0),
    20: ("turned", 0.0, 360.0),
    21: ("slant", 0.0, 5_000_000.0),
    75: ("hae", -900.0, 19_000.0),
    90: ("pitch", -90.0, 90.0),
    91: ("roll", -90.0, 90.0),
}
"""Tag of ST 0601 to name and range; of a range from below 0 the integer has a sign."""

UNIVERSAL: dict[bytes, str] = {
    bytes.fromhex(key): name
    for key, name in {
        "0702010101050000": "time_us",
        "0701020102040200": "lat",
        "0701020102060200": "lon",
        "0701020102020000": "alt",
        "0701100106000000": "heading",
        "0701100105000000": "pitch",
        "0701100104000000": "roll",
        "0701100102000000": "north",  # of the sensor's direction, from north
        "0701100103000000": "obliquity",
        "0701080101000000": "slant",
        "0420020101080000": "hfov",
    }.items()
}
"""Second half of the key to name; degrees, metres, and unix microseconds in an integer."""


def of_packets(path: Path, packets: Iterable[Packet], config: HistoryConfig) -> TelemetryLog:
    """The history in the packets of a metadata stream; ValueError where they give none."""
    history, counts, views = VehicleHistory(config), Counter[str](), list[float]()
    track, warnings = Track(), list[str]()
    sets = [(time_ns, fields_of(data)) for time_ns, _, data in packets]
    counts["packets"] = len(sets)
    heights = Counter(name for _, found in sets for name in found.keys() & {"alt", "hae"})
    height = max(("alt", "hae"), key=lambda name: heights[name])
    if other := sum(height not in found and bool(found.keys() & heights) for _, found in sets):
        warnings.append(f"{other} positions are above another datum than the others': not used")
    for time_ns, found in sets:
        views += [found["hfov"]] if 0.0 < found.get("hfov", 0.0) < 180.0 else []
        if samples := samples_of(found, height):
            own_ns = 1000 * round(found["time_us"]) if "time_us" in found else None
            track.add(time_ns, own_ns, samples)
            counts.update(type(sample).__name__ for sample in samples)
    start_ns = track.fill(history)
    if height == "hae":
        history.vertical_datum = ELLIPSOID
    return finish(
        path, history, counts, warnings, "video", may_lag=True,
        hfov_deg=one_lens(views, "degrees", 2, warnings),
        start_unix_ns=start_ns if start_ns >= YEAR_2000_UNIX_S * 10**9 else None,
    )  # fmt: skip


def fields_of(data: bytes) -> dict[str, float]:
    """Values by name in the first set of a packet that has more than a time; empty without one."""
    end = 0
    for _ in range(MAX_SETS):
        if (start := data.find(MARK, end)) < 0:
            break
        content, after = _value(data, start + 16)
        end = after if after > 0 else start + 1
        found = _fields(data[start:end], content)
        if found.keys() - {"time_us"}:
            return found
    return {}


def _fields(whole: bytes, content: bytes) -> dict[str, float]:
    """Values by name in one set; empty where it is not one that is read."""
    if whole[:16] == UNIVERSAL_SET:
        pairs = (_universal(name[8:], value) for name, value in _items(content, 16))
    elif whole[:16] == LOCAL_SET and _is_sound(whole):
        pairs = (_local(name, value) for name, value in _items(content, 1))
    else:
        return {}
    return {name: number for name, number in pairs if name and number is not None}


def _is_sound(whole: bytes) -> bool:
    """Whether the checksum at the end of a local set, where there is one, is that of the set."""
    if whole[-4:-2] != bytes([CHECKSUM, 2]):
        return True
    summed = sum(whole[0:-2:2]) * 256 + sum(whole[1:-2:2])
    return summed & 0xFFFF == int.from_bytes(whole[-2:], "big")


def _items(content: bytes, wide: int) -> Iterator[tuple[bytes, bytes]]:
    """Key and value of items, those before an error."""
    at = 0
    for _ in range(MAX_ITEMS):
        key = content[at : at + wide]
        if wide == 1 and key and key[0] & 0x80:  # tags above 127 have two bytes; none is read
            at += 1
        value, at = _value(content, at + wide)
        if len(key) < wide or at < 0:
            return
        yield key, value


def _value(data: bytes, at: int) -> tuple[bytes, int]:
    """What follows a BER length, and the place after it; -1 where it is cut off."""
    if not 0 <= at < len(data):
        return b"", -1
    length, at = data[at], at + 1
    if length & 0x80:
        wide = length & 0x7F
        length, at = int.from_bytes(data[at : at + min(wide, 8)], "big"), at + wide
    end = at + length
    return (data[at:end], end) if end <= len(data) else (b"", -1)


def _universal(key: bytes, value: bytes) -> tuple[str | None, float | None]:
    name, code = UNIVERSAL.get(key), {4: ">f", 8: ">d"}.get(len(value))
    number = struct.unpack(code, value)[0] if code else math.nan
    if name == "time_us" and code:
        number = int.from_bytes(value, "big")
    return name, float(number) if math.isfinite(number) else None


def _local(key: bytes, value: bytes) -> tuple[str | None, float | None]:
    """Of an integer over its range; its lowest value, where it has a sign, says unknown."""
    if key[0] == STAMP and len(value) == 8:
        return "time_us", float(int.from_bytes(value, "big"))
    name, low, high = LOCAL.get(key[0], ("", 0.0, 0.0))
    if not name or len(value) not in (2, 4):
        return None, None
    is_signed = low == -high
    number, bits = int.from_bytes(value, "big", signed=is_signed), 8 * len(value)
    if is_signed:
        most = 2 ** (bits - 1) - 1
        return name, None if number < -most else high * number / most
    return name, low + (high - low) * number / (2**bits - 1)


def samples_of(found: dict[str, float], height: str = "") -> list[Sample]:
    """The samples of vehicle and camera in the fields of one set; without a place where it has an
    altitude and none of the ``height`` that is asked for."""
    out: list[Sample] = []
    lat, lon = found.get("lat", math.nan), found.get("lon", math.nan)
    is_other = height not in ("", *found) and bool(found.keys() & {"alt", "hae"})
    if plausible_place(lat, lon) and not is_other:
        out.append(PositionSample(None, lat, lon, found.get(height), None, None))
    head, down = None, 0.0  # down: of the optical axis
    body = from_degrees(*(found.get(name) for name in ("roll", "pitch", "heading")))
    on_body = from_degrees(*(found.get(name) for name in ("turned", "elevation", "azimuth")))
    if body is not None:
        out.append(AttitudeSample(None, body))
    if body is not None and on_body is not None:
        head = multiply(body, on_body)
        down = 2.0 * (head[1] * head[3] - head[0] * head[2])
    if "north" in found and "obliquity" in found:
        # Some count the angle down from level, others up.
        depression = math.radians(abs(found["obliquity"]))
        head, down = from_rpy(0.0, -depression, math.radians(found["north"])), math.sin(depression)
    if head is not None:
        out.append(GimbalSample(None, head, GimbalFrame.EARTH, CAMERA, 0))
    if down > 0.1 and 0.0 < (agl := found.get("slant", 0.0) * down) < MAX_AGL_M:
        out.append(TerrainSample(None, agl, AGL_SHARE * agl))
    return out
