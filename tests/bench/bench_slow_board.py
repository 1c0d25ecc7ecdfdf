"""``make bench ARGS=slow``: the load ladder on a board of four slow cores, emulated here.

``skyrelief run`` scans a simulated flight of 1280x720 at 30 images a second, sent to it as H.264
with its telemetry, while all its threads stand still for a share of every 20 ms. On two cores, half
of the time is in all what four cores of a quarter of this machine's speed do, with faster single
threads; a quarter of the time is the speed of those cores, two of them. The board lies between.
Its caches and its memory are not emulated. The peer of a figure is what the ladder allows.

make bench ARGS="slow --flight FLIGHT" plays a flight of ``skyrelief simulate``.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bench_options import DataOptions
from command_line import command_process

from service.bench import BenchResult
from service.daemon.load_shedding import LATE_FRAMES, LATE_VIEWS, OLDEST_S
from service.errors import OutsideError
from service.listener import free_ports
from service.workers import python_command

SHARES = {"half of the time": 0.5, "a quarter of the time": 0.25}
PERIOD_S, LOOK_S = 0.02, 0.5
START_S = 240.0
"""For a slow start; kernels are compiled before."""
SETTLED_S = 20.0
"""At the end the ladder has taken its steps."""


def run(options: DataOptions) -> list[BenchResult]:
    """Of each share: the steps of the ladder, and how late images and views are after them."""
    results: list[BenchResult] = []
    with tempfile.TemporaryDirectory(prefix="skyrelief-slow-") as name:
        flight = options.flight
        if flight is None:
            flight = Path(name) / "flight"
            size = ("--size", "1280x720", "--fps", "30", "--duration-s", "30")
            _done("simulate", "--out", str(flight), *size)
        _done("warm-up")
        for words, share in SHARES.items():
            folder = Path(name) / f"{share:g}"
            folder.mkdir()
            with ExitStack() as open_now:
                watched_s = 2.0 * options.rounds
                looks = fly(folder, flight, share, options.backend, watched_s, open_now)
            results += figures(words, looks)
    return results


def _done(*words: str) -> None:
    subprocess.run(python_command("service.cli", *words), check=True, stdin=subprocess.DEVNULL)


class Look(NamedTuple):
    """The daemon's status at a time of the flight."""

    at_s: float
    level: int
    name: str
    age_s: float  # of the newest image when its work began
    frames: int  # passed on
    late: int  # images that nothing took in time
    keyframes: int
    late_views: int


def figures(words: str, looks: list[Look]) -> list[BenchResult]:
    """Steps, and what was late once they were taken."""
    steps = [
        f"{look.name} at {look.at_s:.0f} s"
        for before, look in pairwise(looks)
        if look.level != before.level
    ]
    settled = [look for look in looks if look.at_s >= looks[-1].at_s - SETTLED_S]
    first, last = settled[0], settled[-1]
    frames, views = last.frames - first.frames, last.keyframes - first.keyframes
    late, late_views = last.late - first.late, last.late_views - first.late_views
    age_s = float(np.percentile([look.age_s for look in settled], 95))
    allowed = "the ladder's limit"
    note = "; ".join(steps) or "no step"
    return [
        BenchResult(f"{words}: steps of the ladder", last.level, "", note=note),
        BenchResult(f"{words}: age of an image as its work begins, 95 %", age_s, "s",
                    peer=allowed, peer_value=OLDEST_S),
        BenchResult(f"{words}: images missed", 100.0 * late / max(frames + late, 1), "%",
                    peer=allowed, peer_value=100.0 * LATE_FRAMES,
                    note=f"{last.late} of {last.frames + last.late} in the whole flight"),
        BenchResult(f"{words}: views dropped", 100.0 * late_views / max(views + late_views, 1), "%",
                    peer=allowed, peer_value=100.0 * LATE_VIEWS,
                    note=f"{last.keyframes} keyframes in {last.at_s:.0f} s"),
    ]  # fmt: skip


def fly(
    folder: Path, flight: Path, share: float, backend: str, watched_s: float, open_now: ExitStack
) -> list[Look]:
    """The daemon's status, watched for so long from the first image on."""
    at_status, video, telemetry = free_ports(3)
    settings = {
        "camera.source": f"stream:udp://127.0.0.1:{video}",
        "camera.model": flight / "camera.yaml",
        "camera.readout_ms": 0,
        "mavlink.links": f'["udpin:127.0.0.1:{telemetry}"]',
        "scan.folder": folder / "scans",
        "scan.start": "on-boot",
        "health.http": f"127.0.0.1:{at_status}",
        "compute.backend": backend,
    }
    process = open_now.enter_context(
        command_process(folder / "run.log", "run", *(
            word for key, value in settings.items() for word in ("--set", f"{key}={value}")
        ))
    )  # fmt: skip
    open_now.enter_context(
        command_process(folder / "camera.log", "simulate", "--out", str(flight), "--live", "--loop",
                        "--video-to", f"udp://127.0.0.1:{video}?pkt_size=1316",
                        "--mavlink-to", f"127.0.0.1:{telemetry}")
    )  # fmt: skip
    with slowed(process.pid, share):
        return list(_looks(process, f"http://127.0.0.1:{at_status}/status", folder, watched_s))


def _looks(
    process: subprocess.Popen[bytes], url: str, folder: Path, watched_s: float
) -> Iterator[Look]:
    """OutsideError when the daemon ends, or no scan begins."""
    due_s, began_s = time.monotonic() + START_S, 0.0
    while not began_s or time.monotonic() < began_s + watched_s:
        if process.poll() is not None or (not began_s and time.monotonic() > due_s):
            lines = (folder / "run.log").read_text(errors="replace").strip().splitlines() or [""]
            raise OutsideError(f"bench slow: no scan; code {process.poll()}: {lines[-1]}")
        status: dict[str, Any] = {}
        with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=10) as answer:
            status = json.load(answer)
        load = status.get("load", {})
        if status.get("frames") and "frame_age_s" in load:
            began_s = began_s or time.monotonic()
            yield Look(
                time.monotonic() - began_s, load["level"], load["name"], load["frame_age_s"],
                status["frames"], load["frames_late"], status["clouds"], load["views_late"],
            )  # fmt: skip
        time.sleep(LOOK_S)


@contextmanager
def slowed(pid: int, share: float) -> Iterator[None]:
    """The process runs only for this share of each :data:`PERIOD_S`."""
    ended = threading.Event()

    def hold() -> None:
        with contextlib.suppress(ProcessLookupError):
            while not ended.wait(share * PERIOD_S):
                os.kill(pid, signal.SIGSTOP)
                time.sleep((1.0 - share) * PERIOD_S)
                os.kill(pid, signal.SIGCONT)

    thread = threading.Thread(target=hold, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
