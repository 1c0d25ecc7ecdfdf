"""``skyrelief keys``: the certificates of a fleet."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def keys(
    folder: Annotated[Path, typer.Argument(help="where the fleet's keys are kept")],
    drone: Annotated[list[str] | None, typer.Option(help="a drone's name; may be repeated")] = None,
    ground: Annotated[
        list[str] | None, typer.Option(help="a ground station's name; may be repeated")
    ] = None,
    viewer: Annotated[
        list[str] | None, typer.Option(help="one who may only look; may be repeated")
    ] = None,
    revoke: Annotated[
        str | None, typer.Option(help="a member whose certificate must not be valid any more")
    ] = None,
    days: Annotated[int, typer.Option(help="how long the certificates hold", min=1)] = 365,
    as_json: Annotated[bool, typer.Option("--json", help="end with one JSON object")] = False,
) -> None:
    """Make keys for drones, ground stations and viewers; those that exist stay as they are.

    Copy FOLDER/drone/NAME to the drone and FOLDER/ground/NAME to the ground station. Keep
    FOLDER/authority to yourself: whoever has it can join the fleet. --revoke NAME takes the
    rights of a drone or viewer; for a ground station all others get new keys.
    """
    from service.errors import InputError
    from service.stream import keys as fleet_keys

    members = {"drone": drone or [], "ground": ground or [], "viewer": viewer or []}
    if revoke is not None:
        if any(members.values()):
            raise InputError("give either --revoke or members to make keys for")
        _say_revoked(revoke, fleet_keys.revoke(folder, revoke, days), as_json)
        return
    if not any(members.values()):
        raise InputError("name at least one --drone, --ground or --viewer")
    made = fleet_keys.make_keys(folder, members, days)
    if as_json:
        print(json.dumps({"made": [str(path) for path in made]}))
        return
    for path in made:
        print(f"made {path}")
    if not made:
        print("all of them have keys already")


def _say_revoked(member: str, paths: list[Path], as_json: bool) -> None:
    """Say what must be copied again before the revocation holds."""
    if as_json:
        print(json.dumps({"revoked": member, "copy": [str(path) for path in paths]}))
        return
    print(f"revoked {member}; it holds when these are copied and every ground station restarts:")
    for path in paths:
        print(f"  {path}")
