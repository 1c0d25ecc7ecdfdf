"""What the tests of peers on the loopback share."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

import pytest


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A port of this machine that nobody uses."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def until(done: Callable[[], Any], limit_s: float = 15.0) -> Any:
    """What ``done`` gives once it is true; the test fails when that takes too long."""
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        value = done()
        if value:
            return value
        time.sleep(0.02)
    pytest.fail(f"nothing came in {limit_s} s")
