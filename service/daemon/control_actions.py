"""Commands of the service and their answers; each call returns at once."""

from __future__ import annotations

import math
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from mavlink.component.control import (
    ACCEPTED,
    Answer,
    CameraView,
    Handled,
    Phase,
    Power,
    Result,
    ScanStatus,
    Work,
)
from service.daemon.load_shedding import Level
from service.daemon.scan_state import Event
from service.daemon.scanning import Scanning
from service.daemon.stored_image import MIN_FREE_MIB
from service.daemon.vehicle_config import with_parameter
from service.errors import InputError, OutsideError, SkyreliefError
from service.scans.writing import existing
from service.workers import PROCESS

DISK_AGE_S = 1.0
VIEW_AGES_NS = (200_000_000, 1_200_000_000)
"""Ages of the camera's view: by positions of 5 and of 1 Hz."""

NO_PHOTO = {
    Phase.IDLE: "start a scan first",
    Phase.WAITING: "the scan failed and is being retried",
    Phase.PAUSED: "the scan is paused, resume it first",
    Phase.FINALISING: "the scan is being closed",
}
"""Reasons why no photo can be taken."""


class ControlActions:
    """The scanning service as commands see it: :class:`mavlink.component.control.ScanControl`."""

    def __init__(self, scanning: Scanning, restart: Callable[[], None]) -> None:
        """``restart`` ends the service; the init system restarts it."""
        self.is_ready = False  # still starting
        self._scanning, self._restart = scanning, restart
        self._disk_mib, self._disk_at = (0.0, 0.0), -math.inf  # total and free, and when seen

    def status(self) -> ScanStatus:
        scanning = self._scanning
        run, scan, phase = scanning.run, scanning.scan, scanning.phase
        total_mib, free_mib = self._disk()
        recording_s = 0.0
        if run is not None and phase in (Phase.SCANNING, Phase.PAUSED):
            recording_s = time.monotonic() - run.started_s
        recording_ms = int(1e3 * recording_s)
        if scan is None:
            return ScanStatus(phase, "", recording_ms, total_mib, free_mib)
        recorder, latency = scan.recorder, scan.check.latency
        return ScanStatus(
            phase,
            scan.inputs.scan_id,
            recording_ms,
            total_mib,
            free_mib,
            speed_m_s=recorder.speed_m_s,
            distance_m=recorder.distance_m,
            turn_rate_rad_s=recorder.turn_rate_rad_s,
            camera_latency_ms=math.nan if latency is None else latency.latency_ms,
            camera_latency_sigma_ms=math.nan if latency is None else latency.sigma_ms,
        )

    def _disk(self) -> tuple[float, float]:
        """Total and free MiB of the disk of the scans, at most DISK_AGE_S old: the protocol's
        thread asks for the status all the time."""
        now_s = time.monotonic()
        if now_s - self._disk_at > DISK_AGE_S:
            disk = shutil.disk_usage(existing(Path(self._scanning.config.scan.folder)))
            self._disk_mib, self._disk_at = (disk.total / 2**20, disk.free / 2**20), now_s
        return self._disk_mib

    def view(self) -> CameraView:
        """The camera's view by telemetry, which takes a moment to arrive."""
        camera = self._scanning.camera
        if camera is None or not self.is_ready:
            return CameraView()
        from service.daemon.vehicle_reports import camera_view

        history, now_ns = self._scanning.vehicle.history, time.monotonic_ns()
        states = (history.state_at(now_ns - age_ns, waits=False) for age_ns in VIEW_AGES_NS)
        state = next((s for s in states if s is not None and s.lat_deg is not None), None)
        return camera_view(self._scanning.config.camera, camera, state)

    def start_scan(self) -> Answer:
        if not self.is_ready:
            return Answer(Result.TEMPORARILY_REJECTED, "still starting")
        is_closing = self._scanning.life.state.is_closing
        self._scanning.start()
        if is_closing:
            return Answer(text="Scan starts when the previous one is closed")
        return ACCEPTED

    def stop_scan(self) -> Work:
        return self._scanning.stop()

    def finalise(self) -> Work:
        return self._scanning.finalise()

    def pause(self) -> Handled:
        is_wanted = self._scanning.handle(Event.PAUSE).is_wanted
        return ACCEPTED if is_wanted else Answer(Result.DENIED, "no scan is running")

    def resume(self) -> Handled:
        was_paused = self._scanning.handle(Event.RESUME).is_paused
        return ACCEPTED if was_paused else Answer(Result.DENIED, "the scan is not paused")

    def capture_keyframe(self) -> Handled:
        scan, phase = self._scanning.scan, self._scanning.phase
        if phase is not Phase.SCANNING:
            why = NO_PHOTO[Phase.FINALISING if self._scanning.life.state.is_closing else phase]
            return Answer(Result.TEMPORARILY_REJECTED, f"photo refused: {why}")
        if scan is None:
            return Answer(Result.TEMPORARILY_REJECTED, "photo refused: the camera is being opened")
        if self._scanning.level is Level.RECORD_ONLY:
            why = "photo refused: the computer is overloaded, images are only stored"
            return Answer(Result.TEMPORARILY_REJECTED, why)
        scan.take_photo()
        return ACCEPTED

    def clear_map(self) -> Handled:
        scan = self._scanning.scan
        if scan is None:
            return Answer(Result.DENIED, "no scan is running")
        scan.mapper.reset_map()
        return ACCEPTED

    def self_test(self) -> Handled:
        work = Work()
        PROCESS.start("self-test", lambda _: self._test(work))
        return work

    def erase_scans(self) -> Handled:
        work = Work()
        PROCESS.start("erase", lambda _: self._erase(work))
        return work

    def power(self, action: Power) -> Handled:
        """Restart the service, or reboot or shut down the computer through the init system."""
        if action is Power.RESTART_SERVICE:
            self._restart()
            return ACCEPTED
        return _systemctl("reboot" if action is Power.REBOOT else "poweroff")

    def parameter_changed(self, name: str, value: float) -> Answer:
        try:
            self._scanning.configure(lambda config: with_parameter(config, name, value))
        except InputError as error:  # "--set KEY=VALUE: why"
            return Answer(Result.DENIED, f"{name} refused: {str(error).partition(': ')[2]}")
        return ACCEPTED

    # ---- on worker threads -------------------------------------------------------------------

    def _test(self, work: Work) -> None:
        from service.cameras import open_camera
        from service.cameras.lens import fitted

        config = self._scanning.config
        try:
            source = open_camera(config.camera.source)
            work.report(0.5)
            source.close()
            if self._scanning.camera is not None:
                fitted(self._scanning.camera, source)
            folder = existing(Path(config.scan.folder))
            free_mib = shutil.disk_usage(folder).free / 2**20
            if free_mib < MIN_FREE_MIB:
                raise OutsideError(f"{folder} has only {free_mib:.0f} MiB free")
            work.finish(Answer(text="Self-test passed"))
        except SkyreliefError as error:
            work.finish(Answer(Result.FAILED, f"Self-test: {error}"))

    def _erase(self, work: Work) -> None:
        found = [p.parent for p in Path(self._scanning.config.scan.folder).glob("*/scan.db")]
        folders = [path for path in found if path.name not in self._scanning.in_the_making]
        try:
            for i, folder in enumerate(folders):
                shutil.rmtree(folder)
                work.report((i + 1) / len(folders))
            work.finish(ACCEPTED)
        except OSError as error:
            work.finish(Answer(Result.FAILED, f"{error.filename}: {error.strerror}"))


def _systemctl(verb: str) -> Answer:
    try:
        done = subprocess.run(["systemctl", verb], capture_output=True, timeout=10, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        return Answer(Result.FAILED, f"systemctl {verb}: {error}")
    if done.returncode:
        why = done.stderr.decode(errors="replace").strip() or f"exit code {done.returncode}"
        return Answer(Result.FAILED, f"systemctl {verb}: {why}")
    return ACCEPTED
