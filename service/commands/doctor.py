"""``skyrelief doctor``: camera, MAVLink, clock, compute, disk and packages at one glance."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from service.config import load_config
from service.errors import OutsideError

INSTALLED = Path("/etc/skyrelief/skyrelief.toml")


def doctor(
    config: Annotated[
        Path | None, typer.Option(help=f"configuration file; else {INSTALLED} if it is there")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value, may be repeated")
    ] = None,
    listen_s: Annotated[float, typer.Option(help="seconds to listen on the MAVLink links")] = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
) -> None:
    """Say what works, what does not, and what to do. Exit code 3 when something is bad."""
    from service.daemon.diagnosis import BAD, examine

    chosen = config or (INSTALLED if INSTALLED.is_file() else None)
    findings = []
    for finding in examine(load_config(chosen, set_ or []), listen_s):
        findings.append(finding)
        if not as_json:
            print(f"{finding.verdict}  {finding.what:<13}{finding.text}", flush=True)
    bad = [finding.what for finding in findings if finding.verdict == BAD]
    if as_json:
        print(json.dumps({"ok": not bad, "findings": [asdict(f) for f in findings]}))
    if bad:
        raise OutsideError(f"not ready to fly: {', '.join(dict.fromkeys(bad))}")
