"""USER_1 to the onboard computer: what no standard command says. Param 1 is the action.

1 pause, 2 resume, 3 clear the map, 4 baseline of param 2 metres (0: automatic),
5 finalise, 6 self-test, 7 start a scan, 8 stop it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from mavlink.commands.baseline import set_baseline
from mavlink.commands.start_scan import start
from mavlink.commands.stop_scan import stop
from mavlink.control import Answer, Handled, Phase, Result
from mavlink.messages import ONBOARD

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (31010,)
COMPONENTS = frozenset({ONBOARD})
WINDOW_S = 3.0

PAUSE, RESUME, CLEAR_MAP, BASELINE, FINALISE, SELF_TEST, START, STOP = range(1, 9)


def handle(call: Call, host: Companion) -> Handled | None:
    """Carry out the action of param 1."""
    action = call.param(1, 0.0)
    if action == PAUSE:
        return _while_recording(host, host.control.pause)
    if action == RESUME:
        return _while_recording(host, host.control.resume)
    if action == CLEAR_MAP:
        return host.control.clear_map()
    if action == BASELINE:
        return set_baseline(host, call.param(2, 0.0))
    if action == FINALISE:
        return stop(host, host.control.finalise)
    if action == SELF_TEST:
        return _self_test(host)
    if action == START:
        return start(host)
    if action == STOP:
        return stop(host, host.control.stop_scan)
    return Answer(Result.DENIED, "unknown action of USER_1; 1 to 8 are known")


def _while_recording(host: Companion, action: Callable[[], Handled]) -> Handled:
    if not host.control.status().is_recording:
        return Answer(Result.TEMPORARILY_REJECTED, "no scan is running")
    return action()


def _self_test(host: Companion) -> Handled:
    if host.control.status().phase is not Phase.IDLE:
        return Answer(Result.TEMPORARILY_REJECTED, "stop the scan before the self-test")
    return host.control.self_test()
