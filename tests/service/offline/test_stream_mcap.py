"""The MCAP recording, read back by the mcap library's own indexed reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from painted_ground import SIZE, K
from painted_strips import flown, made

from recon import se3
from recon.types import DepthMap, Keyframe, Pose
from service.errors import InputError
from service.offline.exports.view import ExportOptions, ScanView, export
from service.stream import codec
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.store import ScanStore

pytest.importorskip("foxglove")
mcap_reader = pytest.importorskip("mcap.reader")

START = 1_700_000_000_000_000_000


def new_store(path: Path) -> ScanStore:
    store = ScanStore.create(path, ScanHeader("s", "d", START, 47.0, 8.0, 400.0, notes=("windy",)))
    T = se3.compose(np.diag([1.0, -1.0, -1.0]), np.array([5.0, 6.0, 50.0]))
    for seq in range(3):
        rng = np.random.default_rng(seq)
        depth = DepthMap(
            np.full((45, 80), 50.0, np.float32),
            np.full((45, 80), 0.2, np.float32),
            np.full((45, 80), 4, np.uint8),
            np.array([[60.0, 0, 39.5], [0, 60.0, 22.0], [0, 0, 1]]),
            T,
        )
        bgr = rng.integers(0, 255, (45, 80, 3), np.uint8)
        frame = Keyframe(seq, 0, depth, bgr, Pose(T, np.eye(6)), np.ones((45, 80), bool))
        time_ns = START + seq * 1_000_000_000
        store.add_keyframe(seq, codec.encode(frame, time_ns))
        store.add_pose(PoseRecord(time_ns, T, np.eye(6), lat_deg=47.0, lon_deg=8.0))
    moved = se3.compose(T[:3, :3], np.array([7.0, 6.0, 50.0]))
    store.add_reposes([Repose(1, 1, moved, 1.0, np.eye(6))])
    store.finish({"points": 3})
    return store


def decoder(schema: Any) -> Any:
    """A message class made from the file descriptors that the recording itself carries."""
    descriptor_pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
    descriptor_pool = pytest.importorskip("google.protobuf.descriptor_pool")
    message_factory = pytest.importorskip("google.protobuf.message_factory")
    pool = descriptor_pool.DescriptorPool()
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
    waiting = list(files)
    while waiting:
        file = waiting.pop(0)
        try:
            pool.Add(file)
        except TypeError:
            waiting.append(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def test_the_recording_gives_frames_at_full_size(tmp_path: Path) -> None:
    with ScanView(made(tmp_path, flown()[:4])) as scan:
        without = export(scan, "mcap", tmp_path / "without.mcap", ExportOptions())
        whole = export(scan, "mcap", None, ExportOptions(video=tmp_path / "stills"))
    with without.open("rb") as file:
        summary = mcap_reader.make_reader(file).get_summary()
        assert summary is not None
        assert "/frame" not in {channel.topic for channel in summary.channels.values()}
    frames, cameras, times = [], [], []
    with whole.open("rb") as file:
        for schema, channel, message in mcap_reader.make_reader(file).iter_messages():
            times.append(message.log_time)
            if channel.topic == "/frame":
                data = decoder(schema).FromString(message.data).data
                frames.append(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
            elif channel.topic == "/frame/camera":
                cameras.append(decoder(schema).FromString(message.data))
    assert times == sorted(times)
    stills = [cv2.imread(str(path)) for path in sorted((tmp_path / "stills").iterdir())]
    for frame, still, camera in zip(frames, stills, cameras, strict=True):
        assert frame is not None and still is not None and frame.shape == (*SIZE[::-1], 3)
        assert np.abs(frame.astype(float) - still).mean() < 8.0
        assert (camera.width, camera.height) == SIZE and list(camera.K) == K.ravel().tolist()


def test_indexed_reader_finds_everything_in_order(tmp_path: Path) -> None:
    from service.offline.exports.recording import export_mcap

    out = tmp_path / "flight.mcap"
    with new_store(tmp_path / "scan.db") as store:
        written = export_mcap(store, out)
    with out.open("rb") as file:
        reader = mcap_reader.make_reader(file)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics.message_count == written
        assert summary.chunk_indexes
        names = {channel.topic: summary.schemas[channel.schema_id].name
                 for channel in summary.channels.values()}  # fmt: skip
        assert names == {
            "/pose": "foxglove.PoseInFrame",
            "/fix": "foxglove.LocationFix",
            "/tf": "foxglove.FrameTransform",
            "/points": "foxglove.PointCloud",
            "/image": "foxglove.CompressedImage",
            "/camera": "foxglove.CameraCalibration",
            "/log": "foxglove.Log",
        }
        clouds = []
        times = []
        for schema, channel, message in reader.iter_messages():
            times.append(message.log_time)
            if channel.topic == "/points":
                clouds.append(decoder(schema).FromString(message.data))
        assert times == sorted(times)
    assert [round(c.pose.position.x) for c in clouds] == [5, 7, 5]  # the re-pose is applied
    cloud = clouds[0]
    assert cloud.frame_id == "world" and len(cloud.data) == 80 * 45 * cloud.point_stride
    offsets = {f.name: f.offset for f in cloud.fields}
    first = np.frombuffer(cloud.data, "<f4", 3, offsets["x"])
    np.testing.assert_allclose(first, [-39.5 / 60 * 50, -22.0 / 60 * 50, 50.0], rtol=1e-3)


def test_a_place_that_cannot_be_written_is_said_in_one_line(tmp_path: Path) -> None:
    from service.offline.exports.recording import export_mcap

    with (
        new_store(tmp_path / "scan.db") as store,
        pytest.raises(InputError, match="cannot be written"),
    ):
        export_mcap(store, tmp_path / "absent" / "flight.mcap")
