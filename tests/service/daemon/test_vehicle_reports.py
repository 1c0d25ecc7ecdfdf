"""The estimate that goes to the autopilot: from steps of the pipeline to ODOMETRY on the wire."""

from __future__ import annotations

import math
import socket
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loopback import until
from rehearsal import RehearsalVehicle
from scipy.spatial.transform import Rotation

from mavlink.component.status import BodyOdometry
from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.samples import PositionSample, VehicleState
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from recon import se3
from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA, gimbal_from_camera
from recon.pipeline.mapper import FramePosed
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.types import F64, Camera, Pose, PosePrior
from service.config import CameraConfig, load_config
from service.daemon.runtime import Daemon
from service.daemon.vehicle_reports import OdometryReport, camera_view

S = 1_000_000_000
BODY = Rotation.from_euler("ZYX", [0.7, 0.05, -0.1])  # q_ned_body
HEAD = Rotation.from_euler("ZYX", [0.7, -math.pi / 3, 0.0])  # q_ned_gimbal
COVARIANCE = np.diag([1e-4, 2e-4, 3e-4, 0.04, 0.09, 0.16])  # about and along east, north, up


def wxyz(R: Rotation) -> F64:
    return np.asarray(R.as_quat()[[3, 0, 1, 2]], np.float64)


def posed_at(
    enu: tuple[float, float, float], time_ns: int, head: Rotation = HEAD, segment: int = 0
) -> FramePosed:
    R = R_ENU_NED @ head.as_matrix() @ R_GIMBAL_CAMERA
    T = se3.compose(R, np.array(enu))
    frame = Frame(
        NO_IMAGE, time_ns, 0, state=Tracking.TRACKED, segment=segment,
        T_keyframe_camera=T, tracks=150,
    )  # fmt: skip
    pose = Pose(T, se3.about(-T[:3, 3], COVARIANCE), ("vision",))
    return FramePosed(frame, pose)


def state() -> VehicleState:
    return VehicleState(0, q_ned_body_wxyz=wxyz(BODY), q_ned_gimbal_wxyz=wxyz(HEAD))


def test_pose_velocity_and_covariance_are_the_bodys_in_ned() -> None:
    sent: list[tuple[BodyOdometry, int]] = []
    report = OdometryReport(CameraConfig(), lambda o, t: sent.append((o, t)))
    for k in range(3):
        report.send(posed_at((4.0 * k / 10, 1.0, 30.0), k * S // 10), state())
    odometry, time_ns = sent[-1]
    assert time_ns == 2 * S // 10
    assert odometry.position_ned_m == pytest.approx((1.0, 0.8, -30.0))
    assert abs(float(np.dot(odometry.q_ned_body, wxyz(BODY)))) == pytest.approx(1.0, abs=1e-9)
    assert odometry.velocity_frd_m_s == pytest.approx(BODY.inv().apply([0.0, 4.0, 0.0]))
    assert np.diag(odometry.pose_covariance) == pytest.approx([0.09, 0.04, 0.16, 2e-4, 1e-4, 3e-4])
    assert (odometry.reset_counter, odometry.quality_percent) == (0, 75)
    assert all(math.isnan(v) for v in sent[0][0].velocity_frd_m_s)


def test_a_fixed_mount_needs_no_gimbal() -> None:
    sent: list[BodyOdometry] = []
    camera = CameraConfig(mount="fixed", mount_pitch_deg=-60.0, mount_yaw_deg=20.0)
    mount = Rotation.from_euler("ZYX", [20.0, -60.0, 0.0], degrees=True)
    report = OdometryReport(camera, lambda o, t: sent.append(o))
    report.send(posed_at((0.0, 0.0, 30.0), 0, BODY * mount), None)
    assert abs(float(np.dot(sent[0].q_ned_body, wxyz(BODY)))) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("is_found", [False, True])
def test_the_body_is_upright_whatever_way_up_its_images_are(is_found: bool) -> None:
    """The roll is stated, or found in flight, when the prior alone knows of it."""
    sent: list[BodyOdometry] = []
    camera = CameraConfig() if is_found else CameraConfig(image_roll_deg=90.0)
    posed = posed_at((0.0, 0.0, 30.0), 0, HEAD)
    T = posed.pose.T_world_camera if posed.pose is not None else np.eye(4)
    T[:3, :3] = R_ENU_NED @ HEAD.as_matrix() @ gimbal_from_camera(90.0)
    prior = PosePrior(R_world_camera=T[:3, :3], is_view_assumed=not is_found)
    posed = replace(posed, frame=replace(posed.frame, prior=prior))
    OdometryReport(camera, lambda o, t: sent.append(o)).send(posed, state())
    assert abs(float(np.dot(sent[0].q_ned_body, wxyz(BODY)))) == pytest.approx(1.0, abs=1e-9)


def test_resets_are_counted_and_lost_frames_left_out() -> None:
    sent: list[BodyOdometry] = []
    report = OdometryReport(CameraConfig(), lambda o, t: sent.append(o))
    way = [(k * 1.0, 0.0, 30.0) for k in range(6)]
    for k, place in enumerate(way):  # a fast vehicle: no step of it is a jump
        report.send(posed_at(place, k * S // 10), state())
    assert report.resets == 0
    report.send(posed_at((9.0, 0.0, 30.0), 6 * S // 10), state())  # a loop was closed
    assert sent[-1].reset_counter == 1
    assert sent[-1].velocity_frd_m_s == pytest.approx(BODY.inv().apply([0.0, 10.0, 0.0]))
    report.send(posed_at((10.0, 0.0, 30.0), 7 * S // 10), state())
    assert report.resets == 1
    lost = FramePosed(Frame(NO_IMAGE, 8 * S // 10, 0, state=Tracking.LOST))
    report.send(lost, state())
    assert len(sent) == 8
    report.send(posed_at((11.0, 0.0, 30.0), 9 * S // 10, segment=1), state())
    assert sent[-1].reset_counter == 2


@pytest.mark.parametrize("wanted", [True, False])
def test_it_reaches_the_autopilot_stamped_with_its_clock_only_when_wanted(wanted: bool) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(0.1)
        address = f"udpout:127.0.0.1:{autopilot.getsockname()[1]}"
        with RehearsalVehicle(address, odometry=wanted) as vehicle:
            _, peer = autopilot.recvfrom(65536)
            mouth, boot = dialect.MAVLink(None, 1, 1), time.monotonic_ns() - 500 * S
            for message in (
                dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
                dialect.MAVLink_attitude_message(500_000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            ):
                autopilot.sendto(bytes(message.pack(mouth)), peer)
            until(lambda: vehicle.link.boot_time_us(0) is not None)
            now_ns = time.monotonic_ns()
            report = OdometryReport(CameraConfig(), vehicle.link.report_odometry)
            report.send(posed_at((1.0, 2.0, 30.0), now_ns), state())
            ear, framer = dialect.MAVLink(None), Framer()
            heard: list[Any] = []
            end = time.monotonic() + (5.0 if wanted else 0.5)
            while not heard and time.monotonic() < end:
                try:
                    packets = framer.feed(autopilot.recv(65536))
                except TimeoutError:
                    continue
                heard = [ear.decode(bytearray(p.data)) for p in packets if p.message_id == 331]
    assert bool(heard) is wanted
    if wanted:
        assert heard[0].time_usec == pytest.approx((now_ns - boot) / 1000, abs=20_000_000)
        assert (heard[0].x, heard[0].y, heard[0].z) == (2.0, 1.0, -30.0)
        assert heard[0].pose_covariance[0] == pytest.approx(0.09)


K = np.array([[500.0, 0.0, 499.5], [0.0, 500.0, 374.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(K, np.zeros(5), (1000, 750))


def above(head: Rotation | None, **known: Any) -> VehicleState:
    """A vehicle 100 m above ground in Zurich."""
    place = {"lat_deg": 47.4, "lon_deg": 8.5, "alt_amsl_m": 550.0, "alt_agl_m": 100.0}
    q = None if head is None else wxyz(head)
    return VehicleState(0, q_ned_gimbal_wxyz=q, sources=("terrain",), **(place | known))


def test_the_field_of_view_ends_on_the_ground_where_the_camera_looks() -> None:
    east = Rotation.from_euler("ZYX", [math.pi / 2, -math.pi / 4, 0.0])
    view = camera_view(CameraConfig(mount="gimbal"), CAMERA, above(east))
    assert view.camera == pytest.approx((47.4, 8.5, 550.0), abs=1e-6)
    assert view.hfov_deg == pytest.approx(90.0)
    assert view.vfov_deg == pytest.approx(2 * math.degrees(math.atan(0.75)))
    assert view.q_ned_camera_wxyz == pytest.approx(list(wxyz(east)))
    assert view.ground is not None
    a_degree_m = 6_388_000 * math.pi / 180 * math.cos(math.radians(47.4))
    assert view.ground[0] == pytest.approx(47.4, abs=1e-6)
    assert (view.ground[1] - 8.5) * a_degree_m == pytest.approx(100.0, rel=0.01)
    assert view.ground[2] == pytest.approx(450.0, abs=0.1)


@pytest.mark.parametrize(
    ("state", "has_place", "has_head"),
    [
        (None, False, False),
        (above(None), True, False),
        (above(HEAD, alt_amsl_m=None), False, True),
        (above(HEAD, alt_agl_m=None), True, True),
        (above(Rotation.identity()), True, True),  # at the horizon
    ],
)
def test_what_telemetry_does_not_tell_stays_unknown(
    state: VehicleState | None, has_place: bool, has_head: bool
) -> None:
    view = camera_view(CameraConfig(mount="gimbal"), CAMERA, state)
    assert (view.camera is not None, view.q_ned_camera_wxyz is not None) == (has_place, has_head)
    assert view.ground is None and view.hfov_deg == pytest.approx(90.0)


def test_the_field_of_view_never_waits_for_telemetry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that asks is the one that delivers it."""

    def wait(*_: object) -> None:
        raise AssertionError("waited")

    daemon = Daemon(load_config(None, [f"scan.folder={tmp_path}", "health.http="]))
    assert daemon.actions.view().camera is None
    daemon.scanning.camera, daemon.actions.is_ready = CAMERA, True
    history, now_ns = daemon.vehicle.history, time.monotonic_ns()
    monkeypatch.setattr(VehicleHistory, "_await", wait)
    for age_s in (2.0, 1.0, 0.0):
        history.add(PositionSample(None, 47.4, 8.5, 550.0, 100.0, None), now_ns - round(age_s * S))
    view = daemon.actions.view()
    assert view.camera == pytest.approx((47.4, 8.5, 550.0), abs=1e-6)
    assert view.q_ned_camera_wxyz is None
