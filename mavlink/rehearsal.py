"""A ScanControl that keeps the state of a scan but scans nothing.

For benches and for trying a ground station on the table without camera or pipeline.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from mavlink.control import ACCEPTED, Answer, Handled, Phase, Power, Result, ScanStatus, Work


@dataclass
class RehearsalControl:
    """Answers every command from its own state and remembers what it was asked, in order."""

    state: ScanStatus = field(
        default_factory=lambda: ScanStatus(storage_total_mib=1000.0, storage_free_mib=750.0)
    )
    asked: list[str] = field(default_factory=list)
    works: dict[str, Work] = field(default_factory=dict)  # answers that take a while, by name
    answers: dict[str, Answer] = field(default_factory=dict)  # answers other than ACCEPTED

    def _ask(self, name: str, phase: Phase | None = None) -> Handled:
        self.asked.append(name)
        answer = self.answers.get(name, ACCEPTED)
        if answer.result is Result.ACCEPTED and phase is not None:
            self.state = replace(self.state, phase=phase)
        return self.works.get(name, answer)

    def status(self) -> ScanStatus:
        """The snapshot."""
        return self.state

    def start_scan(self) -> Handled:
        """Scan."""
        return self._ask("start_scan", Phase.SCANNING)

    def stop_scan(self) -> Handled:
        """Be idle."""
        return self._ask("stop_scan", Phase.IDLE)

    def capture_keyframe(self) -> Handled:
        """Take note of it."""
        return self._ask("capture_keyframe")

    def pause(self) -> Handled:
        """Pause."""
        return self._ask("pause", Phase.PAUSED)

    def resume(self) -> Handled:
        """Go on."""
        return self._ask("resume", Phase.SCANNING)

    def clear_map(self) -> Handled:
        """Take note of it."""
        return self._ask("clear_map")

    def finalise(self) -> Handled:
        """Be idle."""
        return self._ask("finalise", Phase.IDLE)

    def self_test(self) -> Handled:
        """Take note of it."""
        return self._ask("self_test")

    def erase_scans(self) -> Handled:
        """Take note of it."""
        return self._ask("erase_scans")

    def power(self, action: Power) -> Handled:
        """Take note of it; nothing is switched off."""
        return self._ask(f"power: {action.value}")

    def parameter_changed(self, name: str, value: float) -> Answer:
        """Take it, unless ``answers`` holds a refusal by this name."""
        self.asked.append(f"{name}={value:g}")
        return self.answers.get(name, ACCEPTED)
