"""The doctor tells what works and what does not, and never fails itself."""

from __future__ import annotations

import _thread
import json
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from command_line import interruptible
from file_modes import bound_by_modes
from loopback import free_port, until
from paths import DEMO
from pymavlink.dialects.v20 import ardupilotmega as dialect  # type: ignore[import-untyped]

from service.cameras import CAMERAS, CameraSource
from service.cameras.live import LiveConfig, open_rtmp_listen
from service.commands.diagnosis import (
    BAD,
    GOOD,
    NOTE,
    Grade,
    examine,
    examine_compute,
    examine_software,
)
from service.config import load_config
from service.daemon.warm_up import MARKER
from service.version import software


def findings(*overrides: str, listen_s: float = 0.1) -> dict[str, tuple[str, str]]:
    found = examine(
        load_config(None, ["compute.backend=cpu", "health.http=", *overrides]), listen_s
    )
    return {f.what: (f.verdict, f.text) for f in found}


def test_links_are_closed_where_it_is_interrupted() -> None:
    def threads() -> list[str]:
        return [t.name for t in threading.enumerate() if t.name.startswith("mavlink")]

    def interrupt() -> None:
        assert until(lambda: any(name.endswith("read") for name in threads()), 60.0)
        _thread.interrupt_main()

    threading.Thread(target=interrupt, daemon=True).start()
    with interruptible(), pytest.raises(KeyboardInterrupt):
        findings(f"mavlink.links=udpin:127.0.0.1:{free_port()}", listen_s=60.0)
    assert not threads()


def test_everything_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    ended = threading.Event()

    def autopilot() -> None:
        sender = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not ended.wait(0.05):
                message: Any = sender.heartbeat_encode(2, 3, 0, 0, 4)
                out.sendto(message.pack(sender), ("127.0.0.1", port))

    thread = threading.Thread(target=autopilot, daemon=True)
    thread.start()
    with socket.create_server(("127.0.0.1", 0)) as ground:
        found = findings(
            f"scan.folder={tmp_path / 'scans'}",
            f"camera.source={DEMO / 'frames'}",
            f"camera.model={DEMO / 'camera.yaml'}",
            f"mavlink.links=udpin:127.0.0.1:{port}",
            f"datalink.connect=tcp/127.0.0.1:{ground.getsockname()[1]}",
            listen_s=1.0,
        )
    ended.set()
    thread.join()
    assert "system 7" in found["mavlink"][1]
    assert "1600x1200" in found["camera"][1]
    assert {what for what, (verdict, _) in found.items() if verdict == BAD} == set()
    for what in ("python", "packages", "scans", "compute", "camera", "mavlink", "datalink"):
        assert found[what][0] == GOOD, found[what]


def test_what_is_missing_is_reported(tmp_path: Path) -> None:
    found = findings(
        f"scan.folder={tmp_path}",
        f"camera.source={tmp_path / 'none.mp4'}",
        f"camera.model={tmp_path / 'none.yaml'}",
        f"mavlink.links=udpin:127.0.0.1:{free_port()}",
        f"datalink.connect=tcp/127.0.0.1:{free_port()}",
    )
    assert found["camera"] == (BAD, f"no such file or folder: {tmp_path / 'none.mp4'}")
    assert found["camera model"][0] == BAD
    assert found["mavlink"][0] == BAD
    assert "silent" in found["mavlink"][1]
    assert found["datalink"][0] == NOTE
    bare = findings(f"scan.folder={tmp_path}")
    for what in ("camera", "camera model", "mavlink", "datalink"):
        assert bare[what][0] == NOTE
    assert findings("mavlink.links=modem:1")["mavlink"][0] == BAD
    lines = findings(f"mavlink.links=lines:127.0.0.1:{free_port()}", listen_s=1.0)
    assert "known header" in lines["mavlink"][1]


def test_a_datalink_that_the_service_refuses_is_bad(tmp_path: Path) -> None:
    assert "not encrypted" in findings("datalink.connect=tcp/192.0.2.1:7447")["datalink"][1]
    local = "datalink.connect=tcp/127.0.0.1:1"
    assert findings(local, "scan.drone=my drone")["datalink"][0] == BAD
    keys = []
    for name in ("ca", "certificate", "key"):
        (tmp_path / name).touch()
        keys.append(f"datalink.tls_{name}={tmp_path / name}")
    (tmp_path / "key").chmod(0)
    found = bound_by_modes(lambda: findings("datalink.connect=tls/127.0.0.1:1", *keys))
    verdict, text = found["datalink"]
    assert verdict == BAD and f"private key {tmp_path / 'key'} is not this user's" in text


def open_soon(rest: str, options: Mapping[str, str]) -> CameraSource:
    """As for a flight, but without its patience."""
    return open_rtmp_listen(rest, options, LiveConfig(open_s=0.2))


def test_a_camera_that_listens_waits_for_a_sender(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CAMERAS, "rtmp-listen", f"{__name__}:open_soon")
    source = f"rtmp-listen:127.0.0.1:{free_port()}/live"
    verdict, text = findings(f"camera.source={source}")["camera"]
    assert verdict == NOTE and "waits for a sender" in text
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        source = f"rtmp-listen:127.0.0.1:{taken.getsockname()[1]}/live"
        assert findings(f"camera.source={source}")["camera"][0] == BAD


def test_camera_model_of_another_size_is_reported(tmp_path: Path) -> None:
    model = tmp_path / "camera.yaml"
    model.write_text(
        (DEMO / "camera.yaml").read_text().replace("image_width: 1600", "image_width: 800")
    )
    found = findings(
        f"scan.folder={tmp_path}", f"camera.source={DEMO / 'frames'}", f"camera.model={model}"
    )
    assert found["camera"][0] == BAD
    assert "calibrate at 1600x1200" in found["camera"][1]


def test_foreign_package_is_reported() -> None:
    *_, found = examine_software(lambda name: f"/somewhere/{name}")
    assert found.what == "packages" and "shadows one of ours" in found.text


def test_command_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "service.cli",
            "doctor",
            "--json",
            "--set",
            f"scan.folder={tmp_path}",
            "--set",
            "compute.backend=cpu",
            "--set",
            f"camera.source={tmp_path / 'no'}",
        ],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 3
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["ok"] is False
    last = done.stderr.splitlines()[-1]
    assert "not ready to fly: " in last and "camera" in last


def test_what_is_missing_to_fly_is_reported(tmp_path: Path) -> None:
    given = [f"scan.folder={tmp_path}", f"camera.source={DEMO / 'frames'}"]
    assert findings(given[0])["settings"] == (
        BAD,
        "set camera.source and camera.model; the service does not start without them",
    )
    assert findings(*given)["settings"][1].startswith("set camera.model;")
    assert findings(*given, f"camera.model={DEMO / 'camera.yaml'}")["settings"][0] == NOTE


def test_the_boards_settings_are_compared() -> None:
    from service.commands.diagnosis import BOARDS, board_of, other_than_profile, profile_path

    assert board_of("NVIDIA Jetson Orin Nano Developer Kit") == "orin-nano"
    assert board_of("NVIDIA Jetson AGX Orin Developer Kit") == "orin-agx"
    assert board_of("Raspberry Pi 5 Model B Rev 1.0") == "raspberry-pi-5"
    for name in (*BOARDS, "x86-bench"):
        path = profile_path(name)
        assert path is not None
        assert other_than_profile(load_config(path), path) == []
    path = profile_path("raspberry-pi-5")
    assert path is not None
    changed = load_config(path, ["compute.threads=1"])
    assert other_than_profile(changed, path) == ["compute.threads = 1, not 3"]
    reported = findings("compute.threads=1")["board"]
    assert reported[0] == NOTE


def test_kernels_are_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def found() -> Grade:
        _, kernels = examine_compute(load_config(None, ["compute.backend=cpu"]))
        return kernels.verdict

    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert found() == NOTE
    (tmp_path / f"{MARKER}-{Path(sys.prefix).name}").write_text(software())
    assert found() == GOOD


def test_kernels_that_cannot_be_loaded_are_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    kernels = "recon.stereo.belief_propagation"
    monkeypatch.setitem(sys.modules, kernels, None)
    (found,) = examine_compute(load_config(None, ["compute.backend=cpu"]))
    assert found.verdict == BAD and "belief_propagation" in found.text

    class Uncached:
        """Finds the kernels, but numba has no place for what it compiles."""

        def find_spec(self, name: str, *_: object) -> None:
            if name == kernels:
                raise RuntimeError("cannot cache function 'aggregate': no locator available")

    monkeypatch.delitem(sys.modules, kernels)
    sys.meta_path.insert(0, uncached := Uncached())
    try:
        (found,) = examine_compute(load_config(None, ["compute.backend=cpu"]))
    finally:
        sys.meta_path.remove(uncached)
    assert found.verdict == BAD and "no locator" in found.text


def test_what_a_running_service_holds_is_asked_of_it(tmp_path: Path) -> None:
    from service.daemon.health import HealthServer

    status = {
        "ok": True,
        "software": "skyrelief 9.9",
        "state": "scanning",
        "frames": 1234,
        "mavlink": {"links_up": 1, "packets": 77},
        "workers": [
            {
                "name": "camera",
                "state": "running",
                "restarts": 0,
                "fault": "",
                "waiting": 2,
                "bound": 2,
                "when_full": "drop oldest",
                "lag_s": 0.26,
            },
        ],
    }
    server = HealthServer("127.0.0.1:0", lambda: status)
    given = [
        f"scan.folder={tmp_path}",
        f"health.http=127.0.0.1:{server.port}",
        f"mavlink.links=udpin:127.0.0.1:{free_port()}",
        f"camera.source={tmp_path / 'held'}",
    ]
    try:
        found = findings(*given)
        status |= {"ok": False, "fault": "no image", "mavlink": {}}
        worse = findings(*given)
    finally:
        server.close()
    assert found["mavlink"] == (GOOD, "held by the running service: 1 open, 77 messages heard")
    assert found["camera"] == (GOOD, "in the running scan: 1234 images so far")
    assert found["service"] == (GOOD, "skyrelief 9.9 runs here: scanning")
    assert found["worker"] == (GOOD, "camera: running, 2 of 2 waiting (drop oldest), 0.3 s behind")
    assert worse["mavlink"][0] == NOTE
    assert worse["service"] == (BAD, "skyrelief 9.9 runs here: no image")
    assert "service" not in findings(*given)  # it ended


def test_a_desk_needs_no_aircraft() -> None:
    found = {f.what: f for f in examine(load_config(None, ["compute.backend=cpu"]), None)}
    assert not [what for what, f in found.items() if f.verdict is BAD]
    assert found["maps"].verdict in (GOOD, NOTE) and "compute" in found
    assert not {"camera", "mavlink", "settings", "datalink", "board"} & set(found)
