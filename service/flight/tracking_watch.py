"""Warns the operator when tracking is lost for long, with the reason, and when it recovers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from recon.tracking.odometry import Tracked, Tracking

LOST_S = 10.0
FOUND = (Tracking.TRACKED, Tracking.KEYFRAME, Tracking.SKIPPED)
"""States with a pose that rests on more than the segment's first image."""


class TrackingWatch:
    """Looks at every frame; ``warn`` gets one text for each loss and one for its end."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._since_ns: int | None = None  # the first frame without a pose
        self._frames, self._is_reported = 0, False
        self._reasons: Counter[str] = Counter()

    def look(self, tracked: Tracked, time_ns: int) -> None:
        """Take the result of a frame; times never decrease. A camera that stands still is not
        lost."""
        if tracked.state in FOUND:
            if self._is_reported:
                self._warn("Tracking recovered")
            self._since_ns, self._frames, self._is_reported = None, 0, False
            self._reasons.clear()
            return
        self._since_ns = time_ns if self._since_ns is None else self._since_ns
        self._frames += 1
        self._reasons[tracked.reason] += tracked.state is Tracking.LOST
        for_s = 1e-9 * (time_ns - self._since_ns)
        is_lost = 2 * self._reasons.total() > self._frames
        if for_s >= LOST_S and is_lost and not self._is_reported:
            ((reason, _),) = self._reasons.most_common(1)
            self._warn(f"Tracking lost for {for_s:.0f} s ({reason}): nothing is scanned")
            self._is_reported = True
