"""Compiled before the flight, and a watchdog that is tight once that is so."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from onboard import MODEL, Onboard
from paths import ROOT
from spied import spied

from mavlink.component.vehicle import VehicleLink
from service.background import BackgroundWorker
from service.cameras import CameraFrame
from service.config import load_config
from service.daemon import runtime
from service.daemon.frame_gate import FrameGate
from service.daemon.runtime import COMPILING_S, HUNG_S
from service.daemon.scanning import ScanRun
from service.daemon.warm_up import SyntheticGround, is_warm, warm_up, warm_up_command
from service.progress import Progress
from service.scans.writing import SUMMARY
from service.stream.records import ScanHeader
from service.stream.store import ScanStore


@pytest.mark.slow
def test_made_up_ground_is_scanned_and_marked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert not is_warm()
    exported = list[str]()
    seconds, keyframes = warm_up(
        load_config(None, ["compute.backend=cpu"]),
        Progress(),
        lambda folder: exported.extend(path.name for path in folder.iterdir()),
    )
    assert seconds > 0 and "scan.db" in exported
    assert keyframes >= 5
    assert is_warm()
    assert not is_warm("another version")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    assert not is_warm()


IDLE = """
import sys, threading, time
sys.path.insert(0, sys.argv[1])
from autopilot import AUTOPILOT, beat, packed
from loopback import until
from mavlink.wire.dialect import dialect
from service.config import load_config
from service.daemon.runtime import Daemon
from service.daemon.warm_up import load_kernels

def hear_armed():
    (message,) = dialect.MAVLink(None).parse_buffer(packed(beat(armed=True), AUTOPILOT))
    daemon.vehicle.presence.hear(message, time.monotonic_ns())
    return load_kernels.cache_info().currsize

daemon = Daemon(load_config(None, sys.argv[2:]))
running = threading.Thread(target=daemon.run)
running.start()
until(lambda: daemon.actions.is_ready, 120)
daemon.recover()
import service.stream.link, service.stream.reports  # of scans that the ground lacks
daemon.snapshot()
heavy = "av llvmlite numba pyproj recon.pipeline scipy service.flight.scan torch"
print(*sorted({*heavy.split()} & sys.modules.keys()))
daemon.scanning.is_warm = True
until(hear_armed, 120)
print(*sorted({"numba", "service.flight.scan"} & sys.modules.keys()))
daemon.quit()
running.join()
"""


@pytest.mark.slow
def test_an_idle_service_holds_no_compiler_and_an_armed_one_is_prepared(tmp_path: Path) -> None:
    scan = tmp_path / "scans" / "20260101T000000Z"
    with ScanStore.create(scan / "scan.db", ScanHeader("1", "drone", 1)) as store:
        store.finish({})
    (scan / SUMMARY).write_text("{}")
    cut_off = scan.with_name("20260102T000000Z")
    ScanStore.create(cut_off / "scan.db", ScanHeader("2", "drone", 1)).close()
    settings = [
        f"camera.source={tmp_path}", f"camera.model={MODEL}", f"scan.folder={scan.parent}",
        "health.http=", "mavlink.links=[]", "mavlink.system_id=1", "compute.backend=cpu",
    ]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", IDLE, str(ROOT / "tests" / "support"), *settings],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "\nnumba service.flight.scan\n"), done.stderr
    assert (cut_off / "cloud.laz").is_file()


def test_kernels_that_cannot_be_loaded_leave_the_rest_of_housekeeping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails() -> None:
        raise RuntimeError("no cache")

    daemon, kept = Onboard(tmp_path), spied(monkeypatch, runtime, "make_room")
    monkeypatch.setattr(runtime, "load_kernels", fails)
    daemon.vehicle.arm()
    daemon.look()
    daemon.scanning.is_warm = True
    with pytest.raises(RuntimeError, match="no cache"):
        daemon.housekeeping()
    assert [call.args[0] for call in kept.call_args_list] == [Path(daemon.config.scan.folder)]


def test_the_command_fits_the_installation() -> None:
    assert warm_up_command() == "skyrelief warm-up"
    installed = warm_up_command("/opt/skyrelief/versions/0.1.0")
    assert "NUMBA_CACHE_DIR=/var/cache/skyrelief /opt/skyrelief/current" in installed


def test_made_up_ground_is_the_same_each_time() -> None:
    first, again = ([f.image for f in SyntheticGround(5)] for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], first[1])


def test_work_at_hand_is_timed() -> None:
    release, begun = Event(), Event()

    def work(x: int) -> int:
        begun.set()
        assert release.wait(20.0)
        return x

    rows = "dense", "placing"
    jobs = BackgroundWorker[int, int](rows, lambda x: partial(work, x), 3, live=True)
    assert jobs.busy_s == 0.0
    jobs.offer(1)
    assert begun.wait(20.0)
    time.sleep(0.02)
    assert jobs.busy_s >= 0.02
    release.set()
    assert jobs.finished(everything=True) == [(1, 1)]
    assert jobs.busy_s == 0.0
    jobs.close()


def test_a_frame_at_work_is_timed_and_a_silent_camera_is_not(tmp_path: Path) -> None:
    asked = Event()
    gate: FrameGate

    class Silent(SyntheticGround):
        """Gives one image, then nothing for a while."""

        def __iter__(self) -> Iterator[CameraFrame]:
            for frame in super().__iter__():
                yield frame
                assert gate.busy_s == 0.0
                asked.set()

    gate = FrameGate(Silent(1), tmp_path, 0, lambda: None, Event())
    for _ in gate:
        time.sleep(0.02)
        assert gate.busy_s >= 0.02
    assert asked.is_set()


class Busy(ScanRun):
    """An attempt that works on one frame for as long as a test says."""

    busy_s = 0.0


def test_the_watchdog_starves_on_a_hang_only(tmp_path: Path) -> None:
    end, now_s, later_ns = Event(), 0.0, 0

    def link(config: Any, control: Any, first: Any) -> VehicleLink:
        return VehicleLink(config, control, first, lambda: time.monotonic_ns() + later_ns)

    daemon = Onboard(
        tmp_path, script=lambda _: end.wait(60.0), clock_s=lambda: now_s, link=link
    )  # fmt: skip
    daemon.scanning.start()
    run = daemon.scanning.run = Busy(is_asked=True)
    now_s += 1000.0  # no frame for long: the camera's fault, not ours
    assert daemon.is_progressing
    daemon.scanning.is_warm = False
    run.busy_s = HUNG_S + 1.0
    assert daemon.is_progressing
    run.busy_s = COMPILING_S + 1.0
    assert not daemon.is_progressing
    run.busy_s, daemon.scanning.is_warm = HUNG_S + 1.0, True
    assert not daemon.is_progressing
    run.busy_s = 0.0
    assert daemon.is_progressing
    later_ns = 60_000_000_000  # the protocol's thread stands still
    assert not daemon.is_progressing
    end.set()
    daemon.scanning.end()
