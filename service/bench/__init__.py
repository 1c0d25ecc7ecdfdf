"""Benchmarks that run on the board: each figure next to a peer's from the same run.

A benchmark is a module with ``run(options) -> list[BenchResult]`` and one line in the table.
Ours and the peer's rounds alternate, after a warm-up, so that a busy machine slows both.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import psutil  # type: ignore[import-untyped]

from service.errors import InputError, OutsideError
from service.scans.writing import write_whole

T = TypeVar("T")

BENCHMARKS: dict[str, str] = {
    "board": "service.bench.board:run",
    "stereo": "service.bench.stereo:run",
    "upsample": "service.bench.stereo:run_upsampling",
    "gpu": "service.bench.gpu:run",
    "matching": "service.bench.tracking:run",
    "pose": "service.bench.tracking:run_pose",
    "icp": "service.bench.mapping:run",
    "pipeline": "service.bench.pipeline:run",
    "codec": "service.bench.codec:run",
    "link": "service.bench.link:run",
}
"""Name to ``module:function``; imported when it runs."""


@dataclass(frozen=True, slots=True)
class BenchOptions:
    rounds: int = 30
    warm_up: int = 3
    backend: str = "cpu"
    say: Callable[[str], None] = field(default=lambda _: None, kw_only=True)  # what is measured


@dataclass(frozen=True, slots=True)
class BenchResult:
    """One figure, and the peer's in the same run; less is better unless the unit is per second."""

    what: str
    value: float
    unit: str
    spread: float = 0.0  # 10th to 90th percentile of the rounds
    peer: str = ""
    peer_value: float | None = None
    peer_spread: float = 0.0
    note: str = ""
    name: str = ""  # empty: that of the benchmark in the table

    @property
    def ratio(self) -> float | None:
        """Ours over the peer's; None without a peer."""
        return self.value / self.peer_value if self.peer_value else None

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"ratio": self.ratio}


def compare(
    what: str,
    ours: Callable[[], object],
    options: BenchOptions,
    peer: str = "",
    theirs: Callable[[], object] | None = None,
    note: str = "",
    clock: Callable[[], float] = time.perf_counter,
) -> BenchResult:
    """Median milliseconds of ``ours`` and ``theirs`` by a clock in seconds, rounds alternating."""
    runs = [ours] if theirs is None else [ours, theirs]
    taken_ms = np.empty((options.warm_up + options.rounds, len(runs)))
    for row in taken_ms:
        for k, run in enumerate(runs):
            start = clock()
            run()
            row[k] = 1e3 * (clock() - start)
    low, median, high = np.percentile(taken_ms[options.warm_up :], (10, 50, 90), axis=0).tolist()
    spread = [b - a for a, b in zip(low, high, strict=True)]
    result = BenchResult(what, median[0], "ms", spread[0], note=note)
    if theirs is None:
        return result
    return replace(result, peer=peer, peer_value=median[1], peer_spread=spread[1])


def run_benchmarks(
    names: Sequence[str], options: BenchOptions, known: Mapping[str, str] = BENCHMARKS
) -> list[BenchResult]:
    """Every figure of the named benchmarks, in order; InputError for a name that is not known."""
    for name in names:
        if name not in known:
            raise InputError(f"bench {name}: there are {', '.join(known)}")
    results: list[BenchResult] = []
    for name in names:
        options.say(name)
        module, _, function = known[name].partition(":")
        found = getattr(import_module(module), function)(options)
        results += [replace(result, name=result.name or name) for result in found]
    return results


def table(results: list[BenchResult], before: Mapping[tuple[str, str], float] | None = None) -> str:
    """The results as aligned text, one line a figure; ``before`` has earlier ones by its names."""
    rows = [["benchmark", "figure", "ours", "spread", "peer", "theirs", "ratio", "before", "note"]]
    for r in results:
        earlier = (before or {}).get((r.name, r.what))
        rows.append([
            r.name, r.what, f"{r.value:.3g} {r.unit}", f"{r.spread:.2g}" if r.spread else "",
            r.peer, "" if r.peer_value is None else f"{r.peer_value:.3g} {r.unit}",
            "" if r.ratio is None else f"{r.ratio:.2f}",
            "" if earlier is None else f"{earlier:.3g}", r.note,
        ])  # fmt: skip
    if not before:
        rows = [[*row[:-2], row[-1]] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def record(results: list[BenchResult], options: BenchOptions) -> dict[str, Any]:
    """Contents of a kept result file: figures, commit, date and the machine in general words."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": commit(),
        "machine": machine(),
        "rounds": options.rounds,
        "results": [result.to_dict() for result in results],
    }


def keep(folder: Path, names: Sequence[str], report: dict[str, Any]) -> Path:
    """Write the result file; its name has the benchmarks, the date and the commit."""
    day = str(report["date"])[:10]
    path = folder / f"{day}-{str(report['commit']).rstrip('+')}-{'-'.join(names)}.json"
    write_whole(path, json.dumps(report, indent=2) + "\n")
    return path


def in_process(work: Callable[..., T], *given: object) -> T:
    """What ``work`` returns in a fresh interpreter, whose peak memory is not that of work before.
    Raises OutsideError when that process is killed, as one that lacks memory is."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(work, *given).result()
        except BrokenProcessPool as error:
            raise OutsideError(
                "bench: a process was killed; is there too little memory?"
            ) from error


def last_kept(folder: Path, names: Sequence[str]) -> dict[tuple[str, str], float]:
    """(benchmark, figure) to its value in the newest result file of these benchmarks there."""
    files = sorted(folder.glob(f"*-{'-'.join(names)}.json"), key=lambda path: path.stat().st_mtime)
    if not files:
        return {}
    try:
        kept = json.loads(files[-1].read_bytes())["results"]
        return {(r["name"], r["what"]): float(r["value"]) for r in kept}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{files[-1]}: no results of a benchmark: {error}") from error


def commit() -> str:
    """The commit of the source that runs, with ``+`` when it was changed since; or ``unknown``."""
    command = ("git", "describe", "--always", "--abbrev=10", "--exclude=*", "--dirty=+")
    folder = Path(__file__).parent
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    except OSError:
        return "unknown"
    return done.stdout.strip() or "unknown"


def machine() -> str:
    """Architecture, cores and memory; nothing that names the machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    processor = platform.machine() or "unknown processor"
    memory = f"{psutil.virtual_memory().total / 2**30:.0f} GiB"
    return f"{processor}, {cores} cores, {memory}, Python {platform.python_version()}"
