"""RESET_CAMERA_SETTINGS: every parameter back to its default."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import ACCEPTED, Answer, Handled, Phase, Result
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (529,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 3.0


def handle(call: Call, host: Companion) -> Handled | None:
    """Param 1 = 1 resets; refused while scanning."""
    if call.param(1, 0.0) != 1.0:
        return Answer(Result.DENIED, "reset refused: param 1 must be 1")
    if host.control.status().phase is not Phase.IDLE:
        return Answer(Result.TEMPORARILY_REJECTED, "reset refused while scanning")
    host.parameters.reset()
    return ACCEPTED
