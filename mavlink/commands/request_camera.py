"""The older questions about the camera, each for one message (older ground stations)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import ACCEPTED, Answer, Handled, Result
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

MESSAGES = {521: 259, 522: 260, 525: 261, 527: 262, 2504: 269, 2505: 270}
NUMBERS = tuple(MESSAGES)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 0.0


def handle(call: Call, host: Companion) -> Handled | None:
    """Send the message that the command stands for; 525 puts the answer flag in param 2."""
    flag = 2 if call.number == 525 else 1
    if call.number not in (2504, 2505) and call.param(flag, 1.0) != 1.0:
        return ACCEPTED  # asked for nothing
    if host.send_requested(CAMERA, MESSAGES[call.number], 0, call.link):
        return ACCEPTED
    return Answer(Result.UNSUPPORTED)
