"""One scan at a time; what a scan cannot start with is reported."""

from __future__ import annotations

import errno
import gc
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loopback import until
from onboard import FakeCamera, Onboard, camera_of

from mavlink.component.control import Phase
from service.cameras.source import CameraFrame
from service.daemon.frame_gate import FrameGate
from service.daemon.intent import MARK, Left, Resumption
from service.daemon.runtime import Daemon
from service.daemon.scan_run import ScanRun
from service.flight.scan import short_collections


class Silent(FakeCamera):
    """A camera that is open and sends no image."""

    def __iter__(self) -> Iterator[CameraFrame]:
        self.closed.wait(60.0)
        return iter(())


def test_images_that_the_camera_model_does_not_fit_are_refused(tmp_path: Path) -> None:
    source = FakeCamera((320, 180))
    daemon = Onboard(tmp_path, opener=camera_of(source))
    scanning, reported = daemon.scanning, daemon.vehicle.said
    daemon.equip()
    scanning.start()
    until(lambda: reported and not scanning.is_running)
    assert reported == [f"Scan failed: {scanning.fault}"]
    assert "for 1600x1200 images, gimbal has 320x180" in scanning.fault
    assert source.closed.is_set()
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]
    scanning.stop()


def test_a_camera_model_of_another_size_is_scaled_as_by_a_replay(tmp_path: Path) -> None:
    """A stream that changes from 1600x1200 to 320x240 ended every later scan."""
    daemon = Onboard(tmp_path, opener=camera_of(Silent((320, 240))))
    scanning = daemon.scanning
    daemon.equip()
    scanning.start()
    inputs = until(lambda: scanning.scan and scanning.scan.inputs)
    assert inputs.camera.size_px == (320, 240)
    assert scanning.camera is not None
    assert inputs.camera.K[0, 0] == pytest.approx(scanning.camera.K[0, 0] / 5)
    note = "the camera model is for 1600x1200 images: scaled to 320x240"
    assert inputs.notes == (note,)
    scanning.end()
    assert scanning.fault == "" and note in daemon.vehicle.said


def test_a_scan_that_was_stopped_counts_as_closing_at_once(tmp_path: Path) -> None:
    """A camera that hangs holds its scan for seconds: a start then waits, and is not swallowed."""
    end = threading.Event()
    daemon = Onboard(tmp_path, script=lambda _: end.wait(60.0))
    daemon.scanning.start()
    assert daemon.actions.status().phase is Phase.SCANNING
    daemon.actions.stop_scan()
    assert daemon.actions.status().phase is Phase.FINALISING
    assert not daemon.actions.status().is_recording
    daemon.actions.is_ready = True
    assert "previous one is closed" in daemon.actions.start_scan().text
    assert daemon.actions.status().is_recording  # ground stations show the scan that follows
    assert "being closed" in daemon.actions.capture_keyframe().text  # type: ignore[union-attr]
    daemon.actions.stop_scan()
    assert daemon.actions.status().phase is Phase.FINALISING
    end.set()
    until(lambda: daemon.actions.status().phase is Phase.IDLE)


def test_a_camera_that_fails_is_reported(tmp_path: Path) -> None:
    end = threading.Event()
    daemon = Onboard(tmp_path, script=lambda _: end.wait(60.0))
    scanning, reported, source = daemon.scanning, daemon.vehicle.said, FakeCamera((64, 48))
    daemon.look()
    scanning.start()
    run = scanning.run
    assert run is not None
    run.gate = FrameGate(source, tmp_path, 0, run.alive, threading.Event())
    source.warnings.append("known when it was opened")
    assert run.camera_news() == ["known when it was opened"]
    source.warnings.append("the image is frozen for 8 s")
    for silent_s in (0.0, 9.0, 11.0, 300.0):
        run.progress_s = time.monotonic() - silent_s
        daemon.look()
        daemon.look()
    run.progress_s = time.monotonic()
    daemon.look()
    assert reported == [
        "Camera: the image is frozen for 8 s",
        "No images for 10 s: nothing is scanned",
        "Camera images recovered",
    ]
    run.progress_s = time.monotonic() - 60.0
    daemon.look()
    scanning.stop()
    end.set()
    until(lambda: not scanning.is_running)  # stopped meanwhile
    daemon.look()
    assert reported[3:] == ["No images for 10 s: nothing is scanned"]


@pytest.mark.parametrize(
    ("boot", "heard", "armed", "goes_on"),
    [
        ("this", False, False, True),  # the service was killed: nothing need say more
        ("another", False, False, False),  # power cut: wait for the autopilot
        ("another", True, True, True),
        ("another", True, False, False),
        ("", True, True, True),
        ("none", True, True, False),
    ],
)
@pytest.mark.slow
def test_a_scan_by_command_goes_on_after_a_fall(
    boot: str, heard: bool, armed: bool, goes_on: bool, tmp_path: Path
) -> None:
    (tmp_path / "boot").write_text("this")
    if boot != "none":
        (tmp_path / "scans").mkdir()
        (tmp_path / "scans" / MARK).write_text(boot)
    begun, end = threading.Event(), threading.Event()

    def scan(_: ScanRun) -> None:
        begun.set()
        end.wait(60.0)

    daemon = Onboard(
        tmp_path / "scans",
        script=scan,
        resumption=Resumption(tmp_path / "scans", tmp_path / "boot"),
    )
    if heard:
        daemon.vehicle.arm(armed)
    daemon.actions.is_ready = True
    for _ in range(3):
        daemon.look()
    assert begun.wait(10.0 if goes_on else 0.2) == goes_on
    mark = tmp_path / "scans" / MARK
    if goes_on:
        assert mark.read_text() == "this"
        daemon.actions.stop_scan()
        end.set()
        until(lambda: not daemon.scanning.is_running)
    if heard:
        assert not mark.exists()  # landed, or stopped


@pytest.mark.slow
def test_only_a_scan_that_was_not_ended_goes_on(tmp_path: Path) -> None:
    end = threading.Event()

    def next_life(start: str = "on-command") -> Daemon:
        return Onboard(tmp_path, f"scan.start={start}", script=lambda _: end.wait(60.0))

    def left(daemon: Daemon) -> Left:
        return daemon.scanning.resumption.left

    killed = next_life()
    killed.scanning.start()
    assert left(next_life()) is Left.BY_SERVICE
    killed.scanning.stop()
    assert left(next_life()) is Left.NOTHING
    end.set()
    until(lambda: not killed.scanning.is_running)
    killed.scanning.start()  # the recording ends by itself
    until(lambda: not killed.scanning.is_running)
    assert left(next_life()) is Left.NOTHING
    by_itself = next_life("on-boot")
    by_itself.scanning.start()
    assert left(next_life()) is Left.NOTHING
    (tmp_path / MARK).write_text("of a configuration that was on-command")
    by_itself = next_life("on-boot")
    by_itself.look()
    assert not by_itself.scanning.is_running


def test_a_disk_that_goes_away_leaves_the_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stat = os.stat

    def away(path: Any, *more: Any, **options: Any) -> os.stat_result:
        if str(path).startswith(str(tmp_path)):
            raise OSError(errno.ENOTCONN, "Transport endpoint is not connected", str(path))
        return stat(path, *more, **options)

    daemon = Onboard(tmp_path, opener=camera_of(FakeCamera((1600, 1200))))
    scanning = daemon.scanning
    daemon.equip()
    monkeypatch.setattr(os, "stat", away)
    assert daemon.actions.status().storage_total_mib > 0
    scanning.start()
    until(lambda: scanning.fault and not scanning.is_running)
    assert "internal" not in scanning.fault
    assert daemon.snapshot()["state"]
    scanning.stop()


def test_a_scan_is_started_once(tmp_path: Path) -> None:
    begun, end = [], threading.Event()

    def scan(_: ScanRun) -> None:
        begun.append(threading.get_ident())
        end.wait(60.0)

    daemon = Onboard(tmp_path, script=scan)
    callers = [threading.Thread(target=daemon.scanning.start) for _ in range(20)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    until(lambda: begun)
    end.set()
    until(lambda: not daemon.scanning.is_running)
    assert len(begun) == 1


def test_the_collector_leaves_out_what_was_loaded_until_the_scan_ends() -> None:
    with pytest.raises(KeyError), short_collections():
        assert gc.get_freeze_count() > 10_000
        raise KeyError
    assert gc.get_freeze_count() == 0
