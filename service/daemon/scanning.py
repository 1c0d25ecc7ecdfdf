"""One scan at a time: starts the wanted scan, and retries it after a fault until it is stopped.

Only this module catches errors of the environment during a scan.
"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.component.control import ACCEPTED, Answer, Phase, Result, Work
from mavlink.component.status import CRITICAL, WARNING
from mavlink.component.vehicle import VehicleLink
from service.config import Config
from service.daemon.intent import Intent, Resumption, Wanted
from service.daemon.load_shedding import Level, lowered
from service.daemon.scan_run import ScanRun
from service.daemon.warm_up import is_warm
from service.daemon.writing import ClosingWatch, Writings
from service.errors import InputError, SkyreliefError
from service.flight.datalink import DaemonLink
from service.memory import give_back
from service.scans.retention import Claim
from service.workers import PROCESS, Worker, Workers

if TYPE_CHECKING:
    from collections.abc import Callable

    from recon.backends import Backend
    from recon.types import Camera
    from service.daemon.frame_gate import FrameGate
    from service.flight.scan import Scan
    from service.stream.store import ScanStore

log = logging.getLogger(__name__)


class Scanning:
    """Links the intent (:attr:`intent`) to the running scan (a :class:`ScanRun`, or none)."""

    vehicle: VehicleLink
    """Telemetry and the operator; set by the owner of both, before the first scan."""

    def __init__(
        self,
        config: Config,
        *,
        attempt: Callable[[Scanning, bool], ScanRun] = ScanRun,
        intent: Intent | None = None,
        resumption: Resumption | None = None,
        closing_watch: ClosingWatch | None = None,
        workers: Workers = PROCESS,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """``attempt`` makes a run from this object and whether a command waits for it."""
        self.config = config
        self.intent = intent or Intent()
        self.fault = ""  # why the last attempt failed; cleared when another starts
        self.level = Level.FULL
        self.is_warm = is_warm()  # all kernels are compiled
        self.camera: Camera | None = None  # the model; None before it is loaded
        self.link = DaemonLink()
        self.made: set[str] = set()  # names of the scans of this process
        self.resumption = resumption or Resumption(Path(config.scan.folder))
        self.claim = Claim()  # to the folder of scans; its holder manages earlier ones
        self.backend: Backend | None = None  # None before it is loaded
        self._attempt, self._workers, self._clock_s = attempt, workers, clock_s
        self._lock = threading.RLock()  # guards the intent, the run and the work of closing it
        self.run: ScanRun | None = None  # the current attempt
        self._worker: Worker | None = None  # of the run
        self._closing: Work | None = None  # ends with the run
        self._writings = Writings(lambda text: self.vehicle.statustext(text, WARNING))
        self._watch = closing_watch or ClosingWatch()

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

    # ---- intent ------------------------------------------------------------------------------

    def want(self) -> None:
        """Request a scan; :meth:`follow_intent` starts it."""
        with self._lock:
            is_new = not self.intent.wants_scan
            self.resume()
            self.intent.scan(self._clock_s())
            if is_new and self.intent.wants_scan and self.config.scan.start == "on-command":
                self.resumption.note()  # otherwise it starts by itself anyway

    def start(self) -> None:
        """Request a scan and start it, at once or after the one that is being closed."""
        with self._lock:
            self.want()
            self.follow_intent()

    def start_again(self, is_heard: bool, is_armed: bool) -> bool:
        """Resume the scan that a crash or a power cut ended; False when there is none."""
        with self._lock:
            is_due = self.resumption.is_due(is_heard, is_armed)
            if is_due:
                self.start()
            return is_due

    def stop(self) -> None:
        """Close the running scan, drop every retry, and forget a scan to resume."""
        with self._lock:
            self.intent.stop()
            self.resumption.forget()
            run = self.run
            if run is not None:
                run.stop.set()
        if run is not None:
            run.close_camera()

    def finalise(self) -> Work | None:
        """Stop; returns the work of writing everything, or None when nothing runs."""
        with self._lock:
            if self.run is not None:
                self._closing = self._closing or Work()
            work = self._closing
        self.stop()
        return work

    def pause(self) -> bool:
        """Take no frames until :meth:`resume`; False when no scan is wanted."""
        with self._lock:
            return self.intent.pause()

    def resume(self) -> bool:
        """Take frames again after a pause; False without a pause."""
        with self._lock:
            run = self.run
            if run is not None:
                run.alive()
            return self.intent.resume()

    def follow_intent(self) -> None:
        """Start the wanted scan when it is due and none runs; call it often."""
        with self._lock:
            if self.run is not None or not self.intent.is_due(self._clock_s()):
                return
            self.fault = ""
            run = self.run = self._attempt(self, self.intent.failures == 0)
            self._worker = self._workers.start(
                "scan", lambda _: self.carry_out(run), lag_s=lambda: run.busy_s
            )

    def fulfilled(self, run: ScanRun) -> None:
        """Note that the run's recording has ended by itself, which fulfils the request."""
        with self._lock:
            if not run.stop.is_set():
                run.stop.set()
                self.intent.stop()
                self.resumption.forget()

    # ---- state ------------------------------------------------------------------------------

    @property
    def phase(self) -> Phase:
        """The current phase."""
        with self._lock:
            if self.run is None or self.run.is_ending:
                if self.intent.wants_scan:
                    return Phase.WAITING
                return Phase.IDLE if self.run is None else Phase.FINALISING
            return Phase.PAUSED if self.intent.wanted is Wanted.PAUSE else Phase.SCANNING

    @property
    def is_running(self) -> bool:
        """True from the start of an attempt at a scan until its files are written."""
        return self.run is not None

    @property
    def is_closing(self) -> bool:
        """True from the end of a scan until its files are written."""
        run = self.run
        return run is not None and run.is_ending

    @property
    def scan(self) -> Scan | None:
        """The running scan."""
        run = self.run
        return None if run is None else run.scan

    @property
    def gate(self) -> FrameGate | None:
        """The gate between the camera and the running scan."""
        run = self.run
        return None if run is None else run.gate

    @property
    def scan_id(self) -> str:
        """Name of the running scan; empty without one."""
        scan = self.scan
        return scan.inputs.scan_id if scan is not None else ""

    @property
    def started_s(self) -> float:
        """Monotonic start time of the run; the current time without one."""
        run = self.run
        return time.monotonic() if run is None else run.started_s

    @property
    def busy_s(self) -> float:
        """Seconds spent on the current frame or view; 0 while waiting for the camera."""
        run = self.run
        return 0.0 if run is None else run.busy_s

    @property
    def progress_s(self) -> float:
        """Monotonic time of the last processed frame; the current time without a scan."""
        run = self.run
        return time.monotonic() if run is None else run.progress_s

    @property
    def silent_s(self) -> float:
        """Seconds since the last processed frame; 0 while no scan takes frames."""
        if self.phase is not Phase.SCANNING:
            return 0.0
        return time.monotonic() - self.progress_s

    def camera_news(self) -> list[str]:
        """Warnings of a running scan's camera since the last call."""
        run = self.run
        return [] if run is None else run.camera_news()

    @property
    def idle_closing_s(self) -> float:
        """Seconds without progress in closing a scan; 0 while none is being closed.

        Call it often: progress is any change since the last call.
        """
        run = self.run
        is_last = self.intent.is_over and len(self._writings) > 0
        if run is not None and run.is_ending:
            marks: tuple[Any, ...] | None = (*run.closing_marks(), *self._writings.marks())
        else:
            marks = self._writings.marks() if is_last else None
        return self._watch.look(marks)

    @property
    def in_the_making(self) -> set[str]:
        """Names of the scans that must not be deleted: the running one, and those whose files are
        being written."""
        return {self.scan_id, *self._writings.names}

    @property
    def backend_name(self) -> str:
        """Name of the backend in use; empty during start-up."""
        return self.backend.name if self.backend is not None else ""

    @property
    def backend_failure(self) -> str:
        """Why the CPU replaced the chosen backend; empty when it did not."""
        if self.backend is None:
            return ""
        from service.compute.backend_choice import FallbackBackend

        return (isinstance(self.backend, FallbackBackend) and self.backend.failure) or ""

    # ---- changes in flight --------------------------------------------------------------------

    def follow(self, config: Config) -> None:
        """Use another configuration; live keys also change in the running scan."""
        self.config = config
        scan = self.scan
        if scan is not None:
            scan.pipeline.set_baseline(config.scan)
            scan.check.set_camera(config.camera)
        self.link.follow(config)

    def set_level(self, level: Level) -> None:
        """Change the load level, in this scan and in the next."""
        self.level = level
        scan, gate = self.scan, self.gate
        if scan is not None and gate is not None:
            scan.pipeline.set_effort(lowered(self.config.compute, level))
            gate.level = level

    def end(self, wait: Callable[[], None] = lambda: None) -> None:
        """Close the running scan, wait for all files, and start no other.

        ``wait`` is called every second.
        """
        with self._lock:
            self.intent.end()
            worker = self._worker
        self.stop()
        while (worker is not None and not worker.is_done) or self._writings:
            wait()
            if worker is not None:
                worker.join(1.0)
            self._writings.wait(1.0)
        self.link.rest(self.config.datalink.drain_s, wait)

    def offer_backlog(self) -> None:
        """Send earlier scans that the ground lacks while no scan runs."""
        if self.claim.is_ours:
            self.link.offer_backlog(
                self.config, lambda: self.phase is Phase.IDLE and not self.intent.is_over
            )

    # ---- the scan's thread ------------------------------------------------------------------

    def carry_out(self, run: ScanRun) -> None:
        """Carry out the run; a fault is reported, and retried while a scan is wanted."""
        fault = ""
        try:
            run.carry_out()
            self.fulfilled(run)
        except (SkyreliefError, OSError) as error:
            fault = str(error)
        except Exception as error:
            log.exception("the scan ended with an internal fault")
            first, *_ = str(error).strip().splitlines() or [type(error).__name__]
            fault = f"internal fault: {first}"
        give_back(collect=True)
        with self._lock:
            if fault:
                self._failed(fault)
            self.run = None
            closing, self._closing = self._closing, None
        if closing is not None:
            closing.finish(Answer(Result.FAILED, fault) if fault else ACCEPTED)
        self.offer_backlog()

    def _failed(self, fault: str) -> None:
        self.fault = fault
        log.error("%s", fault)
        is_first = self.intent.failures == 0
        self.vehicle.statustext(f"Scan failed: {fault}", CRITICAL, is_answer=is_first)
        if self.intent.wants_scan:
            log.warning("next attempt in %.1f s", self.intent.failed(self._clock_s()))

    def equipment(self) -> tuple[Camera, Backend]:
        """The camera's model and the backend."""
        assert self.camera is not None and self.backend is not None
        return self.camera, self.backend

    def write_files(self, folder: Path, store: ScanStore) -> None:
        """Write a scan's files, in the background when another scan is wanted meanwhile."""

        def land() -> None:
            self.link.land(self.config, is_last=self.intent.is_over)

        self._writings.write(folder, store, lambda: self.intent.wants_scan, land, self._hand_over)

    def _hand_over(self) -> Work | None:
        """Release a scan whose files are being written; returns the work that ends with them."""
        self.link.land(self.config, in_haste=True)
        with self._lock:
            work, self._closing = self._closing, None
        return work
