"""The ``skyrelief`` command: a table of subcommands, each loaded when it is called."""

from __future__ import annotations

import logging
import sys
from importlib import import_module

import click
import typer
import typer.core

from service.errors import SkyreliefError

COMMANDS: dict[str, tuple[str, str]] = {
    "replay": ("service.commands.replay:replay", "Recorded video through the onboard path."),
    "run": ("service.commands.run:run", "The daemon."),
    "ground": ("service.commands.ground:ground", "Receive scans from drones."),
    "simulate": ("service.commands.simulate:simulate", "A synthetic flight with exact truth."),
    "score": ("service.commands.score:score", "Compare a scan folder with the truth."),
    "calibrate": ("service.commands.calibrate:calibrate", "Camera model from a chessboard."),
    "stereo": ("service.commands.stereo:stereo", "The stereo stage alone."),
    "config": ("service.commands.config:config", "Check, show or print the configuration."),
    "bench": ("service.commands.bench:bench", "Benchmarks, each against a peer."),
}
"""Name to (``module:function``, one line of help). The next command is one file, one line."""


class LazyCommands(typer.core.TyperGroup):
    """A command group that imports a subcommand's module only when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        target, text = COMMANDS[cmd_name]
        module, _, function = target.partition(":")
        single = typer.Typer(add_completion=False)
        single.command(cmd_name, help=None)(getattr(import_module(module), function))
        command = typer.main.get_command(single)
        command.short_help = text
        return command


app = typer.Typer(cls=LazyCommands, no_args_is_help=True, add_completion=False)


@app.callback()
def _root(
    verbose: bool = typer.Option(False, "--verbose", "-v", help="Log what every stage does."),
) -> None:
    """Terrain and buildings in 3D, in real time, from the camera of a drone."""
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )


def main() -> None:
    """Run the command line; exit codes: 0 done, 2 usage or input, 3 outside world, 1 ours."""
    try:
        app(standalone_mode=True)
    except SkyreliefError as error:
        print(f"skyrelief: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
