"""``camera.source = "sim:"``: a simulated flight in place of a camera and an autopilot.

The flight is rendered once into the state directory, then played in a loop by a separate process,
``skyrelief simulate --live --loop``; the configuration's camera, camera model and MAVLink link are
set to it. Options: ``sim:?size=640x360&fps=10&duration_s=30&seed=1``.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from socket import SOCK_DGRAM

from service.cameras import parse_source, reject_options
from service.config import Config, ScanConfig
from service.errors import InputError, refusing
from service.init_system import Notifier
from service.listener import free_ports
from service.scans.writing import existing, writing_folder
from service.workers import PROCESS, Worker, python_command, run_process

log = logging.getLogger(__name__)

OPERATOR = "udpout:127.0.0.1:14550"  # default endpoint of skyrelief ctl and ground stations
REPORT_EVERY = 25  # frames between two progress lines


class SimulatedFlight:
    def __init__(
        self, source: str, render: Callable[[Path, dict[str, str]], None] | None = None
    ) -> None:
        """The flight of a source ``sim:`` with its options, rendered if necessary. InputError for
        invalid options."""
        _, rest, options = parse_source(source)
        given = {"size": "640x360", "fps": "10", "duration_s": "30", "seed": "1"}
        reject_options("sim", options, tuple(given))
        if rest:
            raise InputError(f"{source}: write sim: or sim:?size=640x360")
        self._state = state_folder()
        given |= options
        self.folder = self._state / "-".join(["sim", *given.values()]).replace("/", "_")
        if not (self.folder / "flight.mp4").exists():
            with writing_folder(self.folder) as part:
                (render or render_flight)(part, given)
        self._ports = free_ports(2, SOCK_DGRAM)

    def configured(self, config: Config) -> Config:
        """``config`` with this flight as its camera and its autopilot.

        A scan starts at once, unless arming starts it; scans go to the state directory if the
        default folder cannot be written.
        """
        if not is_simulated(config):
            return config
        video, telemetry = self._ports
        source, model = f"stream:udp://127.0.0.1:{video}", str(self.folder / "camera.yaml")
        links = (*config.mavlink.links, f"udpin:127.0.0.1:{telemetry}", OPERATOR)
        scan = config.scan
        if scan.start == "on-command":
            scan = replace(scan, start="on-boot")
        folder = Path(scan.folder)
        if folder == Path(ScanConfig().folder) and not os.access(existing(folder), os.W_OK):
            scan = replace(scan, folder=str(self._state / "scans"))
        return replace(
            config,
            camera=replace(config.camera, source=source, model=model),
            mavlink=replace(config.mavlink, links=links),
            scan=scan,
        )

    def start(self) -> Worker:
        """Play the flight until the worker is stopped; it is restarted when it fails."""
        return PROCESS.start("simulated flight", self._play)

    def _play(self, worker: Worker) -> None:
        video, telemetry = self._ports
        command = python_command(
            "service.cli", "simulate", "--out", str(self.folder), "--live",
            "--loop", "--video-to", f"udp://127.0.0.1:{video}?pkt_size=1316",
            "--mavlink-to", f"127.0.0.1:{telemetry}", "--until-stdin-ends",
        )  # fmt: skip
        run_process(worker, worker.name, command)


def is_simulated(config: Config) -> bool:
    return config.camera.source.startswith("sim:")


def state_folder() -> Path:
    """The service's data folder: systemd's state directory, or the user's."""
    if systemd := os.environ.get("STATE_DIRECTORY", "").partition(":")[0]:
        return Path(systemd)
    home = os.environ.get("XDG_STATE_HOME", "")
    return (Path(home) if home else Path.home() / ".local" / "state") / "skyrelief"


def render_flight(folder: Path, given: dict[str, str]) -> None:
    log.info("laying out the site of the simulated flight; rendering takes some minutes, once")
    from service.sim import recording
    from service.sim.flight import FlightPlan

    with refusing("camera.source sim"):
        W, _, H = given["size"].partition("x")
        options = recording.SimulationOptions(
            FlightPlan("legs", float(given["duration_s"]), legs=2),
            seed=int(given["seed"]),
            size_px=(int(W), int(H)),
            fps=float(given["fps"]),
            depth_frames=0,
        )
        simulation = recording.prepare(options)
    notifier = Notifier()

    def report(done: int, total: int) -> None:
        if done % REPORT_EVERY == 0 or done == total:
            log.info("rendering the simulated flight: frame %d of %d", done, total)
            notifier.closing()  # extends systemd's timeout

    recording.write(simulation, folder, report)
