"""The scan as an MCAP recording with Foxglove schemas, for Foxglove and its like.

Topics: ``/pose`` PoseInFrame, ``/fix`` LocationFix, ``/tf`` FrameTransform, ``/points``
PointCloud, ``/image`` CompressedImage, ``/camera`` CameraCalibration, ``/log`` Log. Frame
``world`` is ENU metres about the scan's origin. Where the recording is there, ``/frame``
CompressedImage and ``/frame/camera`` CameraCalibration are the keyframes' frames at full size,
without distortion. Chunks are 64 KiB and unbuffered, so that a process that is killed has written
what it logged.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from recon import se3
from recon.camera_model import Undistorter
from recon.types import F64, U8, Keyframe
from service.errors import InputError, SkyreliefError
from service.offline.exports.images import frames_at, recording_for
from service.offline.exports.view import ExportOptions, ScanView
from service.packages import needing
from service.scans.track import camera_of
from service.scans.writing import writing
from service.stream.codec import whole_bgr
from service.stream.records import PoseRecord
from service.stream.store import ScanStore

CHUNK_BYTES = 65_536
JPEG_QUALITY = 85
FRAME_TOPIC, FRAME_CAMERA_TOPIC = "/frame", "/frame/camera"
POINT = np.dtype([("xyz", "<f4", 3), ("bgra", "u1", 4), ("sigma_m", "<f4"), ("views", "u1")])


TOPICS = {
    "PoseInFrame": "/pose",
    "LocationFix": "/fix",
    "FrameTransform": "/tf",
    "PointCloud": "/points",
    "CompressedImage": "/image",
    "CameraCalibration": "/camera",
    "Log": "/log",
}


def write_mcap(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """Keyframes, poses and corrections of the store as MCAP, and the recording's frames."""
    with writing(out) as part:
        export_mcap(scan.store, part, _frames(scan, options))


def _frames(scan: ScanView, options: ExportOptions) -> Iterator[Frame]:
    """Those of the keyframes, by time; none where no recording is there."""
    header = scan.store.header
    video = recording_for(scan, options).path
    if video is None:
        return
    seqs = {k.time_ns: k.seq for k in scan.store.keyframes()}
    times = sorted(seqs)
    camera = camera_of(header)
    undistort = Undistorter(camera)
    try:
        for n, image in frames_at(times, header, video, options.video_epoch_ns, scan.progress):
            yield Frame(times[n], seqs[times[n]], undistort.image(image), camera.K)
    except SkyreliefError as error:
        if options.video is not None:
            raise
        scan.progress(f"without the recording's frames: {error}")


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A keyframe's frame as the camera took it, without distortion."""

    time_ns: int  # unix
    seq: int
    bgr: U8  # (H, W, 3)
    K: F64  # (3, 3) px


def export_mcap(store: ScanStore, out_path: Path, frames: Iterable[Frame] = ()) -> int:
    """Write ``store``, and ``frames`` by time, to ``out_path``, in order of time; how many messages
    that makes.

    Raises OutsideError without the ``foxglove-sdk`` package, InputError when the file cannot
    be written.
    """
    count = 0
    with mcap_file(out_path) as context:
        from foxglove import channels

        opened = {
            kind: getattr(channels, f"{kind}Channel")(topic, context=context)
            for kind, topic in TOPICS.items()
        }
        found = [((time_ns, opened[type(m).__name__], m) for time_ns, m in _messages(store))]
        shown = iter(frames)
        first = next(shown, None)
        if first is not None:
            image = channels.CompressedImageChannel(FRAME_TOPIC, context=context)
            camera = channels.CameraCalibrationChannel(FRAME_CAMERA_TOPIC, context=context)
            found.append(
                (frame.time_ns, channel, message)
                for frame in chain([first], shown)
                for channel, message in zip((image, camera), _of_frame(frame), strict=True)
            )
        for time_ns, channel, message in heapq.merge(*found, key=lambda one: one[0]):
            channel.log(message, log_time=max(time_ns, 0))
            count += 1
    return count


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


def _messages(store: ScanStore) -> Iterator[tuple[int, Any]]:
    """Unix time in ns and message: the scan's name and notes, its content, its summary."""
    header = store.header
    last_ns = header.started_unix_ns
    origin = f"{header.origin_lat_deg}, {header.origin_lon_deg}, {header.origin_alt_amsl_m} m"
    text = f"scan {header.name} of {header.drone}, {header.software}, origin {origin}"
    for line in (text, *header.notes):
        yield last_ns, _log(line, last_ns)
    for item in in_order(store.poses(), store.keyframes()):
        time_ns = _time_ns(item)
        last_ns = max(last_ns, time_ns)
        if isinstance(item, PoseRecord):
            found = _of_pose(item)
        else:
            found = _of_keyframe(item, whole_bgr(item, store.image(item.seq)))
        for message in found:
            yield time_ns, message
    if store.summary is not None:
        yield last_ns, _log(f"finished: {store.summary}", last_ns)


def _log(text: str, time_ns: int) -> Any:
    from foxglove.messages import Log, LogLevel

    return Log(timestamp=_stamp(time_ns), level=LogLevel.Info, message=text, name="skyrelief")


def _of_pose(pose: PoseRecord) -> Iterator[Any]:
    """Where the camera was, in the world and on the globe."""
    from foxglove import messages

    stamp = _stamp(pose.time_unix_ns)
    position, rotation = _parts(pose.T_world_camera)
    place = messages.Pose(position=position, orientation=rotation)
    yield messages.PoseInFrame(timestamp=stamp, frame_id="world", pose=place)
    yield messages.FrameTransform(
        timestamp=stamp,
        parent_frame_id="world",
        child_frame_id="camera",
        translation=position,
        rotation=rotation,
    )
    if pose.lat_deg is not None and pose.lon_deg is not None:
        yield messages.LocationFix(
            timestamp=stamp,
            frame_id="camera",
            latitude=pose.lat_deg,
            longitude=pose.lon_deg,
            altitude=pose.alt_amsl_m or 0.0,
            position_covariance=pose.position_covariance.ravel().tolist(),
            position_covariance_type=messages.LocationFixPositionCovarianceType.Known,
        )


def _of_keyframe(keyframe: Keyframe, bgr: U8) -> Iterator[Any]:
    """The keyframe's points, placed by its pose, its image ``bgr`` and camera."""
    from foxglove import messages

    stamp, depth = _stamp(keyframe.time_ns), keyframe.depth
    real, byte = (getattr(messages.PackedElementFieldNumericType, k) for k in ("Float32", "Uint8"))
    fields = (
        ("x", 0, real), ("y", 4, real), ("z", 8, real), ("blue", 12, byte), ("green", 13, byte),
        ("red", 14, byte), ("alpha", 15, byte), ("sigma_m", 16, real), ("views", 20, byte),
    )  # fmt: skip
    position, orientation = _parts(depth.T_world_camera)
    yield messages.PointCloud(
        timestamp=stamp,
        frame_id="world",
        pose=messages.Pose(position=position, orientation=orientation),
        point_stride=POINT.itemsize,
        fields=[messages.PackedElementField(name=n, offset=at, type=t) for n, at, t in fields],
        data=known_points(keyframe).tobytes(),
    )
    yield from _of_frame(Frame(keyframe.time_ns, keyframe.seq, bgr, depth.K))


def _of_frame(frame: Frame) -> Iterator[Any]:
    """The image and its camera."""
    from foxglove import messages

    stamp, frame_id = _stamp(frame.time_ns), f"keyframe-{frame.seq}"
    yield messages.CompressedImage(
        timestamp=stamp, frame_id=frame_id, data=jpeg(frame.bgr).tobytes(), format="jpeg"
    )
    h, w = frame.bgr.shape[:2]
    yield messages.CameraCalibration(
        timestamp=stamp,
        frame_id=frame_id,
        width=w,
        height=h,
        K=frame.K.ravel().tolist(),
        P=np.column_stack([frame.K, np.zeros(3)]).ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
    )


def jpeg(bgr: U8) -> U8:
    """(N,) bytes of an image."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return np.asarray(cv2.imencode(".jpg", bgr, quality)[1], np.uint8).ravel()


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


def _stamp(time_ns: int) -> Any:
    from foxglove.messages import Timestamp

    time_ns = max(time_ns, 0)  # the format has no time before 1970
    return Timestamp(time_ns // 1_000_000_000, time_ns % 1_000_000_000)


def _parts(T: F64) -> tuple[Any, Any]:
    """Position and orientation of a pose."""
    from foxglove.messages import Quaternion, Vector3

    w, x, y, z = (float(v) for v in se3.quaternion_from_rotation(T[:3, :3]))
    place = Vector3(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
    return place, Quaternion(x=x, y=y, z=z, w=w)
