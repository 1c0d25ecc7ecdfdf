"""One scan at a time: performs the effects of :class:`service.daemon.scan_state.ScanLife`.

The attempt at a scan runs on the worker ``scan``: open the camera, scan, close the scan. Its files
are written on the worker ``files``, so that a flight that begins meanwhile does not wait for them;
the stored data is safe by then, and the next start writes files that are missing. Only this module
catches errors of the environment during a scan.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from operator import sub
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.component.camera import KeyframeReport
from mavlink.component.control import ACCEPTED, Answer, Phase, Result, Work
from mavlink.component.status import CRITICAL, WARNING
from mavlink.component.vehicle import VehicleLink
from mavlink.telemetry.clock import agree, computer_offset_ns
from service.config import Config, change
from service.daemon.datalink import DaemonLink
from service.daemon.load_shedding import GRACE_S, Level, MachineReadings, lowered
from service.daemon.resumption import Resumption
from service.daemon.scan_state import (
    FIRST_RETRY_S,
    LAST_RETRY_S,
    Effect,
    Event,
    ScanLife,
    State,
)
from service.daemon.warm_up import is_warm
from service.errors import InputError, OutsideError, SkyreliefError
from service.memory import release_memory
from service.scans.retention import Claim
from service.workers import PROCESS, Worker, Workers, guarded

if TYPE_CHECKING:
    from recon.backends import Backend
    from recon.tracking.frame import Frame
    from recon.types import F64, Camera, Keyframe
    from service.cameras.source import CameraSource
    from service.daemon.frame_gate import FrameGate
    from service.flight.scan import Scan, ScanInputs
    from service.stream.store import ScanStore

log = logging.getLogger(__name__)

LATER, PHOTOS = "later", "photos"
"""Subfolders of a scan: images that are only stored, and those that operators asked for."""

OTHERS = ("scan.db", "link.tlog")


@dataclass(eq=False)
class ScanRun:
    """One attempt at a scan, from opening the camera until its files are written."""

    is_asked: bool  # a command waits for it; it is not a retry
    clock_s: Callable[[], float] = time.monotonic
    folder: Path | None = None  # from before its store exists
    scan: Scan | None = None  # like the gate and the store, once the camera is open
    gate: FrameGate | None = None
    store: ScanStore | None = None
    is_feeding: bool = False  # frames go into the scan
    has_grown: bool = False
    stop: threading.Event = field(default_factory=threading.Event)
    workers: list[Worker] = field(default_factory=list)  # its own, and that of its files
    is_left: bool = False  # its files are being written, and another scan did not wait for them
    work: Work | None = None  # of a command that waits for its end
    warnings_reported: int = 0  # camera warnings reported so far
    _photos: set[int] = field(default_factory=set)  # times of the frames reported as photos
    _counted: tuple[int, ...] = (0, 0, 0, 0)

    def __post_init__(self) -> None:
        self.started_s = self.progress_s = self.clock_s()

    @property
    def busy_s(self) -> float:
        """Seconds spent on the current frame or view; 0 while waiting for the camera."""
        scan, gate = self.scan, self.gate
        if scan is None or gate is None or not self.is_feeding:
            return 0.0
        return max(gate.busy_s, scan.worker.busy_s)

    def alive(self) -> None:
        self.progress_s = self.clock_s()

    def new_camera_warnings(self) -> list[str]:
        gate = self.gate
        fresh = [] if gate is None else gate.warnings[self.warnings_reported :]
        self.warnings_reported += len(fresh)
        return fresh

    def closing_marks(self) -> tuple[Any, ...]:
        """Values that change when closing makes progress: uses of the store, keyframes, files."""
        scan, store, folder = self.scan, self.store, self.folder
        return (
            None if scan is None else scan.recorder.keyframes,
            None
            if store is None
            else [store.database.uses[worker.thread_id] for worker in self.workers],
            None if folder is None else sizes(folder),
        )

    def finish(self, fault: str) -> None:
        if self.work is not None:
            self.work.finish(Answer(Result.FAILED, fault) if fault else ACCEPTED)

    def configure(self, config: Config, level: Level) -> None:
        scan, gate = self.scan, self.gate
        if scan is not None and gate is not None:
            scan.configure(config, lowered(config.compute, level))
            gate.level = level

    def lag(self) -> MachineReadings:
        """Views and frames since the last call, and how late they were; none at the start."""
        scan, gate = self.scan, self.gate
        if scan is None or gate is None:
            return MachineReadings()
        dropped, late = scan.worker.dropped, gate.dropped
        counted = scan.recorder.keyframes + dropped, dropped, gate.frames + late, late
        views, late_views, frames, late_frames = map(sub, counted, self._counted)
        self._counted = counted
        if self.clock_s() - self.started_s < GRACE_S:
            return MachineReadings()
        age_s = gate.age_s if frames > late_frames else 0.0
        return MachineReadings(views, late_views, frames, late_frames, age_s)

    def lag_figures(self) -> dict[str, float]:
        """Counts of late frames and views, and of images that were only stored."""
        scan, gate = self.scan, self.gate
        if scan is None or gate is None:
            return {}
        return {
            "frame_age_s": round(gate.age_s, 3),
            "frames_late": gate.dropped,
            "views_late": scan.worker.dropped,
            "pictures_kept": gate.kept,
            "pictures_lost": gate.lost,
        }

    # ---- reports to ground stations ----------------------------------------------------------

    def report_keyframe(self, vehicle: VehicleLink, keyframe: Keyframe) -> None:
        """Report a keyframe at its current pose, unless it was a photo."""
        scan = self.scan
        if scan is None or keyframe.time_ns in self._photos:
            return
        state = vehicle.history.state_at(keyframe.time_ns)
        T = keyframe.pose.T_world_camera
        agl_m = None if state is None else state.alt_agl_m
        vehicle.report_keyframe(_report(scan, keyframe.time_ns, T[:3, :3], T[:3, 3], agl_m))

    def report_photo(self, vehicle: VehicleLink, photo: Frame) -> None:
        """Store a photo and report it, or why that failed."""
        from service.daemon.stored_image import image_name, store_image

        scan, tag = self.scan, photo.prior
        if scan is None:
            return
        self._photos.add(photo.time_ns)
        name = f"{PHOTOS}/{image_name(photo.time_ns + scan.inputs.unix_offset_ns)}"
        report = _report(
            scan, photo.time_ns, tag.R_world_camera, tag.position_m, tag.agl_m,
            f"{scan.inputs.scan_id}/{name}",
        )  # fmt: skip
        try:
            store_image(scan.inputs.folder / name, photo.image, report)
        except OSError as error:
            why = f"photo failed: {error.strerror or error}"
            vehicle.statustext(why, WARNING, is_answer=True)
            report = KeyframeReport(ok=False)
        vehicle.report_keyframe(report)


class Scanning:
    """Runs what :attr:`life` decides: an attempt at a scan (:attr:`run`), or none."""

    vehicle: VehicleLink
    """Telemetry and the operator; set by the owner of both, before the first scan."""

    def __init__(
        self,
        config: Config,
        *,
        attempt: Callable[[ScanRun], object] | None = None,
        opener: Callable[[str], CameraSource] | None = None,
        write: Callable[[Path, ScanStore], object] | None = None,
        life: ScanLife | None = None,
        resumption: Resumption | None = None,
        workers: Workers = PROCESS,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """``attempt`` carries out a run (default: a scan with the camera); ``opener`` opens the
        camera (``service.cameras.open_camera``); ``write`` writes a scan's files (deliverables)."""
        self.config = config
        self.life = life or ScanLife()
        self.run: ScanRun | None = None
        self.fault = ""  # why the last attempt failed; cleared when another starts
        self.level = Level.FULL
        self.is_warm = is_warm()  # all kernels are compiled
        self.camera: Camera | None = None  # the model; None before it is loaded
        self.backend: Backend | None = None  # None before it is loaded
        self.link = DaemonLink()
        self.made: set[str] = set()  # names of the scans of this process, before their stores exist
        self.resumption = resumption or Resumption(Path(config.scan.folder))
        self.claim = Claim()  # to the folder of scans; its holder manages earlier ones
        self.paused = threading.Event()  # set while no frames are taken
        self._attempt, self._opener, self._write = attempt or self._try, opener, write
        self._workers, self._clock_s = workers, clock_s
        self._lock = threading.RLock()  # guards life, run, its end, config and level
        self._runs: list[ScanRun] = []  # those whose workers run, the newest last
        self._marks: list[Any] | None = None  # of the closing, as seen last
        self._marked_s = 0.0  # when they changed
        self._following: CameraSource | None = None  # the camera, open, for the next run
        self._is_reshaped = False  # it went over to images of another shape, of this wanted scan

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
            scan = self.scan
            if event is Event.GROWN:
                self.is_warm = True
            unused = None
            if not self.life.state.is_wanted:
                unused, self._is_reshaped = self._take_following(), False
        if Effect.CLOSE in effects and scan is not None:
            scan.source.close()  # wakes it where the camera is dead; may take long
        if unused is not None:
            unused.close()
        if Effect.UNMARK in effects and event is not Event.STOP:  # :meth:`stop` waits elsewhere
            self.resumption.settle()
        return before

    def _take_following(self) -> CameraSource | None:
        following, self._following = self._following, None
        return following

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

    def stop(self) -> Work:
        """Drop the wanted scan; the work ends once no power cut can bring it back."""
        self.handle(Event.STOP)
        work = Work(is_brief=True)

        def settle(_: Worker) -> None:
            self.resumption.settle()
            work.finish()

        self._workers.start("stop", settle)
        return work

    def finalise(self) -> Work:
        """Stop; the work ends once everything is written."""
        with self._lock:
            run = self.run
            if run is not None:
                run.work = run.work or Work()
        stopped = self.stop()
        return stopped if run is None or run.work is None else run.work

    def end(self, wait: Callable[[], None] = lambda: None) -> None:
        """Close the running scan, wait for all files, and start no other. ``wait`` is called every
        second."""
        self.handle(Event.END)
        while workers := [w for run in self._runs for w in run.workers if not w.is_done]:
            wait()
            workers[0].join(1.0)
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
    def silent_s(self) -> float:
        """Seconds since the last processed frame; 0 while no scan takes frames."""
        run = self.run
        if run is None or self.life.state is not State.SCANNING:
            return 0.0
        return self._clock_s() - run.progress_s

    @property
    def idle_closing_s(self) -> float:
        """Seconds without progress in closing a scan; 0 while none is being closed. Call it often:
        progress is any change since the last call."""
        runs, state, marks = self._live(), self.life.state, None
        if runs and (state.is_closing or state is State.ENDED):
            marks = [run.closing_marks() for run in runs]
        now_s = self._clock_s()
        if marks is None or marks != self._marks:
            self._marks, self._marked_s = marks, now_s
        return now_s - self._marked_s

    @property
    def in_the_making(self) -> set[str]:
        """Names of the scans that must not be deleted: the running one, and those whose files are
        being written."""
        return {run.folder.name for run in self._live() if run.folder is not None}

    def _live(self) -> list[ScanRun]:
        return [run for run in self._runs if not all(w.is_done for w in run.workers)]

    # ---- changes in flight --------------------------------------------------------------------

    def configure(self, change: Callable[[Config], Config]) -> None:
        """Change the configuration in one step; live keys also change in the running scan. Raises
        what ``change`` raises; then nothing is changed."""
        with self._lock:
            self.config = change(self.config)
            self._apply()

    def set_level(self, level: Level) -> None:
        with self._lock:
            self.level = level
            self._apply()

    def _apply(self) -> None:
        if self.run is not None:
            self.run.configure(self.config, self.level)
        self.link.configure(self.config)

    def offer_backlog(self) -> None:
        """Send earlier scans that the ground lacks while no scan runs."""
        if self.claim.is_ours:
            self.link.offer_backlog(self.config, lambda: self.life.state is State.IDLE)

    # ---- the scan's thread ------------------------------------------------------------------

    def _open(self) -> None:
        self.fault = ""
        run = self.run = ScanRun(self.life.failures == 0, self._clock_s)
        self._runs = [*self._live(), run]
        try:
            worker = self._workers.start(
                "scan", lambda _: self._carry_out(run), lag_s=lambda: run.busy_s
            )
            run.workers.append(worker)
        except Exception as error:  # such as no room for another thread
            self._end_run(run, _fault_of(error))

    def _carry_out(self, run: ScanRun) -> None:
        """Carry out the run; a fault is reported, and retried while a scan is wanted."""
        fault = ""
        try:
            self._attempt(run)
        except Exception as error:
            fault = _fault_of(error)
        run.scan = run.gate = None
        release_memory(collect=True)
        self._end_run(run, fault)

    def _end_run(self, run: ScanRun, fault: str) -> None:
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
        if run.work is not None:  # and from here on none can ask for it
            self.resumption.settle()
        if not run.is_left:
            run.finish(fault)

    def _try(self, run: ScanRun) -> None:
        """Scan until stopped or the recording ends, then close the scan and write its files."""
        source = self._open_camera(run)
        if source is not None:
            with closing(source):
                self._scan(run, source)

    def _open_camera(self, run: ScanRun) -> CameraSource | None:
        """The camera at its own pace, retried until it answers; None when stopped meanwhile."""
        from service.cameras import open_camera
        from service.cameras.source import QueuedSource

        with self._lock:
            following = self._take_following()
        if following is not None:
            return following
        wait_s, is_answer = FIRST_RETRY_S, run.is_asked
        while not run.stop.is_set():
            began_s = time.monotonic()
            try:
                source = (self._opener or open_camera)(self.config.camera.source)
                source.is_reshaped = self._is_reshaped
                return source if isinstance(source, QueuedSource) else QueuedSource(source)
            except OutsideError as error:
                log.warning("%s; trying again", error)
                self.vehicle.statustext(f"Camera: {error}", WARNING, is_answer=is_answer)
                is_answer = False
                # A source that listens for a sender is open again at once.
                run.stop.wait(max(0.0, began_s + wait_s - time.monotonic()))
                wait_s = min(2 * wait_s, LAST_RETRY_S)
        return None

    def _scan(self, run: ScanRun, source: CameraSource) -> None:
        from service.flight.scan import Scan, create_store

        vehicle = self.vehicle
        inputs, gate = self._inputs(run, source)
        store = create_store(inputs)
        with ExitStack() as on_fault:  # nothing is sent or recorded of a scan that cannot begin
            on_fault.callback(store.close)
            scan = Scan(inputs, store)
            on_fault.pop_all()
        clocks = disagreement(inputs.unix_offset_ns)
        gate.warnings += clocks
        for text in (*inputs.notes, *clocks):
            vehicle.statustext(text, WARNING)
        run.warnings_reported = len(gate.warnings)
        vehicle.record(inputs.folder / "link.tlog", inputs.unix_offset_ns)
        self.link.begin_scan(store, self.config, vehicle)
        with self._lock:
            run.store, run.gate, run.scan = store, gate, scan
            self._apply()  # what was configured since
        vehicle.statustext(f"Scan {inputs.scan_id} started")
        try:
            self._feed(run, scan, source)
        finally:
            source.close()
            vehicle.record(None)
            try:
                gate.warnings += set_since(inputs.unix_offset_ns, vehicle.unix_offset_ns())
                self._close_scan(scan, store)
            finally:
                self.write_files(run, store)

    def _inputs(self, run: ScanRun, source: CameraSource) -> tuple[ScanInputs, FrameGate]:
        from service.cameras.camera_file import seeks_readout
        from service.cameras.lens import fitted
        from service.daemon.camera_memory import measured
        from service.daemon.frame_gate import FrameGate
        from service.daemon.vehicle_reports import OdometryReport
        from service.flight.scan import ScanInputs

        vehicle, config, backend = self.vehicle, self.config, self.backend
        assert self.camera is not None and backend is not None
        camera, notes = fitted(self.camera, source)
        scans = Path(config.scan.folder)
        earlier = measured(scans, source.description, source.size_px)
        if earlier.shutter is not None and seeks_readout(camera, config.camera):
            camera = replace(camera, shutter=earlier.shutter)
            config = change(config, "camera.readout_ms", "auto")  # sought on from there
        now_ns, start_ns = time.monotonic_ns(), source.start_monotonic_ns
        zero_ns = now_ns if start_ns is None else start_ns
        offset_ns = vehicle.unix_offset_ns()
        odometry = OdometryReport(config.camera, vehicle.report_odometry).send
        folder = run.folder = new_folder(scans, 1e-9 * (now_ns + offset_ns))
        self.made.add(folder.name)
        gate = FrameGate(source, folder / LATER, zero_ns + offset_ns, run.alive, self.paused)
        inputs = ScanInputs(
            gate,
            camera,
            config,
            backend,
            folder,
            folder.name,
            zero_ns,
            unix_offset_ns=offset_ns,
            notes=tuple(notes),
            history=vehicle.history,
            sigma_focal=camera.sigma_focal,
            extra={"backend": backend.name, "source": source.description},
            latency_ms=earlier.latency_ms,
            warn=lambda text: vehicle.statustext(text, WARNING),
            on_frame=odometry if config.mavlink.odometry else None,
            on_keyframe=partial(run.report_keyframe, vehicle),
            on_photo=partial(run.report_photo, vehicle),
        )
        return inputs, gate

    def _feed(self, run: ScanRun, scan: Scan, source: CameraSource) -> None:
        """Feed frames into the scan until it is stopped, the recording ends or the images change
        their shape: another scan follows then."""

        def on_frame(_: Scan) -> None:
            run.alive()
            if scan.recorder.keyframes > 1 and not run.has_grown:
                run.has_grown = True
                self.handle(Event.GROWN)

        event, run.is_feeding = Event.INTERRUPTED, True
        try:
            scan.run(run.stop, on_frame, self.paused)
            with self._lock:
                if not run.stop.is_set():
                    self._following = source.following()
                    self._is_reshaped |= self._following is not None
            event = Event.COMPLETED if self._following is None else Event.INTERRUPTED
        finally:
            run.is_feeding = False
            self.handle(event)

    def _close_scan(self, scan: Scan, store: ScanStore) -> None:
        """Finish the scan; if the pipeline fails, mark the stored part as interrupted."""
        with ExitStack() as on_fault:
            on_fault.callback(store.finish, {"interrupted": True})
            summary = scan.close()
            on_fault.pop_all()
        self.vehicle.statustext(
            f"Scan {scan.inputs.scan_id}: {summary['clouds']} clouds, {summary['distance_m']:.0f} m"
        )

    def write_files(self, run: ScanRun, store: ScanStore) -> None:
        """Write a scan's files, and leave them to their worker when another scan is wanted
        meanwhile. Raises OutsideError when they cannot be written."""
        folder, is_written, fault = store.path.parent, threading.Event(), ""

        def write(_: Worker) -> None:
            nonlocal fault
            from service.scans.folder import write_deliverables

            files = partial(self._write or write_deliverables, folder, store)
            fault = guarded(f"files of {folder.name}", files)
            with self._lock:
                is_written.set()
            if run.is_left:
                store.close()
                if fault:
                    text = f"Scan {folder.name} is stored, its files are not written: {fault}"
                    self.vehicle.statustext(text, WARNING)
                with self._lock:
                    run.is_left = False
                run.finish(fault)

        run.workers.append(self._workers.start("files", write))
        while not is_written.wait(0.1):
            if self.life.state.is_wanted:
                self.link.end_scan(self.config, is_next_wanted=True)
                with self._lock:
                    is_left = run.is_left = not is_written.is_set()
                if is_left:
                    return
        is_last = self.life.state in (State.ENDING, State.ENDED)
        self.link.end_scan(self.config, is_last=is_last)
        store.close()
        if fault:
            raise OutsideError(fault)


def _fault_of(error: Exception) -> str:
    if isinstance(error, SkyreliefError | OSError):
        return str(error)
    log.error("the scan ended with an internal fault", exc_info=error)
    first, *_ = str(error).strip().splitlines() or [type(error).__name__]
    return f"internal fault: {first}"


def _report(
    scan: Scan, time_ns: int, R_world_camera: F64 | None, position_m: F64 | None,
    agl_m: float | None, file: str = "",
) -> KeyframeReport:  # fmt: skip
    from service.daemon.vehicle_reports import keyframe_report

    unix_ns, frame = time_ns + scan.inputs.unix_offset_ns, scan.rig.local_frame
    return keyframe_report(unix_ns, R_world_camera, position_m, frame, agl_m, file)


def sizes(folder: Path) -> tuple[tuple[str, int], ...]:
    """Name and bytes of each file that closing writes into a scan's folder. The store and the
    link's log are left out, because others write them too."""
    with suppress(OSError):  # it is not there yet, or a file was renamed meanwhile
        files = (path for path in folder.iterdir() if not path.name.startswith(OTHERS))
        return tuple(sorted((path.name, path.stat().st_size) for path in files))
    return ()


def new_folder(scans: Path, unix_s: float) -> Path:
    """The folder of a scan that starts now; a name that is taken, as by a clock that stands still
    or was set back, is followed by the next second's."""
    while True:
        folder = scans / time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(unix_s))
        if not os.path.exists(folder):
            return folder
        unix_s += 1.0


def disagreement(offset_ns: int) -> list[str]:
    """A warning if a scan with this offset (unix time minus monotonic clock) does not use the
    computer's clock, else nothing."""
    own_ns = computer_offset_ns()
    if agree(offset_ns, own_ns):
        return []
    return [f"Companion's clock is {_apart(own_ns - offset_ns)}: using the autopilot's"]


def set_since(offset_ns: int, now_ns: int) -> list[str]:
    """How far the times of a scan with ``offset_ns`` are off by the current one, else nothing."""
    if agree(offset_ns, now_ns):
        return []
    return [
        "the clock was set while scanning, or the autopilot sent the time late: the scan's "
        f"times are {_apart(offset_ns - now_ns)}"
    ]


def _apart(ahead_ns: int) -> str:
    seconds = abs(ahead_ns) / 1e9
    unit_s, unit = next(u for u in ((86_400, "days"), (3600, "h"), (1, "s")) if seconds >= u[0])
    return f"{seconds / unit_s:.0f} {unit} {'ahead' if ahead_ns > 0 else 'behind'}"
