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
    days: Annotated[int, typer.Option(help="how long the certificates hold", min=1)] = 365,
    as_json: Annotated[bool, typer.Option("--json", help="end with one JSON object")] = False,
) -> None:
    """Make keys for drones, ground stations and viewers; those that exist stay as they are.

    Copy FOLDER/drone/NAME to the drone and FOLDER/ground/NAME to the ground station. Keep
    FOLDER/authority to yourself: whoever has it can join the fleet.
    """
    from service.errors import InputError
    from service.stream.keys import make_keys

    members = {"drone": drone or [], "ground": ground or [], "viewer": viewer or []}
    if not any(members.values()):
        raise InputError("name at least one --drone, --ground or --viewer")
    made = make_keys(folder, members, days)
    if as_json:
        print(json.dumps({"made": [str(path) for path in made]}))
        return
    for path in made:
        print(f"made {path}")
    if not made:
        print("all of them have keys already")
