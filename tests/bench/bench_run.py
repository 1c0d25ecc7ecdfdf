"""``make bench ARGS="NAME ..."``: the benchmarks of development, and those of the command.

make bench ARGS="real --data ../shared/data"
make bench ARGS="screen --scan SCAN --flight FLIGHT --keep FOLDER"
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from bench_options import DataOptions

from service.bench import BENCHMARKS, keep, record, run_benchmarks, table
from service.commands import showing
from service.errors import InputError, OutsideError

DEVELOPMENT = {
    "codecs": "bench_codecs:run",
    "device": "bench_device:run",
    "graph": "bench_graph:run",
    "growth": "bench_growth:run",
    "latency": "bench_latency:run",
    "map": "bench_map:run",
    "mavlink": "bench_mavlink:run",
    "memory": "bench_memory:run",
    "portal": "bench_portal:run",
    "radio": "bench_radio:run",
    "middlebury": "bench_middlebury:run",
    "scenes": "bench_scenes:run",
    "real": "bench_real:run",
    "screen": "bench_screen:run",
    "site": "bench_site:run",
    "slow": "bench_slow_board:run",
    "truth": "bench_truth:run",
}
"""Name to ``module:function`` of this folder."""

ASKED_FOR = ("board", "device", "growth", "middlebury", "real", "screen", "site", "slow")
"""Those that need a GPU, data or many minutes, and run by name only."""


def main(
    names: Annotated[list[str] | None, typer.Argument(help="benchmarks; default: most")] = None,
    rounds: Annotated[int, typer.Option(help="timed rounds of each figure", min=1)] = 30,
    backend: Annotated[str, typer.Option(help="auto, cpu, torch or onnx")] = "cpu",
    data: Annotated[Path | None, typer.Option(help="folder of the real sets")] = None,
    scans: Annotated[int, typer.Option(min=0, help="site: tiles of a site of so many scans")] = 0,
    scan: Annotated[Path | None, typer.Option(help="screen: folder of a scan")] = None,
    flight: Annotated[Path | None, typer.Option(help="screen: its recording or stills")] = None,
    frames: Annotated[int, typer.Option(min=1, help="screen: frames drawn at most")] = 8,
    kept: Annotated[
        Path | None, typer.Option("--keep", help="folder for result (JSON) and previews")
    ] = None,
) -> None:
    """Print our figure, the peer's in the same run, and the ratio."""
    known = BENCHMARKS | DEVELOPMENT
    chosen = names or [name for name in known if name not in ASKED_FOR]
    try:
        with showing("bench") as progress:
            options = DataOptions(
                rounds, 3, backend, scans, data, kept, scan, flight, frames, say=progress
            )
            results = run_benchmarks(chosen, options, known)
        print(table(results))
        if kept is not None:
            print(f"kept in {keep(kept, chosen, record(results, options))}")
    except (InputError, OutsideError) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    typer.run(main)
