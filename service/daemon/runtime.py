"""The life of the onboard service: heartbeats first, then the heavy imports, then scans.

MAVLink starts first and on its own threads, so that its heartbeat does not wait for the heavy
imports; the scan runs on one worker thread (:mod:`service.daemon.scanning`).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]

from mavlink.component.control import Phase
from mavlink.component.presence import RECENT_NS, Health
from mavlink.component.status import CRITICAL, INFO, NOTICE, WARNING
from mavlink.component.vehicle import VehicleLink
from mavlink.wire.first_beat import FirstBeats
from service.config import Config, reload
from service.daemon.control_actions import ControlActions
from service.daemon.health import HealthServer
from service.daemon.load_shedding import Ladder, MachineReadings
from service.daemon.machine import Machine, computer_load, read_machine
from service.daemon.resumption import Landing, LandingWatch
from service.daemon.scan_state import Event, State
from service.daemon.scanning import Scanning
from service.daemon.vehicle_config import TUNABLES, parameters_of, vehicle_config
from service.daemon.warm_up import load_kernels
from service.errors import InputError, OutsideError, SkyreliefError
from service.init_system import Notifier
from service.memory import release_memory
from service.scans.retention import close_open_scans, make_room
from service.version import software
from service.workers import PROCESS, row_of, running

log = logging.getLogger(__name__)

STUCK_S = 10.0  # a scan without a processed frame for this long is reported as critical

HUNG_S = row_of("scan").deadline_s or 20.0
"""Work on one frame or view for this long is a hang: the watchdog is no longer fed."""

CLOSING_S = 120.0  # closing a scan without any progress for this long is a hang, too

PROGRESS_S = 1.5
"""Closing counts as progressing within this time of its last step; checked every second."""

HOUSEKEEPING_S = 2.0  # interval between two checks of the machine, its memory and its disk

COMPILING_S = 180.0
"""The same before anything is compiled, where ``skyrelief warm-up`` has not been run."""

REPORT_FAULT_S = 10.0
"""The operator sees for this long why the service cannot start, before it is restarted."""


class Daemon:
    def __init__(
        self,
        config: Config,
        first: FirstBeats | None = None,
        fault: InputError | None = None,
        *,
        scanning: Scanning | None = None,
        link: type[VehicleLink] = VehicleLink,
        report_fault_s: float = REPORT_FAULT_S,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """``first`` sends heartbeats on the MAVLink links already. With a ``fault`` of the
        configuration, the service only reports it."""
        self._wanted = config  # as last loaded; operators may have tuned it since
        self._quit = threading.Event()
        self._fault, self._report_fault_s = fault, report_fault_s
        self._clock_ns = clock_ns
        self._landing = LandingWatch()
        self._was_armed = False
        self._is_silent = False  # no images arrive, and that was reported
        self.scanning = scanning or Scanning(config)
        self.ladder = Ladder(config.compute)
        self._reported_failure = ""  # of the compute device
        self.actions = ControlActions(self.scanning, self.quit)
        self.vehicle = link(vehicle_config(config), self.actions, first)
        self.scanning.vehicle = self.vehicle

    @property
    def config(self) -> Config:
        return self.scanning.config

    def run(self, notifier: Notifier | None = None) -> None:
        """Serve until :meth:`quit`; raises InputError when the configuration is unusable."""
        notifier = notifier or Notifier()
        self.vehicle.set_health(Health.BOOT)
        self.vehicle.start()
        http = self._serve_health()
        try:
            if self.config.scan.start == "on-boot":
                self.scanning.handle(Event.START)  # a stop before it is ready still counts
            self._load(notifier)
            self.actions.is_ready = True
            notifier.ready()
            PROCESS.every("housekeeping", HOUSEKEEPING_S, self.housekeeping)
            PROCESS.start("recover", lambda _: self.recover())
            self.watch(notifier)
        finally:
            notifier.stopping()
            self.scanning.end(lambda: self._wait_for_closing(notifier))
            self.vehicle.stop()
            if http is not None:
                http.close()
            PROCESS.stop()
            self.scanning.claim.give_up()

    def _load(self, notifier: Notifier) -> None:
        """Load what is heavy. After a fault, report it to the operator for
        :data:`REPORT_FAULT_S` before the init system restarts the service."""
        try:
            if self._fault is not None:
                raise self._fault
            self.scanning.load()
        except SkyreliefError as error:
            if notifier.is_heard:
                self.scanning.fault = str(error)
                self.vehicle.set_health(Health.CRITICAL)
                self.vehicle.statustext(f"Not ready: {error}", CRITICAL)
                notifier.status(str(error))
                log.error("%s; restart in %g s", error, self._report_fault_s)
                self._quit.wait(self._report_fault_s)
            raise

    def watch(self, notifier: Notifier) -> None:
        """Report to the operator and the init system until :meth:`quit`."""
        while not self._quit.wait(0.25):
            self.look()
            if self.is_progressing:
                notifier.alive(self.scanning.phase.value)

    def look(self) -> None:
        """Report to the operator, and follow the vehicle and the time."""
        self.vehicle.set_health(self._health())
        self._follow_flight()
        self._report_camera()
        self.scanning.handle(Event.TICK)

    def _wait_for_closing(self, notifier: Notifier) -> None:
        """Report once a second that the last scan is being closed, unless that hangs."""
        idle_s = self.scanning.idle_closing_s
        hangs = idle_s > self._max_closing_s
        self.vehicle.set_health(Health.CRITICAL if hangs else Health.ACTIVE)
        if idle_s < PROGRESS_S:
            notifier.closing()

    @property
    def _max_closing_s(self) -> float:
        """Seconds without progress after which the closing of a scan counts as hung."""
        return CLOSING_S + self.config.datalink.drain_s  # includes the wait for a dead radio

    @property
    def is_progressing(self) -> bool:
        """False for a hang that only a restart ends; a silent camera is not one."""
        max_s = HUNG_S if self.scanning.is_warm else COMPILING_S
        run = self.scanning.run
        return (
            (run is None or run.busy_s < max_s)
            and self.scanning.idle_closing_s < self._max_closing_s
            and self.vehicle.is_serving
        )

    def quit(self) -> None:
        """Close a running scan, then let :meth:`run` return."""
        self._quit.set()

    def _serve_health(self) -> HealthServer | None:
        """The server of health.http; without it the flight continues."""
        if not self.config.health.http:
            return None
        try:
            return HealthServer(self.config.health.http, self.snapshot)
        except OutsideError as error:
            log.error("%s", error)
            return None

    def snapshot(self) -> dict[str, Any]:
        health, status = self._health(), self.actions.status()
        figures = {"speed_m_s": status.speed_m_s, "distance_m": status.distance_m}
        run, scan, backend = self.scanning.run, self.scanning.scan, self.scanning.backend
        if scan is not None:
            figures |= {
                "frames": scan.recorder.frames,
                "clouds": scan.recorder.keyframes,
                "points": scan.recorder.points,
                "camera_latency_ms": status.camera_latency_ms,
                "camera_latency_sigma_ms": status.camera_latency_sigma_ms,
            } | scan.pipeline.held
        return {
            "ok": health is not Health.CRITICAL,
            "state": self.scanning.phase.value if self.actions.is_ready else "starting",
            "fault": self.scanning.fault,
            "software": software(),
            "scan": status.scan_id,
            "recording_s": status.recording_ms / 1e3,
            "backend": "" if backend is None else backend.name,
            "backend_failure": self._backend_failure(),
            "load": {
                "level": int(self.ladder.level),
                "name": self.ladder.level.label,
                "reason": self.ladder.reason,
            }
            | ({} if run is None else run.lag_figures()),
            "mavlink": self._mavlink(),
            "machine": read_machine(Path(self.config.scan.folder)).to_dict(),
            "workers": running(),
        } | {key: value for key, value in figures.items() if math.isfinite(value)}

    def _mavlink(self) -> dict[str, Any]:
        report = self.vehicle.report()
        figures = {
            "links_up": sum(link.is_up for link in report.links),
            "packets": sum(sum(link.packets.values()) for link in report.links),
            "skipped_bytes": sum(link.skipped_bytes for link in report.links),
            "dropped": report.dropped,
            "unverified": report.unverified,
            "armed": report.is_armed,
            "autopilot_age_s": report.autopilot_age_s,
            "round_trip_ms": report.timesync_round_trip_ms,
            "troubles": [asdict(trouble) for trouble in report.troubles],
        }
        return {key: value for key, value in figures.items() if value is not None}

    def reload(self, wanted: Config) -> None:
        """Apply the live keys of ``wanted``; the others wait for a restart."""
        taken = waiting = list[str]()

        def change(config: Config) -> Config:
            nonlocal taken, waiting
            config, taken, waiting = reload(config, wanted, self._wanted)
            self._wanted = wanted
            return config

        self.scanning.configure(change)
        tuned = parameters_of(self.config).items()
        self.vehicle.show_parameters({n: v for n, v in tuned if TUNABLES[n].key in taken})
        log.info("configuration: now in force: %s", ", ".join(taken) or "nothing new")
        if waiting:
            log.warning("configuration: after a restart: %s", ", ".join(waiting))

    def recover(self) -> None:
        """Close scans that a crash or a power cut left open; then send what the ground lacks."""
        folder = Path(self.config.scan.folder)
        if self.scanning.claim.take(folder):
            close_open_scans(folder, self.scanning.made, lambda: not self._quit.is_set())
        else:
            log.warning("%s: another service uses it; earlier scans are left unchanged", folder)
        self.scanning.offer_backlog()

    def housekeeping(self) -> None:
        """Monitor the machine, shed load, keep free space on the disk, and prepare for a scan."""
        if self._quit.is_set():
            return
        folder, keep_free_mib = Path(self.config.scan.folder), self.config.scan.keep_free_mib
        machine = read_machine(folder)
        cores = psutil.cpu_percent(percpu=True)  # since the last call
        self.vehicle.set_load(computer_load(machine, cores, keep_free_mib))
        self.shed_load(machine)
        make_room(folder, keep_free_mib, self.scanning.in_the_making)
        release_memory()
        if self._was_armed and self.scanning.is_warm:
            load_kernels()

    def shed_load(self, machine: Machine, now_s: float | None = None) -> None:
        """Take the step of the load ladder that heat, memory and the scan's lag ask for."""
        scanning, ladder = self.scanning, self.ladder
        self._report_device()
        run = scanning.run if scanning.life.state is State.SCANNING else None
        readings = replace(
            MachineReadings() if run is None else run.lag(),
            temperature_c=machine.temperature_c,
            throttled=machine.throttled,
            memory_free_mib=machine.memory_left_mib,
        )
        ladder.config = self.config.compute
        move = ladder.update(readings, time.monotonic() if now_s is None else now_s)
        if scanning.level is not ladder.level:
            scanning.set_level(ladder.level)
        if move is not None:
            log.log(logging.WARNING if move.reason else logging.INFO, "%s", move.text)
            self.vehicle.statustext(move.text, WARNING if move.reason else INFO)

    def _backend_failure(self) -> str:
        """Why the CPU replaced the chosen backend; empty when it did not."""
        return getattr(self.scanning.backend, "failure", None) or ""

    def _report_device(self) -> None:
        failure = self._backend_failure()
        if failure and failure != self._reported_failure:
            self.vehicle.statustext(f"Compute device failed: {failure}", CRITICAL)
        self._reported_failure = failure

    def _health(self) -> Health:
        if self.scanning.fault:
            return Health.CRITICAL
        if not self.actions.is_ready:
            return Health.BOOT
        if self.scanning.silent_s > STUCK_S:
            return Health.CRITICAL
        return Health.ACTIVE if self.scanning.phase is not Phase.IDLE else Health.STANDBY

    def _report_camera(self) -> None:
        """Report why the scan does not grow, and when it does again."""
        run = self.scanning.run
        if run is not None and not self.scanning.life.state.is_closing:
            for text in run.new_camera_warnings():
                self.vehicle.statustext(f"Camera: {text}", WARNING)
        was_silent, self._is_silent = self._is_silent, self.scanning.silent_s > STUCK_S
        if self._is_silent and not was_silent:
            self.vehicle.statustext(f"No images for {STUCK_S:.0f} s: nothing is scanned", CRITICAL)
        elif was_silent and not self._is_silent and self.scanning.phase is Phase.SCANNING:
            self.vehicle.statustext("Camera images recovered", NOTICE)

    def _follow_flight(self) -> None:
        """Start and end scans without a command: by arming, after a fault or a power cut in flight,
        and after a landing, as a stop may have been lost."""
        scan, presence, now_ns = self.config.scan, self.vehicle.presence, self._clock_ns()
        is_armed = presence.is_armed and presence.is_certain
        was_armed, self._was_armed = self._was_armed, is_armed
        if scan.start == "on-arm" and is_armed != was_armed:
            if not is_armed:
                self.actions.stop_scan()
            elif text := self.actions.start_scan().text:
                self.vehicle.statustext(text, NOTICE)
        if scan.start == "on-command":
            is_heard = presence.autopilot is not None and presence.is_certain
            if self.scanning.start_again(is_heard, is_armed):
                self.vehicle.statustext("Scan resumed after a restart", WARNING)
        landing = self._landing.look(
            self.scanning.life.state.is_wanted and scan.start == "on-command",
            presence.is_armed,
            presence.is_disarmed(now_ns - RECENT_NS),
            scan.close_after_landing_s,
            1e-9 * now_ns,
        )
        if landing is Landing.LANDED:
            text = f"Landed: scan closes in {scan.close_after_landing_s:g} s unless you arm"
            self.vehicle.statustext(text, WARNING)
        elif landing is Landing.CLOSE:
            self.vehicle.statustext("Scan closed after landing: no stop command", WARNING)
            self.actions.stop_scan()
