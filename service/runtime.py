"""The daemon: waits for the operator, scans, closes scans, and says how it goes.

MAVLink starts first and on threads of its own, so that its heartbeat does not wait for the
heavy imports; the scan runs on one worker thread. This is the only place that catches what
the outside world throws at a scan.
"""

from __future__ import annotations

import logging
import math
import shutil
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.camera import KeyframeReport
from mavlink.control import ACCEPTED, Answer, Handled, Phase, Power, Result, ScanStatus, Work
from mavlink.presence import Health
from mavlink.status import CRITICAL, INFO, WARNING
from mavlink.vehicle import VehicleLink
from service.config import Config, change, reload
from service.errors import InputError, OutsideError, SkyreliefError
from service.health import HealthServer, Notifier
from service.machine import CoreLoad, computer_load, read_machine
from service.retention import close_open_scans, make_room
from service.vehicle_config import vehicle_config
from service.version import software

if TYPE_CHECKING:
    from recon.backends import Backend
    from recon.types import Camera
    from service.cameras.source import CameraSource
    from service.scan import Scan
    from service.stream.records import PoseRecord
    from service.stream.store import ScanStore

log = logging.getLogger(__name__)

STUCK_S = 10.0
"""A scan without a processed frame for so long is reported as critical."""

HUNG_S = 180.0
"""A scan without a processed frame for so long is restarted by the watchdog; the compilers
of the first frames may take minutes on a small board."""

FIRST_RETRY_S, LAST_RETRY_S = 1.0, 8.0
"""Back-off between attempts to open a camera or to scan again; names of scans are seconds."""


class Daemon:
    """The service on the aircraft; an implementation of :class:`mavlink.control.ScanControl`."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.phase = Phase.IDLE
        self.fault = ""
        self._booted = False
        self._started_s = time.time()
        self._scan: Scan | None = None
        self._backend: Backend | None = None
        self._camera: Camera | None = None
        self._stop_scan, self._quit = threading.Event(), threading.Event()
        self._paused = threading.Event()
        self._worker: threading.Thread | None = None
        self._closing: Work | None = None
        self._scan_started_s = 0.0
        self._progress_s = time.monotonic()
        self._reported = 0
        self._retry_at_s: float | None = None
        self._retry_s = FIRST_RETRY_S
        self.vehicle = VehicleLink(vehicle_config(config), self)

    # ---- life ----------------------------------------------------------------------------

    def run(self) -> None:
        """Serve until :meth:`quit`; raises InputError when the configuration cannot work."""
        notifier = Notifier()
        self.vehicle.set_health(Health.BOOT)
        self.vehicle.start()
        http = self._serve_health()
        try:
            self._load()
            notifier.ready()
            threading.Thread(target=self._tidy, name="tidy", daemon=True).start()
            if self.config.scan.start == "on-boot":
                self.start_scan()
            was_armed = False
            while not self._quit.wait(0.25):
                self.vehicle.set_health(self._health())
                was_armed = self._follow_arming(was_armed)
                self._retry()
                if time.monotonic() - self._progress_s < HUNG_S or self.phase is not Phase.SCANNING:
                    notifier.alive(self.phase.value)
        finally:
            notifier.stopping()
            self._end_scan()
            self.vehicle.stop()
            if http is not None:
                http.close()

    def _serve_health(self) -> HealthServer | None:
        """The server of health.http; a flight goes on without it."""
        if not self.config.health.http:
            return None
        try:
            return HealthServer(self.config.health.http, self.snapshot)
        except OutsideError as error:
            log.error("%s", error)
            return None

    def snapshot(self) -> dict[str, Any]:
        """How it goes, for /status and /metrics."""
        health, status = self._health(), self.status()
        figures = {"speed_m_s": status.speed_m_s, "distance_m": status.distance_m}
        scan = self._scan
        if scan is not None:
            figures |= {
                "frames": scan.recorder.frames,
                "clouds": scan.recorder.keyframes,
                "points": scan.recorder.points,
            }
        return {
            "ok": health is not Health.CRITICAL,
            "state": self.phase.value if self._booted else "starting",
            "fault": self.fault,
            "software": software(),
            "scan": status.scan_id,
            "recording_s": status.recording_ms / 1e3,
            "machine": read_machine(Path(self.config.scan.folder)).to_dict(),
        } | {key: value for key, value in figures.items() if math.isfinite(value)}

    def reload(self, wanted: Config) -> None:
        """Take over what of ``wanted`` may change while running; the rest waits for a restart."""
        self.config, taken, waiting = reload(self.config, wanted)
        if "scan.baseline" in taken and self._scan is not None:
            self._scan.pipeline.set_baseline(self.config.scan)
        log.info("configuration: now in force: %s", ", ".join(taken) or "nothing new")
        if waiting:
            log.warning("configuration: after a restart: %s", ", ".join(waiting))

    def _tidy(self) -> None:
        """Close what a crash left open; then watch the machine and keep room on the disk."""
        folder = Path(self.config.scan.folder)
        cores = CoreLoad()
        close_open_scans(folder, self._started_s)
        while not self._quit.wait(2.0):
            keep_free_mib = self.config.scan.keep_free_mib
            self.vehicle.set_load(
                computer_load(read_machine(folder), cores.percent(), keep_free_mib)
            )
            make_room(
                folder, keep_free_mib, self._scan.inputs.scan_id if self._scan is not None else ""
            )

    def quit(self) -> None:
        """Close a running scan, then let :meth:`run` return."""
        self._quit.set()

    def _load(self) -> None:
        """The heavy part of the start: camera model and backend."""
        from service.camera_file import load_camera
        from service.compute import open_backend

        if not self.config.camera.source:
            raise InputError("camera.source is not set; give it in the configuration file")
        if not self.config.camera.model:
            raise InputError(
                "camera.model is not set; make one with 'skyrelief calibrate' and name it"
            )
        self._camera = load_camera(Path(self.config.camera.model))
        self._backend = open_backend(self.config.compute)
        self._booted = True
        log.info("ready: backend %s", self._backend.name)

    def _health(self) -> Health:
        if not self._booted:
            return Health.BOOT
        if self.fault:
            return Health.CRITICAL
        if self.phase is Phase.SCANNING and time.monotonic() - self._progress_s > STUCK_S:
            return Health.CRITICAL
        return Health.ACTIVE if self.phase is not Phase.IDLE else Health.STANDBY

    def _follow_arming(self, was_armed: bool) -> bool:
        is_armed = self.vehicle.report().is_armed
        if self.config.scan.start == "on-arm" and is_armed != was_armed:
            if is_armed:
                self.start_scan()
            else:
                self.stop_scan()
        return is_armed

    # ---- what commands ask (mavlink.control.ScanControl) -----------------------------------

    def status(self) -> ScanStatus:
        """A snapshot for the operator."""
        folder = _existing(Path(self.config.scan.folder))
        disk = shutil.disk_usage(folder)
        recorder = self._scan.recorder if self._scan is not None else None
        recording = self.phase in (Phase.SCANNING, Phase.PAUSED)
        return ScanStatus(
            phase=self.phase,
            scan_id=self._scan.inputs.scan_id if self._scan is not None else "",
            recording_ms=int(1e3 * (time.monotonic() - self._scan_started_s)) if recording else 0,
            storage_total_mib=disk.total / 2**20,
            storage_free_mib=disk.free / 2**20,
            speed_m_s=recorder.speed_m_s if recorder is not None else math.nan,
            distance_m=recorder.distance_m if recorder is not None else math.nan,
            turn_rate_rad_s=recorder.turn_rate_rad_s if recorder is not None else math.nan,
        )

    def start_scan(self) -> Handled:
        """Start a scan."""
        if not self._booted:
            return Answer(Result.TEMPORARILY_REJECTED, "still starting")
        if self._worker is not None and self._worker.is_alive():
            return Answer(Result.TEMPORARILY_REJECTED, f"a scan is {self.phase.value}")
        self.fault = ""
        self._retry_at_s = None
        self._stop_scan.clear()
        self._paused.clear()
        self.phase = Phase.SCANNING
        self._scan_started_s = self._progress_s = time.monotonic()
        self._worker = threading.Thread(target=self._work, name="scan", daemon=True)
        self._worker.start()
        return ACCEPTED

    def stop_scan(self) -> Handled:
        """Close the running scan; the files are written after the answer."""
        self._retry_at_s = None
        self._stop_feeding()
        return ACCEPTED

    def _stop_feeding(self) -> None:
        """Make the scan's thread come to its end, also where it waits for a dead camera."""
        self._stop_scan.set()
        scan = self._scan
        if scan is not None:
            scan.source.close()

    def finalise(self) -> Handled:
        """Close the scan and answer when everything is written out."""
        if self._worker is None or not self._worker.is_alive():
            return ACCEPTED
        self._closing = Work()
        self._stop_feeding()
        return self._closing

    def pause(self) -> Handled:
        """Take no frames until :meth:`resume`."""
        if self.phase is not Phase.SCANNING:
            return Answer(Result.DENIED, "no scan is running")
        self._paused.set()
        self.phase = Phase.PAUSED
        return ACCEPTED

    def resume(self) -> Handled:
        """Go on after a pause."""
        if self.phase is not Phase.PAUSED:
            return Answer(Result.DENIED, "the scan is not paused")
        self._paused.clear()
        self.phase = Phase.SCANNING
        self._progress_s = time.monotonic()
        return ACCEPTED

    def capture_keyframe(self) -> Handled:
        """Make the next frame a keyframe; refused while no scan runs."""
        if self._scan is None or self.phase is not Phase.SCANNING:
            return Answer(Result.TEMPORARILY_REJECTED, "start a scan first")
        self._scan.pipeline.viewpoints.take_next()
        return ACCEPTED

    def clear_map(self) -> Handled:
        """Forget which surface is known, so that everything counts as new again."""
        if self._scan is None:
            return Answer(Result.DENIED, "no scan is running")
        self._scan.pipeline.dense.forget_map()
        return ACCEPTED

    def self_test(self) -> Handled:
        """Camera, disk and compute, one after the other, off the protocol's thread."""
        work = Work()
        threading.Thread(target=self._test, args=(work,), name="self-test", daemon=True).start()
        return work

    def erase_scans(self) -> Handled:
        """Delete the finished scans."""
        work = Work()
        threading.Thread(target=self._erase, args=(work,), name="erase", daemon=True).start()
        return work

    def power(self, action: Power) -> Handled:
        """Restart the service; rebooting or shutting down the computer is the system's."""
        if action is Power.RESTART_SERVICE:
            self.quit()
            return ACCEPTED
        return _systemctl("reboot" if action is Power.REBOOT else "poweroff")

    def parameter_changed(self, name: str, value: float) -> Answer:
        """The baseline from now on: metres, 0 for automatic; other parameters are refused."""
        if name != "SR_BASELINE_M":
            return Answer(Result.UNSUPPORTED, f"{name} cannot change while running")
        try:
            self.config = change(self.config, "scan.baseline", value if value > 0 else "auto")
        except InputError as error:
            return Answer(Result.DENIED, str(error))
        if self._scan is not None:
            self._scan.pipeline.set_baseline(self.config.scan)
        return ACCEPTED

    # ---- the scan's thread ------------------------------------------------------------------

    def _work(self) -> None:
        try:
            self._scan_once()
        except SkyreliefError as error:
            self._fail(str(error))
        except Exception as error:
            log.exception("the scan ended with a fault of ours")
            self._fail(f"internal fault: {error}")
        finally:
            self._scan = None
            self.phase = Phase.IDLE
            if self._closing is not None:
                failed = Answer(Result.FAILED, self.fault)
                self._closing.finish(failed if self.fault else ACCEPTED)
                self._closing = None

    def _fail(self, text: str) -> None:
        self.fault = text
        log.error("%s", text)
        self.vehicle.statustext(f"Scan failed: {text}", CRITICAL)
        if not (self._stop_scan.is_set() or self._quit.is_set()):
            log.warning("scanning again in %.1f s", self._retry_s)
            self._retry_at_s = time.monotonic() + self._retry_s
            self._retry_s = min(2 * self._retry_s, LAST_RETRY_S)

    def _retry(self) -> None:
        """Start the next scan when a fault ended the last one and nobody stopped it."""
        due = self._retry_at_s is not None and time.monotonic() >= self._retry_at_s
        if due and not (self._worker is not None and self._worker.is_alive()):
            self.start_scan()

    def _scan_once(self) -> None:
        """Open the camera, scan until stopped or the recording ends, close the scan."""
        from service.datalink import open_datalink
        from service.scan import Scan, ScanInputs, create_store
        from service.scan_folder import write_deliverables

        assert self._camera is not None and self._backend is not None
        source = self._open_camera()
        if source is None:
            return
        scan_id = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        folder = Path(self.config.scan.folder) / scan_id
        offset = time.time_ns() - time.monotonic_ns()
        inputs = ScanInputs(
            source,
            self._camera,
            self.config,
            self._backend,
            folder,
            scan_id,
            _zero_ns(source),
            unix_offset_ns=offset,
            history=self.vehicle.history,
            extra={"backend": self._backend.name, "source": source.description},
        )
        store = create_store(inputs)
        self.vehicle.record(folder / "link.tlog")
        link = open_datalink(store, self.config)
        self._scan, self._reported = Scan(inputs, store), 0
        self.vehicle.statustext(f"Scan {scan_id} started")
        try:
            self._scan.run(self._stop_scan, self._on_frame, self._paused)
        finally:
            source.close()
            self.phase = Phase.FINALISING
            self.vehicle.record(None)
            try:
                self._close_scan(self._scan, store)
            finally:
                write_deliverables(folder, store, {})
                if link is not None:
                    link.drain(self.config.datalink.drain_s)
                    link.close()
                store.close()

    def _close_scan(self, scan: Scan, store: ScanStore) -> None:
        """Finish the scan; when the pipeline cannot, what is stored is kept as interrupted."""
        try:
            summary = scan.close()
        except Exception:
            store.finish({"interrupted": True})
            raise
        self.vehicle.statustext(
            f"Scan {scan.inputs.scan_id}: {summary['clouds']} clouds, {summary['distance_m']:.0f} m"
        )

    def _open_camera(self) -> CameraSource | None:
        """The camera at its own pace, tried until it answers; None when stopped meanwhile."""
        from service.cameras import open_camera
        from service.cameras.pace import paced

        wait_s = FIRST_RETRY_S
        while not (self._stop_scan.is_set() or self._quit.is_set()):
            try:
                source = open_camera(self.config.camera.source)
                return source if source.is_live else paced(source)
            except OutsideError as error:
                log.warning("%s; trying again in %.1f s", error, wait_s)
                self.vehicle.statustext(f"Camera: {error}", WARNING)
                self._stop_scan.wait(wait_s)
                wait_s = min(2 * wait_s, LAST_RETRY_S)
        return None

    def _on_frame(self, scan: Scan) -> None:
        self._progress_s = time.monotonic()
        if scan.recorder.keyframes > self._reported and scan.recorder.last is not None:
            self._reported = scan.recorder.keyframes
            self._retry_s = FIRST_RETRY_S
            self.vehicle.report_keyframe(_keyframe_report(scan.recorder.last))

    def _end_scan(self) -> None:
        self._stop_feeding()
        if self._worker is not None:
            self._worker.join()

    # ---- work of its own thread --------------------------------------------------------------

    def _test(self, work: Work) -> None:
        try:
            source = self._open_once()
            work.report(0.5)
            source.close()
            folder = _existing(Path(self.config.scan.folder))
            free_mib = shutil.disk_usage(folder).free / 2**20
            if free_mib < 500:
                raise OutsideError(f"{folder} has {free_mib:.0f} MiB left")
            work.finish(ACCEPTED)
            self.vehicle.statustext("Self-test passed", INFO)
        except SkyreliefError as error:
            work.finish(Answer(Result.FAILED, str(error)))
            self.vehicle.statustext(f"Self-test: {error}", WARNING)

    def _open_once(self) -> CameraSource:
        from service.cameras import open_camera

        return open_camera(self.config.camera.source)

    def _erase(self, work: Work) -> None:
        folders = [p.parent for p in Path(self.config.scan.folder).glob("*/scan.db")]
        try:
            for i, folder in enumerate(folders):
                shutil.rmtree(folder)
                work.report((i + 1) / len(folders))
            work.finish(ACCEPTED)
        except OSError as error:
            work.finish(Answer(Result.FAILED, f"{error.filename}: {error.strerror}"))


def _keyframe_report(pose: PoseRecord) -> KeyframeReport:
    """What ground stations are told of a keyframe, from the newest pose."""
    from recon.frames import rotation_from_rpy
    from recon.se3 import quaternion_from_rotation

    q = quaternion_from_rotation(rotation_from_rpy(pose.roll_rad, pose.pitch_rad, pose.yaw_rad))
    return KeyframeReport(
        unix_us=pose.time_unix_ns // 1000,
        lat_deg=pose.lat_deg,
        lon_deg=pose.lon_deg,
        alt_amsl_m=pose.alt_amsl_m,
        alt_agl_m=pose.agl_m,
        q_ned_camera_wxyz=(float(q[0]), float(q[1]), float(q[2]), float(q[3])),
    )


def _zero_ns(source: CameraSource) -> int:
    """Monotonic clock at the source's time 0: its own word if it is live, else now."""
    start_ns = source.start_monotonic_ns
    return time.monotonic_ns() if start_ns is None else start_ns


def _existing(folder: Path) -> Path:
    """The folder, or the nearest of its parents that exists."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder


def _systemctl(verb: str) -> Answer:
    """Ask the init system to reboot or power off."""
    import subprocess

    try:
        subprocess.run(["systemctl", verb], check=True, capture_output=True, timeout=10)
    except (OSError, subprocess.SubprocessError) as error:
        return Answer(Result.FAILED, f"systemctl {verb}: {error}")
    return ACCEPTED
