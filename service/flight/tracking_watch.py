"""Tells the operator when vision has lost its way for long, why, and when it has it again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from recon.tracking.odometry import Tracked

LOST_S = 10.0
FOUND = ("tracked", "keyframe")
"""States with a pose that rests on more than the segment's first image."""


class TrackingWatch:
    """Looks at every frame; what is to be said goes to ``tell``, once for each loss."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._since_ns: int | None = None  # the first frame without a pose
        self._frames, self._is_told = 0, False
        self._reasons: Counter[str] = Counter()

    def look(self, tracked: Tracked, time_ns: int) -> None:
        """Take what a frame gave; times never go back. A camera that stands still is not lost."""
        if tracked.state in FOUND:
            if self._is_told:
                self._tell("Tracking recovered")
            self._since_ns, self._frames, self._is_told = None, 0, False
            self._reasons.clear()
            return
        self._since_ns = time_ns if self._since_ns is None else self._since_ns
        self._frames += 1
        self._reasons[tracked.reason] += tracked.state == "lost"
        for_s = 1e-9 * (time_ns - self._since_ns)
        is_lost = 2 * self._reasons.total() > self._frames
        if for_s >= LOST_S and is_lost and not self._is_told:
            ((reason, _),) = self._reasons.most_common(1)
            self._tell(f"Tracking lost for {for_s:.0f} s ({reason}): nothing is scanned")
            self._is_told = True
