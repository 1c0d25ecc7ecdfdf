"""The command line, in this process or in one of its own: the same exit codes and messages."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

from service.cli import main
from service.workers import end_process, python_command


def skyrelief(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """What ``skyrelief`` with these arguments ends with; a fault of our own is raised."""
    words = ["skyrelief", *map(str, arguments)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    hooks = patch.object(sys, "excepthook"), patch.object(threading, "excepthook")
    given = patch.object(sys, "argv", words)
    try:
        with redirect_stdout(out), redirect_stderr(err), given, hooks[0], hooks[1]:
            main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


@contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C is heard, by new processes too, though a shell's background job ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def command_process(log: Path, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """A command in a process of its own, which writes to ``log`` and is ended at the end."""
    with log.open("wb") as said:
        process = subprocess.Popen(
            python_command("service.cli", *words), stdin=subprocess.DEVNULL, stdout=said,
            stderr=said, start_new_session=True,
        )  # fmt: skip
    try:
        yield process
    finally:
        end_process(process, 60.0)
