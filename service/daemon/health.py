"""The state of the service over HTTP, for this machine.

Uses only the standard library's HTTP server.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import socket
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from service.errors import OutsideError
from service.listener import BoundedListener, ListenerLimits, host_name, is_loopback
from service.redaction import redacted
from service.workers import PROCESS

log = logging.getLogger(__name__)

Snapshot = Callable[[], dict[str, Any]]
LIMITS = ListenerLimits(total=32, per_address=16)
PREFIX = "skyrelief_"


class HealthServer:
    """``/healthz`` (200 or 503), ``/status`` (JSON) and ``/metrics`` (Prometheus) over HTTP.

    ``/openapi.json`` describes them. ``snapshot`` is called for each request, on its thread; its
    ``ok`` determines ``/healthz``, its numbers become metrics.
    """

    def __init__(self, address: str, snapshot: Snapshot) -> None:
        """Listen on HOST:PORT; raises OutsideError when it is in use."""
        host, _, port = address.rpartition(":")
        try:
            listener = BoundedListener(host.strip("[]"), int(port), LIMITS)
        except OSError as error:
            raise OutsideError(
                f"health.http {address} cannot be served: {error.strerror}; give another port"
            ) from error
        self.port = int(listener.getsockname()[1])
        own_names = OwnNames(is_loopback(host.strip("[]")))
        self._server = _Server(listener, _handler(snapshot, own_names))
        self._worker = PROCESS.start("health", lambda _: self._server.serve_forever())

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._worker.join()


class OwnNames:
    """The names that a request may use for this machine.

    A foreign site's name that resolves to this machine would let a browser read on behalf of that
    site.
    """

    def __init__(self, is_local: bool) -> None:
        self._is_local = is_local
        self._name = socket.gethostname().partition(".")[0].lower()

    def holds(self, header: str | None) -> bool:
        """Whether a ``Host`` header names this machine; true without one (browsers send it)."""
        if header is None:
            return True
        name = host_name(header)
        if is_loopback(name):
            return True
        return not self._is_local and (_is_address(name) or name.partition(".")[0] == self._name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, listener: BoundedListener, handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(listener.getsockname()[:2], handler, bind_and_activate=False)
        self.socket.close()
        self.socket = self._listener = listener

    def service_actions(self) -> None:
        """Called twice a second while serving."""
        self._listener.sweep()


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


def _handler(snapshot: Snapshot, own_names: OwnNames) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        server_version = "skyrelief"
        sys_version = ""
        timeout = 10.0

        def do_GET(self) -> None:
            if not own_names.holds(self.headers.get("Host")):
                self._answer(421, "not a name of this machine\n", "text/plain")
                return
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

    return Handler


_TEXT, _NUMBER, _COUNT = {"type": "string"}, {"type": "number"}, {"type": "integer"}

HEALTH: dict[str, Any] = {
    "type": "object",
    "required": ["ok", "state", "fault"],
    "properties": {
        "ok": {"type": "boolean", "description": "false: needs attention"},
        "state": {
            **_TEXT,
            "description": "starting, idle, waiting (to retry), scanning, paused or finalising",
        },
        "fault": {**_TEXT, "description": "why the last scan failed; empty: no fault"},
    },
}

STATUS: dict[str, Any] = {
    "type": "object",
    "required": [*HEALTH["required"], "software", "scan", "load", "machine", "mavlink"],
    "properties": {
        **HEALTH["properties"],
        "software": _TEXT,
        "scan": {**_TEXT, "description": "name of the running scan; empty: none"},
        "recording_s": _NUMBER,
        "backend": _TEXT,
        "backend_failure": {**_TEXT, "description": "why the CPU replaced the backend"},
        "frames": {**_COUNT, "description": "of the running scan, like the next nine"},
        "map_voxels": {**_COUNT, "description": "of known surface in memory"},
        "map_tiles_on_disk": _COUNT,
        "loop_views": {**_COUNT, "description": "keyframes kept for loop detection"},
        "graph_keyframes": {**_COUNT, "description": "keyframes in the pose graph"},
        "clouds": _COUNT,
        "points": _COUNT,
        "camera_latency_ms": _NUMBER,
        "camera_latency_sigma_ms": _NUMBER,
        "speed_m_s": _NUMBER,
        "distance_m": _NUMBER,
        "load": {
            "type": "object",
            "required": ["level", "name", "reason"],
            "properties": {
                "level": {**_COUNT, "description": "load level; 0: full quality"},
                "name": _TEXT,
                "reason": _TEXT,
                "frame_age_s": _NUMBER,
                "frames_late": _COUNT,
                "views_late": _COUNT,
                "pictures_kept": _COUNT,
                "pictures_lost": _COUNT,
            },
        },
        "mavlink": {
            "type": "object",
            "description": "links, packets, age of the telemetry, what is missing (troubles)",
        },
        "machine": {
            "type": "object",
            "description": "temperature, power, memory, disk, if available",
        },
        "workers": {
            "type": "array",
            "description": "running and failed threads and processes",
            "items": {
                "type": "object",
                "required": ["name", "state", "waiting", "lag_s", "bound", "when_full", "stop"],
                "properties": {
                    "name": _TEXT,
                    "state": {**_TEXT, "description": "running, stalled or failed"},
                    "does": _TEXT,
                    "restarts": _COUNT,
                    "fault": {**_TEXT, "description": "the last one; empty: none"},
                    "waiting": {**_COUNT, "description": "entries in its queue"},
                    "lag_s": {**_NUMBER, "description": "age of the current or oldest entry"},
                    "bound": {"type": ["integer", "null"], "description": "of the queue"},
                    "when_full": {**_TEXT, "description": "drop oldest, wait or refuse"},
                    "deadline_s": {"type": ["number", "null"], "description": "of progress"},
                    "stop": {**_COUNT, "description": "order of stopping"},
                },
            },
        },
    },
}


_NOT_US: dict[str, Any] = {"421": {"description": "the Host header names another machine"}}


def _get(summary: str, kind: str, schema: dict[str, Any], *codes: tuple[int, str]) -> Any:
    content = {kind: {"schema": schema}}
    answers: dict[str, Any] = {
        str(code): {"description": text, "content": content} for code, text in codes
    }
    return {"get": {"summary": summary, "responses": answers | _NOT_US}}


DOCUMENT: dict[str, Any] = {
    "openapi": "3.1.0",
    "info": {"title": "skyrelief on board", "version": "1"},
    "paths": {
        "/healthz": _get(
            "Whether the service is healthy.", "application/json", HEALTH,
            (200, "well"), (503, "needs attention"),
        ),
        "/status": _get("State of the service.", "application/json", STATUS, (200, "all values")),
        "/metrics": _get(
            "The same numbers for Prometheus.", "text/plain", _TEXT, (200, "text format 0.0.4")
        ),
        "/openapi.json": _get(
            "This description.", "application/json", {"type": "object"}, (200, "OpenAPI 3.1")
        ),
    },
}  # fmt: skip
