"""IMAGE_STOP_CAPTURE: end a series of keyframes at an interval."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import ACCEPTED, Handled
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (2001,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 3.0


def handle(call: Call, host: Companion) -> Handled | None:
    """End the series; accepted when there is none."""
    host.camera.stop_shooting()
    return ACCEPTED
