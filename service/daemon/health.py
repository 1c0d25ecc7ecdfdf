"""The state of the service over HTTP, for this machine.

Uses only the standard library's HTTP server: an aircraft has none of the ground's packages. The
figures are one dict; Prometheus' client, which registers each by name, would not shorten them.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import logging
import socket
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from service.errors import outside
from service.listener import BoundedListener, ListenerLimits, host_name, is_loopback, parse_address
from service.redaction import redacted
from service.workers import PROCESS

log = logging.getLogger(__name__)

Snapshot = Callable[[], dict[str, Any]]
LIMITS = ListenerLimits(total=32, per_address=16)
PREFIX = "skyrelief_"
DESCRIPTION = Path(__file__).with_name("openapi.json")


class HealthServer(ThreadingHTTPServer):
    """``/healthz`` (200 or 503), ``/status`` (JSON) and ``/metrics`` (Prometheus) over HTTP.

    ``/openapi.json`` describes them. ``snapshot`` is called for each request, on its thread; its
    ``ok`` determines ``/healthz``, its numbers become metrics.
    """

    daemon_threads = True

    def __init__(self, address: str, snapshot: Snapshot) -> None:
        """Listen on HOST:PORT; raises OutsideError when it is in use."""
        host, port = parse_address(address, "health.http")
        with outside(f"health.http {address} cannot be served", "give another port"):
            listener = BoundedListener(host, port, LIMITS)
        super().__init__(listener.getsockname()[:2], _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = self._listener = listener
        self.port = int(listener.getsockname()[1])
        self.snapshot, self.is_local = snapshot, is_loopback(host)
        self._worker = PROCESS.start("health", lambda _: self.serve_forever())

    def service_actions(self) -> None:
        """Called twice a second while serving."""
        self._listener.sweep()

    def close(self) -> None:
        self.shutdown()
        self.server_close()
        self._worker.join()


def _is_own(header: str | None, is_local: bool) -> bool:
    """Whether a ``Host`` header names this machine; true without one (browsers send it). A foreign
    site's name that resolves to this machine would let a browser read on behalf of that site."""
    name = "localhost" if header is None else host_name(header)
    if is_local or is_loopback(name):
        return is_loopback(name)
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return name.partition(".")[0] == socket.gethostname().partition(".")[0].lower()


def metrics_text(snapshot: dict[str, Any], prefix: str = PREFIX) -> str:
    """Prometheus text of the numbers in ``snapshot``; nested names are joined by ``_``."""
    lines = []
    for name, value in snapshot.items():
        full = prefix + "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
        if isinstance(value, dict):
            lines.append(metrics_text(value, f"{full}_").rstrip("\n"))
        elif isinstance(value, bool | int | float):
            lines.append(f"# TYPE {full} gauge\n{full} {float(value):.10g}")
    return "\n".join(line for line in lines if line) + "\n"


class _Handler(BaseHTTPRequestHandler):
    server: HealthServer
    server_version = "skyrelief"
    sys_version = ""
    timeout = 10.0

    def do_GET(self) -> None:
        if not _is_own(self.headers.get("Host"), self.server.is_local):
            self._answer(421, "not a name of this machine\n", "text/plain")
            return
        path = self.path.partition("?")[0]
        if path == "/openapi.json":
            self._answer(200, DESCRIPTION.read_text(encoding="utf-8"), "application/json")
            return
        found = redacted(self.server.snapshot())
        if path == "/healthz":
            ok = bool(found.get("ok"))
            body = {"ok": ok, "state": found.get("state"), "fault": found.get("fault")}
            self._answer(200 if ok else 503, json.dumps(body), "application/json")
        elif path == "/status":
            self._answer(200, json.dumps(found), "application/json")
        elif path == "/metrics":
            self._answer(200, metrics_text(found), "text/plain; version=0.0.4")
        else:
            self._answer(404, "available: /healthz, /status and /metrics\n", "text/plain")

    do_HEAD = do_GET

    def _refuse(self) -> None:
        self.send_response(405)
        self.send_header("Allow", "GET, HEAD")
        self.send_header("Content-Length", "0")
        self.end_headers()
        self.close_connection = True  # a body may follow; it is not read

    do_POST = do_PUT = do_PATCH = do_DELETE = do_OPTIONS = do_TRACE = _refuse

    def _answer(self, code: int, text: str, kind: str) -> None:
        body = text.encode()
        self.send_response(code)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        log.debug("http: " + format, *args)
