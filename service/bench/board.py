"""A board's sheet: what this computer makes of a flight at each width, its memory, heat, power.

Each width flies in a process of its own, whose peak memory is then that of the flight. The peer is
the same path with OpenCV's SGBM. A thread reads the board's sensors meanwhile.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2

from service.bench import BenchOptions, BenchResult, in_process, stereo
from service.bench.pipeline import FPS, SIZE, SgbmBackend, fly, make_video
from service.cameras import open_camera
from service.compute.backend_choice import choose_backend
from service.daemon.machine import Machine, read_machine

WIDTHS = (320, 640, 1280)
EVERY_S = 1.0


def run(options: BenchOptions, widths: Sequence[int] = WIDTHS) -> list[BenchResult]:
    """Stereo, decoding, the whole path at three widths, and the sensors that the board has."""
    flight_s = max(2, round(options.rounds / 3.0))
    results = stereo.run(options)
    with tempfile.TemporaryDirectory() as folder, watched(Path(folder)) as readings:
        options.say("board: decoding")
        video = Path(folder) / "flight.mp4"
        make_video(video, flight_s * FPS)
        results.append(_decoding(video))
        for width in widths:
            options.say(f"board: a flight, stereo {width} wide")
            results += _whole_path(video, width, options.backend, flight_s)
    return results + sheet(readings)


def _decoding(video: Path) -> BenchResult:
    """Images a second from the source that a scan reads, next to OpenCV's reader."""
    source, reader = open_camera(str(video)), cv2.VideoCapture(str(video))
    ours = _rate_hz(source)
    theirs = _rate_hz(iter(lambda: reader.read()[0] or None, None))
    source.close()
    reader.release()
    what = f"decode {SIZE[0]}x{SIZE[1]}"
    return BenchResult(what, ours, "images/s", peer="OpenCV", peer_value=theirs)


def _rate_hz(images: Iterable[object]) -> float:
    start = time.perf_counter()
    return sum(1 for _ in images) / (time.perf_counter() - start)


def _whole_path(video: Path, width: int, backend: str, flight_s: int) -> list[BenchResult]:
    """Times real time and peak memory, with this backend and with SGBM."""
    (ours_s, keyframes, ours_mib), (theirs_s, _, theirs_mib) = (
        in_process(_flown, video, width, name) for name in (backend, SgbmBackend.name)
    )
    peer = "with OpenCV SGBM"
    note = f"{keyframes} keyframes of {SIZE[0]}x{SIZE[1]} at {FPS} images/s"
    words, memory = f"whole path, stereo {width} wide", f"its memory, {width} wide"
    return [
        BenchResult(
            words, flight_s / ours_s, "times real time",
            peer=peer, peer_value=flight_s / theirs_s, note=note,
        ),
        BenchResult(memory, ours_mib, "MiB", peer=peer, peer_value=theirs_mib),
    ]  # fmt: skip


def _flown(video: Path, width: int, backend: str) -> tuple[float, int, float]:
    """Seconds, keyframes and the process's peak MiB of its second flight: the first loads or
    compiles kernels."""
    chosen = SgbmBackend() if backend == SgbmBackend.name else choose_backend(backend)
    flags = [f"compute.stereo_width={width}", f"compute.guide_width={max(width, 640)}"]
    with tempfile.TemporaryDirectory() as folder:
        for name in ("warm", "timed"):
            summary, elapsed_s = fly(video, Path(folder) / name, flags, chosen)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    in_kib = sys.platform != "darwin"
    return elapsed_s, summary["keyframes"], peak / (2**10 if in_kib else 2**20)


@contextmanager
def watched(disk: Path) -> Iterator[list[Machine]]:
    """The board's readings while the block runs, one more each second."""
    readings: list[Machine] = []
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(EVERY_S):
            readings.append(read_machine(disk))

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield readings
    finally:
        ended.set()
        thread.join()


def sheet(readings: list[Machine]) -> list[BenchResult]:
    """The hottest temperature, the mean power, the share of the time throttled: what is stated."""
    model = readings[-1].model if readings else ""
    heat = [r.temperature_c for r in readings if r.temperature_c is not None]
    power = [r.power_w for r in readings if r.power_w is not None]
    throttled = [r.throttled for r in readings if r.throttled is not None]
    found = []
    if heat:
        found.append(BenchResult("hottest sensor", max(heat), "°C", note=model))
    if power:
        found.append(BenchResult("power, mean", sum(power) / len(power), "W", note=model))
    if throttled:
        share = 100.0 * sum(throttled) / len(throttled)
        found.append(BenchResult("throttled", share, "% of the time", note=model))
    return found
