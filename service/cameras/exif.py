"""Time and place of a still: EXIF, the XMP block of its maker or Pix4D, or its file name.

EXIF 2.32 (CIPA DC-008-2019) sections 4.6.5 and 4.6.6; XMP names as DJI, Autel, Parrot and Skydio
write them, and those of http://pix4d.com/camera/1.0, which older Autels, Parrot's Sequoia, senseFly
and MicaSense write.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from recon.frames import rotation_from_rpy, rpy_from_rotation
from service.cameras.lens import Lens, finite_number, finite_numbers, lens_of
from service.cameras.source import GeoTag

XMP_BYTES = 1 << 18  # DJI's block sits in the first 64 KiB
PREFIXES = "(?:drone-dji|drone-parrot|drone|Camera)"
"""Of XMP names. Autel's are those of DJI with the prefix drone."""

DEFAULT_SIGMA_H_M, MAX_SIGMA_M = 5.0, 1000.0
NAME_TIME = re.compile(r"(?<!\d)(20\d{6})[T_-]?(\d{6})[._]?(\d{1,6})?Z(?![A-Za-z0-9])")
SKYDIO_ANGLES = re.compile(
    "<drone-skydio:CameraOrientationNED([^>]*/>|.{0,999}?</drone-skydio:CameraOrientationNED>)",
    re.DOTALL,
)
"""Other frames of reference have angles of the same names."""

TURNED_DEG = {3: 180, 6: 90, 8: 270}
"""EXIF orientation to degrees clockwise; no camera writes the mirrored ones."""

EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


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


def read_tags(path: Path) -> Tags:
    """The tags of the image at ``path``; raises OSError when it is not an image, or when it
    claims more pixels than any camera has."""
    from PIL import Image

    try:
        return _read_tags(path)
    except (*BROKEN, Image.DecompressionBombError) as error:
        raise OSError(" ".join(str(error).split())[:200] or type(error).__name__) from error


def _read_tags(path: Path) -> Tags:
    from PIL import Image

    with Image.open(path) as image:
        size_px = (int(image.width), int(image.height))
        exif = image.getexif()
        photo, gps = dict(exif.get_ifd(0x8769)), dict(exif.get_ifd(0x8825))
    xmp = _xmp(path)
    geotag = _geotag(gps, xmp)
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
        turned_deg=TURNED_DEG.get(exif.get(274), 0),
    )


def name_unix_ns(name: str) -> int | None:
    """UTC in a file name like 2018080501004480Z: date, time, fraction of a second, Z."""
    found = NAME_TIME.search(name)
    if found is None:
        return None
    day, time, fraction = found.groups()
    try:
        moment = datetime.strptime(day + time, "%Y%m%d%H%M%S").replace(tzinfo=timezone.utc)
    except ValueError:
        return None
    return _unix_ns(moment) + round(float(f"0.{fraction or 0}") * 1_000_000_000)


def _local_ns(text: str, sub: str) -> int | None:
    try:
        moment = datetime.strptime(text.strip("\0 ")[:19], "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    fraction = round(float(f"0.{sub}") * 1_000_000_000) if sub.isdecimal() else 0
    return _unix_ns(moment.replace(tzinfo=timezone.utc)) + fraction if _is_known(moment) else None


def _offset_ns(text: str) -> int | None:
    found = re.match(r"([+-])(\d\d):(\d\d)", text.strip("\0 "))
    if found is None:
        return None
    sign = -1 if found[1] == "-" else 1
    return sign * (int(found[2]) * 3600 + int(found[3]) * 60) * 1_000_000_000


def _gps_unix_ns(gps: dict[int, Any]) -> int | None:
    clock = finite_numbers(gps.get(7), 3)
    try:
        day = datetime.strptime(str(gps.get(29, "")).strip("\0 "), "%Y:%m:%d")
    except ValueError:
        return None
    seconds = math.inf if clock is None else clock[0] * 3600 + clock[1] * 60 + clock[2]
    if not (_is_known(day) and 0 <= seconds <= 86_401):
        return None
    return _unix_ns(day.replace(tzinfo=timezone.utc)) + round(seconds * 1_000_000_000)


def _is_known(moment: datetime) -> bool:
    """Whether a clock that was set, and time in ns as we store it, can show it."""
    return 1970 <= moment.year < 2106


def _geotag(gps: dict[int, Any], xmp: dict[str, str]) -> GeoTag | None:
    lat = _degrees(gps.get(2), gps.get(1), "S")
    lon = _degrees(gps.get(4), gps.get(3), "W")
    if lat is None or lon is None:
        lat, lon = (
            _xmp_number(xmp, "GpsLatitude"),
            _xmp_number(xmp, "GpsLongitude", "GpsLongtitude"),
        )
    ypr_deg, relative_m = _gimbal_ypr_deg(xmp), _xmp_number(xmp, "RelativeAltitude")
    if lat is None or lon is None or abs(lat) > 90 or abs(lon) > 180 or (lat == 0 and lon == 0):
        if ypr_deg is None and relative_m is None:
            return None
        lat = lon = None
    altitude = finite_number(gps.get(6))
    if altitude is not None and gps.get(5) in (1, b"\x01"):
        altitude = -altitude
    across = _sigma(xmp, "RtkStdLat", "RtkStdLon", "GPSXYAccuracy")
    stated = across or _plausible(finite_number(gps.get(31)))
    return GeoTag(
        lat_deg=lat,
        lon_deg=lon,
        alt_amsl_m=altitude if altitude is not None else _xmp_number(xmp, "AbsoluteAltitude"),
        sigma_h_m=stated or DEFAULT_SIGMA_H_M,
        sigma_v_m=_sigma(xmp, "RtkStdHgt", "GPSZAccuracy"),
        ypr_deg=ypr_deg,
        relative_alt_m=relative_m,
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


def _xmp(path: Path) -> dict[str, str]:
    """The values of makers and of Pix4D in the XMP block, as attributes or as elements."""
    with path.open("rb") as stream:
        head = stream.read(XMP_BYTES)
    text = head.decode("latin-1")
    pairs = re.findall(rf"{PREFIXES}:(\w+)=\"([^\"]*)\"", text)
    pairs += re.findall(rf"<{PREFIXES}:(\w+)>([^<]*)</", text)
    for block in SKYDIO_ANGLES.findall(text):
        angles = re.findall(r"(?<!/)drone-skydio:(Yaw|Pitch|Roll)(?:=\"|>)([^\"<]*)", block)
        pairs += [(f"Gimbal{name}Degree", value) for name, value in angles]
    # Lists: <Camera:PrincipalPoint><rdf:Seq><rdf:li>3.4,2.6</rdf:li>...
    for name, block in re.findall(r"<Camera:(\w+)>\s*<rdf:Seq>(.*?)</rdf:Seq>", text, re.DOTALL):
        pairs.append((name, ",".join(re.findall(r"<rdf:li>([^<]*)</rdf:li>", block))))
    return dict(pairs)


def _xmp_number(xmp: dict[str, str], *names: str) -> float | None:
    for name in names:
        value = finite_number(xmp.get(name))
        if value is not None:
            return value
    return None


def _degrees(value: Any, reference: Any, negative: str) -> float | None:
    parts = finite_numbers(value, 3)
    if parts is None:
        return None
    degrees = parts[0] + parts[1] / 60 + parts[2] / 3600
    return -degrees if str(reference).strip("\0 ").upper() == negative else degrees


def _unix_ns(moment: datetime) -> int:
    since = moment - EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000
