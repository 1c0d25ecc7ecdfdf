"""What commands may ask of the scanning service, and how it answers."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Protocol


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5
    CANCELLED = 6


@dataclass(frozen=True, slots=True)
class Answer:
    """A command's final result; the text is for the operator and always sent."""

    result: Result = Result.ACCEPTED
    text: str = ""


ACCEPTED = Answer()


class Work:
    """A command that takes a while: the service reports, the link tells the asker.

    Safe between threads. The service looks at ``cancelled``, set once the asker no longer wants
    it, and finishes.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.fraction = 0.0  # how much is done, 0 to 1
        self.answer: Answer | None = None  # how it ended; None while it runs
        self.cancelled = False

    def report(self, fraction: float) -> None:
        """Say how much is done, 0 to 1."""
        self.fraction = min(1.0, max(0.0, fraction))

    def finish(self, answer: Answer = ACCEPTED) -> None:
        """Say how it ended; the first word stands."""
        with self._lock:
            self.answer = self.answer or answer

    def cancel(self) -> None:
        """Ask for an early end."""
        self.cancelled = True


Handled = Answer | Work


class Phase(Enum):
    """What the scan is doing."""

    IDLE = "idle"
    WAITING = "waiting"  # a scan is wanted and not running: it is tried again soon
    SCANNING = "scanning"
    PAUSED = "paused"
    FINALISING = "finalising"


class Power(Enum):
    """What a reboot command asks for."""

    RESTART_SERVICE = "restart service"
    REBOOT = "reboot"
    SHUT_DOWN = "shut down"


@dataclass(frozen=True, slots=True)
class ScanStatus:
    """A snapshot for the operator; figures that are not known are NaN or 0."""

    phase: Phase = Phase.IDLE
    scan_id: str = ""
    recording_ms: int = 0
    storage_total_mib: float = 0.0
    storage_free_mib: float = 0.0
    speed_m_s: float = float("nan")
    distance_m: float = float("nan")
    turn_rate_rad_s: float = float("nan")
    camera_latency_ms: float = float("nan")  # as the pictures say, whether applied or not
    camera_latency_sigma_ms: float = float("nan")

    @property
    def is_recording(self) -> bool:
        """True from start to stop, pauses and retries included."""
        return self.phase in (Phase.WAITING, Phase.SCANNING, Phase.PAUSED)


class ScanControl(Protocol):
    """The service as commands see it. Every call returns at once; long work is a Work."""

    def status(self) -> ScanStatus:
        """A snapshot."""

    def start_scan(self) -> Handled:
        """Start a scan, end a pause, or try again at once; a second start changes nothing."""

    def stop_scan(self) -> Handled:
        """Want no scan: close the running one and drop every retry; always possible."""

    def capture_keyframe(self) -> Handled:
        """Make the next frame a keyframe and report it."""

    def pause(self) -> Handled:
        """Stop adding to the scan without closing it."""

    def resume(self) -> Handled:
        """Go on after a pause."""

    def clear_map(self) -> Handled:
        """Forget the map of the running scan."""

    def finalise(self) -> Handled:
        """Stop as :meth:`stop_scan` does, and answer when everything is written out."""

    def self_test(self) -> Handled:
        """Check camera, link, disk and compute."""

    def erase_scans(self) -> Handled:
        """Delete the finished scans; asked only while none runs."""

    def power(self, action: Power) -> Handled:
        """Reboot or shut down; asked only while disarmed."""

    def parameter_changed(self, name: str, value: float) -> Answer:
        """Take a new value of one of ``PARAMETERS``, or refuse it.

        The baseline comes this way, whatever command set it: ``SR_BASELINE_M``, 0 automatic.
        """
