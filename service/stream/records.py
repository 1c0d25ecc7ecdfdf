"""The small records of a scan: header, poses, re-poses; each with its wire format.

Poses and re-poses are fixed little-endian structures with a CRC-32 at their end; the scan
header is JSON. ``docs/wire.md`` is the reference. Decoders return None for anything that is
not a valid record: they never raise and never allocate more than the record itself.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from recon import se3
from recon.types import F64, Keyframe, Pose
from service.stream import validity
from service.stream.validity import MAX_DEPTH_M, MAX_HEADER_BYTES, MIN_DEPTH_M

SOURCES = ("vision", "attitude", "altitude", "gnss", "exif", "loop", "dead reckoning")
"""Bit k of a ``sources`` byte on the wire stands for name k."""


@dataclass(frozen=True, slots=True)
class ScanHeader:
    """Identity of a scan: drone, origin, camera and settings."""

    scan_id: validity.Name
    drone: validity.Name
    started_unix_ns: validity.Time
    origin_lat_deg: validity.Latitude | None = None
    origin_lon_deg: validity.Longitude | None = None
    origin_alt_amsl_m: validity.Altitude | None = None
    epsg: validity.Epsg | None = None
    camera: dict[str, Any] = field(default_factory=dict)
    configuration: dict[str, Any] = field(default_factory=dict)
    software: validity.Text = ""
    georeference: validity.Text = "none"  # "gnss", "exif" or "none"
    vertical_datum: validity.Text = ""  # of heights as flown, where tags or telemetry state it
    notes: validity.Notes = ()
    run_id: validity.RunId = ""  # 32 hexadecimal digits, random for each run; old scans have none

    @property
    def name(self) -> str:
        """The scan's name on the datalink and the radio; no two runs have the same."""
        return f"{self.scan_id}.{self.run_id}" if self.run_id else self.scan_id

    @property
    def identity(self) -> tuple[str, str, str]:
        """Drone, scan and run: identifies this scan and never changes."""
        return self.drone, self.scan_id, self.run_id

    def to_json(self) -> bytes:
        return msgspec.json.encode(self)


def header_from_json(data: bytes) -> ScanHeader | None:
    """The header in ``data``, or None when it is invalid or too large."""
    try:
        return read_header(data)
    except ValueError:
        return None


def read_header(data: bytes) -> ScanHeader:
    """The header in ``data``; ValueError says where it is invalid."""
    if len(data) > MAX_HEADER_BYTES:
        raise ValueError(f"it has {len(data)} bytes, at most {MAX_HEADER_BYTES} are allowed")
    try:
        header = msgspec.json.decode(data.decode("utf-8"), type=ScanHeader)
    except RecursionError as error:
        raise ValueError(str(error)) from error
    validity.check_camera(header.camera)
    return header


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """The camera's pose at one time, in the world and on the globe, with its uncertainty."""

    time_unix_ns: int
    T_world_camera: F64  # (4, 4) m
    covariance: F64  # (6, 6) left perturbation in the world frame: rotation rad, translation m
    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_amsl_m: float | None = None
    agl_m: float | None = None
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    speed_m_s: float = 0.0
    distance_m: float = 0.0
    turn_rate_rad_s: float = 0.0
    sources: tuple[str, ...] = ()
    sigma_m: float = 0.0
    keyframe_seq: int | None = None

    @property
    def position_covariance(self) -> F64:
        """(3, 3) m2 of the camera's position."""
        return se3.about(self.T_world_camera[:3, 3], self.covariance)[3:, 3:]

    @property
    def sigma_h_v_m(self) -> tuple[float, float]:
        """Sigma of the camera's position: horizontal (both directions together) and vertical."""
        east, north, up = np.diag(self.position_covariance).clip(0.0)  # a peer's may be negative
        return math.sqrt(east + north), math.sqrt(up)


@dataclass(frozen=True, slots=True, eq=False)
class Repose:
    """A better pose of a published keyframe; the highest revision is in force."""

    seq: int
    revision: int
    T_world_camera: F64  # (4, 4) m
    scale: float  # the keyframe's depth and sigma are multiplied by this
    covariance: F64  # (6, 6) left perturbation in the world frame: rotation rad, translation m

    def applied_to(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe at this pose, its depth and sigma scaled; implausible depth is NaN."""
        depth = keyframe.depth.scaled(self.scale, self.T_world_camera)
        with np.errstate(invalid="ignore"):
            far = (depth.depth_m < MIN_DEPTH_M) | (depth.depth_m > MAX_DEPTH_M)
        depth.depth_m[far] = np.nan
        pose = Pose(self.T_world_camera, self.covariance, keyframe.pose.sources)
        return replace(keyframe, depth=depth, pose=pose)


_UPPER = np.triu_indices(6)


def source_bits(sources: Sequence[str]) -> int:
    """One byte with bit k set for ``SOURCES[k]``; unknown names are dropped."""
    return sum(1 << k for k, name in enumerate(SOURCES) if name in sources)


def sources_of(bits: int) -> tuple[str, ...]:
    return tuple(name for k, name in enumerate(SOURCES) if bits >> k & 1)


def pack_covariance(covariance: F64) -> list[float]:
    """21 numbers: the upper triangle of a (6, 6) covariance, row by row, finite in float32."""
    upper = np.nan_to_num(np.asarray(covariance, np.float64)[_UPPER], posinf=1e30, neginf=-1e30)
    return [float(v) for v in np.clip(upper, -1e30, 1e30)]


def unpack_covariance(upper: Sequence[float] | F64) -> F64:
    """(6, 6) covariance from its 21 numbers."""
    out = np.zeros((6, 6))
    out[_UPPER] = upper
    return np.asarray(out + np.triu(out, 1).T)


def pack_motion(T: F64) -> list[float]:
    """Seven numbers of the (4, 4) motion ``T``: x y z, then the quaternion w x y z."""
    q = se3.quaternion_from_rotation(T[:3, :3])
    return [float(v) for v in (*T[:3, 3], *q)]


def unpack_motion(seven: Sequence[float] | F64) -> F64 | None:
    """(4, 4) motion of x y z, qw qx qy qz; None unless within reach, with a real quaternion."""
    v = np.asarray(seven, np.float64)
    if not (validity.is_position(v[:3]) and validity.is_rotation(v[3:])):
        return None
    return se3.compose(se3.rotation_from_quaternion(v[3:]), v[:3])


_PLACE = struct.Struct("<7d21f")
_CRC = struct.Struct("<I")


class Placed:
    """A record with a camera pose.

    Magic and version, leading fields, position and quaternion (7 f64), covariance (21 f32),
    trailing fields, CRC-32 of all the rest, and a body where ``max_bytes`` has room for one.
    """

    def __init__(self, start: bytes, first: str, last: str, max_bytes: int = 0) -> None:
        self._start = start
        self._first, self._last = struct.Struct(f"<{len(start)}s{first}"), struct.Struct(f"<{last}")
        self._sealed = self._first.size + _PLACE.size + self._last.size
        self.size = self._sealed + _CRC.size  # without a body
        self._max_bytes = max_bytes or self.size

    def pack(
        self, first: Sequence[Any], T: F64, covariance: F64, last: Sequence[Any], body: bytes = b""
    ) -> bytes:
        sealed = self._first.pack(self._start, *first)
        sealed += _PLACE.pack(*pack_motion(T), *pack_covariance(covariance))
        sealed += self._last.pack(*last)
        return sealed + _CRC.pack(zlib.crc32(body, zlib.crc32(sealed))) + body

    def unpack(self, data: bytes) -> tuple[tuple[Any, ...], F64, F64, tuple[Any, ...]] | None:
        """First fields, motion, covariance, last fields; None for anything else."""
        if not self.size <= len(data) <= self._max_bytes or not data.startswith(self._start):
            return None
        crc = zlib.crc32(memoryview(data)[self.size :], zlib.crc32(data[: self._sealed]))
        if crc != _CRC.unpack_from(data, self._sealed)[0]:
            return None
        place = _PLACE.unpack_from(data, self._first.size)
        motion = unpack_motion(place[:7])
        if motion is None or not all(map(math.isfinite, place[7:])):
            return None
        last = self._last.unpack_from(data, self._first.size + _PLACE.size)
        return self._first.unpack_from(data)[1:], motion, unpack_covariance(place[7:]), last


_POSE = Placed(b"SP\x01", first="Bqi", last="3d8f")
_REPOSE = Placed(b"SR\x01", first="BII", last="f")


def or_nan(value: float | None) -> float:
    """NaN for None, as on the wire."""
    return math.nan if value is None else value


def or_none(value: float) -> float | None:
    """None for NaN and infinity."""
    return value if math.isfinite(value) else None


def pack_pose(pose: PoseRecord) -> bytes:
    seq = -1 if pose.keyframe_seq is None else pose.keyframe_seq
    place = map(or_nan, (pose.lat_deg, pose.lon_deg, pose.alt_amsl_m, pose.agl_m))
    angles = pose.roll_rad, pose.pitch_rad, pose.yaw_rad
    way = pose.speed_m_s, pose.distance_m, pose.turn_rate_rad_s
    return _POSE.pack(
        (source_bits(pose.sources), pose.time_unix_ns, seq),
        pose.T_world_camera,
        pose.covariance,
        (*place, *angles, *way, pose.sigma_m),
    )


def unpack_pose(data: bytes) -> PoseRecord | None:
    """The pose in ``data``, or None when it is not a valid pose record."""
    found = _POSE.unpack(data)
    if found is None:
        return None
    (bits, time_unix_ns, seq), motion, covariance, last = found
    lat, lon, alt, agl = map(or_none, last[:4])
    roll, pitch, yaw, speed, distance, turn, sigma = last[4:]
    if not (validity.is_time(time_unix_ns) and validity.is_on_globe(lat, lon, alt, agl)):
        return None
    if not all(map(math.isfinite, last[4:])):
        return None
    return PoseRecord(
        time_unix_ns, motion, covariance, lat, lon, alt, agl, roll, pitch, yaw, speed, distance,
        turn, sources_of(bits), sigma, None if seq < 0 else seq,
    )  # fmt: skip


def pack_repose(repose: Repose) -> bytes:
    return _REPOSE.pack(
        (0, repose.seq, repose.revision), repose.T_world_camera, repose.covariance, (repose.scale,)
    )


def unpack_repose(data: bytes) -> Repose | None:
    """The re-pose in ``data``, or None when it is not a valid record."""
    found = _REPOSE.unpack(data)
    if found is None:
        return None
    (_, seq, revision), motion, covariance, (scale,) = found
    return Repose(seq, revision, motion, scale, covariance) if validity.is_scale(scale) else None
