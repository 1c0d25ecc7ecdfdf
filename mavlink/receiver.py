"""The GNSS receiver's own altitude beside the autopilot's, which rests on its barometer."""

from __future__ import annotations

import math

from mavlink.state import ReceiverAltitude
from mavlink.track import Bracket, Track

ALTITUDE = 3
"""Column of the receiver's samples."""

EKF_ALTITUDE = 2
"""Column of the autopilot's positions."""


def receiver_above(accuracy: Bracket | None, positions: Track) -> ReceiverAltitude | None:
    """The fix nearest in time against the autopilot's altitude then; None without either."""
    if accuracy is None:
        return None
    at = positions.around(accuracy.nearer_ns)
    if at is None:
        return None
    before, after = at.before[EKF_ALTITUDE], at.after[EKF_ALTITUDE]
    above = accuracy.nearer[ALTITUDE] - (before + (after - before) * at.fraction)
    return ReceiverAltitude(accuracy.nearer_ns, above) if math.isfinite(above) else None
