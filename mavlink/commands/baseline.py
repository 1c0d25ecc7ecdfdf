"""DO_SET_CAM_TRIGG_DIST: its distance is the virtual stereo baseline."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import Answer, Handled, Result
from mavlink.messages import CAMERA, ONBOARD

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (206,)
COMPONENTS = frozenset({CAMERA, ONBOARD})
WINDOW_S = 3.0


def handle(call: Call, host: Companion) -> Handled | None:
    """Param 1: metres, 0 lets it follow the altitude; param 3 = 1 takes a keyframe now."""
    handled = set_baseline(host, call.param(1, 0.0))
    if handled.result is Result.ACCEPTED and call.param(3, 0.0) == 1.0:
        host.camera.shoot()
    return handled


def set_baseline(host: Companion, metres: float) -> Answer:
    """Set the baseline through its parameter, so that range and memory are in one place."""
    return host.parameters.change("SR_BASELINE_M", metres)
