"""``skyrelief bench [NAME ...]``: benchmarks, each against a peer in the same run."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from service.commands import AsJson, BackendName, showing
from service.progress import Progress


def bench(
    names: Annotated[list[str] | None, typer.Argument(help="benchmarks; default: all")] = None,
    rounds: Annotated[int, typer.Option(help="timed rounds of each figure", min=1)] = 30,
    backend: Annotated[str, BackendName] = "cpu",
    keep: Annotated[
        Path | None, typer.Option(help="folder for JSON; compares with the last")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print our figure, the peer's in the same run, and the ratio."""
    from service import bench as benchmarks

    chosen = names or list(benchmarks.BENCHMARKS)
    before = benchmarks.last_kept(keep, chosen) if keep is not None else {}
    with nullcontext(Progress()) if as_json else showing("bench") as progress:
        options = benchmarks.BenchOptions(rounds=rounds, backend=backend, say=progress)
        results = benchmarks.run_benchmarks(chosen, options)
    print(benchmarks.table(results, before))
    report = benchmarks.record(results, options)
    if keep is not None:
        print(f"kept in {benchmarks.keep(keep, chosen, report)}")
    if as_json:
        print(json.dumps(report))
