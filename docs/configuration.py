"""Write docs/configuration.md from the dataclasses of service/config.py.

python docs/configuration.py
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from service.config import Config

PAGE = Path(__file__).resolve().parent / "configuration.md"
UNITS = {
    "_kbit_s": "kbit/s",
    "_deg": "degrees",
    "_ms": "ms",
    "_mib": "MiB",
    "_m": "m",
    "_s": "s",
    "_c": "°C",
    "_width": "px",
    "_baud": "bit/s",
}
"""End of a key's name to its unit."""
HEAD = """# Configuration

Every key of the configuration file (TOML), in its section. `--set section.key=value` sets one on
the command line, `skyrelief config default` prints all as a file, `skyrelief config check FILE`
checks one, and `skyrelief config show` prints the settings in force. The running service takes over
a *live* key with `systemctl reload skyrelief`. `make pages` writes this page from
`service/config.py`.
"""


def page() -> str:
    """The page: a table for each section."""
    sections = get_type_hints(Config).items()
    return HEAD + "".join(line for name, kind in sections for line in section(name, kind))


def section(name: str, kind: Any) -> Iterator[str]:
    """A section's heading, what it is about, and its keys."""
    about = kind.__doc__.partition(": ")[2]
    yield f"\n## {name}\n\n{about[0].upper()}{about[1:]}\n\n"
    yield "| key | unit | default | live | what it does |\n|---|---|---|---|---|\n"
    hints = get_type_hints(kind)
    for field in fields(kind):
        unit = next((unit for end, unit in UNITS.items() if field.name.endswith(end)), "")
        default = "" if field.default is None else f"`{json.dumps(field.default)}`"
        live = "live" if field.metadata["live"] else ""
        does = "; ".join((field.metadata["doc"], *choices(hints[field.name])))
        yield f"| `{field.name}` | {unit} | {default} | {live} | {does} |\n"


def choices(hint: Any) -> Iterator[str]:
    """The words that a key takes, if they are listed."""
    parts = (hint, *get_args(hint))
    words = [word for part in parts if get_origin(part) is Literal for word in get_args(part)]
    if words:
        number = "" if get_origin(hint) is Literal else "a number, or "
        yield f"{number}one of " + ", ".join(f"`{word}`" for word in words)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
