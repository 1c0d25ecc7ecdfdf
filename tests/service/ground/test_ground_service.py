"""The ground process as a service: supervised, and fed to the init system's watchdog."""

from __future__ import annotations

import configparser
import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from loopback import free_port, until
from paths import ROOT
from typer.testing import CliRunner

from service.cli import app
from service.commands.ground import feed_watchdog
from service.errors import InputError, SkyreliefError
from service.init_system import Notifier
from service.scans.retention import Claim
from service.workers import Worker, Workers, row_of

pytest.importorskip("zenoh")


def test_the_unit_has_the_watchdog_that_the_daemon_has() -> None:
    def read(name: str) -> configparser.SectionProxy:
        unit = configparser.RawConfigParser(strict=False)
        unit.optionxform = str  # type: ignore[assignment, method-assign]
        unit.read(ROOT / "systemd" / name)
        return unit["Service"]

    onboard, ground = read("skyrelief.service"), read("skyrelief-ground.service")
    for key in ("Type", "NotifyAccess", "Restart"):
        assert ground[key] == onboard[key]
    assert 1 < float(ground["WatchdogSec"]) <= 60


@pytest.mark.slow
def test_ground_feeds_the_watchdog_and_asks_for_time_to_close(tmp_path: Path) -> None:
    heard: list[str] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(60.0)
        command = [sys.executable, "-m", "service.cli", "ground", "--store", str(tmp_path / "g")]
        command += ["--listen", f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        environment["NOTIFY_SOCKET"] = str(tmp_path / "notify")
        with subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment) as process:
            while heard.count("WATCHDOG=1") < 2:
                heard.append(listener.recv(200).decode())
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0
        listener.settimeout(0.1)
        with contextlib.suppress(TimeoutError):
            while True:
                heard.append(listener.recv(200).decode())
    assert heard[0] == "READY=1"
    assert "STOPPING=1" in heard and heard[-1].startswith("EXTEND_TIMEOUT_USEC=")


def test_a_second_station_on_a_store_is_refused(tmp_path: Path) -> None:
    other = Claim()
    assert other.take(tmp_path)
    try:
        done = CliRunner().invoke(app, ["ground", "--store", str(tmp_path)])
    finally:
        other.give_up()
    assert isinstance(done.exception, InputError) and "another station" in str(done.exception)


def test_a_worker_that_hangs_starves_the_watchdog_and_one_that_failed_ends_the_process(
    tmp_path: Path,
) -> None:
    def heard() -> str:
        return listener.recv(200).decode()

    table, hung = Workers(max_restarts=0, pause_s=0.0), threading.Event()

    def hangs(worker: Worker) -> None:
        hung.wait()

    def fails(worker: Worker) -> None:
        raise KeyError("made up")

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        notifier = Notifier(str(tmp_path / "notify"))
        feed_watchdog(table, notifier)
        assert heard() == "WATCHDOG=1"
        worker = table.start(replace(row_of("deliverables"), deadline_s=0.05), hangs)
        until(lambda: table.stalled)
        feed_watchdog(table, notifier)
        assert heard() == "STATUS=no progress: deliverables"
        hung.set()
        assert worker.join(10.0)
        feed_watchdog(table, notifier)
        assert heard() == "WATCHDOG=1"
        of_a_drone = table.start("drone red", fails)
        until(lambda: of_a_drone.has_failed)
        feed_watchdog(table, notifier)
        essential = table.start("receiver", fails)
        until(lambda: essential.has_failed)
        with pytest.raises(SkyreliefError, match="receiver failed too often"):
            feed_watchdog(table, notifier)
