"""The interface between commands and the scanning service."""

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
UNAVAILABLE = Answer(Result.DENIED, "no scanning service runs here")


class Work:
    """A command that takes a while: the service reports, the link answers the sender.

    Thread-safe. The service checks ``cancelled``, which is set when the sender no longer wants the
    result, and finishes.
    """

    def __init__(self, is_brief: bool = False) -> None:
        self._lock = threading.Lock()
        # Usually done within half a second: no progress until then, and nothing to cancel.
        self.is_brief = is_brief
        self.fraction = 0.0  # progress, 0 to 1
        self.answer: Handled | None = None  # the result, or the work that follows; None: it runs
        self.cancelled = False

    def report(self, fraction: float) -> None:
        self.fraction = min(1.0, max(0.0, fraction))

    def finish(self, answer: Handled = ACCEPTED) -> None:
        """Report the result, or hand over to other work; the first one counts."""
        with self._lock:
            self.answer = self.answer or answer

    def cancel(self) -> None:
        self.cancelled = not self.is_brief


Handled = Answer | Work


class Phase(Enum):
    IDLE = "idle"
    WAITING = "waiting"  # a scan is wanted: it is retried soon, or follows the one being closed
    SCANNING = "scanning"
    PAUSED = "paused"
    FINALISING = "finalising"  # and no other scan is wanted


class Power(Enum):
    RESTART_SERVICE = "restart service"
    REBOOT = "reboot"
    SHUT_DOWN = "shut down"


@dataclass(frozen=True, slots=True)
class ScanStatus:
    """A snapshot for the operator; unknown figures are NaN or 0."""

    phase: Phase = Phase.IDLE
    scan_id: str = ""
    recording_ms: int = 0
    storage_total_mib: float = 0.0
    storage_free_mib: float = 0.0
    speed_m_s: float = float("nan")
    distance_m: float = float("nan")
    turn_rate_rad_s: float = float("nan")
    camera_latency_ms: float = float("nan")  # measured from the images, whether applied or not
    camera_latency_sigma_ms: float = float("nan")

    @property
    def is_recording(self) -> bool:
        """True from start to stop, pauses and retries included."""
        return self.phase in (Phase.WAITING, Phase.SCANNING, Phase.PAUSED)


Place = tuple[float, float, float]  # latitude and longitude in degrees, metres above mean sea level


@dataclass(frozen=True, slots=True)
class CameraView:
    """Where the camera is and looks, as far as known."""

    camera: Place | None = None
    ground: Place | None = None  # in the middle of the image
    q_ned_camera_wxyz: tuple[float, float, float, float] | None = None  # of the head, FRD
    hfov_deg: float = float("nan")
    vfov_deg: float = float("nan")


class ScanControl(Protocol):
    """The service as commands see it. Every call returns at once; long work is a Work."""

    def status(self) -> ScanStatus:
        return ScanStatus()

    def view(self) -> CameraView:
        return CameraView()

    def start_scan(self) -> Handled:
        """Start a scan, resume a paused one, or retry at once; a second start changes nothing."""
        return UNAVAILABLE

    def stop_scan(self) -> Handled:
        """Close the running scan and drop every retry; always possible."""
        return UNAVAILABLE

    def capture_keyframe(self) -> Handled:
        """Take the next frame as a photo and report it."""
        return UNAVAILABLE

    def pause(self) -> Handled:
        """Take no frames without closing the scan."""
        return UNAVAILABLE

    def resume(self) -> Handled:
        return UNAVAILABLE

    def clear_map(self) -> Handled:
        return UNAVAILABLE

    def finalise(self) -> Handled:
        """Stop as :meth:`stop_scan` does, and answer when all files are written."""
        return UNAVAILABLE

    def self_test(self) -> Handled:
        return UNAVAILABLE

    def erase_scans(self) -> Handled:
        """Delete the finished scans; called only while none runs."""
        return UNAVAILABLE

    def power(self, action: Power) -> Handled:
        """Reboot or shut down; called only while disarmed."""
        return UNAVAILABLE

    def parameter_changed(self, name: str, value: float) -> Answer:
        """Apply a new value of one of ``PARAMETERS``, or refuse it. The baseline always arrives as
        ``SR_BASELINE_M`` (0: automatic), whatever command set it."""
        return UNAVAILABLE


class NoScans(ScanControl):
    """A link without a scanning service: it refuses every command."""
