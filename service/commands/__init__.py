"""The subcommands, and the options that several of them take."""

from pathlib import Path
from typing import Annotated

import typer

Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="section.key=value, may be repeated")
]
ConfigFile = Annotated[Path | None, typer.Option(help="configuration file (TOML)")]
