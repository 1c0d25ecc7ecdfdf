"""One scan at a time: performs the effects of :class:`service.daemon.scan_state.ScanLife`.

Only this module catches errors of the environment during a scan.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.component.control import ACCEPTED, Answer, Phase, Result, Work
from mavlink.component.status import CRITICAL, WARNING
from mavlink.component.vehicle import VehicleLink
from service.config import Config
from service.daemon.load_shedding import Level
from service.daemon.resumption import Resumption
from service.daemon.scan_run import Equipment, ScanRun
from service.daemon.scan_state import Effect, Event, ScanLife, State
from service.daemon.warm_up import is_warm
from service.daemon.writing import Writings
from service.errors import InputError, SkyreliefError
from service.flight.datalink import DaemonLink
from service.memory import release_memory
from service.scans.retention import Claim
from service.workers import PROCESS, Worker, Workers

if TYPE_CHECKING:
    from recon.backends import Backend
    from recon.types import Camera
    from service.flight.scan import Scan
    from service.stream.store import ScanStore

log = logging.getLogger(__name__)


class Scanning:
    """Runs what :attr:`life` decides: an attempt at a scan (:attr:`run`), or none."""

    vehicle: VehicleLink
    """Telemetry and the operator; set by the owner of both, before the first scan."""

    def __init__(
        self,
        config: Config,
        *,
        attempt: Callable[[Equipment, bool], ScanRun] = ScanRun,
        life: ScanLife | None = None,
        resumption: Resumption | None = None,
        workers: Workers = PROCESS,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """``attempt`` makes a run from its equipment and whether a command waits for it."""
        self.config = config
        self.life = life or ScanLife()
        self.run: ScanRun | None = None
        self.fault = ""  # why the last attempt failed; cleared when another starts
        self.level = Level.FULL
        self.is_warm = is_warm()  # all kernels are compiled
        self.camera: Camera | None = None  # the model; None before it is loaded
        self.backend: Backend | None = None  # None before it is loaded
        self.link = DaemonLink()
        self.made: set[str] = set()  # names of the scans of this process
        self.resumption = resumption or Resumption(Path(config.scan.folder))
        self.claim = Claim()  # to the folder of scans; its holder manages earlier ones
        self.paused = threading.Event()  # set while no frames are taken
        self._attempt, self._workers, self._clock_s = attempt, workers, clock_s
        self._lock = threading.RLock()  # guards life, run, its closing, config and level
        self._worker: Worker | None = None  # of the run
        self._closing: Work | None = None  # ends with the run
        self._writings = Writings(lambda text: self.vehicle.statustext(text, WARNING))
        self._marks: tuple[Any, ...] | None = None  # of the closing, as seen last
        self._marked_s = 0.0  # when they changed

    def load(self) -> None:
        """Load camera model and backend, which takes long; InputError if they are unusable."""
        from service.cameras.camera_file import load_camera
        from service.compute.backend_choice import open_backend

        if not self.config.camera.source:
            raise InputError("camera.source is not set; give it in the configuration file")
        if not self.config.camera.model:
            raise InputError(
                "camera.model is not set; make one with 'skyrelief calibrate' and set it"
            )
        self.camera = load_camera(Path(self.config.camera.model))
        self.backend = open_backend(self.config.compute, self.camera.size_px)
        log.info("ready: backend %s", self.backend.name)

    # ---- events ------------------------------------------------------------------------------

    def handle(self, event: Event) -> State:
        """Take an event and perform its effects; the state before it."""
        with self._lock:
            before = self.life.state
            effects = self.life.handle(event, self._clock_s())
            for effect in effects:
                self._perform(effect)
            run = self.run
            if event is Event.GROWN:
                self.is_warm = True
        if Effect.CLOSE in effects and run is not None:
            run.close_camera()  # may take long
        return before

    def _perform(self, effect: Effect) -> None:
        match effect:
            case Effect.HOLD:
                self.paused.set()
            case Effect.RELEASE:
                self.paused.clear()
                if self.run is not None:
                    self.run.alive()
            case Effect.MARK if self.config.scan.start == "on-command":
                self.resumption.note()  # otherwise it starts by itself anyway
            case Effect.UNMARK:
                self.resumption.forget()
            case Effect.CLOSE if self.run is not None:
                self.run.stop.set()
            case Effect.OPEN:
                self._open()
            case Effect.OFFER:
                self.offer_backlog()

    def start(self) -> None:
        """Request a scan and start it, at once or after the one that is being closed."""
        with self._lock:
            self.handle(Event.START)
            self.handle(Event.TICK)

    def start_again(self, is_heard: bool, is_armed: bool) -> bool:
        """Resume the scan that a crash or a power cut ended; False when there is none."""
        with self._lock:
            is_due = self.resumption.is_due(is_heard, is_armed)
            if is_due:
                self.start()
            return is_due

    def finalise(self) -> Work | None:
        """Stop; returns the work of writing everything, or None when nothing runs."""
        with self._lock:
            if self.run is not None:
                self._closing = self._closing or Work()
            work = self._closing
        self.handle(Event.STOP)
        return work

    def end(self, wait: Callable[[], None] = lambda: None) -> None:
        """Close the running scan, wait for all files, and start no other.

        ``wait`` is called every second.
        """
        self.handle(Event.END)
        worker = self._worker
        while (worker is not None and not worker.is_done) or self._writings:
            wait()
            if worker is not None:
                worker.join(1.0)
            self._writings.wait(1.0)
        self.link.end_backlog(self.config.datalink.drain_s, wait)

    # ---- state ------------------------------------------------------------------------------

    @property
    def phase(self) -> Phase:
        return self.life.state.phase

    @property
    def scan(self) -> Scan | None:
        run = self.run
        return None if run is None else run.scan

    @property
    def scan_id(self) -> str:
        """Name of the running scan; empty without one."""
        scan = self.scan
        return scan.inputs.scan_id if scan is not None else ""

    @property
    def silent_s(self) -> float:
        """Seconds since the last processed frame; 0 while no scan takes frames."""
        run = self.run
        if run is None or self.life.state is not State.SCANNING:
            return 0.0
        return self._clock_s() - run.progress_s

    @property
    def idle_closing_s(self) -> float:
        """Seconds without progress in closing a scan; 0 while none is being closed.

        Call it often: progress is any change since the last call.
        """
        run, state = self.run, self.life.state
        marks: tuple[Any, ...] | None = None
        if run is not None and state.is_closing:
            marks = (*run.closing_marks(), *self._writings.marks())
        elif state is State.ENDED and self._writings:
            marks = self._writings.marks()
        now_s = self._clock_s()
        if marks is None or marks != self._marks:
            self._marks, self._marked_s = marks, now_s
        return now_s - self._marked_s

    @property
    def in_the_making(self) -> set[str]:
        """Names of the scans that must not be deleted: the running one, and those whose files are
        being written."""
        return {self.scan_id, *self._writings.names}

    # ---- changes in flight --------------------------------------------------------------------

    def configure(self, change: Callable[[Config], Config]) -> None:
        """Change the configuration in one step; live keys also change in the running scan.

        Raises what ``change`` raises; then nothing is changed.
        """
        with self._lock:
            self.config = config = change(self.config)
            if self.run is not None:
                self.run.configure(config, self.level)
            self.link.configure(config)

    def set_level(self, level: Level) -> None:
        """Change the load level, in this scan and in the next."""
        with self._lock:
            self.level = level
            if self.run is not None:
                self.run.configure(self.config, level)

    def offer_backlog(self) -> None:
        """Send earlier scans that the ground lacks while no scan runs."""
        if self.claim.is_ours:
            self.link.offer_backlog(self.config, lambda: self.life.state is State.IDLE)

    # ---- the scan's thread ------------------------------------------------------------------

    def _open(self) -> None:
        """Start an attempt at the wanted scan."""
        self.fault = ""
        equipment = Equipment(
            self.config, self.vehicle, self.link, self.camera, self.backend, self.level,
            self.paused, self.made, self.handle, self._write_files,
        )  # fmt: skip
        try:
            run = self.run = self._attempt(equipment, self.life.failures == 0)
            self._worker = self._workers.start(
                "scan", lambda _: self._carry_out(run), lag_s=lambda: run.busy_s
            )
        except Exception as error:  # such as no room for another thread
            self._end_run(_fault_of(error))

    def _carry_out(self, run: ScanRun) -> None:
        """Carry out the run; a fault is reported, and retried while a scan is wanted."""
        fault = ""
        try:
            run.carry_out()
        except Exception as error:
            fault = _fault_of(error)
        release_memory(collect=True)
        self._end_run(fault)

    def _end_run(self, fault: str) -> None:
        with self._lock:
            if fault:
                self.fault = fault
                log.error("%s", fault)
                is_first = self.life.failures == 0
                self.vehicle.statustext(f"Scan failed: {fault}", CRITICAL, is_answer=is_first)
            self.handle(Event.FAILED if fault else Event.DONE)
            if fault and self.life.state.is_wanted:
                log.warning("next attempt in %.1f s", self.life.due_s - self._clock_s())
            self.run = None
            closing, self._closing = self._closing, None
        if closing is not None:
            closing.finish(Answer(Result.FAILED, fault) if fault else ACCEPTED)

    def _write_files(self, folder: Path, store: ScanStore) -> None:
        """Write a scan's files, in the background when another scan is wanted meanwhile."""

        def end_sender() -> None:
            is_last = self.life.state in (State.ENDING, State.ENDED)
            self.link.end_scan(self.config, is_last=is_last)

        self._writings.write(
            folder, store, lambda: self.life.state.is_wanted, end_sender, self._hand_over
        )

    def _hand_over(self) -> Work | None:
        """Release a scan whose files are being written; returns the work that ends with them."""
        self.link.end_scan(self.config, is_next_wanted=True)
        with self._lock:
            work, self._closing = self._closing, None
        return work


def _fault_of(error: Exception) -> str:
    if isinstance(error, SkyreliefError | OSError):
        return str(error)
    log.error("the scan ended with an internal fault", exc_info=error)
    first, *_ = str(error).strip().splitlines() or [type(error).__name__]
    return f"internal fault: {first}"
