"""Memory and time of the onboard path over a long flight."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from recon.backends.cpu import CpuBackend
from service.bench import BenchOptions, BenchResult
from service.bench.pipeline import FPS, fly, make_video, resident_mib
from service.flight.scan import Scan


def run(options: BenchOptions) -> list[BenchResult]:
    """Resident memory and milliseconds a frame at the end, against the first tenth."""
    frames = max(200, int(options.rounds / 3.0 * FPS) * 10)
    with tempfile.TemporaryDirectory() as folder:
        short, video = Path(folder) / "short.mp4", Path(folder) / "flight.mp4"
        make_video(short, 120)
        backend = CpuBackend()
        fly(short, Path(folder) / "warm", [], backend)  # what compilers need is not the flight's
        make_video(video, frames)
        watch = _Watch()
        summary, _ = fly(video, Path(folder) / "scan", [], backend, watch)
    note = f"{summary['frames']} frames, {summary['keyframes']} keyframes"
    early, late = watch.tenth(0), watch.tenth(9)
    return [
        BenchResult(
            "resident at the end of the flight", late[0], "MiB",
            peer="after a tenth of it", peer_value=early[0], note=note,
        ),
        BenchResult(
            "a frame in the last tenth", late[1], "ms",
            peer="in the second tenth", peer_value=watch.tenth(1)[1],
        ),
    ]  # fmt: skip


class _Watch:
    """Resident memory and time after every frame."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []  # s, MiB

    def __call__(self, scan: Scan) -> None:
        self._seen.append((time.perf_counter(), resident_mib()))

    def tenth(self, index: int) -> tuple[float, float]:
        """Memory in MiB at the end of a tenth of the flight, and its ms a frame."""
        first, last = (int(n * len(self._seen) / 10) for n in (index, index + 1))
        part = self._seen[first:last]
        return part[-1][1], 1e3 * (part[-1][0] - part[0][0]) / (len(part) - 1)
