"""The scan's thread: open the camera, scan, close the scan, and scan again after a fault.

This is the only place that catches what the outside world throws at a scan.
"""

from __future__ import annotations

import logging
import threading
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.control import ACCEPTED, Answer, Phase, Result, Work
from mavlink.status import CRITICAL, WARNING
from mavlink.vehicle import VehicleLink
from service.config import Config
from service.daemon.closing import ClosingWatch
from service.daemon.degradation import Level, lowered
from service.daemon.memory import fill_small_caches, give_back
from service.daemon.resumption import Resumption
from service.daemon.scan_reports import odometry_reporter, tell_keyframe
from service.daemon.scan_time import disagreement, set_since
from service.daemon.warm_up import is_warm
from service.daemon.writing import Writings
from service.errors import InputError, OutsideError, SkyreliefError
from service.onboard.datalink import DaemonLink
from service.scans.claim import Claim

if TYPE_CHECKING:
    from collections.abc import Callable

    from recon.backends import Backend
    from recon.types import Camera, Keyframe
    from service.cameras.source import CameraSource
    from service.daemon.frame_gate import FrameGate
    from service.onboard.scan import Scan
    from service.stream.store import ScanStore

log = logging.getLogger(__name__)

FIRST_RETRY_S, LAST_RETRY_S = 1.0, 8.0
"""Back-off between attempts to open a camera or to scan again; names of scans are seconds."""


LATER = "later"
"""Folder within a scan's for pictures that were only kept."""


class Scanning:
    """One scan at a time, on a thread of its own."""

    vehicle: VehicleLink
    """Telemetry and the operator; set by who owns both, before the first scan."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.phase = Phase.IDLE
        self.fault = ""
        self.scan: Scan | None = None
        self.gate: FrameGate | None = None
        self.level = Level.FULL
        self.is_warm = is_warm()  # nothing is left to compile
        self.started_s = self.progress_s = time.monotonic()
        self._backend: Backend | None = None
        self.camera: Camera | None = None  # the model; None before it is loaded
        self._stop, self._ended = threading.Event(), threading.Event()
        self._paused = threading.Event()
        self._worker: threading.Thread | None = None
        self._starting = threading.Lock()  # by a command, by arming, or again after a fault
        self._in_haste = threading.Event()  # another scan is to begin
        self._writings = Writings(lambda text: self.vehicle.statustext(text, WARNING))
        self._closing: Work | None = None
        self._watch = ClosingWatch()
        self._store: ScanStore | None = None  # of the scan that runs
        self._retry_at_s: float | None = None
        self._retry_s = FIRST_RETRY_S
        self._latency_ms: float | None = None  # of the camera, as the last scan found it
        self.link = DaemonLink()
        self.made: set[str] = set()  # names of the scans of this process
        self._news_told = 0  # of the camera's warnings
        self.resumption = Resumption(Path(config.scan.folder))
        self.claim = Claim()  # to the folder of scans: whoever has it looks after earlier ones

    def load(self) -> None:
        """The heavy part of the start: camera model and backend; InputError without them."""
        from service.cameras.camera_file import load_camera
        from service.compute.opening import open_backend

        if not self.config.camera.source:
            raise InputError("camera.source is not set; give it in the configuration file")
        if not self.config.camera.model:
            raise InputError(
                "camera.model is not set; make one with 'skyrelief calibrate' and name it"
            )
        self.camera = load_camera(Path(self.config.camera.model))
        self._backend = open_backend(self.config.compute, self.camera.size_px)
        fill_small_caches()
        log.info("ready: backend %s", self._backend.name)

    # ---- what may be asked of it -----------------------------------------------------------

    @property
    def is_running(self) -> bool:
        """True from the start of a scan until its files are written."""
        return self._worker is not None and self._worker.is_alive()

    @property
    def scan_id(self) -> str:
        """Of the scan that runs; else empty."""
        scan = self.scan
        return scan.inputs.scan_id if scan is not None else ""

    def start(self) -> None:
        """Start a scan; nothing happens while one is running."""
        with self._starting:
            if self.is_running:
                return
            self.fault = ""
            self._retry_at_s = None
            self._stop.clear()
            self._paused.clear()
            self._in_haste.clear()
            if self.config.scan.start == "on-command":  # else it starts by itself anyway
                self.resumption.note()
            self.phase = Phase.SCANNING
            self.started_s = self.progress_s = time.monotonic()
            self._worker = threading.Thread(target=self._work, name="scan", daemon=True)
            self._worker.start()

    def start_next(self) -> None:
        """Start a scan as soon as the one that is being closed is safe in its store.

        Its files are written beside the new scan, where this computer's kernels can run on two
        threads at once; else the new scan waits for them.
        """
        self._retry_at_s = time.monotonic()
        self._in_haste.set()

    def stop(self) -> None:
        """Close the running scan, also where it waits for a dead camera, and start no other."""
        self._retry_at_s = None
        self._in_haste.clear()
        self._stop_feeding()

    def _stop_feeding(self) -> None:
        self._stop.set()
        self.resumption.forget()
        scan = self.scan
        if scan is not None:
            scan.source.close()

    def finalise(self) -> Work:
        """Close the running scan; done when everything is written out."""
        work = self._closing = self._closing or Work()
        self._stop_feeding()
        return work

    def pause(self) -> None:
        """Take no frames until :meth:`resume`."""
        self._paused.set()
        self.phase = Phase.PAUSED

    def resume(self) -> None:
        """Go on after a pause."""
        self._paused.clear()
        self.phase = Phase.SCANNING
        self.progress_s = time.monotonic()

    def follow(self, config: Config) -> None:
        """Work by another configuration: what can change in flight also in the scan that runs."""
        self.config = config
        scan = self.scan
        if scan is not None:
            scan.pipeline.set_baseline(config.scan)
            scan.check.set_camera(config.camera)
        self.link.follow(config)

    @property
    def busy_s(self) -> float:
        """Seconds for which one frame or view has been worked on; 0 while the camera is awaited."""
        scan, gate = self.scan, self.gate
        if scan is None or gate is None or self.phase is not Phase.SCANNING:
            return 0.0
        return max(gate.busy_s, scan.pipeline.busy_s)

    def camera_news(self) -> list[str]:
        """What has gone wrong with the camera of a running scan since this was asked last."""
        gate = self.gate
        if gate is None or self.phase is not Phase.SCANNING:
            return []
        fresh = gate.warnings[self._news_told :]
        self._news_told += len(fresh)
        return fresh

    @property
    def silent_s(self) -> float:
        """Seconds since a frame was done; 0 while no scan runs or it is paused."""
        is_scanning = self.phase is Phase.SCANNING
        return time.monotonic() - self.progress_s if is_scanning else 0.0

    @property
    def idle_closing_s(self) -> float:
        """Seconds for which the closing of a scan has not got on; 0 while none is closed.

        To be asked often: progress is what has changed since it was asked last.
        """
        is_waited_for = self.is_closing or (self._ended.is_set() and len(self._writings) > 0)
        return self._watch.look(self._closing_marks() if is_waited_for else None)

    @property
    def is_closing(self) -> bool:
        """True from the end of a scan until its files are written."""
        return self.is_running and (self._stop.is_set() or self.phase is Phase.FINALISING)

    def _closing_marks(self) -> tuple[Any, ...]:
        """What changes when closing gets on: uses of the store, bytes of files, keyframes."""
        scan, store, worker = self.scan, self._store, self._worker
        marks = (self.phase, *self._writings.marks())
        if scan is None or store is None or worker is None:
            return marks
        return (*marks, store.uses(worker.ident or 0), scan.recorder.keyframes)

    @property
    def in_the_making(self) -> set[str]:
        """Names of the scans that nobody may delete: the one that runs, and those whose files are
        being written."""
        return {self.scan_id, *self._writings.names}

    def set_level(self, level: Level) -> None:
        """Do less with the pictures, or more again, in this scan and in the next."""
        self.level = level
        scan, gate = self.scan, self.gate
        if scan is not None and gate is not None:
            scan.pipeline.set_effort(lowered(self.config.compute, level))
            gate.level = level

    @property
    def backend_name(self) -> str:
        """Of the backend that computes now; empty while starting."""
        return self._backend.name if self._backend is not None else ""

    @property
    def backend_failure(self) -> str:
        """Why the backend that was chosen gave way to the CPU; empty when it did not."""
        return getattr(self._backend, "failure", None) or ""

    def retry(self) -> None:
        """Start the next scan when a fault ended the last one and nobody stopped it."""
        due = self._retry_at_s is not None and time.monotonic() >= self._retry_at_s
        if due and not self.is_running:
            self.start()

    def end(self, alive: Callable[[], None] = lambda: None) -> None:
        """Close the running scan, wait for all files, and start no other.

        ``alive`` is called every second while closing gets on.
        """
        self._ended.set()
        self._in_haste.clear()
        self._stop_feeding()
        while (worker := self._worker) is not None and (worker.is_alive() or self._writings):
            if self.idle_closing_s < 1.5:
                alive()
            worker.join(1.0)
            self._writings.wait(1.0)
        self.link.rest()

    # ---- the scan's thread ------------------------------------------------------------------

    def _work(self) -> None:
        try:
            self._scan_once()
            self.resumption.forget()
        except SkyreliefError as error:
            self._fail(str(error))
        except Exception as error:
            log.exception("the scan ended with a fault of ours")
            first, *_ = str(error).strip().splitlines() or [type(error).__name__]
            self._fail(f"internal fault: {first}")
        finally:
            self.scan = self.gate = self._store = None
            self.phase = Phase.IDLE
            give_back(collect=True)
            if self._closing is not None:
                failed = Answer(Result.FAILED, self.fault)
                self._closing.finish(failed if self.fault else ACCEPTED)
                self._closing = None
            self.offer_backlog()

    def offer_backlog(self) -> None:
        """Send earlier scans that the ground lacks while none is flown."""
        if self.claim.is_ours:
            self.link.offer_backlog(
                self.config, lambda: self.phase is Phase.IDLE and not self._ended.is_set()
            )

    def _fail(self, text: str) -> None:
        self.fault = text
        log.error("%s", text)
        self.vehicle.statustext(f"Scan failed: {text}", CRITICAL)
        if not (self._stop.is_set() or self._ended.is_set()):
            log.warning("scanning again in %.1f s", self._retry_s)
            self._retry_at_s = time.monotonic() + self._retry_s
            self._retry_s = min(2 * self._retry_s, LAST_RETRY_S)

    def _scan_once(self) -> None:
        """Open the camera, scan until stopped or the recording ends, close the scan."""
        source = self._open_camera()
        if source is not None:
            try:
                self._scan(source)
            finally:
                source.close()

    def _scan(self, source: CameraSource) -> None:
        from service.cameras.camera_file import check_size
        from service.daemon.frame_gate import FrameGate
        from service.onboard.scan import Scan, ScanInputs, create_store

        assert self.camera is not None and self._backend is not None
        check_size(self.camera, source.size_px, source.description)
        zero_ns, offset = _zero_ns(source), self.vehicle.unix_offset_ns()
        unix_s = 1e-9 * (time.monotonic_ns() + offset)
        scan_id = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(unix_s))
        folder = Path(self.config.scan.folder) / scan_id
        self.made.add(scan_id)
        gate = FrameGate(source, folder / LATER, zero_ns + offset, self._alive, self._paused)
        inputs = ScanInputs(
            gate,
            self.camera,
            self.config,
            self._backend,
            folder,
            scan_id,
            zero_ns,
            unix_offset_ns=offset,
            history=self.vehicle.history,
            extra={"backend": self._backend.name, "source": source.description},
            latency_ms=self._latency_ms,
            tell=lambda text: self.vehicle.statustext(text, WARNING),
            on_step=odometry_reporter(self.config, self.vehicle),
            on_keyframe=self._on_keyframe,
        )
        store = create_store(inputs)
        self._tell_of_clock(gate, offset)
        self._news_told = len(gate.warnings)
        self.vehicle.record(folder / "link.tlog", offset)
        self.link.take_off(store, self.config, self.vehicle)
        self.scan, self.gate, self._store = Scan(inputs, store), gate, store
        self.set_level(self.level)
        self.vehicle.statustext(f"Scan {scan_id} started")
        try:
            self.scan.run(self._stop, self._on_frame, self._paused)
        except Exception:
            if not self._stop.is_set():
                self._in_haste.set()  # it is tried again at once
            raise
        finally:
            source.close()
            self.phase = Phase.FINALISING
            self.vehicle.record(None)
            try:
                gate.warnings += set_since(offset, self.vehicle.unix_offset_ns())
                self._close_scan(self.scan, store)
            finally:
                land = partial(self.link.land, self.config)
                self._writings.write(folder, store, self._in_haste, land, self._hand_over)

    def _hand_over(self) -> Work | None:
        """Have done with a scan whose files are still being written; what ends with them."""
        self.link.land(self.config, in_haste=True)
        work, self._closing = self._closing, None
        return work

    def _tell_of_clock(self, gate: FrameGate, offset_ns: int) -> None:
        """Say that the scan has the autopilot's time instead of this computer's."""
        for text in disagreement(offset_ns):
            gate.warnings.append(text)
            self.vehicle.statustext(text, WARNING)

    def _close_scan(self, scan: Scan, store: ScanStore) -> None:
        """Finish the scan; when the pipeline cannot, what is stored is kept as interrupted."""
        try:
            summary = scan.close()
        except Exception:
            store.finish({"interrupted": True})
            raise
        if scan.check.latency is not None and scan.check.latency.is_settled:
            self._latency_ms = scan.check.latency.latency_ms
        self.vehicle.statustext(
            f"Scan {scan.inputs.scan_id}: {summary['clouds']} clouds, {summary['distance_m']:.0f} m"
        )

    def _open_camera(self) -> CameraSource | None:
        """The camera at its own pace, tried until it answers; None when stopped meanwhile."""
        from service.cameras import open_camera
        from service.cameras.pace import paced

        wait_s = FIRST_RETRY_S
        while not (self._stop.is_set() or self._ended.is_set()):
            try:
                source = open_camera(self.config.camera.source)
                return source if source.is_live else paced(source)
            except OutsideError as error:
                log.warning("%s; trying again in %.1f s", error, wait_s)
                self.vehicle.statustext(f"Camera: {error}", WARNING)
                self._stop.wait(wait_s)
                wait_s = min(2 * wait_s, LAST_RETRY_S)
        return None

    def _alive(self) -> None:
        self.progress_s = time.monotonic()

    def _on_frame(self, scan: Scan) -> None:
        self._alive()
        self.is_warm = self.is_warm or scan.recorder.keyframes > 1
        if scan.recorder.keyframes:
            self._retry_s = FIRST_RETRY_S

    def _on_keyframe(self, keyframe: Keyframe) -> None:
        scan = self.scan
        if scan is not None:
            tell_keyframe(self.vehicle, scan, keyframe)


def _zero_ns(source: CameraSource) -> int:
    """Monotonic clock at the source's time 0: its own word if it is live, else now."""
    start_ns = source.start_monotonic_ns
    return time.monotonic_ns() if start_ns is None else start_ns
