"""A daemon whose scans, camera and vehicle are a test's."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from autopilot import AUTOPILOT, beat, packed
from paths import DEMO

from mavlink.component.presence import Health
from mavlink.component.vehicle import VehicleLink
from mavlink.telemetry.history import VehicleHistory
from mavlink.wire.dialect import dialect
from recon.backends.cpu import CpuBackend
from recon.types import Camera
from service.cameras.camera_file import load_camera
from service.cameras.source import CameraFrame, CameraSource
from service.config import Config, load_config
from service.daemon.runtime import Daemon
from service.daemon.scan_state import ScanLife
from service.daemon.scanning import Scanning, ScanRun
from service.flight.scan import Scan, ScanInputs, create_store

MODEL = DEMO / "camera.yaml"


class HeardVehicle(VehicleLink):
    """Notes what the service says; its autopilot does what the test says."""

    is_serving = True  # its threads need not run

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.said: list[str] = []
        self.answers: list[bool] = []  # which of them answer a command
        self.looks: list[Health] = []

    def statustext(self, text: str, severity: int = 0, is_answer: bool = False) -> None:
        self.said.append(text)
        self.answers.append(is_answer)

    def set_health(self, health: Health) -> None:
        self.looks.append(health)

    def arm(self, armed: bool = True, now_ns: int | None = None) -> None:
        """A heartbeat of the autopilot is heard."""
        ear = dialect.MAVLink(None)
        (message,) = ear.parse_buffer(packed(beat(armed=armed), AUTOPILOT))
        self.presence.hear(message, time.monotonic_ns() if now_ns is None else now_ns)


class FakeCamera(CameraSource):
    """A live camera without images."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        super().__init__("gimbal")
        self.size_px, self.is_live, self.start_monotonic_ns = size_px, True, 0
        self.closed = threading.Event()

    def __iter__(self) -> Iterator[CameraFrame]:
        return iter(())

    def close(self) -> None:
        self.closed.set()


class Onboard(Daemon):
    """A daemon with a :class:`HeardVehicle`, whose scans do what ``script`` does or get the camera
    of ``opener``; by default a scan fails at once and is retried at once."""

    vehicle: HeardVehicle

    def __init__(
        self,
        folder: Path,
        *given: str,
        script: Callable[[ScanRun], object] | None = None,
        opener: Callable[[str], Any] | None = None,
        of: type[Scanning] = Scanning,
        **seams: Any,
    ) -> None:
        config = load_config(
            None, [f"scan.folder={folder}", "health.http=", "mavlink.system_id=1", *given]
        )
        outer: dict[str, Any] = {"link": HeardVehicle}
        outer |= {key: seams.pop(key) for key in ("clock_ns", "link") if key in seams}

        inner: dict[str, Any] = {"attempt": script, "opener": opener, "life": ScanLife(0.0, 0.0)}
        super().__init__(config, scanning=of(config, **inner | seams), **outer)

    def equip(self) -> None:
        """Load what a scan needs, without configuration."""
        self.scanning.camera, self.scanning.backend = load_camera(MODEL), CpuBackend()
        self.actions.is_ready = True


def camera_of(source: object) -> Callable[[str], CameraSource]:
    """Opens ``source``, whatever is configured."""
    found: Any = source
    return lambda _: found


def real_scan(
    folder: Path, *, config: Config | None = None, history: VehicleHistory | None = None,
    **inputs: Any,
) -> Scan:  # fmt: skip
    """A scan into ``folder`` over a camera without images; end it by ``mapper.finish()``."""
    K = np.array([[140.0, 0.0, 79.5], [0.0, 140.0, 44.5], [0.0, 0.0, 1.0]])
    camera = Camera(K, np.zeros(5), (160, 90))
    source: Any = FakeCamera(camera.size_px)
    made = ScanInputs(
        source, camera, config or load_config(None), CpuBackend(), folder, folder.name, 0,
        history=history, **inputs,
    )  # fmt: skip
    return Scan(made, create_store(made))
