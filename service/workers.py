"""Every thread and process of the service: one table of rows, and the only place that starts them.

A row gives the worker's task, the bound of its queue, its deadline for progress, and its order of
stopping. ``/status`` and ``skyrelief doctor`` list running workers by row. This is also the place
that catches every exception: a fault in one worker is logged with its traceback, never ends
another worker, and the worker is restarted where its row says so.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from service.errors import OutsideError, SkyreliefError

log = logging.getLogger(__name__)

MAX_RESTARTS, WINDOW_S = 5, 60.0
"""A worker that fails more often than this within the window is not restarted again."""
MAX_FAILED = 100  # workers that are no longer restarted, kept for the report
PAUSE_S, LOOK_S = 0.5, 0.5  # pause between a fault and the restart; between two looks at a process
NICE = 10
DROP, WAIT = "drop oldest", "wait"
"""Policy of a full queue: drop its oldest entry, or make the filling thread wait."""


@dataclass(frozen=True, slots=True)
class Row:
    name: str  # name of its workers, or the first word of their names
    does: str
    stop: int = 0  # order of stopping: the lowest first
    bound: int | None = None  # entries of its queue; None: it has none
    full: str = ""  # DROP or WAIT
    deadline_s: float | None = None  # stalled without progress for this long; None: never
    restarts: bool = False  # restarted after a fault
    is_essential: bool = False  # the process ends without it
    is_awaited: bool = False  # the process waits for its end
    starts_itself: str = ""  # reason why it is not started here


_BELOW = "mavlink does not import service"
_HANG_S, _STALL_S = 20.0, 120.0

ROWS: tuple[Row, ...] = (
    # A scan, live or replayed.
    Row("camera", "images of a camera when they are due", 1, 2, DROP),
    Row("decoder", "images of a recording, decoded ahead", 1, 4, WAIT),
    Row("gst", "process: a GStreamer pipeline, and its error messages", 1),
    Row("scan", "one scan: tracking, map and store", 2, deadline_s=_HANG_S),
    Row("dense", "depth of views; a replay waits, drops nothing", 2, 3, DROP, _HANG_S),
    Row("placing", "pose graph and map of views that have depth", 2, 1, WAIT, _HANG_S),
    Row("coverage", "coverage.png of the growing scan", 2),
    Row("files", "the files of a scan that has ended", 3),
    Row("progress", "says again what a long step of a command does", 3),
    # The daemon.
    Row("backlog", "opens the earlier scans that the ground lacks", 4),
    Row("backlog closing", "ends the Zenoh session of earlier scans", 4, is_awaited=True),
    Row("datalink", "the scan to the ground; a Zenoh session for each station", 4, restarts=True,
        is_essential=True),
    Row("datalink closing", "ends a Zenoh session; over a dead link that takes long", 4),
    Row("radio", "the coarse scan over a telemetry radio, both ends", 4, restarts=True,
        is_essential=True),
    Row("self-test", "camera and disk, on command", 5),
    Row("stop", "waits for the disk, so that no power cut brings a stopped scan back", 5),
    Row("erase", "deletes finished scans, on command", 5),
    Row("recover", "closes what a crash left open", 5),
    Row("housekeeping", "watches the machine, its memory and its disk", 5),
    Row("first beats", "heartbeats while the rest loads", 6, starts_itself=_BELOW),
    Row("stand-in", "process: heartbeats where ours are late", 6, starts_itself=_BELOW),
    Row("mavlink", "vehicle, heartbeat, reader and writer of each link", 6, starts_itself=_BELOW),
    Row("health", "/healthz, /status and /metrics; a thread a request", 7, 32, "refuse"),
    Row("simulated flight", "process: camera and autopilot of sim:", 8, restarts=True),
    # The ground.
    Row("front", "passes on connections of drones, within limits", 2, restarts=True,
        is_essential=True),
    Row("receiver", "keeps the session with the drones", 1, None, "", _STALL_S,
        True, True),
    Row("messages", "takes messages of one kind, or the replies to a request", 1, restarts=True,
        is_essential=True),
    Row("drone", "the scans of one drone", 3, None, "", _STALL_S, True),
    Row("deliverables", "files of received scans", 4, restarts=True, is_essential=True),
    Row("sites", "aligns finished scans of the same ground", 4, restarts=True),
    Row("alignment", "process: one of them", 4),
    Row("live site", "process: aligns scans in flight", 4, restarts=True),
    Row("exports", "deliverables asked for in the portal", 4, 20, "refuse", is_awaited=True),
    Row("replay", "process: the scan of an uploaded recording", 4),
    Row("mesh", "process: the mesh of a scan that has ended", 4),
    Row("vehicle", "looks for the vehicle that the portal steers", 5, restarts=True),
    Row("portal", "the web server", 5, None, "", 60.0, True, True),
    Row("closing", "keeps the init system waiting while all is closed", 6, restarts=True,
        is_essential=True),
)  # fmt: skip


def row_of(name: str) -> Row:
    """The row of a worker's name; KeyError for an unknown worker."""
    found = [row for row in ROWS if name == row.name or name.startswith(f"{row.name} ")]
    if not found:
        raise KeyError(f"no row of ROWS is called {name!r}")
    return max(found, key=lambda row: len(row.name))


@dataclass(slots=True, eq=False)
class Worker:
    """A thread of the table, while it runs and for a while after."""

    name: str
    row: Row
    work: Callable[[Worker], None]
    restarts: int = 0
    fault: str = ""  # the last exception, in one line
    has_failed: bool = False  # the budget of restarts is spent
    is_done: bool = False
    beat_at: float = field(default_factory=time.monotonic)
    stop: threading.Event = field(default_factory=threading.Event)
    thread: threading.Thread | None = None
    depth: Callable[[], int] = lambda: 0  # entries in its queue
    lag_s: Callable[[], float] = lambda: 0.0  # age of the current or oldest entry

    @property
    def thread_id(self) -> int:
        """Of its thread, as the interpreter counts; 0 before it runs."""
        return (self.thread.ident if self.thread is not None else None) or 0

    def beat(self) -> None:
        self.beat_at = time.monotonic()

    @property
    def is_stalled(self) -> bool:
        """Whether it runs and has made no progress for its row's deadline. Only restarting workers
        are judged by their beats; the service judges a scan itself."""
        if self.row.deadline_s is None or not self.row.restarts or self.is_done:
            return False
        return time.monotonic() - self.beat_at > self.row.deadline_s

    @property
    def state(self) -> str:
        if self.has_failed:
            return "failed"
        if self.is_done:
            return "done"
        return "stalled" if self.is_stalled else "running"

    def join(self, timeout_s: float | None = None) -> bool:
        """Ask it to stop and wait for its end; False when it still runs."""
        self.stop.set()
        thread = self.thread
        if thread is None or thread is threading.current_thread():
            return True
        thread.join(timeout_s)
        return not thread.is_alive()

    def to_dict(self) -> dict[str, Any]:
        """For a report: name, state, restarts, last fault, and the bounds of its row."""
        return {
            "name": self.name,
            "state": self.state,
            "restarts": self.restarts,
            "fault": self.fault,
            "waiting": self.depth(),
            "lag_s": round(self.lag_s(), 3),
            "bound": self.row.bound,
            "when_full": self.row.full,
            "deadline_s": self.row.deadline_s,
            "stop": self.row.stop,
            "does": self.row.does,
        }


class Workers:
    """Workers that one owner starts, supervises and ends. Thread-safe."""

    def __init__(self, max_restarts: int = MAX_RESTARTS, pause_s: float = PAUSE_S) -> None:
        self._max_restarts, self._pause_s = max_restarts, pause_s
        self._lock = threading.Lock()
        self._workers: list[Worker] = []
        with _ALL_LOCK:
            _ALL.add(self)

    def start(
        self,
        row: str | Row,
        work: Callable[[Worker], None],
        depth: Callable[[], int] = lambda: 0,
        lag_s: Callable[[], float] = lambda: 0.0,
    ) -> Worker:
        """Run ``work(worker)`` on a thread until it returns; ``row`` is the worker's name.

        After an exception it is restarted where the row says so. ``work`` must end soon after
        ``worker.stop`` is set. ``depth`` and ``lag_s`` describe its queue, for the report.
        """
        name, row = (row, row_of(row)) if isinstance(row, str) else (row.name, row)
        worker = Worker(name, row, work, depth=depth, lag_s=lag_s)
        worker.thread = threading.Thread(
            target=self._supervise, args=(worker,), name=name, daemon=not row.is_awaited
        )
        with self._lock:
            failed = [w for w in self._workers if w.has_failed and w.name != name]
            running = [w for w in self._workers if not w.is_done]
            worker.thread.start()  # a RuntimeError leaves the table as it was
            self._workers = [*failed[-MAX_FAILED:], *running, worker]
        return worker

    def every(self, row: str, period_s: float, work: Callable[[], None]) -> Worker:
        """Run ``work()`` repeatedly with pauses of ``period_s``, also after faults."""

        def repeat(worker: Worker) -> None:
            while not worker.stop.wait(period_s):
                worker.fault = guarded(worker.name, work)

        return self.start(row, repeat)

    @property
    def failed(self) -> list[Worker]:
        """Essential workers that are no longer restarted: the process should end."""
        return [w for w in self.table() if w.has_failed and w.row.is_essential]

    @property
    def stalled(self) -> list[Worker]:
        return [worker for worker in self.table() if worker.is_stalled]

    def report(self) -> list[dict[str, Any]]:
        return [worker.to_dict() for worker in self.table()]

    def table(self) -> list[Worker]:
        with self._lock:
            return list(self._workers)

    def stop(self, patience_s: float = 1.0) -> None:
        """Stop all in the order of the table, each within ``patience_s``."""
        for worker in sorted(self.table(), key=lambda worker: worker.row.stop):
            worker.join(patience_s)

    def _supervise(self, worker: Worker) -> None:
        faults: deque[float] = deque()
        try:
            while True:
                worker.beat()
                fault = guarded(worker.name, lambda: worker.work(worker))
                if not fault:
                    return
                worker.fault = fault
                if worker.stop.is_set() or not worker.row.restarts:
                    return
                now = time.monotonic()
                faults.append(now)
                while faults[0] < now - WINDOW_S:
                    faults.popleft()
                if len(faults) > self._max_restarts:
                    worker.has_failed = True
                    log.critical("%s failed %d times; it stays off", worker.name, len(faults))
                    return
                worker.restarts += 1
                worker.stop.wait(self._pause_s)
        finally:
            worker.is_done = True
            worker.work = lambda _: None  # releases what it worked on
            worker.depth, worker.lag_s = (lambda: 0), (lambda: 0.0)


_ALL: weakref.WeakSet[Workers] = weakref.WeakSet()
_ALL_LOCK = threading.Lock()  # a set must not change while it is iterated
_PROCESSES: list[tuple[str, subprocess.Popen[bytes]]] = []

PROCESS = Workers()  # the workers without a closer supervisor


WITHOUT_THE_CURRENT_FOLDER = (
    "import sys; sys.path[:] = filter(None, sys.path); import runpy; "
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module of ours in a process of its own.

    ``python -m`` imports from the current folder first, which may be a stranger's card; its option
    -P needs Python 3.11.
    """
    return [sys.executable, "-c", WITHOUT_THE_CURRENT_FOLDER, module, *arguments]


def open_process(name: str, command: Sequence[str], **streams: Any) -> subprocess.Popen[bytes]:
    """Start a process of the table, with the ``streams`` of Popen; its owner ends it. Ctrl-C in a
    terminal does not reach it; its owner ends it in order."""
    row_of(name)
    _PROCESSES[:] = [(n, p) for n, p in _PROCESSES if p.poll() is None]
    process = subprocess.Popen(command, start_new_session=True, **streams)
    _PROCESSES.append((name, process))
    return process


@atexit.register
def end_processes() -> None:
    """Leave none behind: it would keep its port."""
    for _, process in _PROCESSES:
        process.terminate()  # one that has ended is left alone


def run_process(worker: Worker, row: str, command: Sequence[str]) -> None:
    """Keep a process of the table until the worker's stop, which ends its standard input too.
    Raises OutsideError when it ends before."""
    process = open_process(row, command, stdin=subprocess.PIPE)
    try:
        while not worker.stop.wait(LOOK_S):
            if process.poll() is not None:
                raise OutsideError(f"the process {row} ended, code {process.returncode}")
    finally:
        end_process(process)
        if process.stdin is not None:
            process.stdin.close()


def run_to_end(row: str, command: Sequence[str], goes_on: Callable[[str], bool]) -> str:
    """Run a process of the table with low priority, the first to go when the machine's memory runs
    out; why it failed, empty when it did not.

    ``goes_on`` gets the last line that it wrote to standard error, every :data:`LOOK_S`; False
    ends the process.
    """
    with tempfile.TemporaryFile() as said:
        streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": said}
        process = open_process(row, command, **streams)
        try:
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, process.pid, NICE)
                Path(f"/proc/{process.pid}/oom_score_adj").write_text("1000")
            while process.poll() is None:
                if not goes_on(_last_line(said)):
                    return ""
                time.sleep(LOOK_S)
        finally:
            end_process(process)
        return (_last_line(said) or "no reason given") if process.returncode else ""


def _last_line(file: IO[bytes]) -> str:
    """The last line of a log, from its last 2000 bytes."""
    size = os.fstat(file.fileno()).st_size
    text = os.pread(file.fileno(), 2000, max(size - 2000, 0)).decode(errors="replace")
    return (text.strip().splitlines() or [""])[-1][:300]


def end_process(
    process: subprocess.Popen[bytes], patience_s: float = 2.0, asks: int = signal.SIGTERM
) -> None:
    """Ask a process to end, by the signal ``asks``, and kill it when it does not."""
    process.send_signal(asks)
    try:
        process.wait(timeout=patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def running() -> list[dict[str, Any]]:
    """Running and failed threads and processes of this process, in the table's order. Threads that
    start themselves are found by name."""
    with _ALL_LOCK:
        groups = list(_ALL)
    workers = [w for group in groups for w in group.table() if w.has_failed or not w.is_done]
    ours = {worker.thread for worker in workers}
    found = [(worker.row, worker.to_dict()) for worker in workers]
    for name, process in list(_PROCESSES):
        if process.poll() is None:
            found.append((row_of(name), _plain(f"{name}, process {process.pid}", row_of(name))))
    for thread in threading.enumerate():
        rows = [row for row in ROWS if row.starts_itself and thread.name.startswith(row.name)]
        if rows and thread not in ours:
            found.append((rows[0], _plain(thread.name, rows[0])))
    found.sort(key=lambda pair: ROWS.index(pair[0]) if pair[0] in ROWS else len(ROWS))
    return [entry for _, entry in found]


def _plain(name: str, row: Row) -> dict[str, Any]:
    """The entry of a thread or process without a :class:`Worker`."""
    return Worker(name, row, lambda _: None).to_dict()


def guarded(name: str, work: Callable[[], object]) -> str:
    """Run ``work``; returns its exception in one line, empty without one."""
    try:
        work()
    except (SkyreliefError, OSError) as error:
        log.error("%s: %s", name, error)
        return str(error) or type(error).__name__
    except Exception as error:  # an internal fault; it must not end anything else
        log.exception("fault in %s", name)
        return f"{type(error).__name__}: {error}".splitlines()[0][:200]
    return ""
