"""Whether a scan outlives its flight, as when the one command that stops it is lost."""

from __future__ import annotations

from enum import Enum, auto


class Landing(Enum):
    """What to do after a look."""

    NOTHING = auto()
    LANDED = auto()  # announce it
    CLOSE = auto()  # close the scan


class LandingWatch:
    """Look at it often: it notices that the motors of a scan's flight stopped for good."""

    def __init__(self) -> None:
        self._has_flown = False  # armed while this scan was wanted
        self._landed_s: float | None = None

    def look(
        self,
        wants_scan: bool,
        is_armed: bool,
        is_disarmed: bool,
        close_after_s: float,
        now_s: float,
    ) -> Landing:
        """Return what to do at ``now_s`` of a clock that never goes back.

        ``is_disarmed`` is what the autopilot says; it is false where none is heard. A
        ``close_after_s`` of 0 never closes.
        """
        if is_armed or not wants_scan or close_after_s <= 0.0:
            self._has_flown = wants_scan and (is_armed or self._has_flown)
            self._landed_s = None
            return Landing.NOTHING
        if self._landed_s is None:
            if not (self._has_flown and is_disarmed):
                return Landing.NOTHING
            self._landed_s = now_s
            return Landing.LANDED
        if now_s - self._landed_s < close_after_s:
            return Landing.NOTHING
        self._has_flown, self._landed_s = False, None
        return Landing.CLOSE
