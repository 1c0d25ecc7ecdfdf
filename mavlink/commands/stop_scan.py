"""VIDEO_STOP_CAPTURE: close the scan. Every command that stops a scan goes through :func:`stop`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from mavlink.control import Handled
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (2501,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 3.0


STOPS: dict[int, tuple[int, tuple[float, ...]]] = {
    2501: (0, ()),
    2001: (0, ()),
    200: (4, (0.0,)),
    31010: (1, (5.0, 8.0)),
}
"""Commands that stop: number to the parameter that says so and its values (0: always)."""


def is_stop(call: Call) -> bool:
    """True for a call that stops something: it is carried out however often it comes."""
    if call.number not in STOPS:
        return False
    k, values = STOPS[call.number]
    return k == 0 or call.param(k, math.nan) in values


def handle(call: Call, host: Companion) -> Handled | None:
    """Stop; accepted also when nothing runs: it is stopped."""
    return stop(host, host.control.stop_scan)


def stop(host: Companion, how: Callable[[], Handled]) -> Handled:
    """End the scan, its retries, the series of keyframes and the stream of the camera's status.

    ``how`` is the control's way to stop. It is called whatever its state is: what is wanted may
    be a scan although none runs.
    """
    host.camera.stream_status(0.0)
    handled = how()
    host.camera.stop_shooting()
    return handled
