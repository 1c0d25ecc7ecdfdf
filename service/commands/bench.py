"""``skyrelief bench [NAME ...]``: benchmarks, each against a peer in the same run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from service.commands import AsJson
from service.errors import InputError, OutsideError


def bench(
    names: Annotated[list[str] | None, typer.Argument(help="benchmarks; default: all")] = None,
    rounds: Annotated[int, typer.Option(help="timed rounds of each figure", min=1)] = 30,
    backend: Annotated[str, typer.Option(help="auto, cpu, torch or onnx")] = "cpu",
    device: Annotated[str, typer.Option(help="for 'gpu': cuda or cpu; default: auto")] = "",
    data: Annotated[Path | None, typer.Option(help="folder of sets to score on")] = None,
    scans: Annotated[int, typer.Option(min=0, help="site: tiles of a site of so many scans")] = 0,
    keep: Annotated[Path | None, typer.Option(help="folder for result (JSON) and previews")] = None,
    as_json: AsJson = False,
) -> None:
    """Print our figure, the peer's in the same run, and the ratio."""
    from service.bench import BENCHMARKS, BenchOptions, record, run_benchmarks, table

    for name in names or []:
        if name not in BENCHMARKS:
            raise InputError(f"bench {name}: there are {', '.join(BENCHMARKS)}")
    if data is not None and not data.is_dir():
        raise InputError(f"{data}: no such folder")
    if device not in ("", "cuda", "cpu"):
        raise InputError(f"--device {device}: give cuda or cpu")
    options = BenchOptions(
        rounds=rounds, backend=backend, device=device, scans=scans, data=data, keep=keep
    )
    slow = {"site"} if data is not None else {"site", "real"}
    chosen = names or [name for name in BENCHMARKS if name not in slow]
    results = run_benchmarks(chosen, options)
    print(table(results))
    report = record(results, options)
    if keep is not None:
        print(f"kept in {_keep(keep, chosen, report)}")
    if as_json:
        print(json.dumps(report))


def _keep(folder: Path, names: list[str], report: dict[str, object]) -> Path:
    """Write the result file; its name has the benchmarks, the date and the commit."""
    day = str(report["date"])[:10]
    path = folder / f"{day}-{str(report['commit']).rstrip('+')}-{'-'.join(names)}.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutsideError(f"{path}: cannot be written: {error.strerror}") from error
    return path
