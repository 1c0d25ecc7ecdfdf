"""Trials that try to break the daemon: kills, broken settings, faults; short here.

The whole of them: ``make trials``, which writes a table of what was tried and what came of it.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shlex
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mavlink.control import Phase
from service.config import load_config
from service.errors import OutsideError
from service.runtime import Daemon
from service.stream.store import ScanStore

DEMO = Path(__file__).resolve().parents[1] / "demo" / "caliterra"
WHOLE = os.environ.get("SKYRELIEF_TRIALS") == "whole"
KILLS = 50 if WHOLE else 2
PATIENCE_S = 120.0

pytestmark = [pytest.mark.trial, pytest.mark.timeout(3600 if WHOLE else 280)]

Record = Callable[[str, int, str], None]


@pytest.fixture(scope="module")
def record() -> Iterator[Record]:
    """Collects (fault, times tried, outcome); writes the table where ``make trials`` asks."""
    rows: list[tuple[str, int, str]] = []
    yield lambda fault, times, outcome: rows.append((fault, times, outcome))
    target = os.environ.get("SKYRELIEF_TRIALS_TABLE")
    if target:
        lines = ["| fault | times | outcome |", "|---|---|---|"]
        lines += [f"| {fault} | {times} | {outcome} |" for fault, times, outcome in rows]
        Path(target).write_text("\n".join(lines) + "\n", encoding="utf-8")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Service:
    """The daemon as a process of its own, looking at the demo flight as its camera."""

    def __init__(
        self,
        folder: Path,
        start: str,
        environment: dict[str, str] | None = None,
        camera: str = f"images:{DEMO / 'frames'}?interval_s=1.0",
        model: Path = DEMO / "camera.yaml",
        largest_file_bytes: int | None = None,
    ) -> None:
        self.port = free_port()
        self.configuration = folder / "skyrelief.toml"
        self.scans = folder / "scans"
        self.configuration.write_text(
            f'[camera]\nsource = "{camera}"\nmodel = "{model}"\n'
            f'[scan]\nfolder = "{self.scans}"\nstart = "{start}"\n'
            '[compute]\nbackend = "cpu"\nguide_width = 320\n'
            f'[health]\nhttp = "127.0.0.1:{self.port}"\n'
        )
        self.log = folder / "log.txt"
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "service.cli", "run", "--config", str(self.configuration)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **(environment or {})},
                preexec_fn=lambda: _limit_files(largest_file_bytes),
            )

    def __enter__(self) -> Service:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    def get(self, path: str) -> dict[str, Any] | None:
        """The JSON answer of the health page; None while nobody answers."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}", timeout=5) as page:
                return dict(json.loads(page.read()))
        except urllib.error.HTTPError as error:
            with error:
                return dict(json.loads(error.read()))
        except OSError:
            return None

    def until(self, reached: Callable[[], Any], what: str) -> None:
        """Wait for ``reached``; fails with the log when the process ends or time runs out."""
        deadline = time.monotonic() + PATIENCE_S
        while not reached():
            alive = self.process.poll() is None
            assert alive and time.monotonic() < deadline, f"{what}:\n{self.log.read_text()[-3000:]}"
            time.sleep(0.05)

    def until_up(self) -> None:
        self.until(lambda: (self.get("/status") or {}).get("state") not in (None, "starting"), "up")

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=PATIENCE_S)


def _limit_files(largest_bytes: int | None) -> None:
    """In the child: writing beyond ``largest_bytes`` of any file fails, as on a full disk."""
    if largest_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_bytes, largest_bytes))


def stored(scans: Path) -> set[tuple[str, int, int, int]]:
    """(scan, keyframe, layer, checksum) of every chunk that a store has acknowledged."""
    found = set()
    for path in scans.glob("*/scan.db"):
        try:
            with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as db:
                rows = db.execute("SELECT seq, layer, crc FROM chunks").fetchall()
        except sqlite3.Error:
            continue  # being made
        found |= {(path.parent.name, *row) for row in rows}
    return found


def test_kill_9_loses_nothing_that_was_stored(tmp_path: Path, record: Record) -> None:
    rng = random.Random(5)
    scans = tmp_path / "scans"
    acknowledged: set[tuple[str, int, int, int]] = set()
    for _ in range(KILLS):
        with Service(tmp_path, "on-boot") as service:
            before, more = stored(scans), rng.randint(1, 4)

            def enough(before: Any = before, more: int = more) -> bool:
                return len(stored(scans) - before) >= more

            service.until(enough, "chunks")
            time.sleep(rng.uniform(0.0, 0.5))
            acknowledged |= stored(scans)
            service.process.kill()
            service.process.wait()
        time.sleep(1.0)  # names of scans are seconds
    with Service(tmp_path, "on-command") as service:
        for folder in scans.iterdir():
            service.until((folder / "scan.json").is_file, f"recovery of {folder.name}")
        assert service.stop() == 0
    assert len(acknowledged) >= KILLS
    assert acknowledged <= stored(scans)
    for folder in scans.iterdir():
        assert json.loads((folder / "scan.json").read_text())["finished"] is True
        assert (folder / "cloud.laz").stat().st_size > 0
    record("kill -9 while scanning", KILLS, f"0 of {len(acknowledged)} stored chunks lost")


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs the ffmpeg command")
def test_camera_dies_and_comes_back(tmp_path: Path, record: Record) -> None:
    port = free_port()
    model = tmp_path / "camera.yaml"
    text = (DEMO / "camera.yaml").read_text().replace("1600", "320").replace("1200", "240")
    model.write_text(
        text.replace("1161.8", "232.4").replace("799.5", "159.5").replace("599.5", "119.5")
    )

    def send() -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            shlex.split(
                f"ffmpeg -v error -re -stream_loop -1 -framerate 2 -pattern_type glob -i "
                f"'{DEMO}/frames/*.jpg' -vf scale=320:240 -c:v libx264 -preset ultrafast "
                f"-tune zerolatency -g 2 -f mpegts udp://127.0.0.1:{port}?pkt_size=1316"
            ),
            stdin=subprocess.DEVNULL,
        )

    deaths = 10 if WHOLE else 1
    sender = send()
    try:
        camera = f"stream:udp://127.0.0.1:{port}"
        with Service(tmp_path, "on-boot", camera=camera, model=model) as service:

            def frames() -> int:
                return int((service.get("/status") or {}).get("frames", 0))

            service.until(lambda: frames() >= 2, "pictures")
            for _ in range(deaths):
                sender.kill()
                sender.wait()
                losses = told(service)
                service.until(lambda n=losses: told(service) > n, "the loss being noticed")  # type: ignore[misc]
                before = frames()
                sender = send()
                service.until(lambda n=before: frames() > n, "pictures again")  # type: ignore[misc]
            scans = list(service.scans.iterdir())
            assert service.stop() == 0
        assert len(scans) == 1, "the scan goes on, it is not begun anew"
    finally:
        sender.kill()
        sender.wait()
    record("camera stream dies", deaths, "same scan goes on when it is back")


def test_full_disk_keeps_what_is_stored(tmp_path: Path, record: Record) -> None:
    with Service(tmp_path, "on-boot", largest_file_bytes=400_000) as service:
        service.until(lambda: "Scan failed" in service.log.read_text() or failed(service), "fault")
        service.until(lambda: len(list(service.scans.glob("*/scan.db"))) >= 2, "a new attempt")
        first = min(service.scans.iterdir())
        acknowledged = {row for row in stored(service.scans) if row[0] == first.name}
        service.stop()
    assert acknowledged
    with ScanStore.open(first / "scan.db") as store:
        assert set(store.seqs()) == {row[1] for row in acknowledged}
        assert list(store.keyframes())
    record("disk full while scanning", 1, "stored chunks sound, scanning tried again")


def told(service: Service) -> int:
    """How often the log speaks of the camera's stream."""
    return service.log.read_text().count("service.cameras.live: udp")


def failed(service: Service) -> bool:
    return (service.get("/status") or {}).get("fault") not in (None, "")


def test_term_closes_the_scan(tmp_path: Path, record: Record) -> None:
    with Service(tmp_path, "on-boot") as service:
        service.until(lambda: stored(service.scans), "a chunk")
        assert service.stop() == 0
        (folder,) = service.scans.iterdir()
        with ScanStore.open(folder / "scan.db") as store:
            assert store.finished
            assert store.summary is not None
            assert "interrupted" not in store.summary, service.log.read_text()[-3000:]
        assert (folder / "preview.jpg").is_file()
    record("TERM while scanning", 1, "scan closed, files written")


def test_broken_configuration_at_reload_changes_nothing(tmp_path: Path, record: Record) -> None:
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(path)
        systemd.settimeout(PATIENCE_S)
        with Service(tmp_path, "on-command", {"NOTIFY_SOCKET": path}) as service:
            assert systemd.recv(100) == b"READY=1"
            assert systemd.recv(100).startswith(b"WATCHDOG=1")
            service.until_up()
            good = service.configuration.read_text()
            for broken in ("[scan\n", "[scan]\nbaselin = 3\n", "[scan]\nbaseline = -3\n", "\0\1\2"):
                service.configuration.write_text(broken)
                service.process.send_signal(signal.SIGHUP)
                service.until(lambda: "stays as it was" in service.log.read_text(), "refusal")
                service.log.write_text("")
            service.configuration.write_text(good.replace("[scan]\n", "[scan]\nbaseline = 3\n"))
            service.process.send_signal(signal.SIGHUP)
            service.until(lambda: "in force: scan.baseline" in service.log.read_text(), "reload")
            assert (service.get("/healthz") or {}).get("ok") is True
            assert service.stop() == 0
            told: list[bytes] = []
            while not told or told[-1] != b"STOPPING=1":
                told.append(systemd.recv(100))
    record("broken configuration at reload", 4, "refused, service unharmed")


def test_a_scan_that_fails_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: Record
) -> None:
    daemon = Daemon(load_config(None, [f"scan.folder={tmp_path}", "health.http="]))
    daemon.actions.is_ready = True
    faults: list[Exception] = [OutsideError("camera gone"), RuntimeError("ours"), OSError("disk")]
    tried = len(faults)
    scanning = []

    def scan_once() -> None:
        if faults:
            raise faults.pop(0)
        scanning.append(daemon.scanning.phase)
        daemon.scanning._stop.wait(PATIENCE_S)

    monkeypatch.setattr(daemon.scanning, "_scan_once", scan_once)
    monkeypatch.setattr("service.scanning.FIRST_RETRY_S", 0.01)
    daemon.scanning._retry_s = 0.01
    daemon.actions.start_scan()
    deadline = time.monotonic() + PATIENCE_S
    while not scanning and time.monotonic() < deadline:
        daemon.scanning.retry()
        time.sleep(0.005)
    assert scanning == [Phase.SCANNING]
    assert daemon.scanning.fault == ""
    daemon.actions.stop_scan()
    daemon.scanning.end()
    daemon.scanning.retry()
    assert daemon.scanning.phase is Phase.IDLE  # stopped by the operator: it stays so
    record("faults of camera, disk and our own code", tried, "scanning again each time")


def test_stopping_ends_the_retries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = Daemon(load_config(None, [f"scan.folder={tmp_path}", "health.http="]))
    daemon.actions.is_ready = True

    def scan_once() -> None:
        raise OutsideError("camera gone")

    monkeypatch.setattr(daemon.scanning, "_scan_once", scan_once)
    daemon.scanning._retry_s = 0.0
    daemon.actions.start_scan()
    assert daemon.scanning._worker is not None
    daemon.scanning._worker.join()
    assert daemon.scanning.fault == "camera gone"
    assert daemon.scanning._retry_at_s is not None
    daemon.actions.stop_scan()
    daemon.scanning.retry()
    assert daemon.scanning.phase is Phase.IDLE
    assert daemon.scanning.fault == "camera gone"
