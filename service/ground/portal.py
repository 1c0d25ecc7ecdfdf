"""The portal as a server: where it listens, its tokens, its thread."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from service.errors import InputError, outside
from service.ground.basemap import open_basemap
from service.ground.due import MESH
from service.ground.guard import (
    MAX_BODY_BYTES,
    Pace,
    RequestLimits,
    Tokens,
    kept_token,
    parse_tokens,
    read_tokens,
)
from service.ground.http import portal_app
from service.ground.library import Library
from service.ground.live_map import LiveMap
from service.ground.meshing import KIND, drop, queue_meshes
from service.ground.state import REFINE, Job, Jobs, OpenScans, PortalState
from service.ground.storage import DroneLimits
from service.ground.vehicle import Vehicle
from service.listener import (
    BoundedListener,
    ListenerLimits,
    fitting,
    is_loopback,
    parse_address,
)
from service.scans.coverage import LiveCoverage
from service.workers import Worker, Workers

log = logging.getLogger(__name__)

MIN_TOKEN_LETTERS = 16

_warnings_pace = Pace(rate_hz=1.0, burst=10)
"""Of the web server's warnings: each malformed request makes one."""

BACKLOG = 64  # connections that may wait to be accepted, and that are accepted at once


@dataclass(frozen=True, slots=True)
class PortalConfig:
    store: Path
    host: str = "127.0.0.1"
    port: int = 8080
    token: str = ""  # one, or lines of NAME TOKEN; empty: made at the start, only on this machine
    tls: tuple[Path, Path] | None = None  # certificate and key
    basemap: Path | None = None  # an MBTiles or PMTiles file
    limits: DroneLimits = field(default_factory=DroneLimits)  # of the disk
    map_age_s: float = 1.0  # at which the live map of a scan is made again
    coverage_age_s: float = 2.0  # the same for its coverage
    meshes: bool = False  # make the mesh of each scan that ends
    body_s: float = 10.0  # a request's whole body must arrive within this time
    stall_s: float = 120.0  # a reader that has received nothing for so long is dropped

    def __post_init__(self) -> None:
        """Raise InputError for an address open to others without a token."""
        if not 0 <= self.port < 65536:
            raise InputError(f"portal: port {self.port} is not 0 to 65535")
        shortest = min(map(len, parse_tokens(self.token).values())) if self.token else 0
        if not is_loopback(self.host) and shortest < MIN_TOKEN_LETTERS:
            raise InputError(
                f"portal on {self.host}: others can reach it; "
                f"give a token of {MIN_TOKEN_LETTERS} letters or more"
            )


class Portal:
    """The web server, on a worker of its own between :meth:`start` and :meth:`close`."""

    def __init__(
        self,
        config: PortalConfig,
        progress: Callable[[], list[dict[str, Any]]] | None = None,
        vehicle: Vehicle | None = None,
        workers: Workers | None = None,
    ) -> None:
        """``progress`` gives one entry per scan being received (``Receiver.progress``)."""
        self.config = config
        self._workers = workers or Workers()
        self.jobs = Jobs(self._workers)
        below = None if config.basemap is None else open_basemap(config.basemap)
        library = Library(config.store)
        self.jobs.ended = self._job_ended
        self.state = PortalState(
            library, self.jobs, progress or list, vehicle, below, config.limits,
            OpenScans(LiveCoverage, config.coverage_age_s, max_scans=4),
            OpenScans(LiveMap, config.map_age_s, max_scans=3), self.ended,
        )  # fmt: skip
        tokens = parse_tokens(config.token or secrets.token_urlsafe(24))
        self.token = next(iter(tokens.values()))
        self.app = portal_app(self.state, Tokens(tokens), is_loopback(config.host))
        self._listener: BoundedListener | None = None
        self._port = config.port
        self._server: Any = None
        self._worker: Worker | None = None

    @property
    def url(self) -> str:
        """The address to open, with the token in it."""
        scheme = "https" if self.config.tls else "http"
        host = f"[{self.config.host}]" if ":" in self.config.host else self.config.host
        return f"{scheme}://{host}:{self._port}/?token={self.token}"

    def ended(self, folder: Path) -> None:
        """Have the mesh of a scan that has ended made, once none grows; from any thread."""
        if self.config.meshes:
            MESH.mark(folder)
            self._queue_meshes()

    def _queue_meshes(self) -> None:
        queue_meshes(self.jobs, self.config.store, lambda: not self.state.is_receiving)

    def _job_ended(self, job: Job) -> None:
        """A recording has become a scan, or a scan was refined, or another mesh may wait."""
        if job.kind == "scan" and job.file is not None:
            self.ended(self.state.library.folder(*job.file.split("/")))
        elif job.kind == REFINE and job.state == "done":
            self.ended(job.folder)
        elif job.kind == KIND:
            if job.state == "cancelled":
                drop(job.folder)
            else:
                MESH.end(job.folder)
            if self.config.meshes:
                self._queue_meshes()

    def start(self) -> None:
        """Begin to serve; raises OutsideError when the address cannot be used."""
        config = self.config
        self._open(config.port)
        if not is_loopback(config.host) and not config.tls:
            log.warning("portal on %s without TLS: the token can be read in transit", config.host)
        self._worker = self._workers.start("portal", self._run)
        if config.meshes:
            for folder in MESH.folders(config.store):  # also what a former process had begun
                MESH.mark(folder)
            self._queue_meshes()

    def _open(self, port: int) -> None:
        """Listen, with a new server. Raises OutsideError when the address cannot be used."""
        import uvicorn

        config = self.config
        with outside(f"portal: cannot listen on {config.host}:{port}", "choose another address"):
            # A quarter of the descriptors, so that the datalink has some.
            listener = BoundedListener(config.host, port, fitting(ListenerLimits(), 4))
        self._listener, self._port = listener, int(listener.getsockname()[1])
        logging.getLogger("uvicorn.error").addFilter(_few_warnings)
        self._server = uvicorn.Server(
            uvicorn.Config(
                RequestLimits(self.app, listener, config.body_s, config.stall_s),
                http="h11",
                loop="asyncio",
                backlog=BACKLOG,
                proxy_headers=False,  # anybody here could write them
                log_level="warning",
                access_log=False,
                lifespan="off",
                ws_max_size=MAX_BODY_BYTES,
                ssl_certfile=config.tls and config.tls[0],
                ssl_keyfile=config.tls and config.tls[1],
            )
        )

    def _run(self, worker: Worker) -> None:
        """Serve until :meth:`close`; after a fault on a new socket with the same port."""
        assert self._listener is not None
        if worker.restarts:
            self._listener.close()
            self._open(self._port)
        asyncio.run(self._serve(worker, self._listener))

    async def _serve(self, worker: Worker, listener: BoundedListener) -> None:
        """Serve; close the connections whose request does not come, once a second."""
        self.state.decoding = asyncio.Semaphore(2)  # each loop has its own
        serving = asyncio.create_task(self._server.serve(sockets=[listener]))
        while not serving.done():
            await asyncio.wait({serving}, timeout=1.0)
            worker.beat()
            listener.sweep()
        await serving  # its fault, if it has one

    def close(self) -> None:
        """End; open connections and the vehicle's link are closed, jobs cancelled."""
        self.jobs.close()
        if self._server is not None and self._worker is not None:
            self._worker.stop.set()
            self._server.should_exit = True
            self._server.force_exit = True
            self._worker.join(5.0)
        if self._listener is not None:
            self._listener.close()
        if self.state.vehicle is not None:
            self.state.vehicle.close()


def _few_warnings(record: logging.LogRecord) -> bool:
    return record.levelno > logging.WARNING or _warnings_pace.take()


def config_of(
    address: str, store: Path, token_file: Path | None, tls: tuple[Path, Path] | None, **rest: Any
) -> PortalConfig:
    """The configuration of a portal at ``HOST:PORT`` on the scans below ``store``.

    ``token_file`` holds the tokens; without it one is made and kept in the store. ``tls`` are
    certificate and key. Raises InputError or OutsideError, in one line.
    """
    host, port = parse_address(address, "portal")
    token = kept_token(store) if token_file is None else read_tokens(token_file)
    for path in tls or ():
        if not path.is_file():
            raise InputError(f"portal certificate {path}: no such file")
    return PortalConfig(store, host, port, token, tls, **rest)
