"""mavsdk as the ground station and as the autopilot, on the loopback."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from forwarding_autopilot import ForwardingAutopilot
from loopback import free_port, until
from rehearsal import RehearsalVehicle

from mavlink.component.camera import KeyframeReport
from mavlink.component.control import Answer, Result, Work
from mavlink.component.parameters import PARAMETERS
from mavlink.telemetry import quaternion
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import CAMERA
from mavlink.wire.framing import Framer
from mavlink.wire.tlog import packets

S = 1_000_000_000

SETTINGS = {p.name for p in PARAMETERS if not p.is_constant}


class Ground:
    """mavsdk as a ground station that has found our vehicle."""

    def __init__(self, port: int) -> None:
        mavsdk = pytest.importorskip("mavsdk")
        kind = mavsdk.ComponentType.GROUND_STATION
        self.mavsdk = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind))
        self.mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        self.plugins: list[Any] = []

    def find(self) -> Any:
        def both() -> Any:
            for system in self.mavsdk.get_systems():
                if {100, 191} <= set(system.component_ids()):
                    return system
            return None

        return until(both)

    def use(self, plugin: Any) -> Any:
        self.plugins.append(plugin)
        return plugin

    def close(self) -> None:
        for plugin in self.plugins:
            plugin.destroy()
        self.mavsdk.destroy()


Joined = tuple[RehearsalVehicle, Ground, Any]


@pytest.fixture
def joined() -> Iterator[Joined]:
    port = free_port()
    ground = Ground(port)
    with contextlib.closing(ground), RehearsalVehicle(f"udpout:127.0.0.1:{port}") as daemon:
        yield daemon, ground, ground.find()


def test_mavsdk_finds_components_and_the_camera(
    joined: Joined,
) -> None:
    _, ground, system = joined
    from mavsdk.plugins.camera.camera import Camera  # type: ignore[import-untyped]

    camera = ground.use(Camera(system))
    info = until(lambda: camera.camera_list().cameras)[0]
    assert (info.component_id, info.vendor_name, info.model_name) == (100, "skyrelief", "3D scan")
    assert system.get_system_id() == 1 and system.has_camera()
    storages: list[Any] = []
    camera.subscribe_storage(lambda update, _: storages.append(update))
    storage = until(lambda: storages)[0].storage
    assert storage.total_storage_mib == pytest.approx(1000.0)


def test_mavsdk_records_and_takes_photos(joined: Joined) -> None:
    daemon, ground, system = joined
    from mavsdk.plugins.camera.camera import Camera, CameraError, Mode

    camera = ground.use(Camera(system))
    until(lambda: camera.camera_list().cameras)
    camera.set_mode(100, Mode.VIDEO)
    captures: list[Any] = []
    camera.subscribe_capture_info(lambda info, _: captures.append(info))
    camera.start_video(100)
    assert daemon.control.state.is_recording
    camera.take_photo(100)
    assert daemon.control.asked == ["start_scan", "capture_keyframe"]
    head = quaternion.from_rpy(0.0, -1.2, 2.0)
    daemon.link.report_keyframe(KeyframeReport(1_700_000_000_000_000, 47.3, 8.5, 512.0, 80.0, head))
    info = until(lambda: captures)[0]
    assert info.is_success and info.index == 0
    assert info.position.latitude_deg == pytest.approx(47.3)
    assert info.position.relative_altitude_m == pytest.approx(80.0)
    q = info.attitude_quaternion
    assert [q.w, q.x, q.y, q.z] == pytest.approx(list(head), abs=1e-5)
    camera.start_photo_interval(100, 0.5)
    until(lambda: daemon.control.asked.count("capture_keyframe") >= 3)
    camera.stop_photo_interval(100)
    camera.stop_video(100)
    assert not daemon.control.state.is_recording
    daemon.control.answers["start_scan"] = Answer(Result.DENIED, "no camera")
    with pytest.raises(CameraError):
        camera.start_video(100)


def test_mavsdk_sets_parameters_and_reads_texts(
    joined: Joined,
) -> None:
    daemon, ground, system = joined
    from mavsdk.plugins.param.param import Param, ParamError, ProtocolVersion  # type: ignore[import-untyped]
    from mavsdk.plugins.telemetry.telemetry import Telemetry  # type: ignore[import-untyped]

    texts: list[str] = []
    telemetry = ground.use(Telemetry(system))
    telemetry.subscribe_status_text(lambda status, _: texts.append(status.text))
    param = ground.use(Param(system))
    with contextlib.suppress(ParamError):  # it reports UNKNOWN and selects nevertheless
        param.select_component(191, ProtocolVersion.V1)
    assert param.get_param_float("SR_LINK_KBIT_S") == pytest.approx(1000.0)
    param.set_param_float("SR_BASELINE_M", 2.5)
    assert daemon.link.parameters()["SR_BASELINE_M"] == 2.5
    assert {p.name for p in param.get_all_params().float_params} >= {"SR_BASELINE_M"}
    with pytest.raises(ParamError):
        param.set_param_float("SR_BASELINE_M", 1e6)
    assert daemon.link.parameters()["SR_BASELINE_M"] == 2.5
    daemon.link.statustext("Scan 7 written, 312 keyframes")
    until(lambda: "Scan 7 written, 312 keyframes" in texts)
    assert any("SR_BASELINE_M refused" in text for text in texts)


def test_mavsdk_downloads_the_definition_and_sets_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mavsdk")
    monkeypatch.setenv("HOME", str(tmp_path))  # its cache would hide the download
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    from mavsdk.plugins.camera.camera import Camera, Option, Setting

    port = free_port()
    ground = Ground(port)
    with contextlib.closing(ground), RehearsalVehicle(f"udpout:127.0.0.1:{port}") as daemon:
        camera = ground.use(Camera(ground.find()))
        until(lambda: camera.camera_list().cameras)

        def options() -> Any:
            with contextlib.suppress(Exception):
                return camera.get_possible_setting_options(100)
            return None

        known = {o.setting_id: o for o in until(options)}
        assert set(known) == SETTINGS
        frames = [option.option_description for option in known["SR_YAW_FRAME"].options]
        assert frames == ["auto", "vehicle", "earth", "body", "servo"]
        camera.set_setting(100, Setting("SR_YAW_FRAME", "", Option("3", ""), False))
        assert daemon.link.history.config.yaw_frame == "body"
        camera.set_setting(100, Setting("SR_BASELINE_M", "", Option("2.5", ""), True))
        assert daemon.link.parameters()["SR_BASELINE_M"] == 2.5
        mode = dialect.MAVLink_camera_settings_message(0, 1)
        daemon.link._inbox.put(lambda: daemon.link._companion._outbox.put(CAMERA, mode))
        camera.set_setting(100, Setting("SR_BASELINE_M", "", Option("2.0", ""), True))
        assert daemon.link.parameters()["SR_BASELINE_M"] == 2.0
    said = capfd.readouterr()
    assert "Unknown setting" not in said.out + said.err  # its word for a missing CAM_MODE


def test_behind_an_autopilot_mavsdk_reads_the_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The autopilot repeats what our camera says as its own; the files are still ours.

    It does so after ours is read: MAVSDK fetches for two cameras at once into one file.
    """
    pytest.importorskip("mavsdk")
    monkeypatch.setenv("HOME", str(tmp_path))  # its cache would hide the download
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    from mavsdk.plugins.camera.camera import Camera

    inner, outer = free_port(), free_port()
    ground = Ground(outer)
    with (
        contextlib.closing(ground),
        ForwardingAutopilot(inner, outer) as autopilot,
        RehearsalVehicle(f"udpout:127.0.0.1:{inner}"),
    ):
        camera = ground.use(Camera(ground.find()))

        def settings(of: int) -> set[str]:
            with contextlib.suppress(Exception):
                return {s.setting_id for s in camera.get_current_settings(of)}
            return set()

        def cameras() -> set[int]:
            return {c.component_id for c in camera.camera_list().cameras}

        until(lambda: settings(100) == SETTINGS)  # they come one by one
        until(lambda: autopilot.camera is not None)
        copy = autopilot.camera.cam_definition_uri
        assert copy == "mftp://[;comp=100]camera.xml"  # for whoever asks the autopilot
        assert cameras() == {100}
        until(lambda: cameras() == {1, 100}, progress=autopilot.repeat)
        until(lambda: settings(100) == SETTINGS)


def test_behind_a_router_that_knows_it_mavsdk_reads_the_metadata(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mavsdk")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    from mavsdk.plugins.component_metadata.component_metadata import (  # type: ignore[import-untyped]
        ComponentMetadata,
        MetadataType,
    )

    inner, outer = free_port(), free_port()
    ground = Ground(outer)
    with (
        contextlib.closing(ground),
        ForwardingAutopilot(inner, outer, drops=frozenset()),
        RehearsalVehicle(f"udpout:127.0.0.1:{inner}") as daemon,
    ):
        metadata = ground.use(ComponentMetadata(ground.find()))
        metadata.request_component(191)

        def described() -> Any:
            with contextlib.suppress(Exception):
                return metadata.get_metadata(191, MetadataType.PARAMETER).json_metadata
            return None

        rows = json.loads(until(described))["parameters"]
        assert {row["name"] for row in rows} == set(daemon.link.parameters())


def test_mavsdk_waits_for_work_and_survives_lost_answers() -> None:
    pytest.importorskip("mavsdk")
    from service.ground.operator import Operator

    inner, outer = free_port(), free_port()
    with RehearsalVehicle(f"udpout:127.0.0.1:{inner}") as daemon, LossyRelay(inner, outer) as relay:
        work = daemon.control.works["finalise"] = Work()
        threading.Timer(1.2, work.finish).start()
        with Operator(f"udpin://127.0.0.1:{outer}", None, 10.0) as operator:
            relay.lose = {(77, 2)}  # the first two acknowledgements
            ack = operator.command(31010, 191, (5.0,))
        assert ack.result == 0 and ack.component == 191
        assert set(daemon.control.asked) == {"finalise"}  # a stop is carried out every time
        assert relay.lost == 2


class LossyRelay:
    """Passes datagrams between the companion and a ground station, less what it is set to lose."""

    def __init__(self, inner: int, outer: int) -> None:
        self._inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._inside.bind(("127.0.0.1", inner))
        self._outside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._outer = ("127.0.0.1", outer)
        self._companion: tuple[str, int] | None = None
        self.lose: set[tuple[int, int]] = set()  # (message, how many)
        self.lost = 0
        self._threads = [
            threading.Thread(target=self._outwards, daemon=True),
            threading.Thread(target=self._inwards, daemon=True),
        ]

    def __enter__(self) -> LossyRelay:
        for s in (self._inside, self._outside):
            s.settimeout(0.1)
        self._open = True
        self._outside.sendto(b"", self._outer)
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open = False
        for thread in self._threads:
            thread.join()
        self._inside.close()
        self._outside.close()

    def _outwards(self) -> None:
        framer = Framer()
        while self._open:
            with contextlib.suppress(TimeoutError):
                data, self._companion = self._inside.recvfrom(65536)
                for packet in framer.feed(data):
                    limit = dict(self.lose).get(packet.message_id, 0)
                    if self.lost < limit:
                        self.lost += 1
                    else:
                        self._outside.sendto(packet.data, self._outer)

    def _inwards(self) -> None:
        while self._open:
            with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                data, _ = self._outside.recvfrom(65536)
                if self._companion is not None:
                    self._inside.sendto(data, self._companion)


def test_telemetry_of_a_simulated_autopilot_becomes_history(tmp_path: Path) -> None:
    mavsdk = pytest.importorskip("mavsdk")
    from mavsdk.plugins.mavlink_direct_server import mavlink_direct_server as server  # type: ignore[import-untyped]

    port = free_port()
    daemon = RehearsalVehicle(f"udpin:127.0.0.1:{port}", state_dir=tmp_path)
    daemon.link.record(tmp_path / "scan.tlog")
    kind = mavsdk.ComponentType.AUTOPILOT
    autopilot = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind))
    autopilot.add_any_connection(f"udpout://127.0.0.1:{port}")
    component = autopilot.server_component_by_type(kind)
    direct = server.MavlinkDirectServer(component)

    def send(name: str, **fields: Any) -> None:
        direct.send_message(server.MavlinkMessage(name, 1, 1, 0, 0, json.dumps(fields)))

    with daemon:
        until(lambda: daemon.link.presence.autopilot == (1, 1))
        start = time.monotonic_ns()
        for _ in range(50):
            t = (time.monotonic_ns() - start) * 1e-9
            q = quaternion.from_rpy(0.1, -0.05, 0.5 * t)
            boot = round((30 + t) * 1000)
            send(
                "ATTITUDE_QUATERNION",
                time_boot_ms=boot,
                q1=q[0],
                q2=q[1],
                q3=q[2],
                q4=q[3],
                rollspeed=0,
                pitchspeed=0,
                yawspeed=0.5,
                repr_offset_q=[0, 0, 0, 0],
            )
            send(
                "GLOBAL_POSITION_INT",
                time_boot_ms=boot,
                lat=473000000,
                lon=85000000,
                alt=512000,
                relative_alt=62000,
                vx=0,
                vy=0,
                vz=0,
                hdg=65535,
            )
            time.sleep(0.02)
        until(lambda: (daemon.link.history.last_ns or 0) > start + 0.8 * S)
        t = 0.5
        state = daemon.link.history.state_at(start + round(t * S))
        assert state is not None and state.q_ned_body_wxyz is not None
        w, x, y, z = map(float, state.q_ned_body_wxyz)
        roll, pitch, yaw = quaternion.to_rpy((w, x, y, z))
        assert (roll, pitch) == pytest.approx((0.1, -0.05), abs=1e-3)
        assert yaw == pytest.approx(0.5 * t, abs=0.05)
        assert state.alt_agl_m == pytest.approx(62.0)
        report = daemon.link.report()
        assert report.autopilot == (1, 1) and report.links[0].is_up and report.dropped == 0
        daemon.link.record(None)
    direct.destroy()
    autopilot.destroy()
    with (tmp_path / "scan.tlog").open("rb") as file:
        counts: Counter[str] = Counter()
        kinds = Counter((p.component, p.message_id) for _, p in packets(file, counts))
    assert kinds[(1, 31)] >= 45 and kinds[(191, 0)] >= 1 and kinds[(100, 0)] >= 1
    assert kinds[(191, 76)] >= 5  # the rates that were asked for
    assert counts["skipped_bytes"] == 0
