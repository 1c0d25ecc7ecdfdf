"""The ``skyrelief`` command: a table of subcommands, each loaded when it is called."""

from __future__ import annotations

import atexit
import difflib
import gc
import json
import logging
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType, TracebackType
from typing import Any, NoReturn

import typer
import typer.core
import typer.main

from service.errors import InputError, OutsideError, SkyreliefError
from service.init_system import log_handler
from service.memory import loading
from service.packages import needing
from service.progress import CancelledError
from service.redaction import without_credentials
from service.version import software

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("service.commands.demo:demo", "Run a recorded flight through both ends."),
    "replay": ("service.commands.replay:replay", "Reconstruct a recorded video."),
    "run": ("service.commands.run:run", "Run the onboard service."),
    "keys": ("service.commands.setup:keys", "Make certificates for a fleet's datalink."),
    "ctl": ("service.commands.ctl:ctl", "Start, stop, watch and control a scan by MAVLink."),
    "ground": ("service.commands.ground:ground", "Receive scans from drones."),
    "simulate": ("service.commands.simulate:simulate", "Render a flight with exact ground truth."),
    "score": ("service.commands.simulate:score", "Compare a scan folder with the ground truth."),
    "export": ("service.commands.deliverables:export", "Export deliverables of a scan folder."),
    "mesh": ("service.commands.deliverables:mesh", "Make a textured mesh of a scan folder."),
    "refine": ("service.commands.refine:refine", "Adjust a finished scan as a whole."),
    "refly": ("service.commands.refine:refly", "Plan a mission over poorly covered areas."),
    "site": (
        "service.commands.deliverables:site",
        "Join scans into one site; measure what changed.",
    ),
    "inspect": (
        "service.commands.deliverables:inspect",
        "Draw every stage of a keyframe as one image.",
    ),
    "calibrate": ("service.commands.calibrate:calibrate", "Calibrate a camera with a chessboard."),
    "stereo": ("service.commands.stereo:stereo", "Run the stereo stage on an image pair."),
    "export-model": ("service.commands.stereo:export_model", "Export the dense stage as ONNX."),
    "config": ("service.commands.setup:config", "Check, show or print the configuration."),
    "doctor": ("service.commands.setup:doctor", "Check what works on this machine."),
    "warm-up": ("service.commands.setup:warm_up", "Compile kernels before the first flight."),
    "bench": ("service.commands.bench:bench", "Run benchmarks, each against a peer."),
}
"""Name to (``module:function``, one line of help). A new command is a function and a line."""


NUMBA_SETTINGS = ".numba_config.yaml"
"""Numba reads it from the current folder: where compiled code lies, which it then runs."""

SERVICES = ("run", "ground")
"""These log what they do; the other commands log warnings only, unless --verbose."""


class LazyCommands(typer.core.TyperGroup):
    """A command group that imports a subcommand's module only when it is called. Contexts and
    commands are ``Any``: some typer releases bring their own copy of click."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command's help line, without importing its module; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        return typer.core.TyperCommand(cmd_name, help=COMMANDS[cmd_name][1])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """(name, command, its arguments) of a command line."""
        wanted = args[0] if args else ""
        if wanted not in COMMANDS and wanted[:1] != "-" and not ctx.resilient_parsing:
            near = difflib.get_close_matches(wanted, COMMANDS, 3)
            hint = f"did you mean {' or '.join(near)}?" if near else "see skyrelief --help"
            raise InputError(f"no command {wanted!r}; {hint}")
        name, _, rest = super().resolve_command(ctx, args)
        return name, load_command(str(name)), rest

    def invoke(self, ctx: Any) -> Any:
        """Run the subcommand; Ctrl-C ends it in one line, and JSON has errors of usage too."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            _end(CancelledByUser("cancelled"))
        except Exception as error:
            cause: BaseException | None = error
            while isinstance(cause, SystemError | ImportError):  # of a signal in compiled code
                cause = cause.__cause__
            if isinstance(cause, KeyboardInterrupt | CancelledError):
                _end(CancelledByUser("cancelled"))
            if isinstance(cause, SystemExit):
                raise cause from None
            if hasattr(error, "format_message"):  # wrong usage; the terminal's line is typer's
                _as_json(str(error.format_message()), InputError.exit_code)
            raise


def load_command(name: str) -> Any:
    """The command called ``name`` in the table, imported."""
    module, _, function = COMMANDS[name][0].partition(":")
    single = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    with loading():
        command = getattr(import_module(module), function)
    single.command(name)(command)
    return typer.main.get_command(single)


app = typer.Typer(cls=LazyCommands, no_args_is_help=True, pretty_exceptions_enable=False)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(software())
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
    verbose: bool = typer.Option(False, "--verbose", "-v", help="Log details of every stage."),
) -> None:
    """Terrain and buildings in 3D, in real time, from the camera of a drone."""
    quiet = logging.INFO if context.invoked_subcommand in SERVICES else logging.WARNING
    logging.basicConfig(level=logging.DEBUG if verbose else quiet, handlers=[log_handler()])
    if not (verbose or sys.warnoptions):
        # Pillow and OpenCV print a line for each odd tag of each image; we report what is not read.
        warnings.simplefilter("ignore")
        os.environ.setdefault("OPENCV_LOG_LEVEL", "FATAL")


def _end_by_signals() -> None:
    """Let a signal that would kill the process unwind it, so that it removes temporary files.
    Commands that stop in order replace this; ``nohup`` stays in force."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, lambda number, _: sys.exit(128 + number))


def main() -> None:
    """Run the command line; exit codes: 0 done, 2 usage or input, 3 environment, 1 internal."""
    _end_by_signals()
    atexit.register(gc.freeze)  # to look for garbage in all that is left takes 0.3 s after a flight
    # Our matrices are small: OpenBLAS's threads would spin, on all cores, and compute nothing.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    threading.excepthook = lambda hook: _print_fault(
        hook.exc_type, hook.exc_value or hook.exc_type(), hook.exc_traceback
    )
    try:
        if os.path.lexists(NUMBA_SETTINGS):
            raise InputError(
                f"{NUMBA_SETTINGS} in this folder could run foreign code; use another folder"
            )
        with needing("this command"):
            app(standalone_mode=True, prog_name="skyrelief")
    except SkyreliefError as error:
        _end(error)
    except OSError as error:
        if error.filename is None:
            raise
        place = str(error.filename)[:200]
        _end(OutsideError(f"{place}: {error.strerror}; check the path and its rights"))
    except Exception as error:
        _as_json(f"{type(error).__name__}: {error}", SkyreliefError.exit_code)
        raise
    finally:
        sys.excepthook = _print_fault  # replaces typer's


class CancelledByUser(SkyreliefError):
    exit_code = 128 + signal.SIGINT


def _end(error: SkyreliefError) -> NoReturn:
    print(f"skyrelief: {error}", file=sys.stderr)
    _as_json(str(error), error.exit_code, error.report)
    sys.exit(error.exit_code)


def _as_json(error: str, exit_code: int, report: Mapping[str, Any] = MappingProxyType({})) -> None:
    """The last line of standard output where ``--json`` is given."""
    if "--json" in sys.argv[1:]:
        print(json.dumps({**report, "error": without_credentials(error), "exit_code": exit_code}))


def _print_fault(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Print the traceback of an internal fault, with credentials hidden."""
    text = "".join(traceback.format_exception(kind, error, trace))
    print(without_credentials(text), end="", file=sys.stderr)


if __name__ == "__main__":
    main()
