"""REQUEST_MESSAGE: send one message of a kind now (param 1: its number)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import ACCEPTED, Answer, Handled, Result
from mavlink.messages import CAMERA, ONBOARD

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (512,)
COMPONENTS = frozenset({CAMERA, ONBOARD})
WINDOW_S = 0.0


def handle(call: Call, host: Companion) -> Handled | None:
    """Send it from the component asked; UNSUPPORTED when that one has no such message.

    Where all are asked it comes from the first that has it.
    """
    asked = (CAMERA, ONBOARD) if call.is_broadcast else (call.target.component,)
    number = int(call.param(1, -1.0))
    index = int(max(-1.0, min(2.0**31, call.param(2, 0.0))))
    if any(host.send_requested(c, number, index, call.link) for c in asked):
        return ACCEPTED
    return None if call.is_broadcast else Answer(Result.UNSUPPORTED)
