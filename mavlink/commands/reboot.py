"""PREFLIGHT_REBOOT_SHUTDOWN of the companion; refused unless the vehicle is disarmed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import Answer, Handled, Power, Result
from mavlink.messages import ONBOARD

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (246,)
COMPONENTS = frozenset({ONBOARD})
WINDOW_S = 3.0

COMPANION = {1.0: Power.REBOOT, 2.0: Power.SHUT_DOWN}


def handle(call: Call, host: Companion) -> Handled | None:
    """Param 2: 1 reboots, 2 shuts down; param 3 = 1 with param 4 = 191 restarts the service."""
    action = COMPANION.get(call.param(2, 0.0))
    if action is None and call.param(3, 0.0) == 1.0 and call.param(4, 0.0) == ONBOARD:
        action = Power.RESTART_SERVICE
    if action is None:
        return None  # for the autopilot or another component
    if host.presence.is_armed:
        return Answer(Result.TEMPORARILY_REJECTED, f"{action.value} refused while armed")
    if not host.is_disarmed:
        text = f"{action.value} refused: no autopilot says that it is disarmed"
        return Answer(Result.TEMPORARILY_REJECTED, text)
    return host.control.power(action)
