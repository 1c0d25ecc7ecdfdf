"""Real peers on the loopback: mavsdk, MAVProxy and pymavlink; a serial line that is unplugged."""

from __future__ import annotations

import contextlib
import json
import math
import os
import pty
import shutil
import socket
import subprocess
import sys
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mavlink import quaternion
from mavlink.camera import KeyframeReport
from mavlink.control import Answer, Result, Work
from mavlink.framing import Framer
from mavlink.link import LinkSpec, parse_link
from mavlink.logs import load_telemetry
from mavlink.logs.tlog import packets
from mavlink.presence import Health
from mavlink.recorder import Recorder
from mavlink.rehearsal import RehearsalControl
from mavlink.signing import Signing
from mavlink.vehicle import VehicleConfig, VehicleLink
from mavlink.wire import dialect

S = 1_000_000_000


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def until(done: Callable[[], Any], limit_s: float = 15.0) -> Any:
    """What ``done`` gives once it is true; the test fails when that takes too long."""
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        value = done()
        if value:
            return value
        time.sleep(0.02)
    pytest.fail(f"nothing came in {limit_s} s")


class Daemon:
    """A VehicleLink whose health is confirmed, over a control that scans nothing."""

    def __init__(self, *links: str, **settings: Any) -> None:
        self.control = RehearsalControl()
        self.link = VehicleLink(VehicleConfig(links=links, **settings), self.control)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._confirm, daemon=True)

    def __enter__(self) -> Daemon:
        self.link.start()
        self._thread.start()
        listening = [r for r in self.link.report().links if r.name.startswith(("udpin", "tcpin"))]
        until(lambda: all(self._is_up(r.name) for r in listening))
        return self

    def _is_up(self, name: str) -> bool:
        return any(r.is_up for r in self.link.report().links if r.name == name)

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.link.stop()

    def _confirm(self) -> None:
        while not self._stop.wait(0.2):
            recording = self.control.state.is_recording
            self.link.set_health(Health.ACTIVE if recording else Health.STANDBY)


# mavsdk as the ground station


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


@pytest.fixture
def joined() -> Iterator[tuple[Daemon, Ground, Any]]:
    port = free_port()
    ground = Ground(port)
    with contextlib.closing(ground), Daemon(f"udpout:127.0.0.1:{port}") as daemon:
        yield daemon, ground, ground.find()


def test_mavsdk_finds_components_and_the_camera(joined: tuple[Daemon, Ground, Any]) -> None:
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


def test_mavsdk_records_and_takes_photos(joined: tuple[Daemon, Ground, Any]) -> None:
    daemon, ground, system = joined
    from mavsdk.plugins.camera.camera import Camera, CameraError

    camera = ground.use(Camera(system))
    until(lambda: camera.camera_list().cameras)
    captures: list[Any] = []
    camera.subscribe_capture_info(lambda info, _: captures.append(info))
    camera.start_video(100)
    assert daemon.control.state.is_recording
    camera.take_photo(100)
    assert daemon.control.asked == ["start_scan", "capture_keyframe"]
    head = quaternion.from_rpy(0.0, -1.2, 2.0)
    daemon.link.report_keyframe(
        KeyframeReport(1_700_000_000_000_000, 47.3, 8.5, 512.0, 80.0, head, True, "keyframe/0")
    )
    info = until(lambda: captures)[0]
    assert info.is_success and info.index == 0 and info.file_url == "keyframe/0"
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


def test_mavsdk_sets_parameters_and_reads_texts(joined: tuple[Daemon, Ground, Any]) -> None:
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
    assert daemon.link.parameter("SR_BASELINE_M") == 2.5
    assert {p.name for p in param.get_all_params().float_params} >= {"SR_BASELINE_M"}
    with pytest.raises(ParamError):
        param.set_param_float("SR_BASELINE_M", 1e6)
    assert daemon.link.parameter("SR_BASELINE_M") == 2.5
    daemon.link.statustext("Scan 7 written, 312 keyframes")
    until(lambda: "Scan 7 written, 312 keyframes" in texts)
    assert any("SR_BASELINE_M refused" in text for text in texts)


def test_mavsdk_downloads_the_definition_and_sets_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mavsdk")
    monkeypatch.setenv("HOME", str(tmp_path))  # its cache would hide the download
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    from mavsdk.plugins.camera.camera import Camera, Option, Setting

    port = free_port()
    ground = Ground(port)
    with contextlib.closing(ground), Daemon(f"udpout:127.0.0.1:{port}") as daemon:
        camera = ground.use(Camera(ground.find()))
        until(lambda: camera.camera_list().cameras)

        def options() -> Any:
            with contextlib.suppress(Exception):
                return camera.get_possible_setting_options(100)
            return None

        known = {o.setting_id: o for o in until(options)}
        assert set(known) == set(daemon.link.parameters())
        frames = [option.option_description for option in known["SR_YAW_FRAME"].options]
        assert frames == ["auto", "vehicle", "earth", "body", "servo"]
        camera.set_setting(100, Setting("SR_YAW_FRAME", "", Option("3", ""), False))
        assert daemon.link.history.config.gimbal.yaw_frame == "body"
        camera.set_setting(100, Setting("SR_BASELINE_M", "", Option("2.5", ""), True))
        assert daemon.link.parameter("SR_BASELINE_M") == 2.5


def test_mavsdk_waits_for_work_and_survives_lost_answers() -> None:
    pytest.importorskip("mavsdk")
    from service.ground.operator import Operator

    inner, outer = free_port(), free_port()
    with Daemon(f"udpout:127.0.0.1:{inner}") as daemon, LossyRelay(inner, outer) as relay:
        work = daemon.control.works["finalise"] = Work()
        threading.Timer(1.2, work.finish).start()
        with Operator(f"udpin://127.0.0.1:{outer}", None, 10.0) as operator:
            relay.lose = {(77, 2)}  # the first two acknowledgements
            ack = operator.command(31010, 191, (5.0,))
        assert ack.result == 0 and ack.component == 191
        assert daemon.control.asked == ["finalise"]
        assert relay.lost == 2


class LossyRelay:
    """Passes datagrams between the companion and a ground station, less what it is told to lose."""

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


# skyrelief ctl


def run_ctl(port: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "service.cli", "ctl", *arguments]
    command += ["--connect", f"udpin://127.0.0.1:{port}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_ctl_steers_a_scan() -> None:
    pytest.importorskip("mavsdk")
    port = free_port()
    with Daemon(f"udpout:127.0.0.1:{port}") as daemon:
        started = run_ctl(port, "start", "--json")
        assert started.returncode == 0, started.stderr
        answer = json.loads(started.stdout.splitlines()[-1])
        assert answer == {"action": "start", "result": "accepted", "system": 1, "component": 100}
        assert run_ctl(port, "baseline", "2.5").returncode == 0
        assert daemon.link.parameter("SR_BASELINE_M") == 2.5
        status = json.loads(run_ctl(port, "status", "--json").stdout.splitlines()[-1])
        assert status["recording"] is True and status["state"] == "scanning"
        assert status["storage_free_mib"] == 750.0
        refused = run_ctl(port, "selftest")
        assert refused.returncode == 3
        assert "stop the scan before the self-test" in refused.stderr
        assert run_ctl(port, "stop").returncode == 0
        assert daemon.control.asked == ["start_scan", "SR_BASELINE_M=2.5", "stop_scan"]


@pytest.mark.parametrize("as_json", [True, False])
def test_ctl_watches(as_json: bool) -> None:
    pytest.importorskip("mavsdk")
    port = free_port()
    with Daemon(f"udpout:127.0.0.1:{port}") as daemon:
        done = threading.Event()

        def talk() -> None:
            k = 0
            while not done.wait(0.2):
                k += 1
                daemon.link.statustext(f"Scan text {k}")
                daemon.link.report_keyframe(KeyframeReport(1, 47.3, 8.5, 512.0, 80.0))

        talker = threading.Thread(target=talk)
        talker.start()
        watched = run_ctl(port, "watch", "--seconds", "2", *(["--json"] if as_json else []))
        done.set()
        talker.join()
    assert watched.returncode == 0, watched.stderr
    lines = watched.stdout.splitlines()
    if as_json:
        messages = {message["message"]: message for message in map(json.loads, lines)}
        assert messages["STATUSTEXT"]["text"].startswith("Scan text")
        assert messages["CAMERA_IMAGE_CAPTURED"]["component"] == 100
    else:
        assert any(line.startswith("Scan text") for line in lines)
        assert any("at 47.3000000, 8.5000000, 512.0 m" in line for line in lines)


def test_ctl_says_when_nobody_or_the_wrong_one_answers() -> None:
    pytest.importorskip("mavsdk")
    port = free_port()
    nobody = run_ctl(port, "start", "--timeout", "1")
    assert nobody.returncode == 3 and "no skyrelief companion heard" in nobody.stderr
    with Impostor(port):
        wrong = run_ctl(port, "pause")
        assert wrong.returncode == 3
        assert "component 1 of system 1 answered (accepted) instead" in wrong.stderr


class Impostor:
    """An autopilot that relays our heartbeats but carries our commands out itself."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.2)
        self._ground = ("127.0.0.1", port)
        self._open = True
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Impostor:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open = False
        self._thread.join()
        self._socket.close()

    def _say(self, component: int, message: Any) -> None:
        encoder = dialect.MAVLink(None, 1, component)
        self._socket.sendto(bytes(message.pack(encoder)), self._ground)

    def _run(self) -> None:
        framer, ear = Framer(), dialect.MAVLink(None)
        beat = 0.0
        while self._open:
            if time.monotonic() > beat:
                beat = time.monotonic() + 0.3
                for component, kind in ((1, 2), (191, 18), (100, 30)):
                    autopilot = 3 if component == 1 else 8
                    message = dialect.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)
                    self._say(component, message)
            with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                for packet in framer.feed(self._socket.recv(65536)):
                    if packet.message_id == 76:
                        m = ear.decode(bytearray(packet.data))
                        ack = (m.command, 0, 255, 0, packet.system, packet.component)
                        self._say(1, dialect.MAVLink_command_ack_message(*ack))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fly"], "there are start, stop"),
        (["baseline"], "takes metres"),
        (["start", "3"], "takes metres"),
        (["baseline", "nan"], "0 or more"),
        (["start", "--timeout", "0"], "give seconds"),
    ],
)
def test_ctl_refuses_wrong_usage_in_one_line(arguments: list[str], words: str) -> None:
    done = run_ctl(free_port(), *arguments)
    assert done.returncode == 2 and words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


# mavsdk as the autopilot


def test_telemetry_of_a_simulated_autopilot_becomes_history(tmp_path: Path) -> None:
    mavsdk = pytest.importorskip("mavsdk")
    from mavsdk.plugins.mavlink_direct_server import mavlink_direct_server as server  # type: ignore[import-untyped]

    port = free_port()
    daemon = Daemon(f"udpin:127.0.0.1:{port}", state_dir=tmp_path)
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


# MAVProxy


def test_mavproxy_drives_both_components(tmp_path: Path) -> None:
    program = shutil.which("mavproxy.py")
    if program is None:
        pytest.skip("MAVProxy is not installed")
    port = free_port()
    with Daemon(f"udpout:127.0.0.1:{port}") as daemon:
        proxy = subprocess.Popen(
            [program, f"--master=udpin:127.0.0.1:{port}", f"--state-basedir={tmp_path}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=tmp_path,
        )
        assert proxy.stdin is not None
        lines: list[str] = []
        reader = threading.Thread(
            target=lambda: lines.extend(iter(proxy.stdout.readline, "")),  # type: ignore[union-attr]
            daemon=True,
        )
        reader.start()
        try:
            until(lambda: any("191" in line for line in lines), 40.0)

            def type_in(*commands: str) -> None:
                for command in commands:
                    proxy.stdin.write(command + "\n")  # type: ignore[union-attr]
                    proxy.stdin.flush()  # type: ignore[union-attr]
                    time.sleep(0.3)

            type_in("set target_system 1", "set target_component 100")
            type_in("long MAV_CMD_VIDEO_START_CAPTURE 0 0 0 0 0 0 0")
            until(lambda: daemon.control.state.is_recording)
            type_in("set target_component 191", "long MAV_CMD_USER_1 1 0 0 0 0 0 0")
            until(lambda: "pause" in daemon.control.asked)
            type_in("long MAV_CMD_COMPONENT_ARM_DISARM 1 0 0 0 0 0 0")
            until(lambda: any("UNSUPPORTED" in line for line in lines))
        finally:
            proxy.kill()
            proxy.wait()
            reader.join(timeout=5)
            assert proxy.stdout is not None
            proxy.stdin.close()
            proxy.stdout.close()


# pymavlink's own connection


def test_pymavlink_over_tcp_and_the_link_comes_back() -> None:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    port = free_port(socket.SOCK_STREAM)
    with Daemon(f"tcpin:127.0.0.1:{port}") as daemon:
        for _ in range(2):  # a client that leaves and another one
            client = mavutil.mavlink_connection(
                f"tcp:127.0.0.1:{port}", dialect="ardupilotmega", source_system=255
            )
            assert client.wait_heartbeat(timeout=10) is not None
            client.mav.command_long_send(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
            ack = client.recv_match(type="COMMAND_ACK", blocking=True, timeout=10)
            assert ack is not None and ack.result == 0
            client.close()
        assert daemon.control.asked == ["start_scan"]
    # And the other way round: our client finds a server that comes late and goes away.
    late = free_port(socket.SOCK_STREAM)
    with Daemon(f"tcp:127.0.0.1:{late}") as daemon:
        time.sleep(0.3)
        for _ in range(2):
            server = socket.create_server(("127.0.0.1", late))
            server.settimeout(15.0)
            peer, _ = server.accept()
            peer.settimeout(15.0)
            framer = Framer()
            assert until(lambda: framer.feed(peer.recv(4096)))  # noqa: B023
            peer.close()
            server.close()
        until(lambda: not daemon.link.report().links[0].is_up)
        assert daemon.link.report().links[0].opened == 2


def test_signed_links_obey_only_the_key(tmp_path: Path) -> None:
    key = bytes(range(32))
    path = tmp_path / "key"
    path.write_bytes(key)
    path.chmod(0o600)
    port = free_port()
    config = {"signing_key": path, "state_dir": tmp_path}
    with (
        Daemon(f"udpin:127.0.0.1:{port}", **config) as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        peer.connect(("127.0.0.1", port))
        start = dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
        mouth = dialect.MAVLink(None, 255, 190)
        peer.send(bytes(start.pack(mouth)))
        until(lambda: daemon.link.report().unverified == 1)
        assert daemon.control.asked == []
        mouth.signing.secret_key, mouth.signing.sign_outgoing = key, True
        mouth.signing.timestamp = (time.time_ns() // 1000 - 1_420_070_400_000_000) // 10
        packet = bytes(start.pack(mouth))
        peer.send(packet)
        until(lambda: daemon.control.asked)
        peer.send(packet)  # replayed
        until(lambda: daemon.link.report().unverified == 2)
        peer.settimeout(10.0)
        (answer, *_) = Framer().feed(peer.recv(4096))
        assert answer.is_signed and Signing(key).accepts(answer)
    kept = json.loads((tmp_path / "mavlink.json").read_text())
    assert kept["signing_timestamp"] >= mouth.signing.timestamp - 1


# A serial line


def plug(path: Path) -> int:
    """A pseudo-terminal whose far end is reachable at ``path``; our end comes back."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    path.symlink_to(os.ttyname(theirs))
    os.close(theirs)
    os.set_blocking(ours, False)
    return ours


def heard(line: int, framer: Framer) -> list[int]:
    try:
        return [packet.message_id for packet in framer.feed(os.read(line, 4096))]
    except OSError:
        return []


def test_a_serial_line_is_spoken_to_first_and_survives_the_plug(tmp_path: Path) -> None:
    path = tmp_path / "autopilot"
    line = plug(path)
    with Daemon(f"serial:{path}:57600") as daemon:
        first = until(lambda: heard(line, Framer()))
        assert first[0] == 0  # a heartbeat before anything else
        mouth = dialect.MAVLink(None, 1, 1)
        beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
        os.write(line, bytes(beat.pack(mouth)))
        until(lambda: daemon.link.presence.autopilot == (1, 1))
        path.unlink()
        os.close(line)
        until(lambda: not daemon.link.report().links[0].is_up)
        assert daemon.link.report().links[0].last_error
        line = plug(path)
        until(lambda: daemon.link.report().links[0].opened >= 2)
        start = dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
        os.write(line, b"\x00\xfd noise" + bytes(start.pack(mouth)) + bytes(300))
        until(lambda: daemon.control.asked == ["start_scan"])
        framer = Framer()
        until(lambda: 77 in heard(line, framer))
    os.close(line)


# The service's side


def test_parameters_are_kept_over_a_restart(tmp_path: Path) -> None:
    port = free_port()
    for value in (2.5, 4.0):
        with (
            Daemon(f"udpin:127.0.0.1:{port}", state_dir=tmp_path) as daemon,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
        ):
            peer.connect(("127.0.0.1", port))
            if value == 4.0:
                assert daemon.link.parameter("SR_BASELINE_M") == 2.5
            message = dialect.MAVLink_param_set_message(1, 191, b"SR_BASELINE_M", value, 9)
            peer.send(bytes(message.pack(dialect.MAVLink(None, 255, 190))))
            until(lambda: daemon.link.parameter("SR_BASELINE_M") == value)  # noqa: B023
    (tmp_path / "mavlink.json").write_text("{ torn")
    with Daemon(state_dir=tmp_path) as daemon:
        assert daemon.link.parameter("SR_BASELINE_M") == 0.0


def test_a_fault_in_the_service_does_not_cost_the_link(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    with (
        Daemon(f"udpin:127.0.0.1:{port}") as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        peer.connect(("127.0.0.1", port))

        def broken() -> Answer:
            raise RuntimeError("a bug")

        daemon.control.start_scan = broken  # type: ignore[method-assign]
        mouth = dialect.MAVLink(None, 255, 190)
        start = dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
        stop = dialect.MAVLink_command_long_message(1, 191, 31010, 0, 3, 0, 0, 0, 0, 0, 0)
        peer.send(bytes(start.pack(mouth)))
        until(lambda: "a fault while serving MAVLink" in caplog.text)
        peer.send(bytes(stop.pack(mouth)))
        until(lambda: daemon.control.asked == ["clear_map"])


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("udp:0.0.0.0:14550", LinkSpec("udpin", "0.0.0.0", 14550)),
        ("udpout:10.0.0.1:14550", LinkSpec("udpout", "10.0.0.1", 14550)),
        ("tcp:host:5760", LinkSpec("tcp", "host", 5760)),
        ("serial:/dev/ttyTHS1:921600", LinkSpec("serial", "/dev/ttyTHS1", 921600)),
        ("serial:/dev/ttyACM0", LinkSpec("serial", "/dev/ttyACM0", 57600)),
        ("tlog:/data/a:b.tlog", LinkSpec("tlog", "/data/a:b.tlog", 0)),
        ("/dev/ttyACM0,115200", LinkSpec("serial", "/dev/ttyACM0", 115200)),
    ],
)
def test_links_are_named_as_pymavlink_does(text: str, spec: LinkSpec) -> None:
    assert parse_link(text) == spec


@pytest.mark.parametrize(
    "text", ["", "udp", "udpin:14550", "foo:1:2", "udpin:h:0", "udpin:h:99999", "tcp:h:x"]
)
def test_senseless_links_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="link"):
        VehicleConfig(links=(text,))


def test_tunnels_and_the_radios_state_pass_through_the_same_link() -> None:
    port = free_port()
    with (
        Daemon(f"udpin:127.0.0.1:{port}") as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        free: list[int] = []
        daemon.link.listen("RADIO_STATUS", lambda message: free.append(message.txbuf))
        peer.connect(("127.0.0.1", port))
        peer.settimeout(10.0)
        radio = dialect.MAVLink_radio_status_message(1, 1, 87, 1, 1, 0, 0)
        peer.send(bytes(radio.pack(dialect.MAVLink(None, 51, 68))))
        until(lambda: free == [87])
        daemon.link.send_tunnel(40_000, b"tile")
        ear, framer = dialect.MAVLink(None), Framer()

        def tunnel() -> Any:
            found = [p for p in framer.feed(peer.recv(4096)) if p.message_id == 385]
            return ear.decode(bytearray(found[0].data)) if found else None

        message = until(tunnel)
        assert message.payload_type == 40_000
        assert bytes(message.payload[: message.payload_length]) == b"tile"
        with pytest.raises(ValueError, match="128 bytes"):
            daemon.link.send_tunnel(40_000, bytes(129))


def test_the_last_word_is_said() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(10.0)
        with Daemon(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as daemon:
            assert peer.recv(4096)
            daemon.link.statustext("Service stops")
        peer.setblocking(False)
        heard = b""
        with contextlib.suppress(BlockingIOError):
            while True:
                heard += peer.recv(4096)
        assert b"Service stops" in heard


def test_a_recorded_flight_comes_in_as_if_it_flew_now(tmp_path: Path) -> None:
    turn = Path(__file__).parent / "data" / "mavlink" / "arducopter_turn.tlog"
    recorded = load_telemetry(turn).history
    began = (recorded.first_ns or 0) + 2 * S
    with Daemon(f"tlog:{turn}") as daemon:
        history = daemon.link.history
        until(lambda: (history.last_ns or 0) - (history.first_ns or 0) > 3 * S)
        start = history.first_ns
        assert start is not None and daemon.link.report().autopilot == (1, 1)
        live = history.state_at(start + 2 * S)
    kept = recorded.state_at(began)
    assert live is not None and kept is not None
    assert live.alt_agl_m == pytest.approx(kept.alt_agl_m, abs=0.1)
    assert live.q_ned_body_wxyz is not None and kept.q_ned_body_wxyz is not None
    assert abs(float(live.q_ned_body_wxyz @ kept.q_ned_body_wxyz)) > 0.9999
    with Daemon(f"tlog:{tmp_path / 'none.tlog'}") as daemon:
        until(lambda: "No such file" in daemon.link.report().links[0].last_error)


def test_a_full_disk_ends_the_log_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    recorder = Recorder()
    recorder.open(full)
    for k in range(3000):
        recorder.write(bytes(40), k)
    recorder.close()
    assert "telemetry log" in caplog.text


def test_odometry_time_is_the_autopilots(tmp_path: Path) -> None:
    with Daemon() as daemon:
        assert daemon.link.boot_time_us(time.monotonic_ns()) is None
    assert math.isnan(daemon.control.state.speed_m_s)
