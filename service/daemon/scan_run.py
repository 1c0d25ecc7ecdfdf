"""One attempt at a scan: open the camera, scan, close the scan."""

from __future__ import annotations

import logging
import os
import threading
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.component.camera import KeyframeReport
from mavlink.component.status import WARNING
from mavlink.telemetry.clock import agree, computer_offset_ns
from service.config import Config, change
from service.daemon.load_shedding import GRACE_S, Level, MachineReadings, lowered
from service.daemon.scan_state import FIRST_RETRY_S, LAST_RETRY_S, Event
from service.errors import OutsideError

if TYPE_CHECKING:
    from collections.abc import Callable

    from mavlink.component.vehicle import VehicleLink
    from recon.backends import Backend
    from recon.types import Camera, Frame, Keyframe
    from service.cameras.source import CameraSource
    from service.daemon.frame_gate import FrameGate
    from service.flight.datalink import DaemonLink
    from service.flight.scan import Scan, ScanInputs
    from service.stream.store import ScanStore

log = logging.getLogger(__name__)

LATER, PHOTOS = "later", "photos"
"""Subfolders of a scan: images that are only stored, and those that operators asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Equipment:
    """What an attempt at a scan works with."""

    config: Config
    vehicle: VehicleLink
    link: DaemonLink
    camera: Camera | None  # the model; None before it is loaded
    backend: Backend | None  # None before it is loaded
    level: Level
    paused: threading.Event  # set while no frames are taken
    made: set[str]  # names of the scans of this process, each from before its store exists
    report: Callable[[Event], object]  # events of this attempt
    write_files: Callable[[Path, ScanStore], None]  # of a closed scan


class ScanRun:
    """One attempt at a scan, from opening the camera until its files are written."""

    def __init__(
        self,
        equipment: Equipment,
        is_asked: bool,
        opener: Callable[[str], CameraSource] | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """``is_asked``: a command waits for this attempt; it is not a retry. ``opener`` opens
        the camera (default: :func:`service.cameras.open_camera`)."""
        self.stop = threading.Event()
        self.scan: Scan | None = None
        self.gate: FrameGate | None = None
        self.store: ScanStore | None = None
        self.thread_id = 0
        self.started_s = self.progress_s = clock_s()
        self._equipment, self._is_asked, self._opener = equipment, is_asked, opener
        self._config, self._level, self._clock_s = equipment.config, equipment.level, clock_s
        self._is_feeding = False  # frames go into the scan
        self._has_grown = False
        self._counted = MachineReadings()
        self._warnings_reported = 0  # camera warnings reported so far
        self._photos: set[int] = set()  # times of the frames that were reported as photos

    @property
    def busy_s(self) -> float:
        """Seconds spent on the current frame or view; 0 while waiting for the camera."""
        scan, gate = self.scan, self.gate
        if scan is None or gate is None or not self._is_feeding:
            return 0.0
        return max(gate.busy_s, scan.pipeline.busy_s)

    def close_camera(self) -> None:
        """Wake a scan that waits for a dead camera."""
        scan = self.scan
        if scan is not None:
            scan.source.close()

    def alive(self) -> None:
        self.progress_s = self._clock_s()

    def new_camera_warnings(self) -> list[str]:
        """Camera warnings since the last call."""
        gate = self.gate
        fresh = [] if gate is None else gate.warnings[self._warnings_reported :]
        self._warnings_reported += len(fresh)
        return fresh

    def closing_marks(self) -> tuple[Any, ...]:
        """Values that change when closing makes progress: uses of the store, keyframes."""
        scan, store = self.scan, self.store
        if scan is None or store is None:
            return ()
        return (store.database.uses[self.thread_id], scan.recorder.keyframes)

    def configure(self, config: Config, level: Level) -> None:
        """Use the live keys of ``config``, reduced to a load level."""
        self._config, self._level = config, level
        scan, gate = self.scan, self.gate
        if scan is not None and gate is not None:
            scan.pipeline.configure_baseline(config.scan)
            scan.check.set_camera(config.camera)
            scan.pipeline.configure_effort(lowered(config.compute, level))
            gate.level = level

    def lag(self) -> MachineReadings:
        """Views and frames since the last call, and how late they were; none at the start."""
        scan, gate = self.scan, self.gate
        if scan is None or gate is None:
            return MachineReadings()
        before, dropped = self._counted, scan.pipeline.dropped
        views, frames = scan.recorder.keyframes + dropped, gate.frames + gate.late
        self._counted = now = MachineReadings(views, dropped, frames, gate.late, gate.age_s)
        if self._clock_s() - self.started_s < GRACE_S:
            return MachineReadings()
        taken = gate.frames - (before.frames - before.late_frames)
        return MachineReadings(
            now.views - before.views,
            now.late_views - before.late_views,
            now.frames - before.frames,
            now.late_frames - before.late_frames,
            now.age_s if taken else 0.0,
        )

    def lag_figures(self) -> dict[str, float]:
        """Counts of late frames and views, and of images that were only stored."""
        scan, gate = self.scan, self.gate
        if scan is None or gate is None:
            return {}
        return {
            "frame_age_s": round(gate.age_s, 3),
            "frames_late": gate.late,
            "views_late": scan.pipeline.dropped,
            "pictures_kept": gate.kept,
            "pictures_lost": gate.lost,
        }

    # ---- on the scan's thread ----------------------------------------------------------------

    def carry_out(self) -> None:
        """Scan until stopped or the recording ends, then close the scan."""
        self.thread_id = threading.get_ident()
        try:
            source = self._open_camera()
            if source is not None:
                with closing(source):
                    self._scan(source)
        finally:
            self.scan = self.gate = self.store = None

    def _open_camera(self) -> CameraSource | None:
        """The camera at its own pace, retried until it answers; None when stopped meanwhile."""
        from service.cameras import open_camera
        from service.cameras.source import Paced

        wait_s, is_answer = FIRST_RETRY_S, self._is_asked
        while not self.stop.is_set():
            began_s = time.monotonic()
            try:
                source = (self._opener or open_camera)(self._config.camera.source)
                return source if isinstance(source, Paced) else Paced(source)
            except OutsideError as error:
                log.warning("%s; trying again", error)
                text = f"Camera: {error}"
                self._equipment.vehicle.statustext(text, WARNING, is_answer=is_answer)
                is_answer = False
                # A source that listens for a sender is open again at once.
                self.stop.wait(max(0.0, began_s + wait_s - time.monotonic()))
                wait_s = min(2 * wait_s, LAST_RETRY_S)
        return None

    def _scan(self, source: CameraSource) -> None:
        from service.flight.scan import Scan, create_store

        vehicle, link = self._equipment.vehicle, self._equipment.link
        inputs, gate = self._inputs(source)
        store = create_store(inputs)
        with ExitStack() as on_fault:  # nothing is sent or recorded of a scan that cannot begin
            on_fault.callback(store.close)
            scan = Scan(inputs, store)
            on_fault.pop_all()
        clocks = disagreement(inputs.unix_offset_ns)
        gate.warnings += clocks
        for text in (*inputs.notes, *clocks):
            vehicle.statustext(text, WARNING)
        self._warnings_reported = len(gate.warnings)
        vehicle.record(inputs.folder / "link.tlog", inputs.unix_offset_ns)
        link.begin_scan(store, self._config, vehicle)
        self.store, self.gate, self.scan = store, gate, scan
        self.configure(self._config, self._level)
        vehicle.statustext(f"Scan {inputs.scan_id} started")
        try:
            self._feed(scan)
        finally:
            source.close()
            vehicle.record(None)
            try:
                gate.warnings += set_since(inputs.unix_offset_ns, vehicle.unix_offset_ns())
                self._close_scan(scan, store)
            finally:
                self._equipment.write_files(inputs.folder, store)

    def _inputs(self, source: CameraSource) -> tuple[ScanInputs, FrameGate]:
        from service.cameras.camera_file import seeks_readout
        from service.cameras.lens import fitted
        from service.daemon.camera_memory import measured
        from service.daemon.frame_gate import FrameGate
        from service.flight.scan import ScanInputs
        from service.flight.vehicle_reports import OdometryReport

        vehicle, config, backend = self._equipment.vehicle, self._config, self._equipment.backend
        assert self._equipment.camera is not None and backend is not None
        camera, notes = fitted(self._equipment.camera, source)
        scans = Path(config.scan.folder)
        earlier = measured(scans, source.description, source.size_px)
        if earlier.shutter is not None and seeks_readout(camera, config.camera):
            camera = replace(camera, shutter=earlier.shutter)
            config = change(config, "camera.readout_ms", "auto")  # sought on from there
        now_ns, start_ns = time.monotonic_ns(), source.start_monotonic_ns
        zero_ns = now_ns if start_ns is None else start_ns
        offset_ns = vehicle.unix_offset_ns()
        odometry = OdometryReport(config.camera, vehicle.report_odometry).send
        unix_s = 1e-9 * (now_ns + offset_ns)
        folder = new_folder(scans, unix_s)
        self._equipment.made.add(folder.name)
        gate = FrameGate(
            source, folder / LATER, zero_ns + offset_ns, self.alive, self._equipment.paused
        )
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
            on_keyframe=self._on_keyframe,
            on_photo=self._on_photo,
        )
        return inputs, gate

    def _feed(self, scan: Scan) -> None:
        """Feed frames into the scan until it is stopped or the recording ends."""
        event, self._is_feeding = Event.INTERRUPTED, True
        try:
            scan.run(self.stop, self._on_frame, self._equipment.paused)
            event = Event.COMPLETED
        finally:
            self._is_feeding = False
            self._equipment.report(event)

    def _close_scan(self, scan: Scan, store: ScanStore) -> None:
        """Finish the scan; if the pipeline fails, mark the stored part as interrupted."""
        with ExitStack() as on_fault:
            on_fault.callback(store.finish, {"interrupted": True})
            summary = scan.close()
            on_fault.pop_all()
        self._equipment.vehicle.statustext(
            f"Scan {scan.inputs.scan_id}: {summary['clouds']} clouds, {summary['distance_m']:.0f} m"
        )

    def _on_frame(self, scan: Scan) -> None:
        self.alive()
        if scan.recorder.keyframes > 1 and not self._has_grown:
            self._has_grown = True
            self._equipment.report(Event.GROWN)

    def _on_keyframe(self, keyframe: Keyframe) -> None:
        scan = self.scan
        if scan is not None and keyframe.time_ns not in self._photos:
            report_keyframe(self._equipment.vehicle, scan, keyframe)

    def _on_photo(self, photo: Frame) -> None:
        scan = self.scan
        if scan is not None:
            self._photos.add(photo.time_ns)
            report_photo(self._equipment.vehicle, scan, photo)


def new_folder(scans: Path, unix_s: float) -> Path:
    """The folder of a scan that starts now; a name that is taken, as by a clock that stands still
    or was set back, is followed by the next second's."""
    while True:
        folder = scans / time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(unix_s))
        if not os.path.exists(folder):
            return folder
        unix_s += 1.0


def report_keyframe(vehicle: VehicleLink, scan: Scan, keyframe: Keyframe) -> None:
    """Report a keyframe to ground stations, at its current pose."""
    from service.flight.vehicle_reports import keyframe_report

    inputs = scan.inputs
    state = vehicle.history.state_at(keyframe.time_ns)
    agl_m = None if state is None else state.alt_agl_m
    time_ns = keyframe.time_ns + inputs.unix_offset_ns
    T = keyframe.pose.T_world_camera
    report = keyframe_report(time_ns, T[:3, :3], T[:3, 3], scan.rig.local_frame, agl_m)
    vehicle.report_keyframe(report)


def report_photo(vehicle: VehicleLink, scan: Scan, photo: Frame) -> None:
    """Store a photo and report it to ground stations, or why that failed."""
    from service.daemon.stored_image import image_name, store_image
    from service.flight.vehicle_reports import keyframe_report

    inputs, tag = scan.inputs, photo.prior
    time_ns = photo.time_ns + inputs.unix_offset_ns
    path = inputs.folder / PHOTOS / image_name(time_ns)
    report = keyframe_report(
        time_ns, tag.R_world_camera, tag.position_m, scan.rig.local_frame, tag.agl_m,
        f"{inputs.scan_id}/{PHOTOS}/{path.name}",
    )  # fmt: skip
    try:
        store_image(path, photo.image, report)
    except OSError as error:
        why = f"photo failed: {error.strerror or error}"
        vehicle.statustext(why, WARNING, is_answer=True)
        report = KeyframeReport(ok=False)
    vehicle.report_keyframe(report)


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
