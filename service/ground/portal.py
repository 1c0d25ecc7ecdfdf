"""The portal as a server: where it listens, its token, its thread."""

from __future__ import annotations

import logging
import secrets
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import InputError, OutsideError
from service.ground.guard import LARGEST_BODY_BYTES, is_loopback
from service.ground.http import portal_app
from service.ground.vehicle import Vehicle

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PortalConfig:
    """Where the portal listens, which scans it shows, and its secrets."""

    store: Path
    host: str = "127.0.0.1"
    port: int = 8080
    token: str = ""  # empty: made at the start; only on this machine
    tls_certificate: str = ""
    tls_key: str = ""

    def __post_init__(self) -> None:
        """Raise InputError for an address open to others without a token."""
        if not 0 <= self.port < 65536:
            raise InputError(f"portal: port {self.port} is not 0 to 65535")
        if not is_loopback(self.host) and len(self.token) < 16:
            raise InputError(
                f"portal on {self.host}: others can reach it; give a token of 16 letters or more"
            )

    @property
    def tls(self) -> bool:
        """True when the portal speaks HTTPS."""
        return bool(self.tls_certificate)


def parse_address(text: str) -> tuple[str, int]:
    """(host, port) of ``HOST:PORT``; InputError for anything else."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise InputError(f"portal {text!r}: give HOST:PORT, such as 127.0.0.1:8080")
    return host.strip("[]"), int(port)


class Portal:
    """The web server, on a thread of its own between :meth:`start` and :meth:`close`."""

    def __init__(
        self,
        config: PortalConfig,
        progress: Callable[[], list[dict[str, Any]]] | None = None,
        vehicle: Vehicle | None = None,
    ) -> None:
        """``progress`` gives one entry per scan being received (``Receiver.progress``)."""
        self.config = config
        self.token = config.token or secrets.token_urlsafe(24)
        self._app = portal_app(
            config.store, self.token, is_loopback(config.host), progress, vehicle
        )
        self._vehicle = vehicle
        self._socket: socket.socket | None = None
        self._server: Any = None
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """The address to open, with the token in it."""
        port = self.config.port if self._socket is None else self._socket.getsockname()[1]
        scheme = "https" if self.config.tls else "http"
        host = f"[{self.config.host}]" if ":" in self.config.host else self.config.host
        return f"{scheme}://{host}:{port}/?token={self.token}"

    def start(self) -> None:
        """Begin to serve; raises OutsideError when the address cannot be used."""
        import uvicorn

        config = self.config
        family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
        try:
            self._socket = socket.create_server((config.host, config.port), family=family)
        except OSError as error:
            raise OutsideError(
                f"portal: cannot listen on {config.host}:{config.port} ({error.strerror}); "
                "choose another address"
            ) from error
        if not is_loopback(config.host) and not config.tls:
            log.warning("portal on %s without TLS: the token can be read on the way", config.host)
        self._server = uvicorn.Server(
            uvicorn.Config(
                self._app,
                log_level="warning",
                access_log=False,
                lifespan="off",
                ws_max_size=LARGEST_BODY_BYTES,
                ssl_certfile=config.tls_certificate or None,
                ssl_keyfile=config.tls_key or None,
            )
        )
        sockets = [self._socket]
        self._thread = threading.Thread(
            target=lambda: self._server.run(sockets=sockets), name="portal", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End; open connections and the vehicle are let go."""
        if self._server is not None and self._thread is not None:
            self._server.should_exit = True
            self._server.force_exit = True
            self._thread.join(timeout=5.0)
        if self._socket is not None:
            self._socket.close()
        if self._vehicle is not None:
            self._vehicle.close()


def open_portal(
    address: str,
    store: Path,
    progress: Callable[[], list[dict[str, Any]]] | None = None,
    token_file: Path | None = None,
    tls: tuple[Path, Path] | None = None,
    vehicle: Vehicle | None = None,
) -> Portal:
    """A started portal at ``HOST:PORT`` on the scans below ``store``.

    ``token_file`` holds the token; without it one is made, on this machine only. ``tls`` are
    certificate and key. Raises InputError or OutsideError, in one line.
    """
    host, port = parse_address(address)
    token = ""
    if token_file is not None:
        try:
            token = token_file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"portal token {token_file} cannot be read ({error})") from error
        if not token:
            raise InputError(f"portal token {token_file} is empty")
    for path in tls or ():
        if not path.is_file():
            raise InputError(f"portal certificate {path}: no such file")
    certificate, key = (str(path) for path in tls) if tls else ("", "")
    portal = Portal(PortalConfig(store, host, port, token, certificate, key), progress, vehicle)
    portal.start()
    return portal
