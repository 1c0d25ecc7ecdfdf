"""ROS 2 messages of a scan, read back by decoders that share no code with what wrote them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ros2_scene import SIZE, START_NS, K, camera_at, in_map, keyframe, matrix, nanoseconds

from recon import se3
from service.offline.exports.view import ExportOptions, ScanView, export
from service.stream import codec
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.store import ScanStore

pytest.importorskip("foxglove")
pytest.importorskip("rosbags")
mcap_ros2 = pytest.importorskip("mcap_ros2.reader")


def scan_folder(folder: Path, lat_deg: float | None = 47.0) -> Path:
    """Three keyframes a second apart, a pose between them, and the second keyframe corrected."""
    folder.mkdir()
    header = ScanHeader("s", "red", START_NS, lat_deg, None if lat_deg is None else 8.0, 400.0)
    with ScanStore.create(folder / "scan.db", header) as store:
        for seq in range(3):
            time_ns = START_NS + seq * 10**9
            T = camera_at(5.0 * seq)
            store.add_keyframe(seq, codec.encode(keyframe(seq, T), time_ns))
            for after_ns in (0, 400_000_000):
                place = () if lat_deg is None else (47.0, 8.0, 450.0)
                own = np.diag([1e-4] * 3 + [1.0, 2.0, 3.0])
                covariance = se3.about(-T[:3, 3], own)
                store.add_pose(PoseRecord(time_ns + after_ns, T, covariance, *place))
        store.add_reposes([Repose(1, 1, camera_at(7.0), 1.0, np.eye(6))])
        store.finish({"keyframes": 3})
    return folder


def read_all(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Topic to (log time, message), by the mcap library and the schemas in the file."""
    found: dict[str, list[tuple[int, Any]]] = {}
    for one in mcap_ros2.read_ros2_messages(path):
        found.setdefault(one.channel.topic, []).append((one.log_time_ns, one.ros_msg))
    return found


def test_points_placed_by_their_transform_are_those_of_the_scan(tmp_path: Path) -> None:
    folder = scan_folder(tmp_path / "scan")
    with ScanView(folder) as view:
        path = export(view, "ros2", None, ExportOptions())
    assert path == folder / "ros2.mcap"
    found = read_all(path)
    transforms = {}
    for time_ns, message in found["/tf"]:
        (one,) = message.transforms
        assert (one.header.frame_id, one.child_frame_id) == ("map", "camera_optical")
        assert nanoseconds(one.header.stamp) == time_ns
        assert time_ns not in transforms  # a second one of the same time is refused by tf2
        transforms[time_ns] = matrix(one.transform)
    times = [START_NS + s * 10**9 + between for s in range(3) for between in (0, 400_000_000)]
    assert list(transforms) == times
    assert [nanoseconds(m.header.stamp) for _, m in found["/camera/points"]] == times[::2]
    for (time_ns, cloud), east_m in zip(found["/camera/points"], (0.0, 7.0, 10.0), strict=True):
        assert cloud.header.frame_id == "camera_optical" and cloud.is_dense
        xyz, rows = in_map(cloud, transforms[time_ns])
        assert len(xyz) == 40 * 80
        T = camera_at(east_m)  # of the second keyframe the corrected one
        first = np.array([(0 - 39.5) / 60.0, (5 - 22.0) / 61.0, 1.0]) * 50.0
        np.testing.assert_allclose(xyz[0], T[:3, :3] @ first + T[:3, 3], atol=0.02)
        is_roof = np.abs(xyz[:, 2] - 10.0) < 0.1
        assert is_roof.sum() == 100 and np.abs(xyz[~is_roof, 2]).max() < 0.1
        np.testing.assert_allclose(rows["sigma_m"], 0.2, rtol=0.1)
        assert set(rows["views"]) == {4}
        red, green, blue = (int(np.median(rows["rgba"] >> shift & 255)) for shift in (16, 8, 0))
        assert abs(red - 200) < 8 and abs(green - 90) < 8 and abs(blue - 30) < 8


def test_image_camera_and_fix_belong_to_the_points(tmp_path: Path) -> None:
    folder = scan_folder(tmp_path / "scan")
    with ScanView(folder) as view:
        found = read_all(export(view, "ros2", tmp_path / "a.mcap", ExportOptions()))
    for kind in ("image/compressed", "camera_info"):
        messages = [m for _, m in found[f"/camera/{kind}"]]
        assert [nanoseconds(m.header.stamp) for m in messages] == [
            nanoseconds(m.header.stamp) for _, m in found["/camera/points"]
        ]
        assert {m.header.frame_id for m in messages} == {"camera_optical"}
    image = found["/camera/image/compressed"][0][1]
    bgr = cv2.imdecode(np.frombuffer(bytes(image.data), np.uint8), cv2.IMREAD_COLOR)
    assert image.format == "jpeg" and bgr is not None and bgr.shape == (*SIZE, 3)
    info = found["/camera/camera_info"][0][1]
    assert (info.height, info.width, info.distortion_model) == (*SIZE, "plumb_bob")
    np.testing.assert_allclose(np.reshape(info.k, (3, 3)), K)
    np.testing.assert_allclose(np.reshape(info.p, (3, 4)), np.column_stack([K, np.zeros(3)]))
    assert len(found["/camera/fix"]) == 6
    fix = found["/camera/fix"][0][1]
    assert (fix.latitude, fix.longitude, fix.altitude) == (47.0, 8.0, 450.0)
    variances = np.diag(np.reshape(fix.position_covariance, (3, 3)))
    np.testing.assert_allclose(variances, [1, 2, 3], rtol=1e-5)
    assert fix.position_covariance_type == 3


def test_rosbags_opens_the_file_and_a_scan_without_a_place_has_no_fix(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    folder = scan_folder(tmp_path / "scan", lat_deg=None)
    with ScanView(folder) as view:
        path = export(view, "ros2", None, ExportOptions())
    with AnyReader([path]) as bag:
        counts = {c.topic: (c.msgtype, c.msgcount) for c in bag.connections if c.msgcount}
    assert counts == {
        "/tf": ("tf2_msgs/msg/TFMessage", 6),
        "/camera/points": ("sensor_msgs/msg/PointCloud2", 3),
        "/camera/image/compressed": ("sensor_msgs/msg/CompressedImage", 3),
        "/camera/camera_info": ("sensor_msgs/msg/CameraInfo", 3),
    }
