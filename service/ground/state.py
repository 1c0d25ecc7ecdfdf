"""Shared state of the portal's endpoints: library, background jobs, open scans, vehicle."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from starlette.requests import HTTPConnection

from service.errors import InputError, MissingError, OutsideError, SkyreliefError
from service.ground.basemap import Basemap
from service.ground.library import Library
from service.ground.live_map import LiveMap
from service.ground.storage import DroneLimits
from service.ground.vehicle import Vehicle
from service.offline.exports import EXPORTERS
from service.offline.exports.view import ExportOptions, ScanView, export
from service.progress import CancelledError, Progress
from service.scans.coverage import LiveCoverage
from service.stream.store import ScanStore
from service.workers import Worker, Workers, guarded

log = logging.getLogger(__name__)

MAX_WAITING_JOBS = 20  # of those asked for, and as many others
SILENT_S = 10.0  # a scan from which nothing was heard for so long does not grow

KEPT = 100
SHOWN_S = 86400.0  # a job that has ended is listed for so long
LOOK_S = 0.5  # how often a job that may not begin yet is looked at
CLOSE_S = 5.0  # time to a running job's next step, when the station closes

REFINE = "refine"
KINDS = (*EXPORTERS, REFINE)  # products that a job may make


@dataclass(slots=True, eq=False)
class Job:
    number: int
    folder: Path
    kind: str
    state: str = "waiting"  # then running; done, failed or cancelled
    file: str | None = None
    error: str | None = None
    queued_unix_s: float = field(default_factory=time.time)
    ended_unix_s: float | None = None
    work: Callable[[Progress], str] | None = None  # what makes it; None: its kind says
    may_begin: Callable[[], bool] | None = None  # of one made unasked
    gives_way: bool = False  # stops for one that was asked for, and begins again
    options: ExportOptions = field(default_factory=ExportOptions)
    progress: Progress = field(default_factory=Progress)

    @property
    def has_ended(self) -> bool:
        return self.state not in ("waiting", "running")

    def end(self, state: str, error: str | None = None) -> None:
        self.state, self.error, self.ended_unix_s = state, error, time.time()
        self.work = None  # and the files that it may own

    def shown(self) -> dict[str, Any]:
        left_s = self.progress.left_s if self.state == "running" else None
        return {
            "number": self.number,
            "drone": self.folder.parent.name,
            "scan": self.folder.name,
            "kind": self.kind,
            "state": self.state,
            "doing": self.progress.text if self.state == "running" else "",
            "percent": round(100.0 * self.progress.share),
            "left_s": None if left_s is None else round(left_s),
            "queued_unix_s": self.queued_unix_s,
            "ended_s": None if self.ended_unix_s is None else time.time() - self.ended_unix_s,
            "file": self.file,
            "error": self.error,
        }


def carry_out(job: Job) -> str:
    """Make the job's deliverable; the name of the file. Errors are passed on."""
    if job.work is not None:
        return job.work(job.progress)
    if job.kind == REFINE:
        from service.offline.refine.marking import marked_file
        from service.offline.refine.refinement import RefineOptions, refine

        refine(job.folder, RefineOptions(marked_file(job.folder)), job.progress)
        return "cloud.laz"
    with ScanView(job.folder, progress=job.progress) as scan:
        return export(scan, job.kind, None, job.options).name


class Jobs:
    """A queue of exports and refinements, made one after the other."""

    def __init__(
        self,
        workers: Workers,
        carry_out: Callable[[Job], str] = carry_out,
        shown_s: float = SHOWN_S,
    ) -> None:
        """``carry_out`` makes a job's deliverable; an ended job is listed for ``shown_s``."""
        self._workers, self._shown_s = workers, shown_s
        self.carry_out = carry_out
        self.ended: Callable[[Job], None] = lambda _: None
        """Called with each job that has ended, but not by the end of the station."""
        self._worker: Worker | None = None  # while jobs wait
        self._lock = threading.Condition()  # of a job that is asked for, and of the end
        self._jobs: list[Job] = []  # replaced, not changed, so that anybody may iterate over it
        self._number = 0
        self._is_closed = False

    def start(
        self,
        folder: Path,
        kind: str,
        work: Callable[[Progress], str] | None = None,
        options: ExportOptions | None = None,
        may_begin: Callable[[], bool] | None = None,
    ) -> dict[str, Any]:
        """Queue a job, or ``work``; the one there is where it is asked for twice.

        With ``may_begin`` it is made unasked: it begins when that is true and nothing else waits,
        gives way to what is asked for, and is forgotten if it fails. InputError for an unknown kind
        or a full queue, OutsideError once closed.
        """
        if work is None and kind not in KINDS:
            raise InputError(f"kind is one of {', '.join(KINDS)}")
        options = options or ExportOptions()
        asked = (folder, kind, options)
        with self._lock:
            if self._is_closed:
                raise OutsideError("the ground station ends")
            current = [job for job in self._jobs if not job.has_ended]
            for job in current if work is None or may_begin else ():
                is_before = may_begin is not None and job.state == "running"  # of an older scan
                if (job.folder, job.kind, job.options) == asked and not is_before:
                    job.may_begin = job.may_begin and may_begin
                    self._lock.notify()
                    return job.shown()
            alike = [job for job in current if (job.may_begin is None) == (may_begin is None)]
            if len(alike) >= MAX_WAITING_JOBS:
                raise InputError("too many deliverables are waiting; try again later")
            for job in current if may_begin is None else ():
                if job.state == "running" and job.may_begin is not None:
                    job.gives_way = True
                    job.progress.cancel()
            self._number += 1
            job = Job(self._number, folder, kind, work=work, may_begin=may_begin, options=options)
            older = [one for one in self._jobs[:-KEPT] if not one.has_ended]
            self._jobs = [*older, *self._jobs[-KEPT:], job]
            if self._worker is None or self._worker.is_done:
                self._worker = self._workers.start("exports", self._work)
            self._lock.notify()
            return job.shown()

    def of(self, folder: Path) -> list[dict[str, Any]]:
        """The jobs of a scan, the oldest first."""
        return [job.shown() for job in self._jobs if job.folder == folder]

    def listed(self) -> list[dict[str, Any]]:
        """The jobs that wait, run or have ended lately, the oldest first."""
        since = time.time() - self._shown_s
        return [j.shown() for j in self._jobs if (j.ended_unix_s or since) >= since]

    def busy(self, folder: Path) -> bool:
        """Whether a job of a scan runs, or one that was asked for waits."""
        of_it = (job for job in self._jobs if job.folder == folder and not job.has_ended)
        return any(job.state == "running" or job.may_begin is None for job in of_it)

    def cancel(self, number: int) -> dict[str, Any]:
        """Take a waiting job off the queue, or stop a running one at its next step. InputError when
        there is none of this number, or it has ended."""
        with self._lock:
            found = [j for j in self._jobs if j.number == number and not j.has_ended]
            if not found:
                raise MissingError(f"no job {number} is waiting or running")
            (job,) = found
            job.gives_way = False
            job.progress.cancel()
            was_waiting = job.state == "waiting"
            if was_waiting:
                job.end("cancelled")
        if was_waiting:
            self.ended(job)
        return job.shown()

    def close(self) -> None:
        """Cancel all jobs, take no more, and wait a while until the one that runs has left its
        files."""
        with self._lock:
            self._is_closed = True
            for job in self._jobs:
                job.gives_way = False
                job.progress.cancel()
                if job.state == "waiting":
                    job.end("cancelled")
            self._lock.notify()
            worker = self._worker
        if worker is not None:
            worker.join(CLOSE_S)

    def _work(self, worker: Worker) -> None:
        while True:
            with self._lock:
                waiting = [job for job in self._jobs if job.state == "waiting"]
                if not waiting:
                    self._worker = None
                    return
                # What is asked for first; the others wait for the same.
                job = min(waiting, key=lambda job: job.may_begin is not None)
                begins = job.may_begin is None or job.may_begin()
                if not begins:
                    self._lock.wait(LOOK_S)
                    if worker.stop.is_set():
                        return
                    continue
                job.state = "running"
            job.progress.begin()
            guarded("exports", partial(self._run, job))
            if job.state == "failed" and job.may_begin is not None:
                log.info("%s of %s: %s", job.kind, job.folder, job.error)
                with self._lock:
                    self._jobs = [one for one in self._jobs if one is not job]
            if job.has_ended and not self._is_closed:
                guarded("exports", partial(self.ended, job))

    def _run(self, job: Job) -> None:
        try:
            job.file = self.carry_out(job)
            job.end("done")
        except CancelledError:
            with self._lock:
                if job.gives_way:
                    job.state, job.gives_way, job.progress = "waiting", False, Progress()
                else:
                    job.end("cancelled")
        except SkyreliefError as error:
            job.end("failed", str(error))
        finally:
            if job.state == "running":  # our own fault, which the caller logs
                job.end("failed", "failed; see the log")


class StoreView(Protocol):
    def refresh(self) -> object: ...


V = TypeVar("V", bound=StoreView)


class OpenScans(Generic[V]):
    """Views of the ``max_scans`` scans asked for last, whose stores stay open. Each view is
    refreshed once it is older than ``min_age_s``. Thread-safe."""

    def __init__(self, view: Callable[[ScanStore], V], min_age_s: float, max_scans: int) -> None:
        self._view, self._min_age_s, self._max_scans = view, min_age_s, max_scans
        self.lock = threading.RLock()  # also of the views
        self._kept: OrderedDict[Path, tuple[V, ScanStore, float]] = OrderedDict()

    def view(self, folder: Path) -> V:
        """The view of the scan in ``folder``. Hold :attr:`lock` while it is used. Raises InputError
        when the folder contains no scan, and what the view raises."""
        with self.lock:
            if folder not in self._kept:
                self._kept[folder] = self._opened(folder)
            found, store, then = self._kept[folder]
            if time.monotonic() - then >= self._min_age_s:
                store.follow()
                found.refresh()
                then = time.monotonic()
            self._kept[folder] = (found, store, then)
            self._kept.move_to_end(folder)
            while len(self._kept) > self._max_scans:
                self._kept.popitem(last=False)[1][1].close()
            return found

    def _opened(self, folder: Path) -> tuple[V, ScanStore, float]:
        store = ScanStore.open(folder / "scan.db")
        try:
            return self._view(store), store, -math.inf
        except Exception:
            store.close()
            raise

    def forget(self, folder: Path) -> None:
        """Close the store of a folder, for example before it is deleted."""
        with self.lock:
            held = self._kept.pop(folder, None)
            if held is not None:
                held[1].close()

    def close(self) -> None:
        for folder in list(self._kept):
            self.forget(folder)


@dataclass(slots=True, eq=False)
class PortalState:
    library: Library
    jobs: Jobs
    progress: Callable[[], list[dict[str, Any]]]  # one entry per scan being received
    vehicle: Vehicle | None
    basemap: Basemap | None
    limits: DroneLimits  # of the disk
    coverages: OpenScans[LiveCoverage]
    maps: OpenScans[LiveMap]
    ended: Callable[[Path], None] = lambda _: None
    """Takes note of a finished scan that came; from any thread."""
    live_views: Counter[bool] = field(default_factory=Counter)  # without a token, and with one
    decoding: asyncio.Semaphore = field(init=False)
    """Recordings opened at a time; who waits holds no thread."""
    started: float = field(default_factory=time.monotonic)

    def receiving(self, drone: str, scan: str) -> dict[str, Any]:
        """The receiver's report about a scan; empty when it does not receive it."""
        names = (drone, scan)
        return next((e for e in self.progress() if (e["drone"], e["scan"]) == names), {})

    @property
    def is_receiving(self) -> bool:
        """Whether any scan grows: one that has not ended, and was heard of lately."""
        since = time.time() - SILENT_S
        return any(
            not e.get("finished") and e.get("heard_unix_s", 0) > since for e in self.progress()
        )


def state_of(connection: HTTPConnection) -> PortalState:
    state: PortalState = connection.app.state.portal
    return state


def names_of(connection: HTTPConnection) -> tuple[str, str]:
    """Drone and scan in the path, unchecked."""
    return connection.path_params["drone"], connection.path_params["scan"]


def folder_of(connection: HTTPConnection) -> Path:
    """The folder of the scan in the path. Raises InputError when there is none."""
    return state_of(connection).library.folder(*names_of(connection))
