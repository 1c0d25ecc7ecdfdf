"""One scan at a time; what a scan cannot start with is told."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from loopback import until

from mavlink.control import Phase
from recon.backends.cpu import CpuBackend
from service.cameras.camera_file import load_camera
from service.config import load_config
from service.daemon.runtime import Daemon
from service.daemon.scanning import Scanning

MODEL = Path(__file__).parent.parent / "demo/caliterra/camera.yaml"


@pytest.fixture
def daemon(tmp_path: Path) -> Daemon:
    return Daemon(load_config(None, [f"scan.folder={tmp_path}", "health.http="]))


def test_pictures_that_the_camera_model_does_not_fit_are_refused(
    daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed, told, scanning = threading.Event(), [], daemon.scanning
    source: Any = SimpleNamespace(
        size_px=(320, 240), description="gimbal", start_monotonic_ns=0, close=closed.set
    )
    monkeypatch.setattr(daemon.vehicle, "statustext", lambda text, *_: told.append(text))
    monkeypatch.setattr(scanning, "_open_camera", lambda: source)
    scanning.camera, scanning._backend = load_camera(MODEL), CpuBackend()
    scanning.start()
    until(lambda: told and not scanning.is_running)
    assert told == [f"Scan failed: {scanning.fault}"]
    assert "for 1600x1200 pictures, gimbal has 320x240" in scanning.fault
    assert closed.is_set()
    assert not list(tmp_path.iterdir())
    scanning.stop()


def test_a_scan_that_was_stopped_counts_as_closing_at_once(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera that hangs holds its scan for seconds: a start then is refused, not swallowed."""
    end = threading.Event()
    monkeypatch.setattr(Scanning, "_scan_once", lambda self: end.wait(60.0))
    daemon.scanning.start()
    assert daemon.actions.status().phase is Phase.SCANNING
    daemon.actions.stop_scan()
    assert daemon.actions.status().phase is Phase.FINALISING
    end.set()
    until(lambda: daemon.actions.status().phase is Phase.IDLE)


def test_a_scan_is_started_once(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, end = [], threading.Event()

    def scan(self: Scanning) -> None:
        begun.append(threading.get_ident())
        end.wait(60.0)

    monkeypatch.setattr(Scanning, "_scan_once", scan)
    callers = [threading.Thread(target=daemon.scanning.start) for _ in range(20)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    until(lambda: begun)
    end.set()
    until(lambda: not daemon.scanning.is_running)
    assert len(begun) == 1
