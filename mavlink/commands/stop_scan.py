"""VIDEO_STOP_CAPTURE: close the scan. Stopping without a scan is accepted: it is stopped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import ACCEPTED, Handled
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (2501,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 3.0


def handle(call: Call, host: Companion) -> Handled | None:
    """Close the running scan, if any."""
    return stop(host)


def stop(host: Companion) -> Handled:
    """Close the running scan, if any, and end the stream of the camera's status."""
    host.camera.stream_status(0.0)
    handled = host.control.stop_scan() if host.control.status().is_recording else ACCEPTED
    host.camera.send_capture_status()
    return handled
