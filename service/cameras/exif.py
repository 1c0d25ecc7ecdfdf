"""Time and place of a still: EXIF, the XMP block of its maker or Pix4D, or its file name.

EXIF 2.32 (CIPA DC-008-2019) sections 4.6.5 and 4.6.6; XMP names as DJI, Autel, Parrot and Skydio
write them, and those of http://pix4d.com/camera/1.0, which older Autels, Parrot's Sequoia, senseFly
and MicaSense write.
"""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from mavlink.telemetry.decode import plausible_place
from mavlink.telemetry.history import M_PER_DEG
from recon.frames import rotation_from_rpy, rpy_from_rotation
from service.cameras.geo_file import MAX_HEIGHT_M
from service.cameras.lens import Lens, finite_number, finite_numbers, lens_of
from service.cameras.source import GeoTag
from service.cameras.xmp import xmp_values

DEFAULT_SIGMA_H_M, MAX_SIGMA_M = 5.0, 1000.0
NAME_TIME = re.compile(r"(?<!\d)(20\d{6})[T_-]?(\d{6})[._]?(\d{1,6})?Z(?![A-Za-z0-9])")
EXIF_HEAD = b"Exif\0\0"
EXIF_BYTES = 1 << 22  # of a file's EXIF that is read; cameras write 64 KiB, and a maker's note

FINE_M, DIFFER_M = 0.1, 1.0
"""Steps of a stated value that make no difference, and a difference of two that does."""

TURNED_DEG = {3: 180, 6: 90, 8: 270}
"""EXIF orientation to degrees clockwise; no camera writes the mirrored ones."""

SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Tags:
    """Tags of a still; times in ns, None where missing."""

    size_px: tuple[int, int]
    local_ns: int | None = None  # camera's clock, as if it were UTC
    offset_ns: int | None = None  # camera's clock minus UTC, when the zone is written
    gps_unix_ns: int | None = None  # UTC of the last GPS fix, often whole seconds
    name_unix_ns: int | None = None  # UTC in the file name
    sub_second: bool = False  # local_ns is finer than a second
    geotag: GeoTag | None = None
    pan_deg: float | None = None  # heading of the image less the aircraft's, which are both stated
    lens: Lens | None = None
    turned_deg: int = 0  # clockwise rotation that viewers apply to the stored pixels
    camera: str = ""  # of several of a drone, as its maker names it
    model: str = ""  # of the camera
    differences: tuple[tuple[str, float], ...] = ()  # two sources of one value, metres apart
    is_hemisphere_missing: bool = False  # there is a position without N, S, E, W


BROKEN = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
)
"""Pillow's errors, besides OSError, for invalid images or broken tags."""


def read_tags(path: Path, hemisphere: str = "") -> Tags:
    """The tags of the image at ``path``; raises OSError when it is not an image, or when it claims
    more pixels than any camera has. ``hemisphere`` ("NW") is that of positions that state none."""
    from PIL import Image

    try:
        return _read_tags(path, hemisphere)
    except (*BROKEN, Image.DecompressionBombError) as error:
        raise OSError(" ".join(str(error).split())[:200] or type(error).__name__) from error


class _Metered:
    """A file of which ``EXIF_BYTES`` can be read: tags may state one place again and again, and a
    list in a TIFF is as long as the file."""

    def __init__(self, file: Any) -> None:
        self._file, self._left = file, EXIF_BYTES

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def read(self, size: int = -1) -> bytes:
        """Read like any file; raises OSError where too much has been read."""
        self._left -= size if size >= 0 else EXIF_BYTES + 1
        self.check()
        data: bytes = self._file.read(size)
        return data

    def check(self) -> None:
        """Raise OSError where too much has been read, which Pillow ignores."""
        if self._left < 0:
            raise OSError("the tags are too large")


def _read_tags(path: Path, hemisphere: str) -> Tags:
    from PIL import Image

    with Image.open(path) as image:
        size_px = (int(image.width), int(image.height))
        packet = image.info.get("xmp") or b""
        block = (image.info.get("exif") or b"").removeprefix(EXIF_HEAD)
        metered = _Metered(io.BytesIO(block) if block else image.fp)
        exif = Image.Exif()
        if block:
            exif.load_from_fp(metered)  # type: ignore[arg-type]
        else:
            if hasattr(image, "tag_v2"):  # a TIFF, whose tags are not in memory yet
                image.fp = metered
            exif = image.getexif()
        photo, gps = dict(exif.get_ifd(0x8769)), dict(exif.get_ifd(0x8825))
        metered.check()
    xmp = xmp_values(packet) if isinstance(packet, bytes) else {}
    place, is_hemisphere_missing, apart = _place(gps, xmp, hemisphere)
    altitude, differs = _altitude(gps, xmp)
    geotag = _geotag(gps, xmp, place, altitude)
    text = str(photo.get(36867) or photo.get(36868) or exif.get(306) or "")
    sub = str(photo.get(37521) or photo.get(37522) or photo.get(37520) or "").strip("\0 ")
    return Tags(
        size_px=size_px,
        local_ns=_local_ns(text, sub),
        offset_ns=_offset_ns(str(photo.get(36881) or photo.get(36880) or "")),
        gps_unix_ns=_gps_unix_ns(gps),
        name_unix_ns=name_unix_ns(path.name),
        sub_second=sub.isdecimal(),
        geotag=geotag,
        pan_deg=_pan_deg(geotag, xmp),
        lens=lens_of(photo, xmp, size_px),
        turned_deg=TURNED_DEG.get(exif.get(274, 1), 0),
        camera=xmp.get("ImageSource", "").strip()[:40],
        model=str(exif.get(272, "")).strip("\0 ")[:40],
        differences=(*apart, *differs),
        is_hemisphere_missing=is_hemisphere_missing,
    )


def name_unix_ns(name: str) -> int | None:
    """UTC in a file name like 2018080501004480Z: date, time, fraction of a second, Z."""
    found = NAME_TIME.search(name)
    if found is None:
        return None
    day, time, fraction = found.groups()
    start_ns = _as_utc_ns(day + time, "%Y%m%d%H%M%S")
    return None if start_ns is None else start_ns + _fraction_ns(fraction or "0")


def _local_ns(text: str, sub: str) -> int | None:
    start_ns = _as_utc_ns(text.strip("\0 ")[:19], "%Y:%m:%d %H:%M:%S")
    return None if start_ns is None else start_ns + _fraction_ns(sub if sub.isdecimal() else "0")


def _as_utc_ns(text: str, form: str) -> int | None:
    """Unix ns of a time as if it were UTC; None unless a clock that was set can show it, and time
    in ns as we store it."""
    try:
        moment = datetime.strptime(text, form).replace(tzinfo=timezone.utc)
    except ValueError:
        return None
    return round(moment.timestamp()) * SECOND_NS if 1970 <= moment.year < 2106 else None


def _fraction_ns(digits: str) -> int:
    return round(float(f"0.{digits}") * SECOND_NS)


def _offset_ns(text: str) -> int | None:
    found = re.match(r"([+-])(\d\d):(\d\d)", text.strip("\0 "))
    if found is None:
        return None
    sign = -1 if found[1] == "-" else 1
    return sign * (int(found[2]) * 3600 + int(found[3]) * 60) * SECOND_NS


def _gps_unix_ns(gps: dict[int, Any]) -> int | None:
    clock = finite_numbers(gps.get(7), 3)
    day_ns = _as_utc_ns(str(gps.get(29, "")).strip("\0 "), "%Y:%m:%d")
    seconds = math.inf if clock is None else clock[0] * 3600 + clock[1] * 60 + clock[2]
    if day_ns is None or not 0 <= seconds <= 86_401:
        return None
    return day_ns + round(seconds * SECOND_NS)


@dataclass(frozen=True, slots=True)
class Reading:
    """A value as one source states it."""

    source: str
    value: tuple[float, ...]  # (latitude, longitude) in degrees, or an altitude in metres
    step_m: float  # the finest difference that the source can state


Differences = tuple[tuple[str, float], ...]
"""Of two sources of one value: what they differ in, and by how many metres."""


def better(
    what: str,
    plausible: Sequence[Reading],
    apart_m: Callable[[Reading, Reading], float],
    doubtful: Sequence[Reading] = (),
) -> tuple[Reading | None, Differences]:
    """The finest of plausible readings, the first of equals; and how far the others are off it.

    Steps below ``FINE_M`` are equal, as no receiver is that good: a program that corrects
    positions writes them to EXIF, which comes first.
    """
    if not plausible:
        return None, ()
    best = min(plausible, key=lambda one: max(one.step_m, FINE_M))
    off = [(one, apart_m(one, best)) for one in (*plausible, *doubtful)]
    return best, tuple(
        (f"{one.source} and {best.source} state another {what}; that of {best.source} counts", m)
        for one, m in off
        if m > DIFFER_M + one.step_m + best.step_m
    )


def _place(
    gps: dict[int, Any], xmp: dict[str, str], hemisphere: str
) -> tuple[Reading | None, bool, Differences]:
    """The position; whether it has no N, S, E, W; and how far sources are apart."""
    readings = []
    letters = [str(gps.get(tag, "")).strip("\0 ").upper() for tag in (1, 3)]
    given = [one if one in pair else "" for one, pair in zip(letters, ("NS", "EW"), strict=True)]
    given = [one or more for one, more in zip(given, hemisphere or "  ", strict=True)]
    degrees = [_degrees(gps.get(tag)) for tag in (2, 4)]
    is_signed = any(one is not None and one[0] < 0.0 for one in degrees)
    is_stated = all(map(str.strip, given)) or is_signed
    signs = [-1.0 if one in ("S", "W") else 1.0 for one in given]
    if degrees[0] is not None and degrees[1] is not None:
        (lat, lat_step), (lon, lon_step) = degrees[0], degrees[1]
        step_m = M_PER_DEG * math.hypot(lat_step, lon_step)
        readings.append(Reading("EXIF", (lat * signs[0], lon * signs[1]), step_m))
    names = (("GpsLatitude",), ("GpsLongitude", "GpsLongtitude"))
    texts = [next((xmp[n] for n in some if n in xmp), "") for some in names]
    if None not in (numbers := [finite_number(text) for text in texts]):
        step_m = M_PER_DEG * math.hypot(*map(_last_digit, texts))
        readings.append(Reading("XMP", (numbers[0] or 0.0, numbers[1] or 0.0), step_m))
    sound = [one for one in readings if plausible_place(*one.value)]
    stated = [one for one in sound if is_stated or one.source != "EXIF"]
    best, apart = better("position", stated, _metres)
    return best, bool(sound) and not stated, apart


def _metres(one: Reading, other: Reading) -> float:
    """Distance of two positions, near enough where they differ little."""
    north, east = (b - a for a, b in zip(one.value, other.value, strict=True))
    across = math.remainder(east, 360.0) * math.cos(math.radians(one.value[0]))
    return M_PER_DEG * math.hypot(north, across)


def _altitude(gps: dict[int, Any], xmp: dict[str, str]) -> tuple[float | None, Differences]:
    """The altitude in metres above what the tags state, and how far sources are apart."""
    readings = []
    altitude = finite_number(gps.get(6))
    if altitude is not None:
        below = gps.get(5) in (1, b"\x01", 3, b"\x03")
        if altitude > MAX_HEIGHT_M:  # below zero in an unsigned number, as a Yuneec E10T writes it
            altitude -= (1 << 32) / getattr(gps[6], "denominator", 1)
        readings.append(Reading("EXIF", (-altitude if below else altitude,), _step(gps.get(6))))
    if (absolute := finite_number(text := xmp.get("AbsoluteAltitude", ""))) is not None:
        readings.append(Reading("XMP", (absolute,), _last_digit(text)))
    # Exactly 0 is what a program writes that does not know it.
    unset = [one for one in readings if not one.value[0]]
    known = [one for one in readings if one.value[0]]
    best, apart = better(
        "altitude", known or unset, lambda a, b: abs(a.value[0] - b.value[0]), unset
    )
    return None if best is None else best.value[0], apart


def _geotag(
    gps: dict[int, Any], xmp: dict[str, str], place: Reading | None, altitude: float | None
) -> GeoTag | None:
    ypr_deg, relative_m = _gimbal_ypr_deg(xmp), _xmp_number(xmp, "RelativeAltitude")
    if place is None and ypr_deg is None and relative_m is None:
        return None
    across = _sigma(xmp, "RtkStdLat", "RtkStdLon", "GPSXYAccuracy")
    stated = across or _plausible(finite_number(gps.get(31)))
    step_m = 0.0 if place is None or place.step_m < DIFFER_M else place.step_m
    lat, lon = (None, None) if place is None else place.value
    datum = "ellipsoid" if xmp.get("AltitudeType", "").strip() == "RtkAlt" else ""
    return GeoTag(
        lat_deg=lat,
        lon_deg=lon,
        alt_amsl_m=altitude,
        sigma_h_m=math.hypot(stated or DEFAULT_SIGMA_H_M, step_m / math.sqrt(3.0)),
        sigma_v_m=_sigma(xmp, "RtkStdHgt", "GPSZAccuracy"),
        is_sigma_h_stated=stated is not None,
        ypr_deg=ypr_deg,
        relative_alt_m=relative_m,
        datum=datum,
        is_pressure_altitude=relative_m is not None and not datum,
    )


def _sigma(xmp: dict[str, str], *names: str) -> float | None:
    """The largest of the accuracies in metres that are there."""
    found = [_plausible(_xmp_number(xmp, name)) for name in names]
    return max((sigma for sigma in found if sigma), default=None)


def _plausible(sigma_m: float | None) -> float | None:
    return sigma_m if sigma_m and 0 < sigma_m < MAX_SIGMA_M else None


def _gimbal_ypr_deg(xmp: dict[str, str]) -> tuple[float, float, float] | None:
    """The gimbal's angles; None where all are exactly 0: the camera did not know them."""
    yaw, pitch, roll = (
        _xmp_number(xmp, f"Gimbal{name}Degree", f"Camera{name}Degree")
        for name in ("Yaw", "Pitch", "Roll")
    )
    if yaw is None or pitch is None:
        return _pix4d_ypr_deg(xmp)
    angles = (yaw, pitch, roll or 0.0)
    return angles if any(angles) else None


def _pan_deg(geotag: GeoTag | None, xmp: dict[str, str]) -> float | None:
    """Heading of the image, whose upper side is ahead, less the aircraft's."""
    nose_deg = _xmp_number(xmp, "FlightYawDegree", "DroneYawDegree")
    if nose_deg is None or geotag is None or geotag.ypr_deg is None:
        return None
    yaw, pitch, roll = map(math.radians, geotag.ypr_deg)
    head = rotation_from_rpy(roll, pitch, yaw)
    north, east, _ = head[:, 0] - head[:, 2]  # ahead where it looks level, up where it looks down
    return math.remainder(math.degrees(math.atan2(east, north)) - nose_deg, 360.0)


def _pix4d_ypr_deg(xmp: dict[str, str]) -> tuple[float, float, float] | None:
    """Pix4D's angles, with which a camera of zero pitch and roll looks down, as a gimbal's."""
    yaw, pitch, roll = (_xmp_number(xmp, name) for name in ("Yaw", "Pitch", "Roll"))
    if yaw is None or pitch is None or roll is None:
        return None
    level = rotation_from_rpy(math.radians(roll), math.radians(pitch), math.radians(yaw))
    turned = rpy_from_rotation(level @ rotation_from_rpy(0.0, -math.pi / 2, 0.0))
    roll, pitch, yaw = (math.degrees(angle) for angle in turned)
    return yaw, pitch, roll


def _xmp_number(xmp: dict[str, str], *names: str) -> float | None:
    for name in names:
        value = finite_number(xmp.get(name))
        if value is not None:
            return value
    return None


def _degrees(value: Any) -> tuple[float, float] | None:
    """Degrees of EXIF's degrees, minutes and seconds, and the finest step that they can state.
    Seconds of 0/0 are none: the minutes have decimals, as a Nikon writes them."""
    if not isinstance(value, tuple) or len(value) != 3:
        return None
    is_short = getattr(value[2], "numerator", 1) == getattr(value[2], "denominator", 1) == 0
    given = value[:2] if is_short else value
    parts = finite_numbers(given, len(given))
    if parts is None:
        return None
    sixties = (1, 60, 3600)[: len(given)]
    step = min(_step(part) / sixty for part, sixty in zip(given, sixties, strict=True))
    sign = math.copysign(1.0, parts[0]) if any(parts) else 1.0
    rest = sum(part / sixty for part, sixty in zip(parts[1:], sixties[1:], strict=True))
    return sign * (abs(parts[0]) + rest), step


def _step(value: Any) -> float:
    return 1.0 / max(getattr(value, "denominator", 1), 1)


def _last_digit(text: str) -> float:
    """The unit of a decimal number's last digit."""
    return float(10.0 ** -len(text.strip().partition(".")[2]))
