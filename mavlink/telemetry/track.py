"""Samples of one quantity in order of time, and the two samples around a given time."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass

Row = tuple[float, ...]

EXTRAPOLATE_NS = 20_000_000
MAX_GAP_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Bracket:
    """The samples before and after a time; the same row twice at the end of a track."""

    before_ns: int
    after_ns: int
    before: Row
    after: Row
    time_ns: int

    @property
    def fraction(self) -> float:
        """Position of the time from before (0) to after (1); slightly outside past an end."""
        span = self.after_ns - self.before_ns
        return (self.time_ns - self.before_ns) / span if span else 0.0

    @property
    def nearer(self) -> Row:
        """The sample nearer to the instant."""
        return self.before if self.fraction < 0.5 else self.after

    @property
    def nearer_ns(self) -> int:
        """Time of the nearer sample."""
        return self.before_ns if self.fraction < 0.5 else self.after_ns

    @property
    def gap_s(self) -> float:
        """Seconds between the two samples."""
        return (self.after_ns - self.before_ns) * 1e-9

    @property
    def age_ms(self) -> float:
        """Milliseconds from the time to the nearer sample."""
        near = min(abs(self.time_ns - self.before_ns), abs(self.after_ns - self.time_ns))
        return near * 1e-6

    @property
    def curvature_s2(self) -> float:
        """``dt_before * dt_after / 2``: times an acceleration, the linear interpolation error."""
        before = (self.time_ns - self.before_ns) * 1e-9
        after = (self.after_ns - self.time_ns) * 1e-9
        return 0.5 * abs(before * after)


class Track:
    """Rows of floats sorted by time. Not thread-safe by itself."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._rows: list[Row] = []

    def __len__(self) -> int:
        return len(self._times)

    @property
    def first_ns(self) -> int | None:
        """Time of the oldest sample."""
        return self._times[0] if self._times else None

    @property
    def last_ns(self) -> int | None:
        """Time of the newest sample."""
        return self._times[-1] if self._times else None

    @property
    def last_row(self) -> Row | None:
        """The newest sample."""
        return self._rows[-1] if self._rows else None

    def items(self) -> list[tuple[int, Row]]:
        """All samples, oldest first."""
        return list(zip(self._times, self._rows, strict=True))

    def add(self, time_ns: int, row: Row) -> None:
        """Insert in order of time; replaces a sample of the same time."""
        if not self._times or time_ns > self._times[-1]:
            self._times.append(time_ns)
            self._rows.append(row)
            return
        i = bisect_left(self._times, time_ns)
        if self._times[i] == time_ns:
            self._rows[i] = row
        else:
            self._times.insert(i, time_ns)
            self._rows.insert(i, row)

    def clear(self) -> None:
        """Discard everything."""
        self._times.clear()
        self._rows.clear()

    def forget_before(self, time_ns: int) -> None:
        """Drop older samples, in batches so that the cost per sample stays constant."""
        i = bisect_left(self._times, time_ns)
        if i > 64 and 2 * i > len(self._times):
            del self._times[:i]
            del self._rows[:i]

    def around(
        self,
        time_ns: int,
        max_gap_ns: int = MAX_GAP_NS,
        extrapolate_ns: int = EXTRAPOLATE_NS,
    ) -> Bracket | None:
        """The samples around a time, or None without samples near enough.

        Inside the track the two neighbours must be at most ``max_gap_ns`` apart, unless one of
        them is within ``extrapolate_ns``. Past an end the last two samples are extrapolated by at
        most ``extrapolate_ns``.
        """
        times = self._times
        if not times:
            return None
        i = bisect_right(times, time_ns)
        if 0 < i < len(times):
            return self._inside(i, time_ns, max_gap_ns, extrapolate_ns)
        return self._past_end(bool(i), time_ns, max_gap_ns, extrapolate_ns)

    def _past_end(self, late: bool, time_ns: int, max_gap: int, near: int) -> Bracket | None:
        times, rows = self._times, self._rows
        k = len(times) - 1 if late else 0
        beyond = abs(time_ns - times[k])
        if beyond > near:
            return None
        step = -1 if late else 1
        j = k + step
        # Samples closer together than the extrapolated step would amplify their noise.
        while 0 <= j < len(times) and abs(times[j] - times[k]) < beyond:
            j += step
        if beyond == 0 or not 0 <= j < len(times) or abs(times[j] - times[k]) > max_gap:
            return Bracket(times[k], times[k], rows[k], rows[k], time_ns)
        a, b = (j, k) if late else (k, j)
        return Bracket(times[a], times[b], rows[a], rows[b], time_ns)

    def _inside(self, i: int, time_ns: int, max_gap: int, near: int) -> Bracket | None:
        before, after = self._times[i - 1], self._times[i]
        if after - before <= max_gap:
            return Bracket(before, after, self._rows[i - 1], self._rows[i], time_ns)
        k = i - 1 if time_ns - before <= after - time_ns else i
        if abs(time_ns - self._times[k]) > near:
            return None
        return Bracket(self._times[k], self._times[k], self._rows[k], self._rows[k], time_ns)
