"""Trials that try to break the daemon: kills, a full disk, cameras, clocks; short here.

The whole of them: ``make trials``, which writes a table of what was tried and what came of it.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from loopback import free_port, until
from onboard import Onboard
from pymavlink.dialects.v20 import ardupilotmega as dialect  # type: ignore[import-untyped]
from trial_autopilot import Autopilot
from trial_rig import (
    PATIENCE_S,
    WHOLE,
    Chunk,
    Row,
    Service,
    back_limit_s,
    burn,
    scan_folders,
    small_model,
    stored,
    stream_to,
    with_site,
)

from mavlink.component.control import Phase, Result
from service.daemon.scan_state import Event, ScanLife
from service.daemon.scanning import ScanRun
from service.errors import OutsideError
from service.stream.store import ScanStore

KILLS = int(os.environ.get("SKYRELIEF_KILLS", "50" if WHOLE else "2"))

pytestmark = [pytest.mark.trial, pytest.mark.timeout(7200 if WHOLE else 280)]

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")


def test_kill_9_loses_nothing_that_was_stored(tmp_path: Path, record: Row) -> None:
    rng = random.Random(5)
    scans = tmp_path / "scans"
    acknowledged: set[Chunk] = set()
    back_s: list[float] = []
    idle = WHOLE and os.getloadavg()[0] < (os.cpu_count() or 1)
    load = burn(1 if idle else 0)  # unless others keep the machine busy already
    try:
        for _ in range(KILLS):
            with Service(tmp_path) as service:
                service.until(lambda s=service: s.frames > 0, "frames")  # type: ignore[misc]
                back_s.append(time.monotonic() - service.began_s)
                before = stored(scans)
                service.until(lambda b=before: stored(scans) - b, "chunks")  # type: ignore[misc]
                time.sleep(rng.uniform(0.0, 2.0))
                acknowledged |= stored(scans)
                service.process.kill()
                service.process.wait()
            time.sleep(1.0)  # names of scans are seconds; systemd waits as long
    finally:
        for process in load:
            process.kill()
            process.wait()
    with Service(tmp_path, "on-command") as service:
        for folder in scan_folders(scans):
            service.until((folder / "scan.json").is_file, f"recovery of {folder.name}")
        assert service.stop() == 0
    lost = acknowledged - stored(scans)
    record(
        "kill -9 while scanning, under load",
        KILLS,
        "every scan closed and kept",
        f"{len(lost)} of {len(acknowledged)} chunks",
        max(back_s),
    )
    assert len(acknowledged) >= KILLS
    assert not lost
    assert max(back_s) < back_limit_s()
    for folder in scan_folders(scans):
        assert json.loads((folder / "scan.json").read_text())["finished"] is True
        assert (folder / "cloud.laz").stat().st_size > 0


def test_kill_9_of_a_scan_started_by_command(tmp_path: Path, record: Row) -> None:
    link, times, back_s = free_port(), 5 if WHOLE else 1, 0.0
    autopilot, more = Autopilot(link), f'[mavlink]\nlinks = ["udpin:127.0.0.1:{link}"]\n'
    autopilot.start()
    for k in range(times + 1):
        with Service(tmp_path, "on-command", more=more) as service:
            if k == 0:
                service.until_up()
                autopilot.asked.append(
                    dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
                )
            service.until(lambda s=service: s.frames > 0, "frames")  # type: ignore[misc]
            if k > 0:
                back_s = max(back_s, time.monotonic() - service.began_s)
            service.until(lambda k=k: len({c[0] for c in stored(service.scans)}) > k, "a chunk")  # type: ignore[misc]
            acknowledged = stored(service.scans)
            if k == times:
                assert service.stop() == 0
        time.sleep(1.0)
    autopilot.ended.set()
    with Service(tmp_path, "on-command", more=more) as service:
        service.until_up()
        time.sleep(1.0)
        assert service.get()["state"] == "idle"  # the last one was closed, not killed
        assert service.stop() == 0
    lost = acknowledged - stored(service.scans)
    record(
        "kill -9 of a scan that was started by command",
        times,
        "a new scan each time; none after a stop",
        f"{len(lost)} of {len(acknowledged)} chunks",
        back_s,
    )
    assert not lost
    assert any("Scan resumed after a restart" in text for text in autopilot.texts)


@pytest.mark.parametrize("fault", ["dies", "stalls", "changes size"])
@needs_ffmpeg
def test_camera_fails_and_comes_back(fault: str, tmp_path: Path, record: Row) -> None:
    port = free_port()
    model = small_model(tmp_path)
    times = 10 if WHOLE else 1
    sender = stream_to(port)
    back_s: list[float] = []
    try:
        camera = f"stream:udp://127.0.0.1:{port}"
        with Service(tmp_path, camera=camera, model=model) as service:
            service.until(lambda: service.frames >= 2, "images")
            for _ in range(times):
                reported = service.said("WARNING service.cameras.live: udp")
                if fault == "stalls":
                    sender.send_signal(signal.SIGSTOP)
                else:
                    sender.kill()
                    sender.wait()
                if fault == "changes size":
                    sender = stream_to(port, "160:120")
                service.until(
                    lambda n=reported: service.said("WARNING service.cameras.live: udp") > n,  # type: ignore[misc]
                    "the fault being noticed",
                )
                connected = service.said("connected")
                if fault == "stalls":
                    sender.send_signal(signal.SIGCONT)
                else:
                    sender.kill()
                    sender.wait()
                    sender = stream_to(port)
                start = time.monotonic()
                if fault != "changes size":  # frames before that are what was still in the queue
                    service.until(
                        lambda n=connected: service.said("connected") > n,  # type: ignore[misc]
                        "the camera again",
                    )
                service.until_more_frames("images again")
                back_s.append(time.monotonic() - start)
            scans = scan_folders(service.scans)
            assert service.stop() == 0
    finally:
        sender.kill()
        sender.wait()
    record(f"camera {fault}", times, "the same scan goes on", "-", max(back_s))
    assert len(scans) == 1
    assert max(back_s) < back_limit_s()


def test_full_disk_keeps_what_is_stored(tmp_path: Path, record: Row) -> None:
    with Service(tmp_path, largest_file_bytes=400_000) as service:
        service.until(lambda: service.said("Scan failed") or service.get().get("fault"), "fault")
        service.until(lambda: len(list(service.scans.glob("*/scan.db"))) >= 2, "a new attempt")
        first = min(scan_folders(service.scans))
        acknowledged = {row for row in stored(service.scans) if row[0] == first.name}
        service.stop()
    assert acknowledged
    with ScanStore.open(first / "scan.db") as store:
        lost = {row[1] for row in acknowledged} - set(store.seqs())
        assert list(store.keyframes())
    record(
        "files cannot grow", 1, "scanning tried again", f"{len(lost)} of {len(acknowledged)} chunks"
    )
    assert not lost


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 MiB in memory; skips where it may not be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(place)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("mounting a small disk needs root")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=False)


def test_disk_full_then_room_again(small_disk: Path, tmp_path: Path, record: Row) -> None:
    filler = small_disk / "filler"
    with Service(tmp_path, scans=small_disk / "scans") as service:
        service.until(lambda: stored(service.scans), "a chunk")
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as out:
            while True:
                out.write(b"x" * 65536)
        service.until(lambda: service.get().get("fault"), "the fault")
        acknowledged = stored(service.scans)
        filler.unlink()
        back_s = service.until_more_frames("scanning again")
        service.stop()
    lost = acknowledged - stored(service.scans)
    record(
        "disk full, then room again",
        1,
        "scanning again by itself",
        f"{len(lost)} of {len(acknowledged)} chunks",
        back_s,
    )
    assert not lost
    assert back_s < back_limit_s()


CLOCK = """
import os, time
_file, _time, _time_ns = os.environ["TRIAL_CLOCK"], time.time, time.time_ns
def _offset():
    try:
        return float(open(_file).read() or 0)
    except OSError:
        return 0.0
time.time = lambda: _time() + _offset()
time.time_ns = lambda: _time_ns() + int(_offset() * 1e9)
"""


def test_clock_set_back_by_a_power_cut(tmp_path: Path, record: Row) -> None:
    """The scan that lies open seems to be written in the future; the autopilot knows the time."""
    with Service(tmp_path) as service:
        service.until(lambda: stored(service.scans), "a chunk")
        acknowledged = stored(service.scans)
    (before,) = scan_folders(service.scans)
    (tmp_path / "clock").write_text("-2592000")
    environment = with_site(tmp_path, CLOCK) | {"TRIAL_CLOCK": str(tmp_path / "clock")}
    link = free_port()
    autopilot, more = Autopilot(link), f'[mavlink]\nlinks = ["udpin:127.0.0.1:{link}"]\n'
    autopilot.start()
    with Service(tmp_path, environment=environment, more=more) as again:
        back_s = again.until(lambda: again.frames > 0, "frames")
        again.until((before / "scan.json").is_file, "the files of the scan that lay open")
        assert again.stop() == 0
    autopilot.ended.set()
    (after,) = set(scan_folders(again.scans)) - {before}
    lost = acknowledged - stored(again.scans)
    record(
        "power cut that sets the clock back by a month",
        1,
        "the scan is closed, kept; the next takes the autopilot's time",
        f"{len(lost)} of {len(acknowledged)} chunks",
        back_s,
    )
    assert not lost
    assert json.loads((before / "scan.json").read_text())["finished"] is True
    assert after.name > before.name
    summary = json.loads((after / "scan.json").read_text())
    assert "autopilot's" in json.dumps(summary)
    assert any("clock is 30 days behind" in text for text in autopilot.texts)


def test_wall_clock_steps(tmp_path: Path, record: Row) -> None:
    steps = [3600.0, -86400.0, 8e8] if WHOLE else [3600.0, -86400.0]
    clock = tmp_path / "clock"
    environment = with_site(tmp_path, CLOCK) | {"TRIAL_CLOCK": str(clock)}
    with Service(tmp_path, environment=environment) as service:
        service.until(lambda: service.frames > 0, "frames")
        back_s = []
        for step_s in steps:
            clock.write_text(str(step_s))
            back_s.append(service.until_more_frames("frames after the step"))
        (folder,) = scan_folders(service.scans)
        assert service.stop() == 0
    times = [float(x.split()[0]) for x in (folder / "trajectory.tum").read_text().splitlines()]
    record("wall clock steps", len(steps), "times of the scan stay even", "-", max(back_s))
    assert times == sorted(times)
    assert times[-1] - times[0] < 600.0


def test_autopilot_reboots(tmp_path: Path, record: Row) -> None:
    port, times = free_port(), 5 if WHOLE else 1
    autopilot = Autopilot(port)
    autopilot.start()
    back_s = []
    link = f'[mavlink]\nlinks = ["udpin:127.0.0.1:{port}"]\n'
    with Service(tmp_path, more=link) as service:

        def heard() -> bool:
            age_s = service.get().get("mavlink", {}).get("autopilot_age_s")
            return age_s is not None and age_s < 1.0

        service.until(lambda: service.frames > 0 and heard(), "frames and telemetry")
        scan = service.get()["scan"]
        for _ in range(times):
            autopilot.silent.set()
            service.until(lambda: not heard(), "silence")
            autopilot.boot_s = time.monotonic()
            autopilot.silent.clear()
            start = time.monotonic()
            service.until(heard, "the autopilot again")
            service.until_more_frames("frames")
            back_s.append(time.monotonic() - start)
        same = service.get().get("scan") == scan
        assert service.stop() == 0
    autopilot.ended.set()
    record("autopilot reboots (its clock at 0)", times, "the same scan goes on", "-", max(back_s))
    assert same
    assert max(back_s) < back_limit_s()


def test_broken_configuration_at_reload_changes_nothing(tmp_path: Path, record: Row) -> None:
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
                service.until(
                    lambda: "configuration is unchanged" in service.log.read_text(), "refusal"
                )
                service.log.write_text("")
            service.configuration.write_text(good.replace("[scan]\n", "[scan]\nbaseline = 3\n"))
            service.process.send_signal(signal.SIGHUP)
            service.until(lambda: "in force: scan.baseline" in service.log.read_text(), "reload")
            assert service.get("/healthz").get("ok") is True
            assert service.stop() == 0
            reported: list[bytes] = []
            while not reported or reported[-1] != b"STOPPING=1":
                reported.append(systemd.recv(100))
    record("broken configuration at reload", 4, "refused, service unharmed")


def test_a_scan_that_fails_is_started_again(tmp_path: Path, record: Row) -> None:
    faults: list[Exception] = [OutsideError("camera gone"), RuntimeError("ours"), OSError("disk")]
    tried = len(faults)
    scanning = []

    def carry_out(run: ScanRun) -> None:
        if faults:
            raise faults.pop(0)
        scanning.append(daemon.scanning.phase)
        run.stop.wait(PATIENCE_S)

    daemon = Onboard(tmp_path, script=carry_out, life=ScanLife(0.01))
    daemon.actions.is_ready = True
    daemon.actions.start_scan()
    deadline = time.monotonic() + PATIENCE_S
    while not scanning and time.monotonic() < deadline:
        daemon.scanning.handle(Event.TICK)
        time.sleep(0.005)
    assert scanning == [Phase.SCANNING]
    assert daemon.scanning.fault == ""
    daemon.actions.stop_scan()
    daemon.scanning.end()
    daemon.scanning.handle(Event.TICK)
    assert daemon.scanning.phase is Phase.IDLE  # stopped by the operator: it stays so
    record("faults of camera, disk and our own code", tried, "scanning again each time")


def test_stopping_ends_the_retries(tmp_path: Path) -> None:
    def carry_out(run: ScanRun) -> None:
        raise OutsideError("camera gone")

    daemon = Onboard(tmp_path, script=carry_out)
    daemon.actions.is_ready = True
    assert daemon.actions.start_scan().result is Result.ACCEPTED
    assert until(lambda: daemon.scanning.run is None, 30.0)
    assert daemon.scanning.fault == "camera gone"
    assert daemon.scanning.life.state.is_wanted  # waits to try again
    daemon.actions.stop_scan()
    daemon.scanning.handle(Event.TICK)
    assert daemon.scanning.phase is Phase.IDLE
    assert daemon.scanning.fault == "camera gone"
