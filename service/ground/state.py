"""Shared state of the portal's endpoints: library, exports in the background, vehicle."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from starlette.requests import HTTPConnection

from service.errors import InputError, SkyreliefError
from service.ground.library import Library
from service.ground.vehicle import Vehicle
from service.offline.exports import EXPORTERS
from service.offline.exports.view import ExportOptions, ScanView, export
from service.scans.coverage import LiveCoverages
from service.workers import Worker, Workers, guarded

log = logging.getLogger(__name__)

MAX_WAITING_JOBS = 20
KEPT = 100


class Jobs:
    """A queue of exports; each job is a dict of id, kind, state, file and error."""

    def __init__(self, workers: Workers) -> None:
        self._workers = workers
        self._worker: Worker | None = None  # while jobs wait
        self._lock = threading.Lock()
        self._queue: deque[tuple[Path, dict[str, Any]]] = deque()
        self._jobs: list[tuple[Path, dict[str, Any]]] = []

    def start(self, folder: Path, kind: str) -> dict[str, Any]:
        """Queue an export. InputError for an unknown kind or a full queue."""
        if kind not in EXPORTERS:
            raise InputError(f"kind is one of {', '.join(EXPORTERS)}")
        with self._lock:
            waiting = [j for _, j in self._jobs if j["state"] in ("waiting", "running")]
            if len(waiting) >= MAX_WAITING_JOBS:
                raise InputError("too many deliverables are waiting; try again later")
            job = {"kind": kind, "state": "waiting", "queued_unix_s": time.time(), "error": None}
            self._jobs = [*self._jobs[-KEPT:], (folder, job)]
            self._queue.append((folder, job))
            if self._worker is None or self._worker.is_done:
                self._worker = self._workers.start("exports", self._work)
            return dict(job)

    def of(self, folder: Path) -> list[dict[str, Any]]:
        """The jobs of a scan, the oldest first."""
        with self._lock:
            return [dict(job) for place, job in self._jobs if place == folder]

    def busy(self, folder: Path) -> bool:
        """True while a deliverable of this scan is waiting or being made."""
        return any(job["state"] in ("waiting", "running") for job in self.of(folder))

    def _work(self, _: Worker) -> None:
        """Make what waits, one after the other."""
        while True:
            with self._lock:
                if not self._queue:
                    self._worker = None
                    return
                folder, job = self._queue.popleft()
            guarded("exports", partial(self._run, folder, job))

    def _run(self, folder: Path, job: dict[str, Any]) -> None:
        job["state"] = "running"
        try:
            with ScanView(folder) as scan:
                job["file"] = export(scan, job["kind"], None, ExportOptions()).name
            job["state"] = "done"
        except SkyreliefError as error:
            job |= {"state": "failed", "error": str(error)}
        finally:
            if job["state"] == "running":  # our own fault, which the caller logs
                job |= {"state": "failed", "error": "failed; see the log"}


@dataclass(slots=True, eq=False)
class PortalState:
    """The parts behind one portal."""

    library: Library
    jobs: Jobs
    progress: Callable[[], list[dict[str, Any]]]  # one entry per scan being received
    vehicle: Vehicle | None
    coverages: LiveCoverages = field(default_factory=LiveCoverages)
    live_views: int = 0
    views_without_token: int = 0  # of these
    started: float = field(default_factory=time.monotonic)


def state_of(connection: HTTPConnection) -> PortalState:
    """The state of the portal that serves ``connection``."""
    state: PortalState = connection.app.state.portal
    return state


def names_of(connection: HTTPConnection) -> tuple[str, str]:
    """Drone and scan in the path, unchecked."""
    return connection.path_params["drone"], connection.path_params["scan"]
