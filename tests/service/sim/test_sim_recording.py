"""The folder that simulate writes, read back by independent readers: PyAV, pymavlink, PROJ."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from mavlink.telemetry.logs import load_telemetry
from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA
from recon.se3 import rotation_from_quaternion
from recon.types import F64, Shutter
from service.cameras.camera_file import load_camera
from service.cameras.video import creation_unix_ns
from service.cli import app
from service.errors import InputError
from service.sim.ground_texture import patchwork
from service.sim.truth import read_surface, write_surface

pytestmark = pytest.mark.slow

SMALL = [
    "--size", "320x180", "--fps", "5", "--duration-s", "4", "--height-m", "40",
    "--depth-frames", "3",
]  # fmt: skip


def simulate(folder: Path, *arguments: str) -> dict[str, Any]:
    result = CliRunner().invoke(
        app, ["simulate", "--out", str(folder), *SMALL, *arguments, "--json"]
    )
    if result.exception is not None:
        raise result.exception
    report = json.loads(result.stdout.strip().splitlines()[-1])
    assert isinstance(report, dict)
    return report


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small flight whose sensors are silent."""
    folder = tmp_path_factory.mktemp("exact") / "flight"
    quiet = ("gps-noise-m", "baro-noise-m", "attitude-noise-deg", "yaw-noise-deg", "image-noise")
    silence = [word for name in quiet for word in (f"--{name}", "0")]
    simulate(folder, *silence, "--log-lead-s", "1")
    return folder


def frames(path: Path) -> list[Any]:
    with av.open(str(path)) as container:
        return list(container.decode(video=0))


def trajectory(folder: Path) -> F64:
    return np.loadtxt(folder / "truth" / "trajectory.tum")


def test_video_is_h264_of_constant_rate_with_its_epoch(exact: Path) -> None:
    with av.open(str(exact / "flight.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert (stream.width, stream.height) == (320, 180)
        assert container.metadata["creation_time"].startswith("2026-05-01T10:00:00")
        times = [frame.time for frame in container.decode(stream)]
    np.testing.assert_allclose(times, np.arange(20) / 5.0, atol=1e-6)
    params = json.loads((exact / "truth" / "params.json").read_text())
    rows = trajectory(exact)
    np.testing.assert_allclose(rows[:, 0], params["video_epoch_unix_s"] + np.arange(20) / 5.0)
    assert params["frames"] == 20 and params["options"]["seed"] == 1


def test_camera_file_is_the_camera(exact: Path) -> None:
    camera = load_camera(exact / "camera.yaml")
    params = json.loads((exact / "truth" / "params.json").read_text())
    assert camera.size_px == (320, 180) and camera.distortion[0] < 0
    np.testing.assert_array_equal(camera.K, params["K"])


def test_depth_maps_lie_on_the_surface(exact: Path) -> None:
    vertices, _ = read_surface(exact / "truth" / "surface.ply")
    paths = sorted((exact / "truth").glob("depth_*.npz"))
    assert [p.name for p in paths] == [f"depth_{k:06d}.npz" for k in (0, 9, 19)]
    rows = trajectory(exact)
    for path in paths:
        with np.load(path) as data:
            depth, K, T = data["depth_m"], data["K"], data["T_world_camera"]
        row = rows[int(path.stem[-6:])]
        np.testing.assert_allclose(T[:3, 3], row[1:4], atol=1e-8)
        np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(row[4:8]).as_matrix(), atol=1e-7)
        assert depth.shape == (180, 320) and np.isfinite(depth).all()
        # Every vertex in sight projects to its own depth or lies behind something.
        local = (vertices - T[:3, 3]) @ T[:3, :3]
        uv = local[:, :2] / local[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
        inside = (uv > 2).all(axis=1) & (uv < [317, 177]).all(axis=1)
        u, v = np.round(uv[inside]).astype(int).T
        gap = cv2.erode(depth, np.ones((3, 3)))[v, u] - local[inside, 2]
        assert (gap < 0.3).mean() > 0.995  # nothing floats in front of the depth map
        assert (np.abs(gap) < 0.15).mean() > 0.5  # the rest is hidden: far sides, trunks


def stamp_of(message: Any) -> float:
    """Of a message of a log; unix seconds."""
    return float(message._timestamp)


def packets(path: Path) -> list[Any]:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    log = mavutil.mavlink_connection(str(path), dialect="common")
    out = []
    while (message := log.recv_match()) is not None:
        out.append(message)
    return out


def test_tlog_is_read_by_pymavlink_with_the_right_rates(exact: Path) -> None:
    messages = packets(exact / "flight.tlog")
    by_kind: dict[str, list[Any]] = {}
    for message in messages:
        by_kind.setdefault(message.get_type(), []).append(message)
    assert "BAD_DATA" not in by_kind
    seconds = 4.0 + 1.0 + 5.0  # the video, the lead asked for, and five after
    for kind, hz in {
        "ATTITUDE": 50, "GLOBAL_POSITION_INT": 10, "GPS_RAW_INT": 5, "SYSTEM_TIME": 1,
        "GIMBAL_DEVICE_ATTITUDE_STATUS": 20, "DISTANCE_SENSOR": 10, "HEARTBEAT": 2,
    }.items():  # fmt: skip
        assert len(by_kind[kind]) == pytest.approx(hz * seconds, abs=2), kind
    stamps = [stamp_of(message) for message in messages]
    assert stamps == sorted(stamps)
    epoch = json.loads((exact / "truth" / "params.json").read_text())["video_epoch_unix_s"]
    assert stamps[0] == pytest.approx(epoch - 1.0, abs=0.01)
    autopilot = [m for m in by_kind["HEARTBEAT"] if m.get_srcComponent() == 1]
    assert all(m.base_mode & 128 for m in autopilot)  # armed
    for message in by_kind["SYSTEM_TIME"]:
        assert message.time_unix_usec / 1e6 == pytest.approx(stamp_of(message), abs=0.002)
    assert {m.flags for m in by_kind["GIMBAL_DEVICE_ATTITUDE_STATUS"]} == {4 | 8 | 64}
    gyroscopes = np.array([(m.rollspeed, m.pitchspeed, m.yawspeed) for m in by_kind["ATTITUDE"]])
    turned = Rotation.from_euler("ZYX", [(m.yaw, m.pitch, m.roll) for m in by_kind["ATTITUDE"]])
    lag = 25  # half a second, so that the noise of two attitudes counts little
    between = (turned[:-lag].inv() * turned[lag:]).as_rotvec()
    summed = np.array([gyroscopes[k : k + lag].sum(axis=0) for k in range(len(between))]) / 50.0
    assert np.abs(between).max() > 0.03
    np.testing.assert_allclose(summed, between, atol=0.008)


def test_messages_give_the_true_camera_pose(exact: Path) -> None:
    """Silent sensors: position through PROJ and attitude through SciPy equal the truth."""
    rows = trajectory(exact)
    origin = json.loads((exact / "truth" / "origin.json").read_text())
    to_enu = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
        f"+step +proj=topocentric +lat_0={origin['lat_deg']} +lon_0={origin['lon_deg']} "
        f"+h_0={origin['alt_amsl_m']}"
    )
    messages = packets(exact / "flight.tlog")
    fixes = [m for m in messages if m.get_type() == "GLOBAL_POSITION_INT"]
    at = np.array([stamp_of(m) for m in fixes])
    enu = np.stack(
        to_enu.transform(
            np.array([m.lon / 1e7 for m in fixes]),
            np.array([m.lat / 1e7 for m in fixes]),
            np.array([m.alt / 1e3 for m in fixes]),
        ),
        axis=1,
    )
    for axis in range(3):
        want = np.interp(rows[:, 0], at, enu[:, axis])
        np.testing.assert_allclose(want, rows[:, 1 + axis], atol=0.05)
    heads = [m for m in messages if m.get_type() == "GIMBAL_DEVICE_ATTITUDE_STATUS"]
    stamps = np.array([stamp_of(m) for m in heads])
    for row in rows:
        q = heads[int(np.argmin(np.abs(stamps - row[0])))].q
        R_ned_gimbal = Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_matrix()
        R = R_ENU_NED @ R_ned_gimbal @ R_GIMBAL_CAMERA
        turn = Rotation.from_matrix(R.T @ Rotation.from_quat(row[4:8]).as_matrix())
        assert np.degrees(turn.magnitude()) < 0.4  # white noise and up to 25 ms of motion


@pytest.mark.parametrize("frame", ["earth", "vehicle"])
def test_vehicle_history_gives_the_true_attitude(frame: str, tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    simulate(folder, "--gimbal-frame", frame, "--fps", "2", "--attitude-noise-deg", "0",
             "--yaw-noise-deg", "0", "--no-video")  # fmt: skip
    history = load_telemetry(folder / "flight.tlog").history
    for row in trajectory(folder):
        state = history.state_at(round(row[0] * 1e9))
        assert state is not None and state.q_ned_gimbal_wxyz is not None
        R = R_ENU_NED @ rotation_from_quaternion(state.q_ned_gimbal_wxyz) @ R_GIMBAL_CAMERA
        turn = Rotation.from_matrix(R.T @ Rotation.from_quat(row[4:8]).as_matrix())
        assert np.degrees(turn.magnitude()) < 0.5


def test_a_boresight_and_a_leaning_rangefinder(tmp_path: Path) -> None:
    """The reported gimbal is off by the angles asked for; the range is that along the body."""
    folder = tmp_path / "flight"
    simulate(folder, "--gnss-noise", "exact", "--no-video", "--boresight-deg", "2:-1",
             "--relief-m", "0", "--density", "0", "--duration-s", "20")  # fmt: skip
    assert not (folder / "flight.mp4").exists()
    history, rows = load_telemetry(folder / "flight.tlog").history, trajectory(folder)
    off = []
    for row in rows[:: len(rows) // 12]:
        state = history.state_at(round(row[0] * 1e9))
        assert state is not None and state.q_ned_gimbal_wxyz is not None
        said = R_ENU_NED @ rotation_from_quaternion(state.q_ned_gimbal_wxyz) @ R_GIMBAL_CAMERA
        axis = said.T @ Rotation.from_quat(row[4:8]).as_matrix()[:, 2]  # in the said camera
        angles = np.degrees(np.arctan2([axis[0], -axis[1]], axis[2]))
        np.testing.assert_allclose(angles, [2.0, -1.0], atol=0.3)
        assert state.alt_agl_m is not None
        off.append(state.alt_agl_m - row[3])
    assert np.median(np.abs(off)) < 0.03  # but for what stands in open country


def test_same_seed_same_files(exact: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        simulate(tmp_path / name, "--duration-s", "1")
    for part in ("flight.tlog", "truth/trajectory.tum", "truth/surface.ply"):
        assert (tmp_path / "a" / part).read_bytes() == (tmp_path / "b" / part).read_bytes()
    a, b = (frames(tmp_path / name / "flight.mp4") for name in ("a", "b"))
    np.testing.assert_array_equal(a[0].to_ndarray(), b[0].to_ndarray())
    with pytest.raises(InputError, match="already holds a flight"):
        simulate(tmp_path / "a")


def test_each_flight_of_a_place_has_its_own_time(tmp_path: Path) -> None:
    starts = set()
    other, second = ("--flight-seed", "8"), ("--date", "2")
    for n, words in enumerate(((), other, second, (*other, *second))):
        folder = tmp_path / str(n)
        simulate(folder, "--seed", "7", "--fps", "1", *words)
        start = json.loads((folder / "truth" / "params.json").read_text())["video_epoch_unix_s"]
        with av.open(str(folder / "flight.mp4")) as video:
            assert creation_unix_ns(video, video.streams.video[0]) == start * 10**9
        assert abs(stamp_of(packets(folder / "flight.tlog")[0]) - start) < 60.0
        assert trajectory(folder)[0, 0] == start
        starts.add(start)
    assert len(starts) == 4


def test_faults_on_purpose(tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    simulate(folder, "--blank", "3:2", "--exposure", "2:1.6", "--telemetry-gap", "1:2",
             "--no-rangefinder")  # fmt: skip
    level = [float(f.to_ndarray(format="gray").mean()) for f in frames(folder / "flight.mp4")]
    assert max(level[3:5]) < 20 < min(level[0], level[5])
    assert np.mean(level[11:]) > 1.3 * np.mean(level[5:9])
    messages = packets(folder / "flight.tlog")
    epoch = json.loads((folder / "truth" / "params.json").read_text())["video_epoch_unix_s"]
    seconds = np.array([stamp_of(m) for m in messages]) - epoch
    assert not ((seconds >= 1.001) & (seconds < 1.999)).any()
    assert "DISTANCE_SENSOR" not in {m.get_type() for m in messages}


def test_flight_without_telemetry(tmp_path: Path) -> None:
    report = simulate(tmp_path / "flight", "--no-telemetry", "--duration-s", "0.4")
    assert report["packets"] == 0
    assert not (tmp_path / "flight" / "flight.tlog").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--pattern", "zigzag"], "zigzag"),
        (["--size", "1280"], "1280x720"),
        (["--size", "321x180"], "even"),
        (["--fps", "0"], "frames per second"),
        (["--blank", "three"], "--blank"),
        (["--telemetry-gap", "1"], "--telemetry-gap"),
        (["--gimbal-frame", "moon"], "gimbal frame"),
        (["--gnss-noise", "pink"], "pink"),
        (["--boresight-deg", "60:0"], "boresight"),
        (["--photos", "nowhere"], "no such folder"),
        (["--duration-s", "1500", "--speed-m-s", "50"], "shorter"),
        (["--height-m", "nan"], "height"),
    ],
)
def test_bad_options_are_refused_in_one_line(
    arguments: list[str], word: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=word) as caught:
        simulate(tmp_path / "flight", *arguments)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "flight").exists()


def test_photographs_cover_the_ground(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    rng = np.random.default_rng(0)
    for k in range(3):
        noise = cv2.resize(rng.integers(60, 200, (40, 60, 3)).astype(np.uint8), (300, 200))
        cv2.imwrite(str(photos / f"{k}.png"), noise)
    (photos / "broken.jpg").write_bytes(b"nothing")
    mosaic = patchwork(photos, (700, 500), 1)
    assert mosaic.shape == (500, 700, 3) and mosaic.mean() > 100
    assert len({row.tobytes() for row in mosaic}) == 500  # no two rows the same
    simulate(tmp_path / "flight", "--photos", str(photos), "--density", "0", "--duration-s", "0.4")
    image = frames(tmp_path / "flight" / "flight.mp4")[0].to_ndarray(format="bgr24")
    assert image.std() > 8
    for path in photos.glob("*.png"):
        path.unlink()
    with pytest.raises(InputError, match="no readable photograph"):
        patchwork(photos, (700, 500), 1)


def test_surface_file_round_trip_and_other_readers(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(30, 3)).astype(np.float32).astype(np.float64)
    triangles = rng.integers(0, 30, (50, 3)).astype(np.int32)
    path = tmp_path / "s.ply"
    write_surface(path, vertices, triangles)
    back = read_surface(path)
    np.testing.assert_array_equal(back[0], vertices)
    np.testing.assert_array_equal(back[1], triangles)
    trimesh = pytest.importorskip("trimesh")
    other = trimesh.load(path, process=False)
    np.testing.assert_allclose(other.vertices, vertices)
    np.testing.assert_array_equal(other.faces, triangles)


@pytest.mark.parametrize("cut", [0, 10, 200, 600])
def test_damaged_surface_is_refused(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "s.ply"
    write_surface(path, np.zeros((30, 3)), np.zeros((50, 3), np.int32))
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError) as caught:
        read_surface(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="no such file"):
        read_surface(tmp_path / "none.ply")


def test_a_rolling_shutter_is_in_the_camera_file_and_the_truth_is_the_middle_row(
    tmp_path: Path,
) -> None:
    """Only the images differ from those of a global shutter: poses and depths are the same."""
    flags = ["--swing-deg", "4", "--depth-frames", "2", "--duration-s", "1"]
    simulate(tmp_path / "global", *flags)
    simulate(tmp_path / "rolling", *flags, "--readout-ms", "30", "--readout-direction", "up")
    assert load_camera(tmp_path / "global" / "camera.yaml").shutter == Shutter()
    assert load_camera(tmp_path / "rolling" / "camera.yaml").shutter == Shutter(0.03, "up")
    np.testing.assert_array_equal(trajectory(tmp_path / "global"), trajectory(tmp_path / "rolling"))
    maps = [np.load(tmp_path / n / "truth" / "depth_000004.npz") for n in ("global", "rolling")]
    np.testing.assert_array_equal(maps[0]["depth_m"], maps[1]["depth_m"])
    a, b = (
        frames(tmp_path / n / "flight.mp4")[2].to_ndarray(format="gray").astype(float)
        for n in ("global", "rolling")
    )
    assert np.abs(a - b)[88:92].mean() < 0.5 * np.abs(a - b)[:8].mean()  # the middle is the same


def test_an_open_shutter_blurs_along_the_motion_and_leaves_the_truth(tmp_path: Path) -> None:
    flags = ["--swing-deg", "4", "--depth-frames", "1", "--duration-s", "0.5", "--fps", "10"]
    simulate(tmp_path / "short", *flags)
    simulate(tmp_path / "long", *flags, "--shutter-ms", "60")
    np.testing.assert_array_equal(trajectory(tmp_path / "short"), trajectory(tmp_path / "long"))
    before, _, after = trajectory(tmp_path / "long")[1:4]
    R = [rotation_from_quaternion(row[[7, 4, 5, 6]]) for row in (before, after)]
    on_axis = R[0] @ [0.0, 0.0, 60.0] + before[1:4] - after[1:4]
    x, y, _ = R[1].T @ on_axis  # where it is two frames later
    detail = []
    for name in ("short", "long"):
        image = frames(tmp_path / name / "flight.mp4")[2].to_ndarray(format="gray").astype(float)
        gy, gx = np.gradient(image[40:-40, 60:-60])
        along = (gx * x + gy * y) / np.hypot(x, y)
        across = (gy * x - gx * y) / np.hypot(x, y)
        detail.append([np.abs(along).mean(), np.abs(across).mean()])
    left = np.divide(detail[1], detail[0])
    assert left[0] < 0.6 and left[0] < 0.8 * left[1]


def test_a_readout_longer_than_a_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="readout of 150 ms is not within 0 and the 100 ms"):
        simulate(tmp_path / "long", "--readout-ms", "150", "--fps", "10")
    with pytest.raises(InputError, match="exposure of 150 ms is not within 0 and the 100 ms"):
        simulate(tmp_path / "long", "--shutter-ms", "150", "--fps", "10")
    with pytest.raises(InputError, match=r"readout_ms 200\.5 is not within"):
        simulate(tmp_path / "slow", "--readout-ms", "200.5")
    with pytest.raises(InputError, match="readout_direction 'around' is not one of down, up"):
        simulate(tmp_path / "odd", "--readout-direction", "around")
