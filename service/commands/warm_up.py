"""``skyrelief warm-up``: compile everything before the first flight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from service.config import load_config


def warm_up(
    config: Annotated[Path | None, typer.Option(help="configuration file (TOML)")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value, may be repeated")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
) -> None:
    """Scan a made-up ground once, so that no flight waits for the compilers.

    Run it as the service's user with its NUMBA_CACHE_DIR; the installer does.
    """
    from service.daemon.warm_up import warm_up as scan_made_up_ground

    seconds, keyframes = scan_made_up_ground(load_config(config, set_ or []))
    if as_json:
        print(json.dumps({"seconds": round(seconds, 2), "keyframes": keyframes}))
    else:
        print(f"warm after {seconds:.1f} s: {keyframes} keyframes of a made-up ground")
