"""The health page against foreign names and half-open requests."""

from __future__ import annotations

import socket
import threading
from typing import TYPE_CHECKING

from service.daemon.health import HealthServer

if TYPE_CHECKING:
    pass


def status_of(server: HealthServer, host: str | None) -> int:
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as one:
        header = "" if host is None else f"Host: {host}\r\n"
        one.sendall(f"GET /status HTTP/1.0\r\n{header}\r\n".encode())
        return int(one.recv(100).split()[1])


def test_the_health_page_answers_to_its_own_names_only() -> None:
    own = socket.gethostname().partition(".")[0]
    server = HealthServer("127.0.0.1:0", lambda: {"ok": True})
    try:
        for host in (None, "localhost", f"127.0.0.1:{server.port}", "[::1]:9560"):
            assert status_of(server, host) == 200
        for host in ("evil.example", "192.168.1.5", "127.0.0.1.evil.example", ""):
            assert status_of(server, host) == 421
    finally:
        server.close()
    server = HealthServer("0.0.0.0:0", lambda: {"ok": True})
    try:
        for host in ("192.168.1.5:9560", own, f"{own}.fleet.example:9560", "localhost"):
            assert status_of(server, host) == 200
        assert status_of(server, "evil.example") == 421
    finally:
        server.close()


def test_half_open_requests_leave_the_health_page_answering() -> None:
    server = HealthServer("127.0.0.1:0", lambda: {"ok": True})
    held = []
    try:
        for _ in range(100):
            one = socket.create_connection(("127.0.0.1", server.port), timeout=5)
            one.sendall(b"GET /sta")
            held.append(one)
        assert status_of(server, "localhost") == 200
        assert sum(t.name.startswith("Thread-") for t in threading.enumerate()) < 40
    finally:
        for one in held:
            one.close()
        server.close()
