"""DO_CONTROL_VIDEO, the old way to start (param 4 = 1 or 2) and stop (0) recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.commands.start_scan import start
from mavlink.commands.stop_scan import stop
from mavlink.control import Answer, Handled, Result
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (200,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 3.0


def handle(call: Call, host: Companion) -> Handled | None:
    """Start or stop a scan by param 4."""
    recording = call.param(4, -1.0)
    if recording in (1.0, 2.0):
        return start(host)
    if recording == 0.0:
        return stop(host, host.control.stop_scan)
    return Answer(Result.DENIED, "DO_CONTROL_VIDEO: param 4 must be 0, 1 or 2")
