"""The subcommands, and the options that several of them take."""

import _thread
import re
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import MISSING, fields
from inspect import Parameter, Signature
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer

from service.errors import InputError
from service.progress import Progress
from service.workers import PROCESS

if TYPE_CHECKING:
    from service.config import Config

QUIET_S = 2.0  # after so long without a line a reader asks whether it still works


def choices(values: Iterable[str]) -> Callable[[str], list[str]]:
    """What the shell offers for an option: those of the values that begin as typed."""
    return lambda incomplete: [value for value in values if value.startswith(incomplete)]


Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="section.key=value, may be repeated")
]
ConfigFile = Annotated[Path | None, typer.Option(help="configuration file (TOML)")]
BACKENDS = ("auto", "cpu", "torch", "onnx")
BackendName = typer.Option(help="auto, cpu, torch or onnx", autocompletion=choices(BACKENDS))
ScanDir = Annotated[Path, typer.Argument(help="scan folder (holds scan.db)")]
Voxel = Annotated[
    float | None, typer.Option("--voxel-m", help="fused voxel size; default: pixel on ground")
]
TilePoints = Annotated[
    int, typer.Option(min=1000, help="stored points above which work is cut into tiles")
]
Scheduler = Annotated[
    str | None, typer.Option(help="Dask scheduler that makes the tiles: tcp://HOST:8786")
]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON object at the end")]

Options = TypeVar("Options")


def with_options(of: type[Options]) -> Callable[[Callable[[Options], None]], Callable[..., None]]:
    """Give a command one option for each field of a dataclass, Annotated by ``typer.Option``."""
    hints = get_type_hints(of, include_extras=True)
    options = [
        Parameter(
            field.name,
            Parameter.KEYWORD_ONLY,
            default=Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(of)  # type: ignore[arg-type]
    ]

    def wrap(command: Callable[[Options], None]) -> Callable[..., None]:
        def run(**given: Any) -> None:
            command(of(**given))

        run.__name__, run.__doc__, run.__annotations__ = command.__name__, command.__doc__, hints
        run.__signature__ = Signature(options)  # type: ignore[attr-defined]
        return run

    return wrap


def record_of(kind: type[Options], given: object, **others: Any) -> Options:
    """A record of ``kind``: ``others``, and what is ``given`` under the names of its fields."""
    names = {field.name for field in fields(kind)} - others.keys()  # type: ignore[arg-type]
    same = {name: getattr(given, name) for name in names if hasattr(given, name)}
    return kind(**same, **others)


def one_of(action: str, actions: Sequence[str], command: str) -> None:
    """InputError for an action that the command does not have."""
    if action not in actions:
        raise InputError(f"{command} {action}: there are {', '.join(actions)}")


def check_names(chosen: "Config", path: Path | None) -> None:
    """Raise InputError for a link, camera or backend that no machine can open."""
    from mavlink.wire.ports import parse_link
    from service.cameras import parse_source

    where = "configuration" if path is None else path
    try:
        for link in chosen.mavlink.links:
            parse_link(link)
        if ":" in chosen.camera.source:  # a file may come later
            parse_source(chosen.camera.source)
    except (InputError, ValueError) as error:
        raise InputError(f"{where}: {error}") from error
    one_of(chosen.compute.backend, BACKENDS, f"{where}: compute.backend")


def parse_size(text: str) -> tuple[int, int]:
    """(W, H) of ``WxH``; InputError for anything else."""
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.strip())
    if found is None:
        raise InputError(f"--size {text!r}: give WIDTHxHEIGHT, such as 1280x720")
    return int(found[1]), int(found[2])


def on_signals(act: Callable[[], object], *numbers: int) -> None:
    """Call ``act`` on a thread of its own when one of the signals comes.

    A handler interrupts the main thread: a lock that this holds, such as that of an event for which
    it waits, would never be free. ``Thread.start`` takes such a lock, too.
    """
    for number in numbers:
        signal.signal(number, lambda *_: _thread.start_new_thread(act, ()))


def stop_by_signals() -> Event:
    """An event that Ctrl-C or a TERM signal sets, instead of ending the process."""
    stop = Event()
    on_signals(stop.set, signal.SIGINT, signal.SIGTERM)
    return stop


@contextmanager
def showing(name: str) -> Iterator[Progress]:
    """Progress of long work on stderr: a bar in a terminal, else a line for each step and for
    each twentieth of the work. Ctrl-C also cancels the work of other threads."""
    with ExitStack() as open_now:
        show = open_now.enter_context(_bar(name) if sys.stderr.isatty() else _lines(name))
        progress = Progress(show)

        def cancel(*_: object) -> None:
            progress.cancel()
            raise KeyboardInterrupt

        before = signal.getsignal(signal.SIGINT)
        if before is signal.default_int_handler:  # a shell's background jobs ignore it
            signal.signal(signal.SIGINT, cancel)
            open_now.callback(signal.signal, signal.SIGINT, before)
        yield progress


@contextmanager
def _lines(name: str) -> Iterator[Callable[[Progress], None]]:
    said = "", 0

    def show(now: Progress) -> None:
        nonlocal said
        step = now.text, int(now.share * 20.0)
        if step != said:
            said = step
            share = f", {5 * step[1]} %" if step[1] else ""
            say(f"{name}: {now.text}{share}")

    with speaking() as say:
        yield show


@contextmanager
def speaking(quiet_s: float = QUIET_S) -> Iterator[Callable[[str], None]]:
    """Prints lines to stderr; after ``quiet_s`` without one the last again, with its seconds."""
    line, began_s, said_s = "", 0.0, 0.0

    def say(text: str) -> None:
        nonlocal line, began_s, said_s
        line, began_s = text, time.monotonic()
        said_s = began_s
        print(text, file=sys.stderr, flush=True)

    def repeat() -> None:
        nonlocal said_s
        now_s = time.monotonic()
        if line and now_s - said_s >= quiet_s:
            said_s = now_s
            print(f"{line}, for {now_s - began_s:.0f} s", file=sys.stderr, flush=True)

    worker = PROCESS.every("progress", quiet_s / 5.0, repeat)
    try:
        yield say
    finally:
        worker.join()


@contextmanager
def _bar(name: str) -> Iterator[Callable[[Progress], None]]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        SpinnerColumn,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bars

    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()
    console = Console(stderr=True)
    with Bars(*columns, TimeRemainingColumn(), console=console, transient=True) as bars:
        bar = bars.add_task(name, total=1.0)
        yield lambda now: bars.update(bar, completed=now.share, description=f"{name}: {now.text}")
