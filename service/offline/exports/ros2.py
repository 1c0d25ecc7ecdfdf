"""A scan's keyframes and poses as ROS 2 messages in CDR, for a recording.

Frames follow REP-105 and REP-103: ``map`` is ENU metres about the scan's origin,
``camera_optical`` looks along z with x right and y down. A keyframe's points are in
``camera_optical`` at the keyframe's time, so that a later transform of that time corrects them.

Topics: ``/tf`` TFMessage, and below ``/camera``: ``points`` PointCloud2, ``image/compressed``
CompressedImage, ``camera_info`` CameraInfo (of the image, without distortion), ``fix`` NavSatFix
(altitude AMSL).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon import se3
from recon.types import F64, U8, Keyframe
from service.offline.exports.recording import JPEG_QUALITY, POINT, in_order, known_points, mcap_file
from service.offline.exports.view import ExportOptions, ScanView
from service.scans.main_piece import main_keyframes
from service.scans.writing import writing
from service.stream.images import whole_bgr
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


class Ros2Channels:
    """Channels of one camera in ``context``, which a file reads."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._tf = self._channel("/tf", "tf2_msgs/msg/TFMessage")
        self._points = self._channel("points", "sensor_msgs/msg/PointCloud2")
        self._image = self._channel("image/compressed", "sensor_msgs/msg/CompressedImage")
        self._info = self._channel("camera_info", "sensor_msgs/msg/CameraInfo")
        self._fix = self._channel("fix", "sensor_msgs/msg/NavSatFix")

    def _channel(self, topic: str, kind: str) -> tuple[Any, str]:
        import foxglove

        text, _ = _types().generate_msgdef(kind, ros_version=2)
        topic = topic if topic.startswith("/") else f"/camera/{topic}"
        schema = foxglove.Schema(name=kind, encoding="ros2msg", data=text.encode())
        channel = foxglove.Channel(
            topic, schema=schema, message_encoding="cdr", context=self._context
        )
        return channel, kind

    def log_transform(self, T_map_camera: F64, time_ns: int) -> None:
        """The camera's pose, (4, 4) m, at a time."""
        w, x, y, z = (float(v) for v in se3.quaternion_from_rotation(T_map_camera[:3, :3]))
        e, n, u = (float(v) for v in T_map_camera[:3, 3])
        transform = _new(
            "geometry_msgs/msg/TransformStamped",
            _header(MAP, time_ns),
            CAMERA,
            _new(
                "geometry_msgs/msg/Transform",
                _new("geometry_msgs/msg/Vector3", e, n, u),
                _new("geometry_msgs/msg/Quaternion", x, y, z, w),
            ),
        )
        _log(self._tf, time_ns, [transform])

    def log_fix(self, pose: PoseRecord) -> None:
        """Where the camera was on the globe; nothing for a pose without a georeference."""
        if pose.lat_deg is None or pose.lon_deg is None:
            return
        _log(
            self._fix,
            pose.time_unix_ns,
            _header(CAMERA, pose.time_unix_ns),
            _new("sensor_msgs/msg/NavSatStatus", 0, 1),  # a fix, of GPS
            pose.lat_deg,
            pose.lon_deg,
            np.nan if pose.alt_amsl_m is None else pose.alt_amsl_m,
            pose.position_covariance.ravel(),
            3,  # the covariance is known
        )

    def log_keyframe(self, keyframe: Keyframe, bgr: U8) -> None:
        """The keyframe's pose, points, its image ``bgr`` and camera."""
        time_ns, depth = keyframe.time_ns, keyframe.depth
        header = _header(CAMERA, time_ns)
        self.log_transform(depth.T_world_camera, time_ns)
        points = known_points(keyframe)
        fields = [_new("sensor_msgs/msg/PointField", *field, 1) for field in FIELDS]
        size = points.size * POINT.itemsize
        data = points.view(np.uint8)
        _log(
            self._points, time_ns, header, 1, points.size, fields, False, POINT.itemsize, size,
            data, True,
        )  # fmt: skip
        _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        _log(self._image, time_ns, header, "jpeg", jpeg.ravel())
        K = np.ascontiguousarray(depth.K, np.float64)
        P = np.hstack([K, np.zeros((3, 1))])
        whole = _new("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        _log(
            self._info, time_ns, header, *depth.depth_m.shape, "plumb_bob", np.zeros(5),
            K.ravel(), np.eye(3).ravel(), P.ravel(), 0, 0, whole,
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


def _log(to: tuple[Any, str], time_ns: int, *parts: Any) -> None:
    channel, kind = to
    data = _types().serialize_cdr(_new(kind, *parts), kind)
    channel.log(bytes(data), log_time=min(max(time_ns, 0), MAX_STAMP_NS))


def write_ros2(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The scan's main piece as an MCAP of ROS 2 messages, in order of time."""
    _types()
    with writing(out) as part, mcap_file(part, "ros2") as context:
        channels = Ros2Channels(context)
        placed_ns = None  # the last keyframe, which has its own transform
        for item in in_order(main_keyframes(scan.store), scan.poses):
            if isinstance(item, Keyframe):
                channels.log_keyframe(item, whole_bgr(item, scan.store.image(item.seq)))
                placed_ns = item.time_ns
                continue
            if item.time_unix_ns != placed_ns:
                channels.log_transform(item.T_world_camera, item.time_unix_ns)
            channels.log_fix(item)
