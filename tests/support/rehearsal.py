"""A vehicle link over a ScanControl that keeps the state of a scan but scans nothing.

For test benches, and to try a ground station without camera or pipeline.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from typing import Any

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
from mavlink.component.presence import Health
from mavlink.component.vehicle import VehicleConfig, VehicleLink


@dataclass
class RehearsalControl:
    """Answers every command from its own state and records the requests in order."""

    state: ScanStatus = field(
        default_factory=lambda: ScanStatus(storage_total_mib=1000.0, storage_free_mib=750.0)
    )
    asked: list[str] = field(default_factory=list)
    works: dict[str, Work] = field(default_factory=dict)  # answers that take time, by name
    answers: dict[str, Answer] = field(default_factory=dict)  # answers other than ACCEPTED
    sees: CameraView = field(default_factory=CameraView)

    def _ask(self, name: str, phase: Phase | None = None) -> Handled:
        self.asked.append(name)
        answer = self.answers.get(name, ACCEPTED)
        if answer.result is Result.ACCEPTED and phase is not None:
            self.state = replace(self.state, phase=phase)
        return self.works.get(name, answer)

    def status(self) -> ScanStatus:
        return self.state

    def view(self) -> CameraView:
        return self.sees

    def start_scan(self) -> Handled:
        return self._ask("start_scan", Phase.SCANNING)

    def stop_scan(self) -> Handled:
        return self._ask("stop_scan", Phase.IDLE)

    def capture_keyframe(self) -> Handled:
        return self._ask("capture_keyframe")

    def pause(self) -> Handled:
        return self._ask("pause", Phase.PAUSED)

    def resume(self) -> Handled:
        return self._ask("resume", Phase.SCANNING)

    def clear_map(self) -> Handled:
        return self._ask("clear_map")

    def finalise(self) -> Handled:
        return self._ask("finalise", Phase.IDLE)

    def self_test(self) -> Handled:
        return self._ask("self_test")

    def erase_scans(self) -> Handled:
        return self._ask("erase_scans")

    def power(self, action: Power) -> Handled:
        """Record the request; nothing is switched off."""
        return self._ask(f"power: {action.value}")

    def parameter_changed(self, name: str, value: float) -> Answer:
        """Accept it, unless ``answers`` holds a refusal by this name."""
        self.asked.append(f"{name}={value:g}")
        return self.answers.get(name, ACCEPTED)


class RehearsalVehicle:
    """A context manager: a VehicleLink with confirmed health, over a :class:`RehearsalControl`."""

    def __init__(self, *links: str, **settings: Any) -> None:
        """``settings`` are fields of :class:`~mavlink.component.vehicle.VehicleConfig`."""
        self.control = RehearsalControl()
        self.link = VehicleLink(VehicleConfig(links=links, **settings), self.control)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._confirm, name="rehearsal", daemon=True)

    def __enter__(self) -> RehearsalVehicle:
        """Open the links; listening links are open when this returns, if possible."""
        self.link.start()
        self._thread.start()
        deadline = time.monotonic() + 5.0
        while not self._is_listening() and time.monotonic() < deadline:
            time.sleep(0.01)
        return self

    def _is_listening(self) -> bool:
        ears = [r for r in self.link.report().links if r.name.startswith(("udpin", "tcpin"))]
        return all(report.is_up for report in ears)

    def __exit__(self, *_: object) -> None:
        """Close everything."""
        self._stop.set()
        self._thread.join()
        self.link.stop()

    def _confirm(self) -> None:
        while not self._stop.wait(0.2):
            recording = self.control.state.is_recording
            self.link.set_health(Health.ACTIVE if recording else Health.STANDBY)
