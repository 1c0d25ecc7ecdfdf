"""A scan's store from the MCAP that an aircraft recorded or exported.

Reads what :mod:`service.stream.mcap_export` writes: points in the camera's frame become the
depth image again that they came from. What an MCAP does not hold (covariances of rotation,
re-poses, the scan's settings) is left at defaults and said in a note.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon import se3
from recon.types import F64, U8, DepthMap, Keyframe, Pose
from service.errors import InputError
from service.packages import needing
from service.stream import codec
from service.stream.mcap_export import POINT
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore

HEADER = re.compile(r"scan (\S+) of (\S+), (.*), origin (\S+), (\S+), (\S+) m")
MOST_PIXELS = 4096 * 4096
USED = ("/points", "/image", "/camera", "/pose", "/fix", "/log")
NOTE = "imported from an MCAP: covariances of rotation and settings are not known"


def header_in(path: Path) -> ScanHeader:
    """The scan's header from the first log line; InputError when the file is no scan of ours."""
    for topic, time_ns, message in _messages(path, ("/log",)):
        found = HEADER.fullmatch(message.message) if topic == "/log" else None
        if found:
            scan, drone, software, *origin = found.groups()
            lat, lon, alt = (_number(text) for text in origin)
            return ScanHeader(
                scan,
                drone,
                time_ns,
                origin_lat_deg=lat,
                origin_lon_deg=lon,
                origin_alt_amsl_m=alt,
                software=software[:100],
                georeference="none" if lat is None else "gnss",
                notes=(NOTE,),
            )
    raise InputError(f"{path} is no recording of a skyrelief scan")


def store_from_mcap(path: Path, out: Path) -> ScanStore:
    """A new store at ``out`` with the recording's keyframes and poses, open for reading.

    Keyframes whose points do not fit their camera are left out. Raises InputError for a file
    that is not ours or holds no keyframe, OutsideError without the ``mcap`` package.
    """
    store = ScanStore.create(out, header_in(path))
    try:
        waiting: dict[int, dict[str, Any]] = {}
        poses: dict[int, dict[str, Any]] = {}
        count = 0
        for topic, time_ns, message in _messages(path, USED):
            if topic in ("/points", "/image", "/camera"):
                parts = waiting.setdefault(time_ns, {})
                parts[topic] = message
                if len(parts) == 3:
                    count += _add_keyframe(store, waiting.pop(time_ns), time_ns)
            elif topic in ("/pose", "/fix"):
                poses.setdefault(time_ns, {})[topic] = message
        _add_poses(store, poses)
        if not count:
            raise InputError(f"{path} holds no keyframe; nothing to import")
        store.finish({"keyframes": count, "source": "mcap"})
    except BaseException:
        store.close()
        raise
    return store


def _messages(path: Path, topics: tuple[str, ...]) -> Iterator[tuple[str, int, Any]]:
    """(topic, time, decoded message) in order of time."""
    with needing("an MCAP"):
        from google.protobuf.message import DecodeError
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    classes: dict[int, Any] = {}
    try:
        with open(path, "rb") as file:
            for schema, channel, message in make_reader(file).iter_messages(topics=list(topics)):
                if schema is None or schema.encoding != "protobuf":
                    continue
                if schema.id not in classes:
                    classes[schema.id] = _message_class(schema)
                decoded = classes[schema.id].FromString(message.data)
                yield channel.topic, message.log_time, decoded
    except (
        McapError,
        DecodeError,
        struct.error,
        ValueError,
        KeyError,
        TypeError,
        EOFError,
    ) as error:
        raise InputError(f"{path} is no sound MCAP ({type(error).__name__})") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error})") from error


def _message_class(schema: Any) -> Any:
    """A message class made from the descriptors that the recording itself carries."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    waiting = list(descriptor_pb2.FileDescriptorSet.FromString(schema.data).file)
    for _ in range(len(waiting) ** 2):  # a file comes after those that it imports
        if not waiting:
            break
        file = waiting.pop(0)
        try:
            pool.Add(file)
        except TypeError:
            waiting.append(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def _add_keyframe(store: ScanStore, parts: dict[str, Any], time_ns: int) -> bool:
    """Store one keyframe; False when its parts do not fit together."""
    camera, points, image = parts["/camera"], parts["/points"], parts["/image"]
    seq = re.fullmatch(r"keyframe-(\d{1,9})", camera.frame_id)
    size = (camera.height, camera.width)
    if seq is None or not 0 < size[0] * size[1] <= MOST_PIXELS or len(camera.K) != 9:
        return False
    K = np.array(camera.K, np.float64).reshape(3, 3)
    bgr = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    T = _transform(points.pose)
    usable = points.point_stride == POINT.itemsize and len(points.data) % POINT.itemsize == 0
    if T is None or bgr is None or bgr.shape[:2] != size or not usable or K[0, 0] <= 0:
        return False
    depth = _depth(np.frombuffer(points.data, POINT), K, size, T)
    number = int(seq.group(1))
    frame = Keyframe(
        number,
        time_ns,
        depth,
        np.asarray(bgr, np.uint8),
        Pose(T, np.eye(6), ("vision",)),
        np.isfinite(depth.depth_m),
    )
    store.add_keyframe(number, codec.encode(frame, time_ns))
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


def _add_poses(store: ScanStore, poses: dict[int, dict[str, Any]]) -> None:
    """The trajectory, with distance and speed from its positions."""
    flown, before = 0.0, None
    for time_ns in sorted(poses):
        message, fix = poses[time_ns].get("/pose"), poses[time_ns].get("/fix")
        T = None if message is None else _transform(message.pose)
        if T is None:
            continue
        speed = 0.0
        if before is not None:
            step = float(np.linalg.norm(T[:3, 3] - before[1][:3, 3]))
            flown += step
            speed = step / max((time_ns - before[0]) / 1e9, 1e-3)
        before = (time_ns, T)
        covariance = np.eye(6)
        if fix is not None and len(fix.position_covariance) == 9:
            covariance[3:, 3:] = np.array(fix.position_covariance).reshape(3, 3)
        spread = float(np.sqrt(max(np.trace(covariance[3:, 3:]) / 3.0, 0.0)))
        record = PoseRecord(
            time_ns,
            T,
            covariance,
            speed_m_s=min(speed, 1e4),
            distance_m=flown,
            sources=("vision",),
            sigma_m=spread,
        )
        if fix is not None:
            place = {"lat_deg": fix.latitude, "lon_deg": fix.longitude, "alt_amsl_m": fix.altitude}
            record = replace(record, **place)
        store.add_pose(record)


def _transform(pose: Any) -> F64 | None:
    """(4, 4) of a Foxglove pose; None when it is none."""
    q = np.array([pose.orientation.w, pose.orientation.x, pose.orientation.y, pose.orientation.z])
    t = np.array([pose.position.x, pose.position.y, pose.position.z])
    length = float(np.linalg.norm(q))
    if not (np.isfinite(t).all() and math.isfinite(length) and abs(length - 1.0) < 0.1):
        return None
    return se3.compose(se3.rotation_from_quaternion(q / length), t)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
