"""The messages of the narrow radio: each fits a MAVLink TUNNEL and decodes alone.

An announcement names the scan in progress, a pose locates the camera, a tile holds 8 x 8 cells of
a keyframe's coarse depth and colour with its pose and camera. Bytes: ``docs/wire.md``.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.types import F32, F64, U8, U16, Bool
from service.stream.naming import NAME, split_scan_name
from service.stream.planes import SIGMA_M, sigma_codes
from service.stream.records import (
    PoseRecord,
    ScanHeader,
    or_nan,
    or_none,
    pack_motion,
    source_bits,
    sources_of,
    unpack_motion,
)
from service.stream.validity import is_on_globe, is_pinhole, is_time

PAYLOAD_TYPE = 42_432  # TUNNEL.payload_type of these messages; 32768 and above is for private use
MAX_BYTES = 128
RADIO_NOTE = "from the narrow radio"
"""Note in a header that was received by radio; the drone's own header replaces it later."""
ANNOUNCE, POSE, TILE = 0x11, 0x12, 0x13
CELLS = 8  # a tile is CELLS x CELLS
_DEPTH_UNIT_M = 0.02
_LEVELS = 62  # depth codes 1 to 63; 0 is unknown
_METRE_CM, _UNIT = 100.0, 32767  # of a quaternion
_NO_FIX = -(1 << 31)

_ANNOUNCE = struct.Struct("<BIq2dfHB")  # type, tag, started, lat, lon, alt, epsg, drone length
_POSE = struct.Struct("<BIIq3i4h2ifHBH")
_TILE = struct.Struct("<BIHIBBB3i4h3HHHBbb")


@dataclass(frozen=True, slots=True, eq=False)
class RadioTile:
    """A part of a keyframe, as sent over the narrow radio."""

    seq: int
    time_unix_ns: int  # to a second
    grid_px: tuple[int, int]  # (w, h) of the whole coarse keyframe
    index: int  # tiles row by row
    K: F64  # (3, 3) px of the grid
    T_world_camera: F64
    sigma_m: float
    depth_m: F32  # (8, 8), NaN where unknown or beyond the grid
    bgr: U8  # (8, 8, 3)


def tag_of(drone: str, scan: str) -> int:
    """The number that identifies a scan of a drone (:attr:`ScanHeader.name`) on the radio."""
    return zlib.crc32(f"{drone}/{scan}".encode())


def pack_announce(header: ScanHeader) -> bytes:
    """The announcement of a scan. Raises ValueError when the names are too long together."""
    drone, scan = header.drone.encode(), header.name.encode()
    if _ANNOUNCE.size + len(drone) + len(scan) > MAX_BYTES:
        raise ValueError(f"{header.drone}/{header.name} is too long for the radio")
    place = map(or_nan, (header.origin_lat_deg, header.origin_lon_deg, header.origin_alt_amsl_m))
    tag, started = tag_of(header.drone, header.name), header.started_unix_ns
    head = _ANNOUNCE.pack(ANNOUNCE, tag, started, *place, header.epsg or 0, len(drone))
    return head + drone + scan


def unpack_announce(data: bytes) -> ScanHeader | None:
    """The header that an announcement gives; None for anything else."""
    if not _ANNOUNCE.size < len(data) <= MAX_BYTES or data[0] != ANNOUNCE:
        return None
    _, tag, started, lat, lon, alt, epsg, length = _ANNOUNCE.unpack_from(data)
    try:
        names = data[_ANNOUNCE.size :].decode("ascii")
    except UnicodeDecodeError:
        return None
    drone, scan = names[:length], names[length:]
    if not (NAME.fullmatch(drone) and NAME.fullmatch(scan)) or tag_of(drone, scan) != tag:
        return None
    place = (or_none(lat), or_none(lon), or_none(alt))
    if started < 0 or not is_time(started) or not is_on_globe(*place):
        return None
    scan_id, run_id = split_scan_name(scan)
    return ScanHeader(
        scan_id,
        drone,
        started,
        *place,
        epsg=epsg or None,
        georeference="none" if math.isnan(lat) else "gnss",
        notes=(RADIO_NOTE,),
        run_id=run_id,
    )


def pack_pose(tag: int, number: int, pose: PoseRecord) -> bytes:
    """A pose, rounded to a centimetre and 3e-5."""
    lat, lon = or_nan(pose.lat_deg), or_nan(pose.lon_deg)
    no_fix = math.isnan(lat) or math.isnan(lon)
    place = [_NO_FIX if no_fix else round(angle * 1e7) for angle in (lat, lon)]
    sigma_cm, speed_cm_s = (
        min(65535, round(v * _METRE_CM)) for v in (pose.sigma_m, pose.speed_m_s)
    )
    return _POSE.pack(
        POSE,
        tag,
        number,
        pose.time_unix_ns,
        *_place(pose.T_world_camera),
        *place,
        or_nan(pose.alt_amsl_m),
        sigma_cm,
        source_bits(pose.sources),
        speed_cm_s,
    )


def unpack_pose(data: bytes) -> tuple[int, int, PoseRecord] | None:
    """Tag, number and pose; None for anything else."""
    data = _extended(data, _POSE.size)
    if len(data) != _POSE.size or data[0] != POSE:
        return None
    _, tag, number, time_unix_ns, *place, lat, lon, alt, sigma_cm, bits, speed_cm_s = _POSE.unpack(
        data
    )
    T = _motion(place)
    no_fix = lat == _NO_FIX
    lat_deg, lon_deg = (None, None) if no_fix else (lat * 1e-7, lon * 1e-7)
    alt_m, sigma_m = or_none(alt), sigma_cm / _METRE_CM
    if T is None or not is_time(time_unix_ns):
        return None
    if not no_fix and not is_on_globe(lat_deg, lon_deg, alt_m):
        return None
    pose = PoseRecord(
        time_unix_ns,
        T,
        np.diag([1e-4] * 3 + [sigma_m**2] * 3),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=alt_m,
        sources=sources_of(bits),
        sigma_m=sigma_m,
        speed_m_s=speed_cm_s / _METRE_CM,
    )
    return tag, number, pose


def pack_tile(tag: int, tile: RadioTile) -> bytes:
    """A tile. Raises ValueError when it has no known cell or the grid is beyond 255 px."""
    known = np.isfinite(tile.depth_m)
    w, h = tile.grid_px
    if not known.any() or max(w, h) > 255:
        raise ValueError(f"no tile of a {w}x{h} grid with {known.sum()} known cells")
    near = max(1, math.floor(float(np.nanmin(tile.depth_m)) / _DEPTH_UNIT_M))
    far = min(65535, max(near + 1, math.ceil(float(np.nanmax(tile.depth_m)) / _DEPTH_UNIT_M)))
    low, high = 1.0 / (far * _DEPTH_UNIT_M), 1.0 / (near * _DEPTH_UNIT_M)
    inverse = 1.0 / np.where(known, tile.depth_m, 1.0).astype(np.float64)
    codes = np.rint((inverse - low) / (high - low) * _LEVELS) + 1
    codes = np.where(known, np.clip(codes, 1, _LEVELS + 1), 0).astype(np.uint16)
    luma, cb, cr = _to_luma(tile.bgr, known)
    K = tile.K
    head = _TILE.pack(
        TILE,
        tag,
        tile.seq & 0xFFFF,
        tile.time_unix_ns // 1_000_000_000,
        w,
        h,
        tile.index,
        *_place(tile.T_world_camera),
        min(65535, round((K[0, 0] + K[1, 1]) / 2 / w * 8192)),
        round(min(max((K[0, 2] + 0.5) / w, 0.0), 1.0) * 65535),
        round(min(max((K[1, 2] + 0.5) / h, 0.0), 1.0) * 65535),
        near,
        far,
        int(sigma_codes(np.array(tile.sigma_m))),
        cb,
        cr,
    )
    return head + _ten_bits(codes.ravel() | luma.ravel() << 6)


def unpack_tile(data: bytes) -> tuple[int, RadioTile] | None:
    """Tag and tile; None for anything else."""
    size = _TILE.size + CELLS * CELLS * 10 // 8
    data = _extended(data, size)
    if len(data) != size or data[0] != TILE:
        return None
    _, tag, seq, unix_s, w, h, index, *rest = _TILE.unpack_from(data)
    T, (focal, x, y, near, far, sigma, cb, cr) = _motion(rest[:7]), rest[7:]
    if T is None or min(w, h, near, focal) == 0 or far <= near:
        return None
    if index >= -(-w // CELLS) * -(-h // CELLS):
        return None
    focal_px = focal / 8192 * w
    cx, cy = x / 65535 * w - 0.5, y / 65535 * h - 0.5
    if not is_pinhole((focal_px, focal_px, cx, cy), (w, h)):
        return None
    packed = _from_ten_bits(data[_TILE.size :])
    codes = (packed & np.uint16(63)).reshape(CELLS, CELLS)
    low, high = 1.0 / (far * _DEPTH_UNIT_M), 1.0 / (near * _DEPTH_UNIT_M)
    depth = 1.0 / (low + (codes - 1.0) * (high - low) / _LEVELS)
    tile = RadioTile(
        seq=seq,
        time_unix_ns=unix_s * 1_000_000_000,
        grid_px=(w, h),
        index=index,
        K=np.array([[focal_px, 0.0, cx], [0.0, focal_px, cy], [0.0, 0.0, 1.0]]),
        T_world_camera=T,
        sigma_m=float(SIGMA_M[sigma]),
        depth_m=np.where(codes > 0, depth, np.nan).astype(np.float32),
        bgr=_from_luma((packed >> np.uint16(6)).reshape(CELLS, CELLS), cb, cr),
    )
    return tag, tile


def _extended(data: bytes, size: int) -> bytes:
    """``data`` with the trailing zeros that MAVLink cut off."""
    return data + bytes(size - len(data)) if 0 < len(data) < size else data


def _place(T: F64) -> list[int]:
    """Position in cm and quaternion in 1/32767 of a (4, 4) motion."""
    motion = pack_motion(T)
    position_cm = [round(float(np.clip(v * _METRE_CM, -2e9, 2e9))) for v in motion[:3]]
    return position_cm + [round(v * _UNIT) for v in motion[3:]]


def _motion(place: Sequence[int]) -> F64 | None:
    """(4, 4) motion of what :func:`_place` gives; None for implausible values."""
    return unpack_motion([*(v / _METRE_CM for v in place[:3]), *(v / _UNIT for v in place[3:])])


def _to_luma(bgr: U8, known: Bool) -> tuple[U16, int, int]:
    """4-bit luma per cell and the tile's mean chroma (BT.601)."""
    b, g, r = (bgr[..., k].astype(np.float64) for k in range(3))
    y = 0.299 * r + 0.587 * g + 0.114 * b
    cb = float(np.mean((0.564 * (b - y))[known]))
    cr = float(np.mean((0.713 * (r - y))[known]))
    return (
        np.rint(y / 17).astype(np.uint16),
        round(min(max(cb, -127.0), 127.0)),
        round(min(max(cr, -127.0), 127.0)),
    )


def _from_luma(luma: U16, cb: int, cr: int) -> U8:
    y = luma.astype(np.float64) * 17.0
    b, r = y + cb / 0.564, y + cr / 0.713
    g = (y - 0.299 * r - 0.114 * b) / 0.587
    return np.asarray(np.clip(np.rint(np.stack([b, g, r], axis=-1)), 0, 255), np.uint8)


def _ten_bits(values: U16) -> bytes:
    """64 values of ten bits, most significant bit first."""
    bits = (values[:, None] >> np.arange(9, -1, -1)) & 1
    return np.packbits(bits.astype(np.uint8)).tobytes()


def _from_ten_bits(data: bytes) -> U16:
    bits = np.unpackbits(np.frombuffer(data, np.uint8)).reshape(-1, 10).astype(np.uint16)
    return np.asarray(bits @ (1 << np.arange(9, -1, -1)).astype(np.uint16), np.uint16)
