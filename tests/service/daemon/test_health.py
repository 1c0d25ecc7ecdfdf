"""The service's report about itself and the machine, and its files on the disk."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect  # type: ignore[import-untyped]

from mavlink.component.status import computer_status
from service.config import Config, load_config, reload
from service.daemon.health import DESCRIPTION, HealthServer, metrics_text
from service.daemon.machine import Machine, computer_load, read_machine
from service.daemon.runtime import Daemon
from service.errors import InputError, OutsideError
from service.init_system import Notifier
from service.scans.retention import Claim, close_open_scans, make_room
from service.stream.records import ScanHeader
from service.stream.store import ScanStore
from service.workers import Workers, running


def fetch(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=10) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_http_tells_health_status_and_metrics() -> None:
    snapshot: dict[str, Any] = {
        "ok": True,
        "state": "scanning",
        "fault": "",
        "machine": {"temperature_c": 61.5, "throttled": False},
        "distance_m": 12,
    }
    server = HealthServer("127.0.0.1:0", lambda: snapshot)
    try:
        assert fetch(server.port, "/healthz")[0] == 200
        assert json.loads(fetch(server.port, "/status")[1]) == snapshot
        code, text = fetch(server.port, "/metrics?x=1")
        assert code == 200
        values = dict(line.split() for line in text.splitlines() if not line.startswith("#"))
        assert values == {
            "skyrelief_ok": "1",
            "skyrelief_machine_temperature_c": "61.5",
            "skyrelief_machine_throttled": "0",
            "skyrelief_distance_m": "12",
        }
        snapshot |= {"ok": False, "fault": "camera lost"}
        code, text = fetch(server.port, "/healthz")
        assert code == 503
        assert json.loads(text)["fault"] == "camera lost"
        assert fetch(server.port, "/etc/passwd")[0] == 404
        described = json.loads(fetch(server.port, "/openapi.json")[1])["paths"]
        assert set(described) == {"/healthz", "/status", "/metrics", "/openapi.json"}
        for method, code in (("HEAD", 200), ("POST", 405), ("DELETE", 405)):
            assert asked(server.port, "/status", method) == (code, "")
        with pytest.raises(OutsideError, match="another port"):
            HealthServer(f"127.0.0.1:{server.port}", lambda: snapshot)
    finally:
        server.close()


def asked(port: int, path: str, method: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def test_the_description_holds_for_what_the_daemon_says(tmp_path: Path) -> None:
    daemon = Daemon(load_config(None, [f"scan.folder={tmp_path}", "health.http="]))
    found = daemon.snapshot()
    kinds = {"string": str, "boolean": bool, "integer": int, "object": dict, "array": list}
    described = json.loads(DESCRIPTION.read_text(encoding="utf-8"))["paths"]["/status"]["get"]
    status = described["responses"]["200"]["content"]["application/json"]["schema"]
    worker = status["properties"]["workers"]["items"]
    waiting = Workers()
    waiting.every("coverage", 60.0, lambda: None)
    entry = next(entry for entry in running() if entry["name"] == "coverage")
    waiting.stop()
    assert set(worker["required"]) <= set(entry) == set(worker["properties"])
    for schema, value in ((status, found), (status["properties"]["load"], found["load"])):
        assert set(schema["required"]) <= set(value) <= set(schema["properties"])
        for name, given in value.items():
            kind = schema["properties"][name]["type"]
            assert isinstance(given, kinds.get(kind, (int, float))), name


@pytest.mark.parametrize(
    "hostile", [b"\0" * 2000, b"GET\r\n\r\n", b"POST /status HTTP/1.1\r\n\r\n", b"GET / HTTP/9\r\n"]
)
def test_http_survives_hostile_bytes(hostile: bytes) -> None:
    server = HealthServer("127.0.0.1:0", lambda: {"ok": True})
    try:
        with socket.create_connection(("127.0.0.1", server.port), timeout=10) as client:
            client.sendall(hostile)
            client.shutdown(socket.SHUT_WR)
            while client.recv(4096):
                pass
        assert fetch(server.port, "/healthz")[0] == 200
    finally:
        server.close()


def test_why_it_cannot_start_is_reported_before_it_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    said: dict[str, Any] = {}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
            radio.bind(("127.0.0.1", 0))
            radio.settimeout(30.0)
            link = f"udpout:127.0.0.1:{radio.getsockname()[1]}"
            given = [f"scan.folder={tmp_path}", "health.http=", f"mavlink.links={link}"]
            daemon = Daemon(load_config(None, given), report_fault_s=60.0)

            def hear() -> None:
                heard = dialect.MAVLink(None)
                while "text" not in said or said.get("state") != dialect.MAV_STATE_CRITICAL:
                    for message in heard.parse_buffer(radio.recv(2048)) or []:
                        if message.get_type() == "HEARTBEAT":
                            said["state"] = message.system_status
                        elif message.get_type() == "STATUSTEXT":
                            said.setdefault("text", message.text)  # its first part
                said["ok"] = daemon.snapshot()["ok"]
                daemon.quit()

            operator = threading.Thread(target=hear, daemon=True)
            operator.start()
            with pytest.raises(InputError, match=r"camera\.source is not set"):
                daemon.run()
            operator.join()
        reported = [listener.recv(200).decode() for _ in range(2)]
    assert said["text"].startswith("Not ready: camera.source is not set")
    assert said["ok"] is False
    assert reported == [
        "STATUS=camera.source is not set; give it in the configuration file",
        "STOPPING=1",
    ]


@pytest.mark.parametrize(
    ("broken", "complaint"),
    [
        ("[scan]\nfolde = '/tmp'\n", "no key scan.folde; did you mean"),
        ("[mavlink]\nlinks = [\n", "is not TOML"),
    ],
)
def test_a_broken_configuration_is_reported_before_it_is_tried_again(
    tmp_path: Path, broken: str, complaint: str
) -> None:
    """By systemd's status, and by MAVLink where the section of the links is whole."""
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as init,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio,
    ):
        init.bind(str(tmp_path / "notify"))
        radio.bind(("127.0.0.1", 0))
        init.settimeout(60.0)
        radio.settimeout(60.0)
        file = tmp_path / "skyrelief.toml"
        link = f"[mavlink]\nlinks = ['udpout:127.0.0.1:{radio.getsockname()[1]}']\n"
        is_heard = "[mavlink]" not in broken
        file.write_text(broken + (link if is_heard else ""))
        command = [sys.executable, "-m", "service.cli", "run", "--config", str(file)]
        environment = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE) as service:
            try:
                status = init.recv(500).decode()
                reported = "" if not is_heard else _first_text(radio)
                service.terminate()
                assert service.wait(timeout=60.0) == 2
            finally:
                service.kill()
    assert status.startswith(f"STATUS={file}") and complaint in status
    assert reported == ("Not ready: " + status[7:])[: len(reported)] and bool(reported) == is_heard


def _first_text(radio: socket.socket) -> str:
    """The first part of the first STATUSTEXT that comes."""
    heard = dialect.MAVLink(None)
    while True:
        for message in heard.parse_buffer(radio.recv(2048)) or []:
            if message.get_type() == "STATUSTEXT":
                return str(message.text)


def test_metric_names_are_plain() -> None:
    assert metrics_text({"a b-ü": 1.5, "text": "no", "deep": {"er": {"x": 2}}}) == (
        "# TYPE skyrelief_a_b__ gauge\nskyrelief_a_b__ 1.5\n"
        "# TYPE skyrelief_deep_er_x gauge\nskyrelief_deep_er_x 2\n"
    )


def test_systemd_is_notified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(path)
        monkeypatch.setenv("NOTIFY_SOCKET", path)
        notifier = Notifier()
        notifier.ready()
        notifier.alive("scanning")
        notifier.stopping()
        reported = [listener.recv(200).decode() for _ in range(3)]
    assert reported == ["READY=1", "WATCHDOG=1\nSTATUS=scanning", "STOPPING=1"]
    notifier.alive()  # nothing listens any more
    monkeypatch.delenv("NOTIFY_SOCKET")
    Notifier().ready()


def test_machine_of_a_raspberry_pi_and_a_jetson(tmp_path: Path) -> None:
    def put(name: str, text: str) -> None:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    put("proc/device-tree/model", "Raspberry Pi 5 Model B\0")
    put("sys/class/thermal/thermal_zone0/temp", "48500\n")
    put("sys/class/thermal/thermal_zone1/temp", "71250\n")
    put("sys/class/thermal/thermal_zone2/temp", "-273000\n")  # a sensor that is not there
    put("sys/devices/platform/soc/soc:firmware/get_throttled", "50000\n")  # once, not now
    found = read_machine(tmp_path, tmp_path)
    assert found.model == "Raspberry Pi 5 Model B"
    assert found.temperature_c == 71.25
    assert found.throttled is False
    assert found.power_w is None
    assert "power_w" not in found.to_dict()
    put("sys/devices/platform/soc/soc:firmware/get_throttled", "50005\n")
    assert read_machine(tmp_path, tmp_path).throttled is True
    shutil.rmtree(tmp_path / "sys/devices")
    put("sys/class/thermal/cooling_device0/type", "pwm-fan\n")
    put("sys/class/thermal/cooling_device0/cur_state", "3\n")
    put("sys/class/thermal/cooling_device1/type", "gpu-throttle-alert\n")
    put("sys/class/thermal/cooling_device1/cur_state", "0\n")
    put("sys/class/hwmon/hwmon3/name", "ina3221\n")
    put("sys/class/hwmon/hwmon3/in1_label", "VDD_IN\n")
    put("sys/class/hwmon/hwmon3/in1_input", "5040\n")
    put("sys/class/hwmon/hwmon3/curr1_input", "1500\n")
    found = read_machine(tmp_path, tmp_path)
    assert found.throttled is False
    assert found.power_w == pytest.approx(7.56)


def test_load_as_the_operator_sees_it() -> None:
    machine = Machine(
        "m",
        temperature_c=61.6,
        memory_free_mib=1000.0,
        memory_total_mib=4000.0,
        disk_free_mib=500.0,
        disk_total_mib=9000.0,
    )
    load = computer_load(machine, (74.9, 0.0), keep_free_mib=2048.0)
    assert (load.cpu_percent, load.temperature_c) == ((74.9, 0.0), 61.6)
    sent = computer_status(load, 0, 0)
    assert (sent.cpu_cores[:3], sent.temperature_board) == ([75, 0, 255], 62)
    assert (load.ram_used_mib, load.ram_total_mib) == (3000, 4000)
    assert (load.storage_used_mib, load.storage_total_mib) == (8500, 9000)
    assert load.disk_full
    assert not load.throttled
    assert computer_load(Machine("m"), (), 0.0).ram_used_mib is None


def test_this_machine_can_be_read(tmp_path: Path) -> None:
    found = read_machine(tmp_path / "not" / "yet" / "there")
    assert found.disk_free_mib is not None
    assert found.disk_free_mib > 0
    assert found.resident_mib is not None
    assert 1 < found.resident_mib < 100_000
    assert found.memory_free_mib is not None and found.memory_total_mib is not None
    assert 0 < found.memory_free_mib <= found.memory_total_mib


def scan(folder: Path, name: str, finished: bool) -> Path:
    header = ScanHeader(
        scan_id=name,
        drone="d",
        started_unix_ns=1_700_000_000_000_000_000,
        origin_lat_deg=None,
        origin_lon_deg=None,
        origin_alt_amsl_m=None,
        epsg=None,
        camera={},
        configuration={},
        software="test",
        georeference="none",
        notes=(),
    )
    with ScanStore.create(folder / name / "scan.db", header) as store:
        if finished:
            store.finish({"frames": 1})
    return folder / name


def test_open_scans_are_closed_after_a_crash(tmp_path: Path) -> None:
    left = scan(tmp_path, "20260101T000000Z", finished=False)
    done = scan(tmp_path, "20260102T000000Z", finished=True)
    (done / "scan.json").write_text("{}")
    half = scan(tmp_path, "20260103T000000Z", finished=True)  # killed before its files were there
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "scan.db").write_bytes(b"no database")
    assert close_open_scans(tmp_path, {left.name, half.name}) == []  # in the making
    assert close_open_scans(tmp_path, ()) == [left.name, half.name]
    with ScanStore.open(left / "scan.db") as store:
        assert store.finished
        assert store.summary == {"interrupted": True}
    assert json.loads((left / "scan.json").read_text())["finished"] is True
    assert (done / "scan.json").read_text() == "{}"
    with ScanStore.open(half / "scan.db") as store:
        assert store.summary == {"frames": 1}
    assert (half / "cloud.laz").is_file()
    assert close_open_scans(tmp_path, ()) == []


@pytest.mark.slow
def test_a_scan_left_open_is_found_whatever_the_clock_says(tmp_path: Path) -> None:
    left = scan(tmp_path, "20990101T000000Z", finished=False)
    os.utime(left / "scan.db", (4e9, 4e9))  # the clock is behind that since the power cut
    assert close_open_scans(tmp_path, ()) == [left.name]


@pytest.mark.slow
def test_a_second_service_leaves_the_scans_of_the_first_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    running = scan(tmp_path, "20260101T000000Z", finished=False)
    first, second = Claim(), Daemon(load_config(None, [f"scan.folder={tmp_path}"]))
    assert first.take(tmp_path)
    assert not Claim().take(tmp_path)
    second.recover()
    assert "another service" in caplog.text
    with ScanStore.open(running / "scan.db") as store:
        assert not store.finished
    first.give_up()
    second.recover()
    with ScanStore.open(running / "scan.db") as store:
        assert store.finished
    assert Claim().take(tmp_path / "new") and (tmp_path / "new").is_dir()
    assert Claim().take(Path("/proc/no-such-place"))  # nothing makes scans there


def test_oldest_finished_scans_make_room(tmp_path: Path) -> None:
    names = [f"2026010{i}T000000Z" for i in range(1, 7)]
    for i, name in enumerate(names):
        scan(tmp_path, name, finished=i != 1)

    def free(_: Path) -> int:
        """Of a disk of 1000 MiB on which every scan takes 150."""
        return (1000 - 150 * len(list(tmp_path.iterdir()))) << 20

    room = partial(make_room, free=free)
    assert room(tmp_path, 0.0) == []
    assert room(tmp_path, 50.0) == []
    assert room(tmp_path, 300.0, keep={names[2]}) == [names[0], names[3]]
    assert (tmp_path / names[1]).is_dir()  # still open
    assert room(tmp_path, 1e6, keep={names[5]}) == [names[2], names[4]]
    assert sorted(p.name for p in tmp_path.iterdir()) == [names[1], names[5]]
    assert room(tmp_path / "none", 100.0) == []


def test_reload_takes_what_may_change_live() -> None:
    wanted = load_config(None, ["scan.baseline=4", "compute.labels=32"])
    now, taken, waiting = reload(Config(), wanted)
    assert now.scan.baseline == 4.0
    assert now.compute.labels == Config().compute.labels
    assert (taken, waiting) == (["scan.baseline"], ["compute.labels"])
    assert reload(now, now) == (now, [], [])
