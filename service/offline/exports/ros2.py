"""A scan's keyframes and poses as ROS 2 messages in CDR, for a recording.

Frames follow REP-105 and REP-103: ``map`` is ENU metres about the scan's origin,
``camera_optical`` looks along z with x right and y down. A keyframe's points are in
``camera_optical`` at the keyframe's time, so that a later transform of that time corrects them.

Topics: ``/tf`` TFMessage, and below ``/camera``: ``points`` PointCloud2, ``image/compressed``
CompressedImage, ``camera_info`` CameraInfo (of the image, without distortion), ``fix`` NavSatFix
(altitude AMSL).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from recon import se3
from recon.types import F64, U8, Keyframe
from service.offline.exports.recording import POINT, in_order, jpeg, known_points, mcap_file
from service.offline.exports.view import ExportOptions, ScanView
from service.scans.main_piece import main_keyframes
from service.scans.writing import writing
from service.stream.codec import whole_bgr
from service.stream.records import PoseRecord

MAX_STAMP_NS = (1 << 31) * 10**9 - 1
"""Seconds of a ROS 2 time are an int32."""
UINT8, UINT32, FLOAT32 = 2, 6, 7  # PointField
FIELDS = (
    ("x", 0, FLOAT32),
    ("y", 4, FLOAT32),
    ("z", 8, FLOAT32),
    ("rgba", 12, UINT32),
    ("sigma_m", 16, FLOAT32),
    ("views", 20, UINT8),
)
"""Name, offset and type of the parts of POINT."""


MAP, CAMERA = "map", "camera_optical"
TOPICS = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/camera/points": "sensor_msgs/msg/PointCloud2",
    "/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
    "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
    "/camera/fix": "sensor_msgs/msg/NavSatFix",
}

Message = tuple[int, str, tuple[Any, ...]]
"""Unix time in ns, topic, and the fields of the message."""


def write_ros2(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The scan's main piece as an MCAP of ROS 2 messages, in order of time."""
    types = _types()
    with writing(out) as part, mcap_file(part, "ros2") as context:
        import foxglove

        channels = {}
        for topic, kind in TOPICS.items():
            text, _ = types.generate_msgdef(kind, ros_version=2)
            schema = foxglove.Schema(name=kind, encoding="ros2msg", data=text.encode())
            channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=context
            )
        for time_ns, topic, fields in _messages(scan):
            data = types.serialize_cdr(_new(TOPICS[topic], *fields), TOPICS[topic])
            channels[topic].log(bytes(data), log_time=min(max(time_ns, 0), MAX_STAMP_NS))


def _messages(scan: ScanView) -> Iterator[Message]:
    placed_ns = None  # the last keyframe, which has its own transform
    for item in in_order(main_keyframes(scan.store), scan.poses):
        if isinstance(item, Keyframe):
            placed_ns = item.time_ns
            yield _transform(item.depth.T_world_camera, placed_ns)
            yield from _of_keyframe(item, whole_bgr(item, scan.store.image(item.seq)))
            continue
        if item.time_unix_ns != placed_ns:
            yield _transform(item.T_world_camera, item.time_unix_ns)
        if item.lat_deg is not None and item.lon_deg is not None:
            yield _fix(item)


def _transform(T_map_camera: F64, time_ns: int) -> Message:
    """The camera's pose, (4, 4) m, at a time."""
    w, x, y, z = (float(v) for v in se3.quaternion_from_rotation(T_map_camera[:3, :3]))
    transform = _new(
        "geometry_msgs/msg/TransformStamped",
        _header(MAP, time_ns),
        CAMERA,
        _new(
            "geometry_msgs/msg/Transform",
            _new("geometry_msgs/msg/Vector3", *T_map_camera[:3, 3].tolist()),
            _new("geometry_msgs/msg/Quaternion", x, y, z, w),
        ),
    )
    return time_ns, "/tf", ([transform],)


def _fix(pose: PoseRecord) -> Message:
    """Where the camera was on the globe."""
    return pose.time_unix_ns, "/camera/fix", (
        _header(CAMERA, pose.time_unix_ns),
        _new("sensor_msgs/msg/NavSatStatus", 0, 1),  # a fix, of GPS
        pose.lat_deg,
        pose.lon_deg,
        np.nan if pose.alt_amsl_m is None else pose.alt_amsl_m,
        pose.position_covariance.ravel(),
        3,  # the covariance is known
    )  # fmt: skip


def _of_keyframe(keyframe: Keyframe, bgr: U8) -> Iterator[Message]:
    """The keyframe's points, its image ``bgr`` and camera."""
    time_ns, depth = keyframe.time_ns, keyframe.depth
    header, points = _header(CAMERA, time_ns), known_points(keyframe)
    fields = [_new("sensor_msgs/msg/PointField", *field, 1) for field in FIELDS]
    size, row = POINT.itemsize, points.size * POINT.itemsize
    yield time_ns, "/camera/points", (
        header, 1, points.size, fields, False, size, row, points.view(np.uint8), True,
    )  # fmt: skip
    yield time_ns, "/camera/image/compressed", (header, "jpeg", jpeg(bgr))
    K = np.ascontiguousarray(depth.K, np.float64)
    P = np.column_stack([K, np.zeros(3)])
    whole = _new("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    yield time_ns, "/camera/camera_info", (
        header, *depth.depth_m.shape, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(),
        P.ravel(), 0, 0, whole,
    )  # fmt: skip


@cache
def _types() -> Any:
    """Definitions and serializers of the messages."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _new(kind: str, *parts: Any) -> Any:
    return _types().types[kind](*parts)


def _header(frame: str, time_ns: int) -> Any:
    second, rest = divmod(min(max(time_ns, 0), MAX_STAMP_NS), 10**9)
    return _new("std_msgs/msg/Header", _new("builtin_interfaces/msg/Time", second, rest), frame)
