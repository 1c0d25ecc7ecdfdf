"""``skyrelief run``: the daemon."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated

import typer


def run(
    config: Annotated[Path | None, typer.Option(help="configuration file (TOML)")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value, may be repeated")
    ] = None,
) -> None:
    """Wait for the operator's commands and scan; ends on Ctrl-C or a TERM signal."""
    from service.config import load_config
    from service.runtime import Daemon

    daemon = Daemon(load_config(config, set_ or []))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: daemon.quit())
    daemon.run()
