"""Options of the benchmarks that serve development."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from service.bench import BenchOptions


@dataclass(frozen=True, slots=True)
class DataOptions(BenchOptions):
    """Options of a run, and the data that some benchmarks need."""

    scans: int = 0  # of the benchmark site: that many instead of two
    data: Path | None = None  # folder with real sets
    previews: Path | None = None  # folder for the previews of real flights, and for images
    scan: Path | None = None  # folder of the scan that ``screen`` shows
    flight: Path | None = None  # its recording, or the folder of its stills
    frames: int = 8  # of these that ``screen`` draws, at most
