"""One scan at a time; what a scan cannot start with is reported."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from live_stream import clip, opener
from loopback import until
from onboard import FakeCamera, Onboard, camera_of

from mavlink.component.control import Phase
from service.cameras.live import LiveConfig, LiveSource
from service.cameras.source import CameraFrame, QueuedSource
from service.daemon.frame_gate import FrameGate
from service.daemon.resumption import MARK, Left, Resumption
from service.daemon.runtime import Daemon
from service.daemon.scan_state import Event, State
from service.daemon.scanning import Scanning, ScanRun
from service.errors import OutsideError
from service.flight.scan import short_collections
from service.stream.store import ScanStore
from service.workers import Worker, Workers


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
    until(lambda: reported and scanning.run is None)
    assert reported == [f"Scan failed: {scanning.fault}"]
    assert "for 1600x1200 images, gimbal has 320x180" in scanning.fault
    assert source.closed.is_set()
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]
    scanning.handle(Event.STOP)


def test_a_scan_that_cannot_begin_is_neither_sent_nor_recorded(tmp_path: Path) -> None:
    daemon = Onboard(tmp_path, opener=camera_of(FakeCamera((1600, 1200))))
    daemon.equip()
    object.__setattr__(daemon.scanning.config.compute, "labels", 1)  # which loading refuses
    daemon.scanning.start()
    until(lambda: daemon.scanning.run is None)
    assert "labels" in daemon.scanning.fault
    assert [path.name for path in tmp_path.glob("2*/*")] == ["scan.db"]
    daemon.scanning.handle(Event.STOP)


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


def test_another_shape_of_a_live_stream_begins_another_scan(tmp_path: Path) -> None:
    """The first scan ends as one whose recording has ended; the camera is not opened again."""
    opened: list[str] = []

    def open_camera(source: str) -> QueuedSource:
        opened.append(source)
        parts = clip(20, (320, 240)), clip(20, (320, 180)), clip(1000, (160, 90))
        return QueuedSource(LiveSource(opener(*parts), "gimbal", LiveConfig(changed_s=0.2)))

    daemon = Onboard(tmp_path, "camera.source=srt://:9000", opener=open_camera)
    scanning, said = daemon.scanning, daemon.vehicle.said
    daemon.equip()
    scanning.start()
    first = until(lambda: scanning.scan)
    until(lambda: scanning.handle(Event.TICK) and scanning.scan not in (None, first))
    second = scanning.scan
    assert second is not None and first.inputs.camera.size_px == (320, 240)
    until(lambda: second.recorder.frames > 20)  # and the smaller ones of that shape are in it
    model, given = second.inputs.camera, scanning.camera
    assert given is not None and model.size_px == (320, 180)
    assert model.K[0, 0] == pytest.approx(given.K[0, 0] / 5) and model.sigma_focal == 0.15
    scanning.end()
    assert opened == ["srt://:9000"] and scanning.fault == ""
    assert any("that of 320x180 is derived" in text for text in said)
    scans = sorted(path.parent for path in tmp_path.glob("2*/scan.json"))
    warned = {240: "now gives 320x180 images instead of 320x240", 180: "they are scaled"}
    for folder, height in zip(scans, warned, strict=True):
        with closing(ScanStore.open(folder / "scan.db")) as store:
            summary = store.summary or {}
            assert store.header.camera["height"] == height
            assert warned[height] in " ".join(summary["warnings"]) and "interrupted" not in summary


@pytest.mark.slow
def test_a_fault_after_another_shape_does_not_make_it_unfit(tmp_path: Path) -> None:
    """The camera is opened again, and still gives that shape."""
    first, later = ((20, (320, 240)), (20, (320, 180))), ((1000, (320, 180)),)
    given = iter((first, later))

    def open_camera(_: str) -> QueuedSource:
        parts = (clip(*part) for part in next(given))
        return QueuedSource(LiveSource(opener(*parts), "gimbal", LiveConfig(changed_s=0.2)))

    faults = iter((None, OutsideError("the disk is away")))

    class Failing(Scanning):
        def _inputs(self, *given: Any) -> Any:
            if (fault := next(faults, None)) is not None:
                raise fault
            return super()._inputs(*given)

    daemon = Onboard(tmp_path, opener=open_camera, of=Failing)
    scanning = daemon.scanning
    daemon.equip()
    scanning.start()
    first_scan = until(lambda: scanning.scan)
    until(lambda: scanning.handle(Event.TICK) and scanning.scan not in (None, first_scan))
    assert scanning.fault == "" and "Scan failed: the disk is away" in daemon.vehicle.said
    assert scanning.scan is not None and scanning.scan.inputs.camera.size_px == (320, 180)
    scanning.end()
    assert not scanning._is_reshaped


def test_a_stop_closes_the_camera_that_the_next_scan_would_take(tmp_path: Path) -> None:
    class Reshaped(FakeCamera):
        def following(self) -> FakeCamera:
            return left

    left, go = FakeCamera((320, 180)), threading.Event()

    class Slow(Scanning):
        def _close_scan(self, *given: Any) -> None:
            go.wait(60.0)
            super()._close_scan(*given)

    daemon = Onboard(tmp_path, opener=camera_of(Reshaped((1600, 1200))), of=Slow)
    daemon.equip()
    daemon.scanning.start()
    until(lambda: daemon.scanning.life.state is State.REOPENING)
    assert not left.closed.is_set()
    daemon.scanning.handle(Event.STOP)
    assert left.closed.is_set()
    go.set()
    until(lambda: daemon.scanning.life.state is State.IDLE)


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


class Crowded(Workers):
    """A process that may not start another thread, a few times."""

    left = 2

    def start(self, *given: Any, **named: Any) -> Worker:
        self.left -= 1
        if self.left >= 0:
            raise RuntimeError("can't start new thread")
        return super().start(*given, **named)


def test_an_attempt_that_cannot_start_is_reported_and_retried(tmp_path: Path) -> None:
    """The state stayed at scanning, with no scan: only a stop and a start ended that."""
    workers = Crowded()
    daemon = Onboard(tmp_path, script=lambda run: run.stop.wait(60.0), workers=workers)
    scanning = daemon.scanning
    scanning.start()
    assert scanning.run is None
    assert scanning.life.state is State.WAITING
    assert scanning.fault == "internal fault: can't start new thread"
    scanning.handle(Event.TICK)
    assert scanning.life.failures == 2
    scanning.handle(Event.TICK)
    assert scanning.run is not None
    assert scanning.fault == ""
    scanning.end()
    assert scanning.life.state is State.ENDED


def test_a_camera_that_fails_is_reported(tmp_path: Path) -> None:
    end, now_s = threading.Event(), 0.0
    daemon = Onboard(tmp_path, script=lambda _: end.wait(60.0), clock_s=lambda: now_s)
    scanning, reported, source = daemon.scanning, daemon.vehicle.said, FakeCamera((64, 48))
    daemon.look()
    scanning.start()
    run = scanning.run
    assert run is not None
    run.gate = FrameGate(source, tmp_path, 0, run.alive, threading.Event())
    source.warnings.append("known when it was opened")
    assert run.new_camera_warnings() == ["known when it was opened"]
    source.warnings.append("the image is frozen for 8 s")
    for now_s in (0.0, 9.0, 11.0, 300.0):  # noqa: B007
        daemon.look()
        daemon.look()
    run.alive()
    daemon.look()
    assert reported == [
        "Camera: the image is frozen for 8 s",
        "No images for 10 s: nothing is scanned",
        "Camera images recovered",
    ]
    now_s += 60.0
    daemon.look()
    scanning.handle(Event.STOP)
    end.set()
    until(lambda: scanning.run is None)  # stopped meanwhile
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
        until(lambda: daemon.scanning.run is None)
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
    killed.scanning.handle(Event.STOP)
    assert left(next_life()) is Left.NOTHING
    end.set()
    until(lambda: killed.scanning.run is None)
    killed.scanning.start()  # the recording ends by itself
    until(lambda: killed.scanning.run is None)
    assert left(next_life()) is Left.NOTHING
    by_itself = next_life("on-boot")
    by_itself.scanning.start()
    assert left(next_life()) is Left.NOTHING
    (tmp_path / MARK).write_text("of a configuration that was on-command")
    by_itself = next_life("on-boot")
    by_itself.look()
    assert by_itself.scanning.run is None


def test_a_disk_that_goes_away_leaves_the_commands(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    daemon = Onboard(disk / "scans", opener=camera_of(FakeCamera((1600, 1200))))
    scanning = daemon.scanning
    daemon.equip()
    disk.rmdir()
    disk.symlink_to("x" * 300)  # every access fails, not just with "no such file"
    with pytest.raises(OSError, match="too long"):
        os.stat(disk)
    assert daemon.actions.status().storage_total_mib > 0
    scanning.start()
    until(lambda: scanning.fault and scanning.run is None)
    assert "internal" not in scanning.fault
    assert daemon.snapshot()["state"]
    scanning.handle(Event.STOP)


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
    until(lambda: daemon.scanning.run is None)
    assert len(begun) == 1


def test_the_collector_leaves_out_what_was_loaded_until_the_scan_ends() -> None:
    with pytest.raises(KeyError), short_collections():
        assert gc.get_freeze_count() > 10_000
        raise KeyError
    assert gc.get_freeze_count() == 0
