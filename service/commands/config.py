"""``skyrelief config check|show|default``: what is configured, and what can be."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from service.config import Config, keys, load_config
from service.errors import InputError

ACTIONS = ("check", "show", "default")


def config(
    action: Annotated[str, typer.Argument(help="check, show or default")],
    file: Annotated[Path | None, typer.Argument(help="configuration file (TOML)")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value, may be repeated")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
) -> None:
    """Check a configuration file, show what is in force, or print the documented default.

    ``default FILE`` prints the documented default with what FILE sets, such as a board's profile.
    """
    if action not in ACTIONS:
        raise InputError(f"config {action}: there are {', '.join(ACTIONS)}")
    if action == "check" and file is None:
        raise InputError("config check: name the file to check")
    chosen = load_config(file, set_ or [])
    if as_json:
        print(json.dumps(chosen.to_dict()))
    elif action == "check":
        print(f"{file}: good")
    else:
        print(to_toml(chosen, documented=action == "default"), end="")


def to_toml(chosen: Config, documented: bool = False) -> str:
    """``chosen`` as TOML; a key that is not set stands as a comment."""
    values = chosen.to_dict()
    lines: list[str] = []
    last = ""
    for section, field in keys():
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
            lines.append(f"{field.name} = {_toml_value(value)}")
    return "\n".join(lines) + "\n"


def _toml_value(value: Any) -> str:
    """``value`` in TOML: its strings, numbers, booleans and arrays of them match JSON's."""
    return json.dumps(value, ensure_ascii=False)
