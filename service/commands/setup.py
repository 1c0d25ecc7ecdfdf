"""``skyrelief config``, ``doctor``, ``keys`` and ``warm-up``: what is done before a flight."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from service.commands import (
    AsJson,
    ConfigFile,
    Overrides,
    check_names,
    choices,
    one_of,
    showing,
)
from service.config import keys as configuration_keys
from service.config import load_config
from service.errors import InputError, OutsideError
from service.redaction import HIDDEN, public_configuration

ACTIONS = ("check", "show", "default")


def config(
    action: Annotated[
        str, typer.Argument(help="check, show or default", autocompletion=choices(ACTIONS))
    ],
    file: Annotated[Path | None, typer.Argument(help="configuration file (TOML)")] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Check a configuration file, show what is in force, or print the documented default.

    'default FILE' prints it with the settings of FILE, such as a board's profile.
    """
    one_of(action, ACTIONS, "config")
    if action == "check" and file is None:
        raise InputError("config check: name the file to check")
    chosen = load_config(file, set_ or [])
    if action == "check":
        check_names(chosen, file)
    values = chosen.to_dict()
    if action == "show":
        values = public_configuration(values)
    if as_json:
        print(json.dumps(values))
    elif action == "check":
        print(f"{file}: good")
    else:
        if values != chosen.to_dict():
            print(f"# {HIDDEN}: a secret, which is not shown")
        print(to_toml(values, documented=action == "default"), end="")


def to_toml(values: Mapping[str, Mapping[str, Any]], documented: bool = False) -> str:
    """A configuration's sections as TOML; a key that is not set is a comment."""
    lines: list[str] = []
    last = ""
    for section, field in configuration_keys():
        if section != last:
            lines += ["", f"[{section}]"] if lines else [f"[{section}]"]
            last = section
        if documented:
            live = " (may change while running)" if field.metadata["live"] else ""
            lines.append(f"# {field.metadata['doc']}{live}")
        value = values[section][field.name]
        if value is None:
            lines.append(f"# {field.name} = (not set)")
        else:
            lines.append(f"{field.name} = {json.dumps(value, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"


INSTALLED = Path("/etc/skyrelief/skyrelief.toml")


def doctor(
    config: Annotated[
        Path | None, typer.Option(help=f"configuration file; else {INSTALLED} if it is there")
    ] = None,
    set_: Overrides = None,
    listen_s: Annotated[float, typer.Option(help="seconds to listen on the MAVLink links")] = 3.0,
    desk: Annotated[
        bool, typer.Option("--desk", help="only what replay, exports and the ground station need")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Report what works, what does not, and the remedy. Exit code 3 when something is bad."""
    from service.commands.diagnosis import BAD, examine

    chosen = config or (INSTALLED if INSTALLED.is_file() else None)
    findings = []
    for finding in examine(load_config(chosen, set_ or []), None if desk else listen_s):
        findings.append(finding)
        if not as_json:
            print(f"{finding.verdict.value:<4}  {finding.what:<13}{finding.text}", flush=True)
    bad = [finding.what for finding in findings if finding.verdict is BAD]
    report = {"ok": not bad, "findings": [asdict(f) for f in findings]}
    if bad:
        ready = "for the desk" if desk else "to fly"
        raise OutsideError(f"not ready {ready}: {', '.join(dict.fromkeys(bad))}", report)
    if as_json:
        print(json.dumps(report))


def keys(
    folder: Annotated[Path, typer.Argument(help="folder of the fleet's keys")],
    drone: Annotated[list[str] | None, typer.Option(help="a drone's name; may be repeated")] = None,
    ground: Annotated[
        list[str] | None, typer.Option(help="a ground station's name; may be repeated")
    ] = None,
    viewer: Annotated[
        list[str] | None, typer.Option(help="a read-only viewer's name; may be repeated")
    ] = None,
    revoke: Annotated[str | None, typer.Option(help="member whose certificate is revoked")] = None,
    days: Annotated[int, typer.Option(help="validity of the certificates", min=1)] = 365,
    as_json: AsJson = False,
) -> None:
    """Make keys for drones, ground stations and viewers; existing keys are kept.

    Copy FOLDER/drone/NAME to the drone and FOLDER/ground/NAME to the ground station. Keep
    FOLDER/authority private: with it anyone can join the fleet. --revoke NAME removes the rights
    of a drone or viewer; revoking a ground station makes new keys for all others.
    """
    from service.stream import keys as fleet_keys

    members = {"drone": drone or [], "ground": ground or [], "viewer": viewer or []}
    if revoke is not None:
        if any(members.values()):
            raise InputError("give either --revoke or members to make keys for")
        paths = [str(path) for path in fleet_keys.revoke(folder, revoke, days)]
        if as_json:
            print(json.dumps({"revoked": revoke, "copy": paths}))
            return
        print(f"revoked {revoke}; copy these files and restart every ground station:")
        print(*(f"  {path}" for path in paths), sep="\n")
        return
    if not any(members.values()):
        raise InputError("name at least one --drone, --ground or --viewer")
    made = [str(path) for path in fleet_keys.make_keys(folder, members, days)]
    if as_json:
        print(json.dumps({"made": made}))
    else:
        print("\n".join(f"made {path}" for path in made) or "all of them already have keys")


def warm_up(config: ConfigFile = None, set_: Overrides = None, as_json: AsJson = False) -> None:
    """Compile all kernels before the first flight, by a scan of synthetic ground.

    Run it as the service's user with its NUMBA_CACHE_DIR; the installer does. Where the packages of
    mesh, splats and maps are installed, their kernels are compiled, too.
    """
    from service.daemon.warm_up import warm_up as scan_made_up_ground
    from service.offline.exports import PACKAGES
    from service.offline.exports.view import ExportOptions, ScanView, export

    def make_products(folder: Path) -> None:
        with ScanView(folder, progress=progress) as scan:
            for kind in ("glb", "splat", "ortho"):
                if all(find_spec(package) for package in PACKAGES[kind]):
                    with progress.part(f"compiling the kernels of {kind}", of_rest=0.5):
                        export(scan, kind, None, ExportOptions())

    with showing("warm-up") as progress:
        loaded = load_config(config, set_ or [])
        seconds, keyframes = scan_made_up_ground(loaded, progress, make_products)
    if as_json:
        print(json.dumps({"seconds": round(seconds, 2), "keyframes": keyframes}))
    else:
        print(f"kernels compiled in {seconds:.1f} s ({keyframes} keyframes of synthetic ground)")
