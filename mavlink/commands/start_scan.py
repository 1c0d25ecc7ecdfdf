"""VIDEO_START_CAPTURE: start a scan, or end its pause. Starting twice is one start."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import ACCEPTED, Handled, Phase
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (2500,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 3.0


def handle(call: Call, host: Companion) -> Handled | None:
    """Start a scan; param 2 asks for CAMERA_CAPTURE_STATUS at that rate in Hz (0: none)."""
    return start(host, call.param(2, 0.0))


def start(host: Companion, status_hz: float = 0.0) -> Handled:
    """Start a scan unless one takes frames, and send the camera's status at a rate."""
    phase = host.control.status().phase
    host.camera.stream_status(status_hz)
    handled = ACCEPTED if phase is Phase.SCANNING else host.control.start_scan()
    host.camera.send_capture_status()
    return handled
