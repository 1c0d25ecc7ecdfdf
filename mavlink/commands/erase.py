"""STORAGE_FORMAT: erase the finished scans; refused while one runs or unless disarmed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import Answer, Handled, Phase, Result
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (526,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 3.0


def handle(call: Call, host: Companion) -> Handled | None:
    """Param 1: storage (1, or 0 for all), param 2 = 1 erases, param 3 = 1 resets the count."""
    if call.param(1, 0.0) not in (0.0, 1.0) or call.param(2, 0.0) != 1.0:
        return Answer(Result.DENIED, "erase refused: storage 1 and param 2 = 1 are needed")
    if host.control.status().phase is not Phase.IDLE:
        return Answer(Result.TEMPORARILY_REJECTED, "erase refused while scanning")
    if host.presence.is_armed:
        return Answer(Result.TEMPORARILY_REJECTED, "erase refused while armed")
    if not host.is_disarmed:
        text = "erase refused: no autopilot says that it is disarmed"
        return Answer(Result.TEMPORARILY_REJECTED, text)
    if call.param(3, 0.0) == 1.0:
        host.camera.reset_image_log()
    return host.control.erase_scans()
