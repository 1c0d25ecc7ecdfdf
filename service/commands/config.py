"""``skyrelief config check|show|default``: what is configured, and what can be."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from service.config import keys, load_config
from service.errors import InputError
from service.redaction import HIDDEN, public_configuration

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
    """A configuration's sections as TOML; a key that is not set stands as a comment."""
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
