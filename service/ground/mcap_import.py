"""A scan's store from the MCAP that an aircraft recorded or exported.

Reads what :mod:`service.offline.exports.recording` writes: points in the camera's frame become a
depth image again. Parts that an MCAP lacks (covariances of rotation, re-poses, the scan's settings)
stay at defaults, with a note.

The file may come from a stranger. The ``mcap`` package takes a chunk whole, whatever size its
compressed frame claims, and protobuf would build whatever classes the recording describes. Here
chunks are bounded before they are opened, and only the fields that are used are decoded, with
their published numbers.
"""

from __future__ import annotations

import io
import logging
import math
import re
import struct
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon import se3
from recon.types import F64, U8, DepthMap, Keyframe, Pose
from service.errors import InputError, refusing
from service.ground.storage import bounded
from service.offline.exports.recording import POINT
from service.packages import needing
from service.stream import codec
from service.stream.codec import MAX_PIXELS, MAX_SIDE_PX
from service.stream.naming import split_scan_name
from service.stream.planes import image_size
from service.stream.records import PoseRecord, ScanHeader, read_header
from service.stream.store import ScanStore
from service.stream.validity import MAX_SIGMA_M, MAX_TIME_NS, is_pinhole, is_position

log = logging.getLogger(__name__)

HEADER = re.compile(r"scan (\S+) of (\S+), (.*), origin (\S+), (\S+), (\S+) m")
MAX_WAITING = 4
"""Times whose messages are gathered: the recording has those of a keyframe one after the other."""
USED = ("/points", "/image", "/camera", "/pose", "/fix")
UNKNOWN = np.diag([0.1**2] * 3 + [1.0] * 3)
"""Covariance of turn (rad) and place (m), which the file lacks; a larger turn would hide the
position's in float32."""

NOTE = "imported from an MCAP: covariances of rotation and settings are not known"


def header_in(path: Path) -> ScanHeader:
    """The scan's header from the first log line; InputError when the file is not a scan of ours."""
    for topic, time_ns, message in messages(path, ("/log",)):
        found = HEADER.fullmatch(message.message) if topic == "/log" else None
        if found:
            scan, drone, software, *origin = found.groups()
            lat, lon, alt = (_number(text) for text in origin)
            scan_id, run_id = split_scan_name(scan)
            header = ScanHeader(
                scan_id,
                drone,
                time_ns,
                origin_lat_deg=lat,
                origin_lon_deg=lon,
                origin_alt_amsl_m=alt,
                software=software[:100],
                georeference="none" if lat is None else "gnss",
                notes=(NOTE,),
                run_id=run_id,
            )
            with refusing(f"{path}: its scan is invalid"):
                return read_header(header.to_json())
    raise InputError(f"{path} is not a recording of a skyrelief scan")


def store_from_mcap(path: Path, out: Path) -> ScanStore:
    """A new store at ``out`` with the recording's keyframes and poses, open for reading.

    Keyframes whose points do not fit their camera are left out. Raises InputError for a file
    that is not ours or contains no keyframe, OutsideError without the ``mcap`` package.
    """
    store = ScanStore.create(out, header_in(path))
    try:
        track, count = _Track(store), 0
        for time_ns, parts in _by_time(messages(path, USED)):
            if "/pose" in parts:
                track.add(time_ns, parts["/pose"], parts.get("/fix"))
            if parts.keys() >= {"/points", "/image", "/camera"}:
                count += _add_keyframe(store, parts, time_ns)
        if not count:
            raise InputError(f"{path} contains no keyframe; nothing to import")
        store.finish({"keyframes": count, "source": "mcap"})
    except BaseException:
        store.close()
        raise
    return store


def _by_time(
    found: Iterator[tuple[str, int, Any]],
) -> Iterator[tuple[int, dict[str, Any]]]:
    waiting: dict[int, dict[str, Any]] = {}
    for topic, time_ns, message in found:
        waiting.setdefault(time_ns, {})[topic] = message
        if len(waiting) > MAX_WAITING:
            first = next(iter(waiting))
            yield first, waiting.pop(first)
    yield from waiting.items()


def _add_keyframe(store: ScanStore, parts: dict[str, Any], time_ns: int) -> bool:
    """Store one keyframe; False when its parts do not fit together."""
    camera, points, image = parts["/camera"], parts["/points"], parts["/image"]
    seq = re.fullmatch(r"keyframe-(\d{1,9})", camera.frame_id)
    size = (camera.height, camera.width)
    is_size = 0 < size[0] <= MAX_SIDE_PX and 0 < size[1] <= MAX_SIDE_PX
    if seq is None or not is_size or size[0] * size[1] > MAX_PIXELS or len(camera.K) != 9:
        return False
    K = np.array(camera.K, np.float64).reshape(3, 3)
    if not is_pinhole((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), size[::-1]):
        return False
    if image_size(image.data) != size[::-1]:
        return False
    bgr = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    T = _transform(points.pose)
    usable = points.point_stride == POINT.itemsize and len(points.data) % POINT.itemsize == 0
    if T is None or bgr is None or bgr.shape[:2] != size or not usable:
        return False
    depth = _depth(np.frombuffer(points.data, POINT), K, size, T)
    number = int(seq.group(1))
    frame = Keyframe(
        number,
        time_ns,
        depth,
        np.asarray(bgr, np.uint8),
        Pose(T, se3.about(-T[:3, 3], UNKNOWN), ("vision",)),
        np.isfinite(depth.depth_m),
    )
    try:
        store.add_keyframe(number, codec.encode(frame, time_ns))
    except ValueError as error:  # such as a pose out of reach
        log.debug("keyframe %d: %s", number, error)
        return False
    return True


def _depth(points: Any, K: F64, size: tuple[int, int], T: F64) -> DepthMap:
    """The depth image whose pixels the points were."""
    xyz = points["xyz"].astype(np.float64)
    good = np.isfinite(xyz).all(axis=1) & (xyz[:, 2] > 1e-3)
    points, xyz = points[good], xyz[good]
    u = np.rint(xyz[:, 0] / xyz[:, 2] * K[0, 0] + K[0, 2])
    v = np.rint(xyz[:, 1] / xyz[:, 2] * K[1, 1] + K[1, 2])
    inside = (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])
    at = v[inside].astype(np.int64), u[inside].astype(np.int64)
    depth = np.full(size, np.nan, np.float32)
    sigma = np.full(size, np.nan, np.float32)
    views: U8 = np.zeros(size, np.uint8)
    depth[at], sigma[at] = xyz[inside, 2], points["sigma_m"][inside]
    views[at] = points["views"][inside]
    return DepthMap(depth, sigma, views, K, T)


class _Track:
    """The trajectory, with distance and speed from its positions, stored as it is read."""

    def __init__(self, store: ScanStore) -> None:
        self._store = store
        self._before: tuple[int, F64] | None = None
        self._flown_m = 0.0

    def add(self, time_ns: int, pose: Any, fix: Any) -> None:
        T = _transform(pose.pose)
        if T is None:
            return
        speed = 0.0
        if self._before is not None:
            step = float(np.linalg.norm(T[:3, 3] - self._before[1][:3, 3]))
            self._flown_m += step
            speed = step / max((time_ns - self._before[0]) / 1e9, 1e-3)
        self._before = (time_ns, T)
        own = UNKNOWN.copy()
        if fix is not None and len(fix.position_covariance) == 9:
            own[3:, 3:] = np.array(fix.position_covariance).reshape(3, 3)
        spread = float(np.sqrt(max(np.trace(own[3:, 3:]), 0.0)))
        record = PoseRecord(
            time_ns,
            T,
            se3.about(-T[:3, 3], own),
            speed_m_s=min(speed, 1e4),
            distance_m=self._flown_m,
            sources=("vision",),
            sigma_m=min(spread, MAX_SIGMA_M),
        )
        if fix is not None:
            place = {"lat_deg": fix.latitude, "lon_deg": fix.longitude, "alt_amsl_m": fix.altitude}
            record = replace(record, **place)
        self._store.add_pose(record)


def _transform(pose: Any) -> F64 | None:
    """(4, 4) of a Foxglove pose; None when it is none."""
    q = np.array([pose.orientation.w, pose.orientation.x, pose.orientation.y, pose.orientation.z])
    t = np.array([pose.position.x, pose.position.y, pose.position.z])
    length = float(np.linalg.norm(q))
    if not (is_position(t) and math.isfinite(length) and abs(length - 1.0) < 0.1):
        return None
    return se3.compose(se3.rotation_from_quaternion(q / length), t)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


SMALL_BYTES = 65_536
MAX_MESSAGE_BYTES = {
    "/points": MAX_PIXELS * POINT.itemsize + SMALL_BYTES,
    "/image": 1 << 24,
    "/camera": SMALL_BYTES,
    "/pose": SMALL_BYTES,
    "/fix": SMALL_BYTES,
    "/log": SMALL_BYTES,
}
"""Topics of a scan, and the maximum size of one message of each."""
MAX_RECORD_BYTES = MAX_MESSAGE_BYTES["/points"] + (1 << 20)
MAX_RATIO, FREE_BYTES = 200, 1 << 20
"""A chunk unpacks to so many times its size, or FREE_BYTES; floats of depth shrink ten times."""
MAX_CHANNELS = 4096

_DOUBLE, _FIXED32, _STRING, _MESSAGE, _BYTES = 1, 7, 9, 11, 12  # FieldDescriptorProto.Type
FIELDS: dict[str, list[tuple[str, int, int, str]]] = {
    "Vector3": [("x", 1, _DOUBLE, ""), ("y", 2, _DOUBLE, ""), ("z", 3, _DOUBLE, "")],
    "Quaternion": [(axis, n + 1, _DOUBLE, "") for n, axis in enumerate("xyzw")],
    "Pose": [("position", 1, _MESSAGE, "Vector3"), ("orientation", 2, _MESSAGE, "Quaternion")],
    "Log": [("message", 3, _STRING, "")],
    "PoseInFrame": [("pose", 3, _MESSAGE, "Pose")],
    "LocationFix": [
        ("latitude", 1, _DOUBLE, ""),
        ("longitude", 2, _DOUBLE, ""),
        ("altitude", 3, _DOUBLE, ""),
        ("position_covariance", 4, _DOUBLE, "repeated"),
    ],
    "PointCloud": [
        ("pose", 3, _MESSAGE, "Pose"),
        ("point_stride", 4, _FIXED32, ""),
        ("data", 6, _BYTES, ""),
    ],
    "CompressedImage": [("data", 2, _BYTES, "")],
    "CameraCalibration": [
        ("width", 2, _FIXED32, ""),
        ("height", 3, _FIXED32, ""),
        ("K", 6, _DOUBLE, "repeated"),
        ("frame_id", 9, _STRING, ""),
    ],
}
"""The fields of Foxglove's schemas that are read: name, number, type, and content."""


def messages(path: Path, topics: tuple[str, ...]) -> Iterator[tuple[str, int, Any]]:
    """(topic, time, message) in the order of the file; other topics are skipped.

    Raises InputError for a file that is not a valid MCAP or asks for more memory than a scan does,
    OutsideError without the ``mcap`` package.
    """
    with needing("an MCAP"):
        from google.protobuf.message import DecodeError
        from mcap.exceptions import McapError
        from mcap.records import Channel, Message, Schema
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}  # topic and schema of those that are read
    try:
        for record in _records(path):
            if isinstance(record, Schema) and record.encoding == "protobuf":
                schemas[record.id] = record.name.removeprefix("foxglove.")
            elif isinstance(record, Channel) and record.topic in topics:
                name = schemas.get(record.schema_id, "")
                if name in FIELDS:
                    channels[record.id] = record.topic, name
            elif isinstance(record, Message) and record.channel_id in channels:
                topic, name = channels[record.channel_id]
                if len(record.data) <= MAX_MESSAGE_BYTES[topic] and record.log_time <= MAX_TIME_NS:
                    yield topic, record.log_time, _classes()[name].FromString(record.data)
            if len(schemas) > MAX_CHANNELS or len(channels) > MAX_CHANNELS:
                raise InputError(f"{path} has more channels than a scan's recording")
    except (McapError, DecodeError, struct.error, EOFError, MemoryError, *_BROKEN) as error:
        raise InputError(f"{path} is not a valid MCAP ({type(error).__name__})") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error})") from error


_BROKEN = (ValueError, LookupError, TypeError, ArithmeticError, AttributeError, RuntimeError)


def _records(path: Path) -> Iterator[Any]:
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    with open(path, "rb") as file:
        reader = StreamReader(
            bounded(file, MAX_RECORD_BYTES, "a record"),
            emit_chunks=True,
            record_size_limit=MAX_RECORD_BYTES,
        )
        for record in reader.records:
            if isinstance(record, Chunk):
                yield from _in_chunk(record)
            else:
                yield record


def _in_chunk(chunk: Any) -> Iterator[Any]:
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Message, Schema

    data = _unpacked(chunk)
    stream = ReadDataStream(io.BytesIO(data))
    while stream.count < len(data):
        opcode, length = stream.read1(), stream.read8()
        if length > len(data) - stream.count:
            raise ValueError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(length)


def _unpacked(chunk: Any) -> bytes:
    """Contents of a chunk. Raises ValueError when its size is wrong or too large."""
    if not chunk.compression:
        return bytes(chunk.data)
    size = chunk.uncompressed_size
    if size > min(MAX_RECORD_BYTES, FREE_BYTES + MAX_RATIO * len(chunk.data)):
        raise ValueError(f"a chunk of {len(chunk.data)} bytes claims to hold {size}")
    if chunk.compression == "zstd":
        import zstandard

        opened = zstandard.ZstdDecompressor(max_window_size=1 << 27)
        try:
            data = opened.stream_reader(io.BytesIO(chunk.data)).read(size + 1)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
    elif chunk.compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        raise ValueError(f"compression {chunk.compression[:20]!r}")
    if len(data) != size:
        raise ValueError(f"a chunk holds other than the {size} bytes it claims")
    return bytes(data)


@cache
def _classes() -> dict[str, Any]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="scan.proto", package="scan", syntax="proto3")
    for name, fields in FIELDS.items():
        message = file.message_type.add(name=name)
        for field, number, kind, holds in fields:
            one = message.field.add(name=field, number=number, type=kind)
            one.label = 3 if holds == "repeated" else 1  # LABEL_REPEATED, LABEL_OPTIONAL
            if kind == _MESSAGE:
                one.type_name = f".scan.{holds}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"scan.{name}"))
        for name in FIELDS
    }
