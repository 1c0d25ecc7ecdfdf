"""The subcommands, and the options that several of them take."""

import signal
from pathlib import Path
from threading import Event
from typing import Annotated

import typer

Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="section.key=value, may be repeated")
]
ConfigFile = Annotated[Path | None, typer.Option(help="configuration file (TOML)")]
ScanDir = Annotated[Path, typer.Argument(help="scan folder (holds scan.db)")]
Voxel = Annotated[
    float | None, typer.Option("--voxel-m", help="fused voxel size; default: pixel on ground")
]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON object at the end")]


def stop_by_signals() -> Event:
    """An event that Ctrl-C or a TERM signal sets, instead of ending the process."""
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
