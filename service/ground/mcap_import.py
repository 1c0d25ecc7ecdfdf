"""A scan's store from the MCAP that an aircraft recorded or exported.

Reads what :mod:`service.offline.exports.recording` writes: points in the camera's frame become a
depth image again. Parts that an MCAP lacks (covariances of rotation, re-poses, the scan's settings)
stay at defaults, with a note.
"""

from __future__ import annotations

import logging
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon import se3
from recon.types import F64, U8, DepthMap, Keyframe, Pose
from service.errors import InputError
from service.ground.mcap_records import messages
from service.offline.exports.recording import POINT
from service.stream import codec
from service.stream.codec import MAX_PIXELS, MAX_SIDE_PX
from service.stream.naming import split_scan_name
from service.stream.planes import image_size
from service.stream.records import PoseRecord, ScanHeader, read_header
from service.stream.store import ScanStore
from service.stream.validity import MAX_SIGMA_M, is_pinhole, is_position

log = logging.getLogger(__name__)

HEADER = re.compile(r"scan (\S+) of (\S+), (.*), origin (\S+), (\S+), (\S+) m")
MAX_WAITING = 4
"""Keyframes of which something is missing: the recording has their parts one after the other."""
USED = ("/points", "/image", "/camera", "/pose", "/fix", "/log")
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
            fault = read_header(header.to_json())
            if isinstance(fault, str):
                raise InputError(f"{path}: its scan is invalid ({fault})")
            return header
    raise InputError(f"{path} is not a recording of a skyrelief scan")


def store_from_mcap(path: Path, out: Path) -> ScanStore:
    """A new store at ``out`` with the recording's keyframes and poses, open for reading.

    Keyframes whose points do not fit their camera are left out. Raises InputError for a file
    that is not ours or contains no keyframe, OutsideError without the ``mcap`` package.
    """
    store = ScanStore.create(out, header_in(path))
    try:
        waiting: dict[int, dict[str, Any]] = {}
        track = _Track(store)
        count = 0
        for topic, time_ns, message in messages(path, USED):
            if topic in ("/points", "/image", "/camera"):
                parts = waiting.setdefault(time_ns, {})
                parts[topic] = message
                if len(parts) == 3:
                    count += _add_keyframe(store, waiting.pop(time_ns), time_ns)
                elif len(waiting) > MAX_WAITING:
                    del waiting[next(iter(waiting))]
            elif topic in ("/pose", "/fix"):
                track.add(topic, time_ns, message)
        track.close()
        if not count:
            raise InputError(f"{path} contains no keyframe; nothing to import")
        store.finish({"keyframes": count, "source": "mcap"})
    except BaseException:
        store.close()
        raise
    return store


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
        self._now: dict[str, Any] = {}  # the messages of one time
        self._time_ns = 0
        self._before: tuple[int, F64] | None = None
        self._flown_m = 0.0

    def add(self, topic: str, time_ns: int, message: Any) -> None:
        """A pose or a fix; both of one time follow each other."""
        if time_ns != self._time_ns:
            self.close()
            self._time_ns = time_ns
        self._now[topic] = message

    def close(self) -> None:
        """Store what is complete."""
        message, fix = self._now.get("/pose"), self._now.get("/fix")
        self._now = {}
        T = None if message is None else _transform(message.pose)
        if T is None:
            return
        speed = 0.0
        if self._before is not None:
            step = float(np.linalg.norm(T[:3, 3] - self._before[1][:3, 3]))
            self._flown_m += step
            speed = step / max((self._time_ns - self._before[0]) / 1e9, 1e-3)
        self._before = (self._time_ns, T)
        own = UNKNOWN.copy()
        if fix is not None and len(fix.position_covariance) == 9:
            own[3:, 3:] = np.array(fix.position_covariance).reshape(3, 3)
        spread = float(np.sqrt(max(np.trace(own[3:, 3:]), 0.0)))
        record = PoseRecord(
            self._time_ns,
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
