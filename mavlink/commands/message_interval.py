"""SET_MESSAGE_INTERVAL and GET_MESSAGE_INTERVAL for the messages that we can repeat."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import ACCEPTED, Answer, Handled, Result
from mavlink.messages import CAMERA, ONBOARD

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

SET, GET = 511, 510
NUMBERS = (SET, GET)
COMPONENTS = frozenset({CAMERA, ONBOARD})
WINDOW_S = 0.0
SHORTEST_US = 20_000
LONGEST_US = 3.6e9


def handle(call: Call, host: Companion) -> Handled | None:
    """Param 1: message, param 2: interval in us, 0 for the default, -1 for never."""
    if call.is_broadcast:
        return None
    component, number = call.target.component, int(call.param(1, -1.0))
    if not host.streams.can_repeat(component, number):
        return Answer(Result.UNSUPPORTED)
    if call.number == GET:
        host.streams.send_interval(component, number, call.link)
        return ACCEPTED
    interval_us = call.param(2, 0.0)
    if 0.0 < interval_us < SHORTEST_US or interval_us > LONGEST_US:
        return Answer(Result.DENIED)
    host.streams.set_interval(component, number, int(interval_us))
    return ACCEPTED
