"""How it goes, for the init system and for whoever asks over HTTP on this machine.

No packages: one datagram to systemd, and the standard library's HTTP server.
"""

from __future__ import annotations

import json
import logging
import os
import socket
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from service.daemon.health_api import DOCUMENT
from service.errors import OutsideError
from service.redaction import redacted

log = logging.getLogger(__name__)

Snapshot = Callable[[], dict[str, Any]]
PREFIX = "skyrelief_"

EXTENSION_US = 30_000_000
"""Without progress for so long, systemd ends a service that is closing its scan."""


class Notifier:
    """The service's word to systemd (sd_notify(3)); silent where nobody listens."""

    def __init__(self, address: str | None = None) -> None:
        """Speak to ``address``, by default the one in NOTIFY_SOCKET."""
        address = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None

    @property
    def is_heard(self) -> bool:
        """True when an init system listens."""
        return self._socket is not None

    def status(self, text: str) -> None:
        """A line for ``systemctl status``."""
        self._send(f"STATUS={text}")

    def ready(self) -> None:
        """The service is up."""
        self._send("READY=1")

    def alive(self, status: str = "") -> None:
        """Progress was made; feeds the watchdog."""
        self._send("WATCHDOG=1" + (f"\nSTATUS={status}" if status else ""))

    def closing(self) -> None:
        """Closing gets on: systemd waits for another :data:`EXTENSION_US`."""
        self._send(f"EXTEND_TIMEOUT_USEC={EXTENSION_US}")

    def stopping(self) -> None:
        """The service is on its way out."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError as error:
            log.debug("systemd does not listen: %s", error)


class HealthServer:
    """``/healthz`` (200 or 503), ``/status`` (JSON) and ``/metrics`` (Prometheus) over HTTP.

    ``/openapi.json`` describes them (:mod:`service.daemon.health_api`). ``snapshot`` is called
    for each request, on a thread of its own; its ``ok`` decides about ``/healthz``, its numbers
    become metrics.
    """

    def __init__(self, address: str, snapshot: Snapshot) -> None:
        """Listen on HOST:PORT; raises OutsideError when that is taken."""
        host, _, port = address.rpartition(":")
        try:
            self._server = ThreadingHTTPServer(
                (host.strip("[]"), int(port)), _handler(snapshot), bind_and_activate=True
            )
        except OSError as error:
            raise OutsideError(
                f"health.http {address} cannot be served: {error.strerror}; give another port"
            ) from error
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="health", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def metrics_text(snapshot: dict[str, Any], prefix: str = PREFIX) -> str:
    """Prometheus text of the numbers in ``snapshot``; nested names are joined by ``_``."""
    lines = []
    for name, value in snapshot.items():
        full = f"{prefix}{_metric_name(name)}"
        if isinstance(value, dict):
            lines.append(metrics_text(value, f"{full}_").rstrip("\n"))
        elif isinstance(value, bool | int | float):
            lines.append(f"# TYPE {full} gauge\n{full} {float(value):.10g}")
    return "\n".join(line for line in lines if line) + "\n"


def _metric_name(name: str) -> str:
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in name)


def _handler(snapshot: Snapshot) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        server_version = "skyrelief"
        sys_version = ""
        timeout = 10.0

        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if path == "/openapi.json":
                self._answer(200, json.dumps(DOCUMENT), "application/json")
                return
            found = redacted(snapshot())
            if path == "/healthz":
                ok = bool(found.get("ok"))
                body = {"ok": ok, "state": found.get("state"), "fault": found.get("fault")}
                self._answer(200 if ok else 503, json.dumps(body), "application/json")
            elif path == "/status":
                self._answer(200, json.dumps(found), "application/json")
            elif path == "/metrics":
                self._answer(200, metrics_text(found), "text/plain; version=0.0.4")
            else:
                self._answer(404, "there are /healthz, /status and /metrics\n", "text/plain")

        do_HEAD = do_GET

        def _refuse(self) -> None:
            self.send_response(405)
            self.send_header("Allow", "GET, HEAD")
            self.send_header("Content-Length", "0")
            self.end_headers()
            self.close_connection = True  # a body may follow, which nobody reads

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

    return Handler
