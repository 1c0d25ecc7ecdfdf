"""From a bare Debian to an aircraft that scans by itself: installed, booted, cut off, upgraded.

The machine is real but for its kernel: its own systemd starts, watches and restarts the service.
Only in the whole form; it needs root, systemd-nspawn and debootstrap.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from loopback import free_port
from trial_machine import Machine, another_release, lacking, make_bundle
from trial_rig import (
    WHOLE,
    Chunk,
    Row,
    answer,
    back_limit_s,
    scan_folders,
    small_model,
    stored,
    stream_to,
)

pytestmark = [
    pytest.mark.trial,
    pytest.mark.timeout(5400),
    pytest.mark.skipif(not WHOLE, reason="only in the whole form of the trials"),
    pytest.mark.skipif(bool(lacking()), reason=f"needs {lacking()}"),
]

CUTS, KILLS = 5, 5
WATCHDOG_S = 10.0
"""``WatchdogSec`` of the unit."""

ENDS_ITSELF = """
import os as _os, sys as _sys, threading as _threading
if "run" in _sys.argv:
    _threading.Timer(8.0, _os._exit, (1,)).start()
"""
"""Comes up, and is gone 8 s later."""

INSTALL = "./deploy/install.sh --bundle . 2>&1 | grep -v INFO; exit ${PIPESTATUS[0]}"
CONFIGURATION = "/etc/skyrelief/skyrelief.toml"
SKYRELIEF = "/opt/skyrelief/current/bin/skyrelief"


@dataclass(frozen=True, slots=True)
class Aircraft:
    """A machine whose camera is a stream of ours."""

    machine: Machine
    camera: int  # its port
    health: int  # the port of the service's page
    radio: socket.socket  # where its MAVLink goes

    @property
    def scans(self) -> Path:
        """Where the service keeps its scans, seen from here."""
        return self.machine.root / "var" / "lib" / "skyrelief" / "scans"

    def status(self) -> dict[str, Any]:
        """The answer of the service; empty while there is none."""
        return answer(self.health)

    def until_scanning(self, since_s: float, limit_s: float = 90.0) -> float:
        """Seconds from ``since_s`` until a frame of a running scan is done."""
        return self.until(lambda: int(self.status().get("frames", 0)) > 0, since_s, limit_s)

    def until(self, reached: Callable[[], bool], since_s: float, limit_s: float) -> float:
        """Seconds from ``since_s`` until ``reached``."""
        while not reached():
            journal = "journalctl -u skyrelief --no-pager | tail -20"
            assert time.monotonic() < since_s + limit_s, self.machine.ask(journal)
            time.sleep(0.1)
        return time.monotonic() - since_s

    def show(self, name: str) -> str:
        """A property of the unit."""
        return self.machine.ask(f"systemctl show -p {name} --value skyrelief")

    def configure(self) -> None:
        """Edit the installer's file as the aircraft's builder does."""
        file = self.machine.root / CONFIGURATION[1:]
        text = file.read_text()
        for key, value in (
            ("source", f"stream:udp://127.0.0.1:{self.camera}"),
            ("model", "/etc/skyrelief/camera.yaml"),
            ("start", "on-boot"),
            ("http", f"127.0.0.1:{self.health}"),
        ):
            old = re.compile(rf'^{key} = ".*"', re.MULTILINE)
            text, times = old.subn(f'{key} = "{value}"', text, count=1)
            assert times == 1, key
        link = f"udpout:127.0.0.1:{self.radio.getsockname()[1]}"
        file.write_text(text.replace("links = []", f'links = ["{link}"]'))

    def until_heard(self, since_s: float) -> float:
        """Seconds from ``since_s`` until the first word of the machine by MAVLink."""
        self.radio.settimeout(60.0)
        self.radio.recv(1024)
        return time.monotonic() - since_s

    def cut(self) -> None:
        """Take its power."""
        self.machine.cut()
        self.radio.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                self.radio.recv(1024)


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Aircraft]:
    folder = tmp_path_factory.mktemp("machine")
    machine = Machine(folder)
    make_bundle(folder / "bundle")
    for name, number, code in (("next", "99.1.0", ""), ("bad", "99.2.0", ENDS_ITSELF)):
        another_release(folder / "bundle", machine.root / "root" / name, number, code)
    shutil.move(folder / "bundle", machine.root / "root" / "bundle")
    camera = free_port()
    sender = stream_to(camera)
    radio = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    radio.bind(("127.0.0.1", 0))
    machine.boot()
    try:
        yield Aircraft(machine, camera, free_port(socket.SOCK_STREAM), radio)
    finally:
        radio.close()
        machine.cut()
        sender.kill()
        sender.wait()
        log = os.environ.get("SKYRELIEF_BOOT_LOG", "")
        if log:
            content = {"typed": [text for text in machine.transcript if text]}
            Path(log).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        shutil.rmtree(machine.root, ignore_errors=True)


def test_install_and_first_start(aircraft: Aircraft, record: Row) -> None:
    machine = aircraft.machine
    machine.run("sed -n 1p /etc/os-release; python3 --version; systemctl is-system-running --wait")
    first = machine.run(f"cd /root/bundle && {INSTALL}", 1800.0)
    assert "installed, not started: set camera.source" in first
    assert "exit code" not in first
    again = machine.run(f"cd /root/bundle && {INSTALL}", 1800.0)
    assert "already there" in again
    machine.run("id skyrelief; ls -l /opt/skyrelief; stat -c '%U %a %n' /var/lib/skyrelief/scans")
    assert "(exit code 3)" in machine.run(f"{SKYRELIEF} doctor 2>/dev/null | grep -v ^good; "
                                          "exit ${PIPESTATUS[0]}")  # fmt: skip
    shutil.copy(small_model(machine.root / "tmp"), machine.root / "etc/skyrelief/camera.yaml")
    aircraft.configure()
    machine.transcript.append("(camera, camera.model, mavlink.links, scan.start, health.http: set)")
    start = time.monotonic()
    machine.run("systemctl restart skyrelief")
    first_s = aircraft.until_scanning(start)
    doctor = machine.run(f"{SKYRELIEF} doctor 2>/dev/null; exit ${{PIPESTATUS[0]}}")
    assert "compiled for this version" in doctor
    assert "runs here: scanning" in doctor
    machine.run("systemctl status skyrelief --no-pager | head -n 5")
    exposure = machine.run("systemd-analyze security skyrelief.service --no-pager | tail -n 1")
    assert float(exposure.split(": ")[1].split()[0]) <= 3.0
    record(
        "installed on a bare Debian with systemd", 1,
        "refuses to fly without a camera, then scans as its own user in its sandbox", "-", first_s,
    )  # fmt: skip
    assert first_s < back_limit_s()


def test_settings_are_taken_over_by_reload(aircraft: Aircraft) -> None:
    scan = aircraft.status()["scan"]
    file = aircraft.machine.root / CONFIGURATION[1:]
    file.write_text(re.sub("(?m)^resolution_m = .*", "resolution_m = 0.5", file.read_text()))
    aircraft.machine.run("systemctl reload skyrelief")
    said = "journalctl -u skyrelief -o cat --no-pager | grep 'now in force'"
    aircraft.until(
        lambda: "scan.resolution_m" in aircraft.machine.ask(said), time.monotonic(), 20.0
    )
    aircraft.machine.run(said)
    assert aircraft.status()["scan"] == scan


def test_systemd_starts_it_again(aircraft: Aircraft, record: Row) -> None:
    back_s = []
    acknowledged: set[Chunk] = set()
    for _ in range(KILLS):
        aircraft.until(lambda: aircraft.status().get("clouds", 0) > 2, time.monotonic(), 60.0)
        acknowledged |= stored(aircraft.scans)
        aircraft.machine.ask("kill -9 $(systemctl show -p MainPID --value skyrelief)")
        start = time.monotonic()
        aircraft.until(lambda: not aircraft.status(), start, 10.0)
        back_s.append(aircraft.until_scanning(start))
    lost = acknowledged - stored(aircraft.scans)
    record(
        "kill -9, started again by systemd", KILLS, "a new scan; the last one is closed and kept",
        f"{len(lost)} of {len(acknowledged)} chunks", max(back_s),
    )  # fmt: skip
    assert int(aircraft.show("NRestarts")) == KILLS
    assert not lost
    assert max(back_s) < back_limit_s()


def test_the_watchdog_ends_a_process_that_hangs(aircraft: Aircraft, record: Row) -> None:
    before = int(aircraft.show("NRestarts"))
    aircraft.machine.run("kill -STOP $(systemctl show -p MainPID --value skyrelief)")
    start = time.monotonic()
    ended_s = aircraft.until(lambda: int(aircraft.show("NRestarts")) > before, start, 60.0)
    back_s = aircraft.until_scanning(time.monotonic())
    aircraft.machine.run("journalctl -u skyrelief -o cat --no-pager | grep -i watchdog | tail -n 1")
    assert "atchdog" in aircraft.machine.transcript[-1]
    record(
        "the whole process stops: systemd's watchdog", 1,
        f"ended after {ended_s:.0f} s, started again", "-", back_s,
    )  # fmt: skip
    assert ended_s < 3.0 * WATCHDOG_S
    assert back_s < back_limit_s()


def test_a_power_cut_loses_nothing(aircraft: Aircraft, record: Row) -> None:
    back_s, heard_s, acknowledged = [], [], set[Chunk]()
    for _ in range(CUTS):
        aircraft.until(lambda: aircraft.status().get("clouds", 0) > 2, time.monotonic(), 60.0)
        acknowledged |= stored(aircraft.scans)
        aircraft.cut()
        assert aircraft.status() == {}
        power_on_s = aircraft.machine.boot()
        heard_s.append(aircraft.until_heard(power_on_s))
        back_s.append(aircraft.until_scanning(power_on_s))
    aircraft.until(
        lambda: all((s / "cloud.laz").is_file() for s in _ended(aircraft)), time.monotonic(), 120.0
    )
    lost = acknowledged - stored(aircraft.scans)
    aircraft.machine.run("systemctl is-system-running; systemctl is-active skyrelief; "
                         "ls /var/lib/skyrelief/scans | wc -l")  # fmt: skip
    record(
        "power cut, then power on (systemd boots)", CUTS,
        f"heard by MAVLink within {max(heard_s):.1f} s, scans by itself; all scans closed, kept",
        f"{len(lost)} of {len(acknowledged)} chunks", max(back_s),
    )  # fmt: skip
    assert acknowledged
    assert not lost
    assert max(back_s) < back_limit_s()


def _ended(aircraft: Aircraft) -> list[Path]:
    """Scans with keyframes that do not run any more."""
    running = aircraft.status().get("scan")
    with_chunks = {name for name, *_ in stored(aircraft.scans)}
    return [s for s in scan_folders(aircraft.scans) if s.name != running and s.name in with_chunks]


def test_upgrade_and_rollback(aircraft: Aircraft, record: Row) -> None:
    machine = aircraft.machine
    first = machine.ask("readlink /opt/skyrelief/current")
    assert "99.1.0" in machine.run(f"cd /root/next && {INSTALL}", 1800.0).splitlines()[-1]
    second = machine.ask("readlink /opt/skyrelief/current")
    assert second != first
    bad = machine.run(f"cd /root/bad && {INSTALL}", 1800.0)
    assert "99.2.0" in bad
    assert "is back in place" in bad
    assert "(exit code 1)" in bad
    assert machine.ask("readlink /opt/skyrelief/current") == second
    back_s = aircraft.until_scanning(time.monotonic())
    assert "is in place" in machine.run("/root/next/deploy/install.sh --rollback")
    assert machine.ask("readlink /opt/skyrelief/current") == first
    aircraft.until_scanning(time.monotonic())
    record(
        "upgrade that does not stay up", 1, "rolled back by itself; the one before that is kept",
        "-", back_s,
    )  # fmt: skip
    assert back_s < back_limit_s()


def test_uninstall_keeps_what_is_the_users(aircraft: Aircraft) -> None:
    machine, before = aircraft.machine, stored(aircraft.scans)
    machine.run("/root/bundle/deploy/install.sh --uninstall; ls /opt /etc/skyrelief /var/cache")
    assert "skyrelief.toml" in machine.transcript[-1]
    assert not (machine.root / "opt" / "skyrelief").exists()
    assert "could not be found" in machine.run("systemctl status skyrelief")
    assert stored(aircraft.scans) >= before
