"""An attempt at a scan as the service sees it, and what is reported of it."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass, field
from operator import sub
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.component.camera import KeyframeReport
from mavlink.component.control import ACCEPTED, Answer, Result, Work
from mavlink.component.status import WARNING
from mavlink.telemetry.clock import agree, computer_offset_ns
from service.config import Config
from service.daemon.load_shedding import GRACE_S, Level, MachineReadings, lowered

if TYPE_CHECKING:
    from collections.abc import Callable

    from mavlink.component.vehicle import VehicleLink
    from recon.tracking.frame import Frame
    from recon.types import F64, Keyframe
    from service.daemon.frame_gate import FrameGate
    from service.flight.scan import Scan
    from service.stream.store import ScanStore
    from service.workers import Worker

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
        """Camera warnings since the last call."""
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
        """Answer a command that waits for the end."""
        if self.work is not None:
            self.work.finish(Answer(Result.FAILED, fault) if fault else ACCEPTED)

    def configure(self, config: Config, level: Level) -> None:
        """Use the live keys of ``config``, reduced to a load level."""
        scan, gate = self.scan, self.gate
        if scan is not None and gate is not None:
            scan.configure(config, lowered(config.compute, level))
            gate.level = level

    def lag(self) -> MachineReadings:
        """Views and frames since the last call, and how late they were; none at the start."""
        scan, gate = self.scan, self.gate
        if scan is None or gate is None:
            return MachineReadings()
        dropped, late = scan.worker.dropped, gate.late
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
            "frames_late": gate.late,
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


def _report(
    scan: Scan, time_ns: int, R_world_camera: F64 | None, position_m: F64 | None,
    agl_m: float | None, file: str = "",
) -> KeyframeReport:  # fmt: skip
    from service.flight.vehicle_reports import keyframe_report

    unix_ns, frame = time_ns + scan.inputs.unix_offset_ns, scan.rig.local_frame
    return keyframe_report(unix_ns, R_world_camera, position_m, frame, agl_m, file)


def sizes(folder: Path) -> tuple[tuple[str, int], ...]:
    """Name and bytes of each file that closing writes into a scan's folder.

    The store and the link's log are left out, because others write them too.
    """
    found = []
    try:
        for path in folder.iterdir():
            if not path.name.startswith(OTHERS):
                found.append((path.name, path.stat().st_size))
    except OSError:
        pass  # it is not there yet, or a file was renamed meanwhile
    return tuple(sorted(found))


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
