"""Valid ranges of the numbers in records, derived from their meaning.

Every decoder uses these rules, so a record is checked in the same way when it is received, imported
or read from a store. ``docs/wire.md`` lists them.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from recon.types import F64

MAX_POSITION_M = 1e6
"""Maximum distance from the scan's origin: the local frame is a plane and only valid nearby."""
MAX_ALTITUDE_M = 1e5  # maximum height above or below sea level or ground
MIN_DEPTH_M, MAX_DEPTH_M = 1e-3, 1e5
MIN_SCALE, MAX_SCALE = 1e-3, 1e3
"""Scale of a re-pose: an assumed height of 60 m covers 6 cm to 60 km."""
MAX_SLOPE = 57.3  # no pixel is further than 89 degrees off the optical axis
MAX_FOCAL_WIDTHS = 1000.0
"""Maximum focal length in image widths: a field of view of a twentieth of a degree."""
MAX_PIXEL_RATIO = 5.0  # maximum ratio of fx and fy
MAX_SIGMA_M = 1e6

MAX_HEADER_BYTES = 262_144  # maximum size of a scan header
MAX_SUMMARY_BYTES = 1_048_576
MAX_NOTES = 10_000
MAX_NAME = 128
MIN_TIME_NS, MAX_TIME_NS = -86_400 * 10**9, (1 << 32) * 10**9
"""Unix time up to 2106; a clock that starts at 0 may be corrected to slightly before."""

NAME_TEXT = r"^[^\x00-\x1f\x7f/\\]+$"
"""No control characters and no slashes: names are used in file names, XML and keys."""

Latitude = Annotated[float, Meta(ge=-90.0, le=90.0)]
Longitude = Annotated[float, Meta(ge=-360.0, le=360.0)]
Altitude = Annotated[float, Meta(ge=-MAX_ALTITUDE_M, le=MAX_ALTITUDE_M)]
Name = Annotated[str, Meta(max_length=MAX_NAME, pattern=NAME_TEXT)]
Text = Annotated[str, Meta(max_length=65_536)]
Time = Annotated[int, Meta(ge=0, le=MAX_TIME_NS)]
Epsg = Annotated[int, Meta(ge=0, le=999_999)]
RunId = Annotated[str, Meta(pattern=r"^([0-9a-f]{32})?$")]
Notes = Annotated[tuple[Text, ...], Meta(max_length=MAX_NOTES)]

_Count = Annotated[int, Meta(ge=0, le=1 << 53)]
_Side = Annotated[int, Meta(ge=1, le=65_535)]


class _CameraJson(msgspec.Struct):
    """The camera in a header; other keys are ignored."""

    width: _Side | None = None
    height: _Side | None = None
    K: Annotated[list[float], Meta(min_length=9, max_length=9)] | None = None
    distortion: Annotated[list[float], Meta(max_length=14)] | None = None
    readout_ms: Annotated[float, Meta(ge=0, le=200)] = 0.0
    readout_direction: Literal["down", "up", "right", "left"] = "down"


class _ScaleJson(msgspec.Struct):
    sigma: float | None = None


class _SummaryJson(msgspec.Struct):
    """The fields of a summary that are read; the rest is kept unchanged."""

    frames: _Count | None = None
    pairs: _Count | None = None
    clouds: _Count | None = None
    keyframes: _Count | None = None
    points: _Count | None = None
    distance_m: float | None = None
    seconds: float | None = None
    clouds_per_second: float | None = None
    warnings: Annotated[list[Text], Meta(max_length=MAX_NOTES)] | None = None
    refusals: dict[str, float] | None = None
    registrations: dict[str, float] | None = None
    stage_ms: dict[str, float] | None = None
    drops: dict[str, float] | None = None
    graph: dict[str, Any] | None = None
    scale: _ScaleJson | None = None
    source: Text | None = None
    backend: Text | None = None
    interrupted: bool | None = None


def summary_from_json(data: bytes) -> dict[str, Any] | None:
    """The summary in ``data``; None unless it is a JSON object in UTF-8 with valid fields."""
    if len(data) > MAX_SUMMARY_BYTES:
        return None
    try:
        raw = msgspec.json.decode(data.decode("utf-8"), type=dict[str, Any])
        msgspec.convert(raw, _SummaryJson)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    return raw


def check_camera(camera: dict[str, Any]) -> None:
    """Raise ValueError for a header's camera that is none."""
    try:
        found = msgspec.convert(camera, _CameraJson)
    except msgspec.ValidationError as error:
        raise ValueError(f"camera: {error}") from error
    if found.K is None:
        return
    fx, _, cx, _, fy, cy, *_ = found.K
    width, height = found.width or 65_535, found.height or 65_535
    if not is_pinhole((fx, fy, cx, cy), (width, height)):
        raise ValueError(
            f"camera: fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} fit no image of {width}x{height}"
        )


def is_pinhole(optics_px: tuple[float, float, float, float], size_px: tuple[int, int]) -> bool:
    """Whether fx, fy, cx, cy describe a pinhole camera with images of (W, H) pixels."""
    fx, fy, cx, cy = optics_px
    w, h = size_px
    if not (all(map(math.isfinite, optics_px)) and fx > 0.0 and fy > 0.0):
        return False
    if not (1.0 / MAX_PIXEL_RATIO < fx / fy < MAX_PIXEL_RATIO and fx < MAX_FOCAL_WIDTHS * w):
        return False
    aside = max(abs(cx + 0.5), abs(w - 0.5 - cx)) / fx
    above = max(abs(cy + 0.5), abs(h - 0.5 - cy)) / fy
    return max(aside, above) <= MAX_SLOPE


def is_position(xyz_m: F64) -> bool:
    """Whether (3,) metres are near enough to the scan's origin."""
    return bool(np.abs(xyz_m).max() <= MAX_POSITION_M)  # False for NaN


def is_rotation(quaternion: F64) -> bool:
    """Whether w x y z can be normalised to a rotation."""
    return 0.5 < math.hypot(*quaternion) < 2.0


def is_time(time_unix_ns: int) -> bool:
    return MIN_TIME_NS <= time_unix_ns < MAX_TIME_NS


def is_scale(scale: float) -> bool:
    return MIN_SCALE <= scale <= MAX_SCALE


def is_inverse_depth(low: float, step: float) -> bool:
    """Whether codes from ``low`` in steps of ``step`` (1/m) cover plausible depths."""
    return 0.999 / MAX_DEPTH_M <= low < 1e4 and 0.0 < step < 1e4


def is_on_globe(lat_deg: float | None, lon_deg: float | None, *heights_m: float | None) -> bool:
    """Whether a partly known position is plausible; NaN is not."""
    return (
        (lat_deg is None or abs(lat_deg) <= 90.0)
        and (lon_deg is None or abs(lon_deg) <= 360.0)
        and all(h is None or abs(h) <= MAX_ALTITUDE_M for h in heights_m)
    )
