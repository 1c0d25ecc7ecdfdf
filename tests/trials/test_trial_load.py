"""Too much to do, too little memory, no GPU any more: what the service gives up, and back."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from onboard import Onboard
from paths import DEMO, demo_stretch
from trial_autopilot import aircraft
from trial_rig import (
    PATIENCE_S,
    WHOLE,
    Row,
    Service,
    back_limit_s,
    burn,
    scan_folders,
    small_model,
    stored,
)

from recon.backends.cpu import CpuBackend
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import U8, DisparityMap
from service.compute.backend_choice import FallbackBackend
from service.daemon.machine import read_machine

pytestmark = [pytest.mark.trial, pytest.mark.timeout(1800 if WHOLE else 280)]

STREAMED = "640:480", f"-framerate 8 -pattern_type glob -i {demo_stretch()}/*.jpg"
BEAT_S = 1.2 if WHOLE else 3.0
"""Between two heartbeats, at most."""
MAX_HOGS = 64
"""Per core, before it is said that nothing makes the service late."""


@contextlib.contextmanager
def hogs(processes: int) -> Iterator[None]:
    """So many processes that take all the time they get."""
    running = burn(processes)
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


@pytest.mark.skipif(not WHOLE, reason="minutes: only in the whole trials")
@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_lag_is_relieved_and_passes(tmp_path: Path, record: Row) -> None:
    """Real lag: processes that take the cores, more of them until the service is late."""
    steps: list[str] = []
    with aircraft(tmp_path, STREAMED, small_model(tmp_path, 640)) as (service, autopilot, _):

        def step() -> str:
            name = str(service.get().get("load", {}).get("name", ""))
            if name and (not steps or steps[-1] != name):
                steps.append(name)
            return name

        service.until(lambda: service.frames > 20, "frames")
        cores, count = os.cpu_count() or 1, 4
        while count <= MAX_HOGS and step() in ("full", ""):
            with hogs(count * cores), contextlib.suppress(TimeoutError):
                deadline = time.monotonic() + 40.0
                while step() in ("full", "") and time.monotonic() < deadline:
                    time.sleep(0.3)
                if step() != "full":
                    time.sleep(15.0)  # further down, if that did not help
                    step()
            count *= 2
        start = time.monotonic()
        down = len(steps)
        while step() != "full" and time.monotonic() < start + 10.0 * PATIENCE_S:
            assert service.process.poll() is None
            time.sleep(0.3)
        calm_s = time.monotonic() - start
        back_s = service.until_more_frames("frames")
        (folder,) = scan_folders(service.scans)
        assert service.stop() == 0
    reported = [text for text in autopilot.texts if text.startswith("Load:")]
    record(
        f"lag: {count // 2 * cores} processes that take the cores",
        1,
        f"{' > '.join(steps)}; {len(reported)} texts; full again after {calm_s:.0f} s",
        "-",
        back_s,
    )
    assert steps[0] == "full"
    assert steps[-1] == "full"
    assert down > 1, "nothing made the service late"
    assert "Load: full quality again" in reported
    assert any("lower rate" in text and "(" in text for text in reported)
    assert (folder / "cloud.laz").is_file()


@pytest.mark.skipif(not WHOLE, reason="a minute: only in the whole trials")
@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_a_camera_is_there_again_after_landing_under_load(tmp_path: Path, record: Row) -> None:
    """Its reader is slow to end then, and must not keep the port from the next scan."""
    longest_s, times, others = 0.0, 8, 8 * (os.cpu_count() or 1)
    model, calm = small_model(tmp_path, 640), "relief = false\n"
    with aircraft(tmp_path, STREAMED, model, "on-arm", calm) as (service, autopilot, _):
        service.until_up()
        for _ in range(times):
            autopilot.armed.set()
            longest_s = max(longest_s, service.until(lambda: service.frames > 0, "take-off"))
            service.until(lambda: service.frames > 20, "frames")
            with hogs(others):
                time.sleep(4.0)
                autopilot.armed.clear()
                service.until(lambda: service.get().get("state") == "idle", "landing")
        assert len(scan_folders(service.scans)) == times
        acknowledged = stored(service.scans)
        assert service.stop() == 0
    lost = acknowledged - stored(service.scans)
    record(
        f"landing while {others} processes take the cores, then taking off",
        times,
        "a new scan each time",
        f"{len(lost)} of {len(acknowledged)} chunks",
        longest_s,
    )
    assert acknowledged and not lost
    assert longest_s < back_limit_s()


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_heartbeats_keep_time_while_a_scan_and_others_take_the_cores(
    tmp_path: Path, record: Row
) -> None:
    others, model = 4 * (os.cpu_count() or 1), small_model(tmp_path, 640)
    kept = "relief = false\n"  # the scan goes on as it is
    with aircraft(tmp_path, STREAMED, model, compute=kept) as (service, autopilot, _):
        service.until(lambda: service.frames > 5, "frames")
        with hogs(others):
            began = len(autopilot.beats_s)
            time.sleep(60.0 if WHOLE else 12.0)
            beats_s = autopilot.beats_s[began:]
        assert service.stop() == 0
    longest_s = max(b - a for a, b in pairwise(beats_s))
    record(
        f"heartbeats beside a scan and {others} processes that take the cores",
        len(beats_s),
        f"longest gap {longest_s:.2f} s",
        "-",
        0.0,
    )
    assert len(beats_s) > (50 if WHOLE else 8)
    assert longest_s < BEAT_S


def test_memory_short_is_relieved(tmp_path: Path, record: Row) -> None:
    """Relief by the ladder, live: nothing reconstructed, images kept, and back."""
    short = '[compute]\nbackend = "cpu"\nguide_width = 320\n'
    with Service(tmp_path) as service:
        service.until(lambda: service.frames > 0, "frames")
        service.reload((short, short + "least_memory_mib = 1e6\n"))
        service.until(lambda: service.get()["load"]["name"] == "record only", "relief")
        service.until(lambda: service.get()["load"].get("pictures_kept", 0) > 1, "kept images")
        service.reload(("least_memory_mib = 1e6", "relief = false"))
        back_s = service.until_more_frames("frames")
        assert service.get()["load"]["name"] == "full"
        (folder,) = scan_folders(service.scans)
        assert service.stop() == 0
    kept = list((folder / "later").glob("*.jpg"))
    record("memory short", 1, f"record only: {len(kept)} images kept for a replay", "-", back_s)
    assert kept
    run = json.loads((folder / "scan.json").read_text())["run"]
    assert any("later/" in warning for warning in run["warnings"])


def test_memory_limit_hit_and_lifted(tmp_path: Path, record: Row) -> None:
    """No more address space for a while; a service that dies of it is started as by systemd."""
    with Service(tmp_path) as service:
        service.until(lambda: stored(service.scans), "a chunk")
        pages = int(Path(f"/proc/{service.process.pid}/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + (1 << 20)
        unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
        resource.prlimit(service.process.pid, resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
        time.sleep(20.0 if WHOLE else 5.0)
        acknowledged = stored(service.scans)
        survived = service.process.poll() is None
        if survived:
            resource.prlimit(service.process.pid, resource.RLIMIT_AS, unlimited)
            back_s = service.until_more_frames("frames")
            service.stop()
    if not survived:
        time.sleep(1.0)
        with Service(tmp_path) as again:
            back_s = again.until(lambda: again.frames > 0, "frames") + 1.0
            again.stop()
    lost = acknowledged - stored(service.scans)
    record(
        "memory limit hit",
        1,
        "survived" if survived else "died, started again",
        f"{len(lost)} of {len(acknowledged)} chunks",
        back_s,
    )
    assert not lost
    assert back_s < back_limit_s()


class OutOfMemory(CpuBackend):
    """A GPU, as far as anyone can tell, until its memory is gone."""

    name, device = "torch", "cuda"

    def __init__(self) -> None:
        self.full = threading.Event()

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        """As the CPU's, until it is full."""
        if self.full.is_set():
            raise RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB")
        return super().belief_propagation(left, right, labels, config)


def test_gpu_out_of_memory(tmp_path: Path, record: Row) -> None:
    given = [f"camera.model={DEMO / 'camera.yaml'}"]
    given += [f"camera.source=images:{demo_stretch()}?interval_s=0.7", "compute.guide_width=320"]
    daemon = Onboard(tmp_path, *given, "compute.backend=cpu")
    daemon.scanning.load()
    gpu = OutOfMemory()
    daemon.scanning.backend = FallbackBackend(gpu)
    daemon.scanning.start()

    def keyframes(more_than: int) -> int:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            scan = daemon.scanning.scan
            if scan is not None and scan.recorder.keyframes > more_than:
                return scan.recorder.keyframes
            time.sleep(0.05)
        raise AssertionError(f"no keyframe after {more_than}: {daemon.scanning.fault}")

    before = keyframes(0)
    gpu.full.set()
    start = time.monotonic()
    for _ in range(5):  # a keyframe or two may have been under way
        before = keyframes(before)
        if daemon.snapshot()["backend"] == "cpu":
            break
    back_s = time.monotonic() - start
    daemon.shed_load(read_machine(Path("/")))
    assert daemon.snapshot()["backend"] == "cpu"
    daemon.scanning.end()
    record("GPU out of memory (simulated)", 1, "the same scan continues on the CPU", "-", back_s)
    assert any("out of memory" in text for text in daemon.vehicle.said)
    assert not daemon.scanning.fault
