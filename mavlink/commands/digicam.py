"""DO_DIGICAM_CONTROL with param 5 = 1: one keyframe (ArduPilot's CAM1_TYPE=5 sends it)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import Answer, Handled, Result
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (203,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 0.3


def handle(call: Call, host: Companion) -> Handled | None:
    """Take a keyframe when param 5 says shoot; zoom, focus and session are not ours."""
    if call.param(5, 0.0) != 1.0:
        return Answer(Result.UNSUPPORTED)
    return host.camera.shoot()
