"""IMAGE_START_CAPTURE: one keyframe now, or several at an interval.

A single shot with a sequence number is taken once however often it comes. Without a number a
repetition within a moment is the same call heard on two links.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink.control import ACCEPTED, Answer, Handled, Result
from mavlink.messages import CAMERA

if TYPE_CHECKING:
    from mavlink.command_desk import Call
    from mavlink.companion import Companion

NUMBERS = (2000,)
COMPONENTS = frozenset({CAMERA})
WINDOW_S = 0.3
LONGEST_INTERVAL_S = 3600.0
MOST = 100_000


def handle(call: Call, host: Companion) -> Handled | None:
    """Param 2: interval in s, param 3: count (0: until stopped), param 4: sequence."""
    interval_s, count = call.param(2, 0.0), call.param(3, 1.0)
    if not 0.0 <= interval_s <= LONGEST_INTERVAL_S or not 0.0 <= count <= MOST:
        return Answer(Result.DENIED, "photo refused: interval or count is out of range")
    if count == 1.0:
        sequence = call.param(4, 0.0)
        if sequence > 0.0 and not host.camera.is_new_shot(call.source, sequence):
            return ACCEPTED
        return host.camera.shoot()
    if interval_s < host.camera.config.shortest_interval_s:
        return Answer(Result.DENIED, "photo refused: the interval is too short")
    return host.camera.shoot_every(interval_s, int(count))
