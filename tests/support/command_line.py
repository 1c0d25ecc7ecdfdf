"""The command line without a process of its own: the same exit codes and messages."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import threading
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

from service.cli import main


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
