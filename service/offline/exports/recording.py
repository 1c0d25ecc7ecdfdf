"""The scan as an MCAP recording with Foxglove schemas, for Foxglove and its like.

Topics: ``/pose`` PoseInFrame, ``/fix`` LocationFix, ``/tf`` FrameTransform, ``/points``
PointCloud, ``/image`` CompressedImage, ``/camera`` CameraCalibration, ``/log`` Log. Frame
``world`` is ENU metres about the scan's origin. Chunks are 64 KiB and unbuffered, so that a
process that is killed has written what it logged.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon import se3
from recon.types import F64, U8, Keyframe
from service.errors import InputError
from service.offline.exports.view import ExportOptions, ScanView
from service.packages import needing
from service.scans.writing import writing
from service.stream.images import whole_bgr
from service.stream.records import PoseRecord
from service.stream.store import ScanStore

CHUNK_BYTES = 65_536
JPEG_QUALITY = 85
POINT = np.dtype([("xyz", "<f4", 3), ("bgra", "u1", 4), ("sigma_m", "<f4"), ("views", "u1")])


def export_mcap(store: ScanStore, out_path: Path) -> int:
    """Write ``store`` to ``out_path``, in order of time; how many messages that makes.

    Raises OutsideError without the ``foxglove-sdk`` package, InputError when the file cannot
    be written.
    """
    with mcap_file(out_path) as context:
        recording = _Recording(context)
        recording.log_header(store)
        for item in in_order(store.poses(), store.keyframes()):
            if isinstance(item, PoseRecord):
                recording.log_pose(item)
            else:
                recording.log_keyframe(item, whole_bgr(item, store.image(item.seq)))
        recording.log_summary(store)
    return recording.messages


@contextmanager
def mcap_file(path: Path, profile: str = "") -> Iterator[Any]:
    """A Foxglove context whose channels are written to an MCAP; errors as of export_mcap."""
    with needing("an MCAP"):
        import foxglove
        from foxglove.mcap import MCAPWriteOptions
    context = foxglove.Context()
    options = MCAPWriteOptions(chunk_size=CHUNK_BYTES, profile=profile)
    try:
        writer = foxglove.open_mcap(
            path, allow_overwrite=True, context=context, writer_options=options
        )
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path} cannot be written: {error}") from error
    with writer:
        yield context


def in_order(*streams: Iterable[PoseRecord | Keyframe]) -> Iterator[PoseRecord | Keyframe]:
    """All by time, of one time those of the first stream first; one of each is in memory."""
    return heapq.merge(*streams, key=_time_ns)


def _time_ns(item: PoseRecord | Keyframe) -> int:
    return item.time_unix_ns if isinstance(item, PoseRecord) else item.time_ns


class _Recording:
    """Channels of one MCAP."""

    def __init__(self, context: Any) -> None:
        from foxglove import channels

        self.messages = 0
        self._last_ns = 0
        self._pose = channels.PoseInFrameChannel("/pose", context=context)
        self._fix = channels.LocationFixChannel("/fix", context=context)
        self._tf = channels.FrameTransformChannel("/tf", context=context)
        self._points = channels.PointCloudChannel("/points", context=context)
        self._image = channels.CompressedImageChannel("/image", context=context)
        self._camera = channels.CameraCalibrationChannel("/camera", context=context)
        self._log = channels.LogChannel("/log", context=context)

    def _write(self, channel: Any, message: Any, time_ns: int) -> None:
        channel.log(message, log_time=max(time_ns, 0))
        self.messages += 1
        self._last_ns = max(self._last_ns, time_ns)

    def _say(self, text: str, time_ns: int) -> None:
        from foxglove import messages

        log = messages.Log(
            timestamp=_stamp(time_ns), level=messages.LogLevel.Info, message=text, name="skyrelief"
        )
        self._write(self._log, log, time_ns)

    def log_header(self, store: ScanStore) -> None:
        """Write a line that names the scan, and its notes."""
        header = store.header
        origin = f"{header.origin_lat_deg}, {header.origin_lon_deg}, {header.origin_alt_amsl_m} m"
        text = f"scan {header.name} of {header.drone}, {header.software}, origin {origin}"
        for line in (text, *header.notes):
            self._say(line, header.started_unix_ns)

    def log_summary(self, store: ScanStore) -> None:
        if store.summary is not None:
            self._say(f"finished: {store.summary}", self._last_ns)

    def log_pose(self, pose: PoseRecord) -> None:
        """Where the camera was, in the world and on the globe."""
        from foxglove import messages

        time_ns = pose.time_unix_ns
        stamp = _stamp(time_ns)
        T = pose.T_world_camera
        self._write(
            self._pose,
            messages.PoseInFrame(timestamp=stamp, frame_id="world", pose=_pose(T)),
            time_ns,
        )
        position, rotation = _parts(T)
        self._write(
            self._tf,
            messages.FrameTransform(
                timestamp=stamp,
                parent_frame_id="world",
                child_frame_id="camera",
                translation=position,
                rotation=rotation,
            ),
            time_ns,
        )
        if pose.lat_deg is None or pose.lon_deg is None:
            return
        fix = messages.LocationFix(
            timestamp=stamp,
            frame_id="camera",
            latitude=pose.lat_deg,
            longitude=pose.lon_deg,
            altitude=pose.alt_amsl_m or 0.0,
            position_covariance=[float(v) for v in pose.position_covariance.ravel()],
            position_covariance_type=messages.LocationFixPositionCovarianceType.Known,
        )
        self._write(self._fix, fix, time_ns)

    def log_keyframe(self, keyframe: Keyframe, bgr: U8) -> None:
        """The keyframe's points, its image ``bgr`` and camera."""
        import cv2
        from foxglove import messages

        time_ns = keyframe.time_ns
        stamp = _stamp(time_ns)
        frame_id = f"keyframe-{keyframe.seq}"
        self._write(self._points, _points(keyframe, stamp), time_ns)
        _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        image = messages.CompressedImage(
            timestamp=stamp, frame_id=frame_id, data=jpeg.tobytes(), format="jpeg"
        )
        self._write(self._image, image, time_ns)
        h, w = keyframe.depth.depth_m.shape
        K = [float(v) for v in keyframe.depth.K.ravel()]
        camera = messages.CameraCalibration(
            timestamp=stamp,
            frame_id=frame_id,
            width=w,
            height=h,
            K=K,
            P=[*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0],
            R=[float(v) for v in np.eye(3).ravel()],
        )
        self._write(self._camera, camera, time_ns)


def known_points(keyframe: Keyframe) -> NDArray[np.void]:
    """The known pixels as (N,) of POINT in the camera's frame."""
    depth = keyframe.depth
    v, u = np.nonzero(np.isfinite(depth.depth_m))
    z = depth.depth_m[v, u]
    points = np.zeros(z.size, POINT)
    points["xyz"][:, 0] = (u - depth.K[0, 2]) / depth.K[0, 0] * z
    points["xyz"][:, 1] = (v - depth.K[1, 2]) / depth.K[1, 1] * z
    points["xyz"][:, 2] = z
    points["bgra"][:, :3] = keyframe.bgr[v, u]
    points["bgra"][:, 3] = 255
    points["sigma_m"] = depth.sigma_m[v, u]
    points["views"] = depth.views[v, u]
    return points


def _points(keyframe: Keyframe, stamp: Any) -> Any:
    """The keyframe's points, placed by the camera's pose."""
    from foxglove.messages import PackedElementField, PackedElementFieldNumericType, PointCloud

    real, byte = PackedElementFieldNumericType.Float32, PackedElementFieldNumericType.Uint8
    fields = [
        PackedElementField(name=name, offset=offset, type=kind)
        for name, offset, kind in (
            ("x", 0, real),
            ("y", 4, real),
            ("z", 8, real),
            ("blue", 12, byte),
            ("green", 13, byte),
            ("red", 14, byte),
            ("alpha", 15, byte),
            ("sigma_m", 16, real),
            ("views", 20, byte),
        )
    ]
    return PointCloud(
        timestamp=stamp,
        frame_id="world",
        pose=_pose(keyframe.depth.T_world_camera),
        point_stride=POINT.itemsize,
        fields=fields,
        data=known_points(keyframe).tobytes(),
    )


def _stamp(time_ns: int) -> Any:
    from foxglove.messages import Timestamp

    time_ns = max(time_ns, 0)  # the format has no time before 1970
    return Timestamp(time_ns // 1_000_000_000, time_ns % 1_000_000_000)


def _parts(T: F64) -> tuple[Any, Any]:
    from foxglove.messages import Quaternion, Vector3

    w, x, y, z = (float(v) for v in se3.quaternion_from_rotation(T[:3, :3]))
    return (
        Vector3(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3])),
        Quaternion(x=x, y=y, z=z, w=w),
    )


def _pose(T: F64) -> Any:
    from foxglove.messages import Pose

    position, orientation = _parts(T)
    return Pose(position=position, orientation=orientation)


def write_mcap(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """Keyframes, poses and corrections of the store as MCAP."""
    with writing(out) as part:
        export_mcap(scan.store, part)
