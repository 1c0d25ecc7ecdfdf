"""Ports and waiting for tests of peers on the loopback."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

import pytest

PAUSE_S = 0.02


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A port of this machine that nothing uses."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def until(
    done: Callable[[], Any], limit_s: float = 15.0, progress: Callable[[], object] = lambda: None,
    sleep: Callable[[float], None] = time.sleep,
) -> Any:  # fmt: skip
    """Return what ``done`` gives once it is true; the test fails when progress stops.

    ``limit_s`` is how long ``progress`` may stay the same. It counts pauses between calls of
    ``done``, not the clock: a machine too busy to call it, or asleep, has that much longer.
    """
    seen, pauses = progress(), 0
    while not (value := done()):
        if pauses * PAUSE_S >= limit_s:
            pytest.fail(f"no progress in {limit_s} s, last {seen}")
        sleep(PAUSE_S)
        now = progress()
        seen, pauses = now, 0 if now != seen else pauses + 1
    return value
