"""A recording's clock against its log's: by how much it is off, and how fast it gains."""

from __future__ import annotations

from mavlink.telemetry.latency import KEPT, SURE, LatencyEstimate
from service.flight.telemetry_check import AHEAD_NS, REACH_NS, TelemetryCheck

MIN_OFF_MS, OFF_SIGMAS = 100.0, 10.0  # a clock that is surely off: less is a camera's latency

MIN_RATE, RATE_SIGMAS = 3e-4, 6.0
"""By how much a clock gains that is surely another one. Crystals differ by a tenth of it, 29.97
from 30 images a second by three times as much."""


class RecordingClock:
    """Judges the clock of a scan's recording by how its images turn."""

    def __init__(self, check: TelemetryCheck) -> None:
        self._check = check
        self._in_log: LatencyEstimate | None = None  # in the whole log, when _compared with it
        self._compared: LatencyEstimate | None = None
        self._rated_ns: int | None = None  # the look whose frames gave no rate

    def off_ms(self, has_ended: bool = False) -> float | None:
        """By how much the stamps are surely late, beyond a camera's latency; or None.

        A latency near by only gives rise to a search of the whole log, in which another turn may
        look alike; so does the end of a recording that shows none.
        """
        near, history = self._check.latency, self._check.history
        is_due = has_ended if near is None else self._off_ms(near) is not None
        if history is None or not is_due:
            return None
        if near is not self._compared or (has_ended and self._in_log is None):
            self._compared = near
            self._in_log = self._check.turns.anywhere(self._check.attitudes(history)())
        return None if self._in_log is None else self._off_ms(self._in_log)

    def rate(self, has_ended: bool = False) -> float | None:
        """How many seconds it surely gains in each of the log's; or None."""
        check, history = self._check, self._check.history
        is_due = has_ended or self._rated_ns != check.next_look_ns
        if history is None or check.seen_ns is None or not is_due:
            return None
        self._rated_ns, first_ns = check.next_look_ns, check.turns.since_ns(KEPT)
        if first_ns is None:
            return None
        near = check.attitudes(history)(first_ns - REACH_NS, check.seen_ns + AHEAD_NS)
        found = check.turns.rate(near)
        if found is None or abs(found[0]) < max(MIN_RATE, RATE_SIGMAS * found[1]):
            return None
        return found[0]

    def _off_ms(self, found: LatencyEstimate) -> float | None:
        if found.correlation < SURE:
            return None
        off_ms = found.latency_ms - self._check.camera.latency_ms
        is_off = abs(off_ms) > max(MIN_OFF_MS, OFF_SIGMAS * found.sigma_ms)
        return off_ms if is_off else None
