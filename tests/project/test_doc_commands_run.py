"""Every command in the documents runs, on one tiny simulated flight.

The lines of the shell blocks are run as they stand, in a folder with the files that they name:
``NAMES`` are the pages' words for them, and ``SMALLER`` keeps it short. ``ELSEWHERE`` has the lines
that need root, hardware or an hour, with the test that runs them.
"""

from __future__ import annotations

import csv
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
from doc_pages import PAGES, lines, words_of
from loopback import free_port, until
from paths import ROOT
from rehearsal import RehearsalVehicle
from typer.testing import CliRunner

from service.cli import app
from service.daemon.stored_image import image_name
from service.offline.exports.view import ScanView

REPORTS = ROOT / "docs" / "reports"
"""Its pages repeat how figures were measured, on flights of an hour and on real data."""

NAMES = {"SCAN_DIR": "scan", "SCAN": "scan", "FLIGHT": "flight", "CAMERA": "camera"}
"""Words of the pages for files."""

ELSEWHERE = {
    "make demo": "test_demo.py",
    ". .venv/bin/activate": "the shell",
    "sudo ": "root: trials/test_trial_boot.py",
    "pip install ": "packages: trials/test_trial_boot.py",
    "skyrelief ground --mavlink serial:": "a telemetry radio",
    "skyrelief site ": "test_site.py",
    "skyrelief run --config drone.toml": "test_cameras_live.py, test_mavlink_lines.py",
    "skyrelief replay flight.mp4 --backend onnx --set compute.model": "test_backend_choice.py",
    "git ": "the shell: test_doc_first_change.py",
    "cd skyrelief": "the shell: test_doc_first_change.py",
    "make format": "the shell",
    "make lint types": "the shell",
    "make test": "the shell",
    ".venv/bin/python -m pytest -q tests/mavlink": "test_doc_first_change.py",
}
"""Start of a line: what it needs, or the test that runs it."""

SMALLER = {
    "simulate": "--size 320x180 --fps 4 --duration-s 6 --depth-frames 2",
    "replay": "--set compute.stereo_width=160 --set compute.guide_width=320",
    "ctl watch": "--seconds 1",
    "refly": "--sigma-m 0.001",  # so that some place is weak
}
"""Options added to a command, to keep it short."""

SERVICES = ("ground", "run", "simulate --live")


def plain(line: str) -> str:
    """The line without its comment and the path of the program, about files by their names."""
    line = re.sub(r"^\S*bin/(?=skyrelief )", "", " ".join(line.partition(" #")[0].split()))
    return re.sub(rf"\b({'|'.join(NAMES)})\b", lambda match: NAMES[match[1]], line)


def documented() -> list[str]:
    """Every line of a shell block in the documents, once."""
    pages = [page for page in PAGES if REPORTS not in page.parents]
    return list(dict.fromkeys(plain(line) for page in pages for line in lines(page)))


def is_elsewhere(line: str) -> bool:
    return any(line.startswith(start) for start in ELSEWHERE)


def is_service(line: str) -> bool:
    name, *rest = words_of(line)[1:]
    return name in SERVICES or (name == "simulate" and "--live" in rest)


HERE = [line for line in documented() if not is_elsewhere(line)]
TO_AN_END = [line for line in HERE if not is_service(line)]


def runnable(line: str, port: int = 0) -> list[str]:
    """Arguments of skyrelief for the line: smaller, on free ports of this machine."""
    words = words_of(line)[1:]
    for start, more in SMALLER.items():
        if words[: len(start.split())] == start.split() and "--live" not in words:
            words += more.split()
    if words[0] == "ctl":
        words += ["--connect", f"udpin://127.0.0.1:{port}"]
    return words


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files that the documents' commands name."""
    folder = tmp_path_factory.mktemp("documents")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done_well("skyrelief simulate --out flight")
        for name in ("flight.mp4", "flight.tlog", "camera.yaml"):
            os.link(f"flight/{name}", name)
        done_well(next(line for line in HERE if line.startswith("skyrelief replay flight.mp4 --t")))
        images_of_an_overload(Path("scan"))
        control_points(Path("scan"))
        done_well(next(line for line in HERE if line.startswith("skyrelief keys fleet --drone")))
    return folder


def images_of_an_overload(scan: Path) -> None:
    """Files of the step "record only": images named by their time, and the log of the links."""
    (scan / "later").mkdir()
    shutil.copy("flight.tlog", scan / "link.tlog")
    with ScanView(scan) as view:
        start_ns = view.store.header.started_unix_ns
    video = cv2.VideoCapture("flight.mp4")
    for k in range(16):
        ok, image = video.read()
        assert ok and cv2.imwrite(
            str(scan / "later" / image_name(start_ns + k * 250_000_000)), image
        )


def control_points(scan: Path) -> None:
    """``points.csv``: four places of the cloud, surveyed where the map has them."""
    with ScanView(scan) as view:
        assert view.frame is not None
        xyz = view.xyz_m[[0, len(view.xyz_m) // 3, 2 * len(view.xyz_m) // 3, -1]]
        places = view.frame.to_geodetic(view.frame.from_utm(xyz))
    with Path("points.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("name", "x", "y", "z", "lat", "lon", "alt_amsl_m"))
        rows.writerows((f"P{k}", *xyz[k], *places[k]) for k in range(len(xyz)))


def done_well(line: str, port: int = 0) -> str:
    """The output of a command that must end well."""
    done = CliRunner().invoke(app, runnable(line, port))
    assert done.exit_code == 0, f"{line}: {done.exception} {done.output}"
    return done.output


@pytest.fixture
def desk(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the flight's folder, as the working directory."""
    copy = tmp_path / "desk"
    shutil.copytree(flight, copy, symlinks=True)
    monkeypatch.chdir(copy)
    return copy


@pytest.mark.parametrize("line", TO_AN_END)
@pytest.mark.slow
def test_the_command_runs(line: str, desk: Path) -> None:
    words = words_of(line)[1:]
    out = Path(words[words.index("--out") + 1]) if "--out" in words else None
    if out is not None and words[0] in ("simulate", "replay"):
        shutil.rmtree(out, ignore_errors=True)
    if words[0] == "keys" and "--drone" in words:
        shutil.rmtree("fleet")
    if words[0] == "ctl":
        pytest.importorskip("mavsdk")
        port = free_port()
        with RehearsalVehicle(f"udpout:127.0.0.1:{port}"):
            done_well(line, port)
        return
    done_well(line)
    if out is not None and "--intrinsics" not in words:
        assert out.exists()


class Started:
    """A service of the documents, as a process in the working directory."""

    def __init__(self, name: str, words: list[str]) -> None:
        self.log = Path(f"{name}.log")
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "service.cli", *words],
                env=os.environ | {"PYTHONPATH": str(ROOT), "XDG_STATE_HOME": str(Path.cwd())},
                stdin=subprocess.DEVNULL,
                stderr=log,
            )

    def wrote(self, text: str) -> bool:
        assert self.process.poll() is None, self.log.read_text()
        return text in self.log.read_text()

    def ends(self) -> None:
        """Ask it to end; it must do so without an error."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(60) == 0, self.log.read_text()


@pytest.fixture
def start() -> Iterator[Any]:
    """Starts services; what still runs in the end is killed."""
    started = []

    def begin(name: str, words: list[str]) -> Started:
        started.append(Started(name, words))
        return started[-1]

    yield begin
    for one in started:
        one.process.kill()
        one.process.wait()


def on_free_ports(line: str, ports: dict[str, int]) -> list[str]:
    """Arguments of skyrelief with every port of the line replaced."""

    def free(match: re.Match[str]) -> str:
        kind = socket.SOCK_DGRAM if "udp" in line and match[1] != "8080" else socket.SOCK_STREAM
        return f":{ports.setdefault(match[1], free_port(kind))}"

    return [re.sub(r":(\d{4,5})\b", free, word) for word in runnable(line)]


@pytest.mark.parametrize("line", [line for line in HERE if line.startswith("skyrelief ground")])
@pytest.mark.slow
def test_the_ground_station_starts_and_ends(line: str, desk: Path, start: Any) -> None:
    ground = start("ground", on_free_ports(line, {}))
    until(lambda: ground.wrote("portal: http"), 60)
    ground.ends()


@pytest.mark.slow
def test_the_simulator_is_seen_at_the_ground(desk: Path, start: Any) -> None:
    """The two terminals of the first flight: the ground receives what the aircraft scans."""
    pages = list(lines(ROOT / "docs" / "first-flight.md"))
    (at_ground,) = (plain(line) for line in pages if line.startswith("skyrelief ground"))
    (on_board,) = (plain(line) for line in pages if line.startswith("skyrelief run"))
    ports: dict[str, int] = {}
    ground = start("ground", on_free_ports(at_ground, ports))
    until(lambda: ground.wrote("portal: http"), 60)
    words = on_free_ports(on_board, ports)
    words[words.index("camera.source=sim:")] += "?size=320x180&fps=5&duration_s=4"
    words += ["--set", f"health.http=127.0.0.1:{free_port(socket.SOCK_STREAM)}"]
    aircraft = start("run", words)
    until(lambda: aircraft.wrote("") and list(desk.glob("ground-scans/drones/*/*/scan.db")), 120)
    aircraft.ends()
    ground.ends()
    assert list(desk.glob("scans/*/scan.db"))


@pytest.mark.slow
def test_a_played_flight_sends_mavlink(desk: Path, start: Any) -> None:
    (line,) = (line for line in HERE if "--live" in line)
    ports: dict[str, int] = {}
    words = on_free_ports(line, ports)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", ports["14550"]))
        autopilot.settimeout(60)
        player = start("player", words)
        assert autopilot.recv(300)[0] == 0xFD
    player.process.send_signal(signal.SIGINT)
    player.process.wait(30)


def test_every_line_is_run_or_says_why_not() -> None:
    every = documented()
    services = [line for line in HERE if is_service(line)]
    covered = ("skyrelief ground", "skyrelief run --set camera.source=sim:", "skyrelief simulate")
    assert all(line.startswith("skyrelief ") for line in HERE), "not a command of skyrelief"
    assert all(line.startswith(covered) for line in services)
    for start, reason in ELSEWHERE.items():
        assert any(line.startswith(start) for line in every), f"no page has {start!r}"
        for name in re.findall(r"\S+\.py", reason):
            assert list((ROOT / "tests").rglob(name))
