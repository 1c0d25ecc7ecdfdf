"""The autopilot's clocks against ours: its boot clock, live and in a log, and unix time.

A message is sampled at ``time_boot_ms`` of its sender and arrives after an unknown delay, so the
offset of the two clocks is the lower edge of (arrival - boot time). Live, TIMESYNC measures it
more precisely: we send ts1 = our ns with tc1 = 0; the autopilot echoes ts1 with tc1 = its boot
time in ns, and a filter like PX4's follows the offset.

Fusion uses the boot clock; only names and labels use unix time, which a computer without clock
battery and network takes from the autopilot's GNSS receiver.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mavlink.wire.dialect import dialect
from mavlink.wire.messages import Address

I64 = npt.NDArray[np.int64]
F64 = npt.NDArray[np.float64]

WRAP_MS = 2**32  # time_boot_ms is a uint32: 49.7 days
WRAP_EDGE_MS = 600_000
REBOOT_BACK_MS = 3_000.0  # messages arrive a little out of order; a reboot goes back further
WINDOW_NS = 5_000_000_000
MS = 1_000_000


class BootCounter:
    """Unwraps one sender's 32-bit ``time_boot_ms`` and detects reboots."""

    def __init__(self) -> None:
        self.session = 0
        self._last_ms: float | None = None
        self._wraps = 0

    def unwrap(self, boot_ms: float) -> float:
        """Milliseconds since the boot of the current session (``session`` counts reboots)."""
        value = boot_ms + self._wraps * WRAP_MS
        if self._last_ms is not None and value < self._last_ms - REBOOT_BACK_MS:
            value = self._step_back(boot_ms, value)
        elif self._last_ms is not None and value > self._last_ms + WRAP_MS - WRAP_EDGE_MS:
            return value - WRAP_MS  # a late message from before the wrap
        self._last_ms = value if self._last_ms is None else max(self._last_ms, value)
        return value

    def _step_back(self, boot_ms: float, value: float) -> float:
        assert self._last_ms is not None
        if self._last_ms % WRAP_MS > WRAP_MS - WRAP_EDGE_MS and boot_ms < WRAP_EDGE_MS:
            self._wraps += 1
            return value + WRAP_MS
        self.session += 1
        self._wraps = 0
        self._last_ms = None
        return boot_ms


@dataclass(frozen=True, slots=True, eq=False)
class BootFit:
    """``unix = boot + offset(boot)`` of one session of one sender in a log."""

    boot_ns: F64  # (N,) knots, increasing
    offset_ns: F64  # (N,) relative to ``base_ns``
    base_ns: int  # the first stamp
    rate: float  # boot seconds per stamp second; 1 unless a simulation ran faster than real time

    @property
    def is_real_time(self) -> bool:
        """False when the boot clock ran at another rate than the stamps."""
        return self.rate == 1.0

    def from_boot(self, boot_ns: float) -> int:
        """Time in ns on the stamps' clock when the sender's clock reads ``boot_ns``."""
        offset = float(np.interp(boot_ns, self.boot_ns, self.offset_ns))
        return self.base_ns + round(boot_ns + offset)

    def from_stamp(self, stamp_ns: int) -> int:
        """The time to use for a message without a boot time."""
        if self.is_real_time:
            return stamp_ns
        return self.from_boot(float(self.boot_ns[0]) + (stamp_ns - self.base_ns) * self.rate)


def fit_boot(stamp_ns: Sequence[int], boot_ms: Sequence[float]) -> BootFit:
    """The fit of stamps (ns) and boot times (ms, unwrapped) of one session.

    The offset is the lower edge of stamp - boot in windows of 5 s: a straight line by
    Theil-Sen when the windows fit one (clocks drift), otherwise the windows themselves (the
    stamping computer's clock was set). When the clocks run at different rates, as in a
    simulation faster than real time, the boot clock is used, anchored at the first stamp.
    """
    base = int(stamp_ns[0])
    stamps: F64 = (np.asarray(stamp_ns, dtype=np.int64) - base).astype(np.float64)
    boots: F64 = np.asarray(boot_ms, dtype=np.float64) * MS
    rate = _rate(stamps, boots)
    if rate != 1.0:
        return BootFit(boots[:1], -boots[:1], base, rate)
    knots, edge = _lower_edge(stamps, boots)
    line = _line(knots, edge)
    if np.median(np.abs(edge - line)) < 20 * MS:
        edge = line
    return BootFit(knots, edge, base, 1.0)


def _rate(stamps: F64, boots: F64) -> float:
    """Boot seconds per stamp second, exactly 1.0 when they agree within 3 percent."""
    if stamps[-1] - stamps[0] < WINDOW_NS:
        return 1.0
    # The median slope over a twentieth of the log: a clock that is set once has no effect.
    lag = max(1, len(stamps) // 20)
    ds, db = stamps[lag:] - stamps[:-lag], boots[lag:] - boots[:-lag]
    use = ds > 0
    if not use.any():
        return 1.0
    rate = float(np.median(db[use] / ds[use]))
    return 1.0 if abs(rate - 1.0) < 0.03 or rate <= 0.0 else rate


def _lower_edge(stamps: F64, boots: F64) -> tuple[F64, F64]:
    """Boot time and offset of the message with minimum delay in each window."""
    order = np.argsort(boots, kind="stable")
    offsets, boots = (stamps - boots)[order], boots[order]
    window = ((boots - boots[0]) // WINDOW_NS).astype(np.int64)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    ends = np.append(starts[1:], len(boots))
    best = np.array([s + int(np.argmin(offsets[s:e])) for s, e in zip(starts, ends, strict=True)])
    return boots[best], offsets[best]


def _line(x: F64, y: F64) -> F64:
    """Theil-Sen line through the points, at x; a constant for fewer than four points."""
    if len(x) < 4:
        return np.full_like(y, float(np.min(y)))
    pick = np.linspace(0, len(x) - 1, min(len(x), 200)).astype(np.int64)
    px, py = x[pick], y[pick]
    i, j = np.triu_indices(len(px), 1)
    slope = float(np.median((py[j] - py[i]) / (px[j] - px[i])))
    result: F64 = slope * x + float(np.median(y - slope * x))
    return result


class BootClock:
    """Live: one sender's boot clock to our monotonic clock, by the messages with minimum delay.

    Two windows of 5 s keep the lower edge current while clocks drift. A TIMESYNC offset
    (:class:`TimesyncFilter`) replaces it.
    """

    def __init__(self) -> None:
        self._counter = BootCounter()
        self._window_end_ns = 0
        self._current_ns: float | None = None
        self._previous_ns: float | None = None
        self._timesync_ns: int | None = None

    @property
    def reboots(self) -> int:
        return self._counter.session

    def time_of(self, boot_ms: float, received_ns: int) -> int:
        """Our time in ns when the sender's clock read ``boot_ms``; never after arrival."""
        reboots = self.reboots
        boot_ns = self._counter.unwrap(boot_ms) * MS
        if self.reboots != reboots:
            self._current_ns = self._previous_ns = self._timesync_ns = None
        offset = received_ns - boot_ns
        if received_ns >= self._window_end_ns or self._current_ns is None:
            self._previous_ns, self._current_ns = self._current_ns, offset
            self._window_end_ns = received_ns + WINDOW_NS
        self._current_ns = min(self._current_ns, offset)
        best = self.offset_ns
        assert best is not None
        return min(received_ns, round(boot_ns) + best)

    def set_timesync(self, offset_ns: int | None) -> None:
        """Use TIMESYNC's offset (ours - boot); None removes it.

        TIMESYNC's boot time has 64 bits and does not wrap, so the offset may differ by whole
        periods of the 32-bit counter; the arrival times of messages resolve how many.
        """
        self._timesync_ns = None
        arrived = self.offset_ns
        if offset_ns is not None and arrived is not None:
            offset_ns += round((arrived - offset_ns) / (WRAP_MS * MS)) * WRAP_MS * MS
        self._timesync_ns = offset_ns

    @property
    def offset_ns(self) -> int | None:
        """Our clock minus the boot clock; None before the first message."""
        if self._timesync_ns is not None:
            return self._timesync_ns
        if self._current_ns is None:
            return None
        previous = self._current_ns if self._previous_ns is None else self._previous_ns
        return round(min(self._current_ns, previous))


EARLIEST_UNIX_S = 1_735_689_600  # 2025-01-01: a clock before this was never set
LATEST_UNIX_S = 4_102_444_800  # 2100-01-01
DIFFER_NS = 5_000_000_000
"""Clocks that differ by less agree: SYSTEM_TIME waits in queues, and manual settings are a second
or two off."""


class WallTime:
    """Unix time minus our monotonic clock, from the last SYSTEM_TIME."""

    def __init__(self) -> None:
        self.offset_ns: int | None = None  # None before the first SYSTEM_TIME

    def hear(self, unix_us: int, now_ns: int) -> None:
        """Process ``time_unix_usec``, which is 0 or years old before the first fix."""
        if EARLIEST_UNIX_S * 1_000_000 <= unix_us < LATEST_UNIX_S * 1_000_000:
            self.offset_ns = unix_us * 1000 - now_ns

    def correct(self, offset_ns: int) -> int:
        """The offset to use: the computer's own ``offset_ns``, or the autopilot's where the two
        disagree."""
        given_ns = self.offset_ns
        return offset_ns if given_ns is None or agree(offset_ns, given_ns) else given_ns


def computer_offset_ns() -> int:
    """Unix time minus the monotonic clock, by this computer's clock alone."""
    return time.time_ns() - time.monotonic_ns()


def agree(offset_ns: int, other_ns: int) -> bool:
    return abs(offset_ns - other_ns) <= DIFFER_NS


REQUEST_EVERY_NS = 1_000_000_000
FAST_REQUEST_NS = 200_000_000  # until it has converged
REMEMBER = 64
GATE_NS = 10 * MS
LONGEST_ROUND_NS = 2_000 * MS
OUTLIER_NS = 100 * MS
OUTLIERS_TO_RESET = 5
GAIN_FIRST, GAIN_LAST = 0.05, 0.003
CONVERGED_AT = 500
USABLE_AT = 10
EVERYONE = Address(0, 0)


class TimesyncRequest(dialect.MAVLink_timesync_message):  # type: ignore[misc]
    """A request to one component, so that routers need not forward it to others. common.xml has its
    target fields, pymavlink's dialect has not."""

    def __init__(self, ts1: int, target: Address) -> None:
        super().__init__(0, ts1)
        self.target = target

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The packet; pymavlink calls this."""
        times = self.unpacker.pack(self.tc1, self.ts1)
        target = struct.pack("<BB", self.target.system, self.target.component)
        payload = times if force_mavlink1 else times + target
        packet: bytes = self._pack(mav, self.crc_extra, payload, force_mavlink1)
        return packet


class TimesyncFilter:
    """Offset of our clock to a remote boot clock (ours = remote + offset), in ns.

    Constants of PX4's Timesync.hpp: gains from 0.05 down to 0.003 over 500 samples; a deviation
    of 100 ms is an outlier, five in a row restart the filter. DEVIATION: the gate on the round
    trip is 10 ms there; here it is the larger of that and twice the minimum of the last minute,
    so that a slow radio still synchronises.
    """

    def __init__(self) -> None:
        self._sent: deque[int] = deque(maxlen=REMEMBER)
        self._asked: deque[int] = deque(maxlen=REMEMBER)  # including answered ones
        self._rounds: deque[int] = deque(maxlen=60)
        self._base_ns = 0
        self._offset_ns = 0.0
        self._skew_ns = 0.0
        self._count = 0
        self._outliers = 0
        self._next_ns = 0
        self.resets = 0

    @property
    def offset_ns(self) -> int | None:
        """Our clock minus the remote one; None before enough answers arrived."""
        if self._count < USABLE_AT:
            return None
        return self._base_ns + round(self._offset_ns)

    @property
    def round_trip_ns(self) -> int | None:
        return min(self._rounds, default=None)

    def reset(self) -> None:
        """Restart, as after a reboot of the autopilot."""
        self._count = self._outliers = 0
        self._skew_ns = 0.0
        self._rounds.clear()
        self._sent.clear()
        self.resets += 1

    def request(self, now_ns: int, target: Address = EVERYONE) -> object | None:
        """The TIMESYNC to send now; None when none is due."""
        if now_ns < self._next_ns:
            return None
        quick = self._count < USABLE_AT
        self._next_ns = now_ns + (FAST_REQUEST_NS if quick else REQUEST_EVERY_NS)
        self._sent.append(now_ns)
        self._asked.append(now_ns)
        return TimesyncRequest(now_ns, target)

    def round_trip_of(self, ts1: int, received_ns: int) -> int | None:
        """Time in ns since we sent this request; None when it is not a recent one of ours."""
        return received_ns - ts1 if ts1 in self._asked and received_ns >= ts1 else None

    def answer(self, tc1: int, ts1: int, received_ns: int) -> bool:
        """Process an answer; True when it was used. Answers to others are ignored."""
        if tc1 <= 0 or ts1 not in self._sent:
            return False
        self._sent.remove(ts1)
        round_trip = received_ns - ts1
        if not 0 <= round_trip <= LONGEST_ROUND_NS:
            return False
        self._rounds.append(round_trip)
        if round_trip > max(GATE_NS, 2 * min(self._rounds)):
            return False
        return self._update((ts1 + received_ns) // 2 - tc1)

    def _update(self, sample_ns: int) -> bool:
        if self._count == 0:
            self._base_ns, self._offset_ns, self._skew_ns = sample_ns, 0.0, 0.0
            self._count = 1
            return True
        sample = float(sample_ns - self._base_ns)
        if abs(sample - self._offset_ns) > OUTLIER_NS:
            self._outliers += 1
            if self._outliers >= OUTLIERS_TO_RESET:
                self.reset()
            return False
        self._outliers = 0
        gain = self._gain()
        before = self._offset_ns
        self._offset_ns = gain * sample + (1.0 - gain) * (before + self._skew_ns)
        self._skew_ns = gain * (self._offset_ns - before) + (1.0 - gain) * self._skew_ns
        self._count += 1
        return True

    def _gain(self) -> float:
        """1/n at first (a plain mean), then PX4's range by the number of samples."""
        progress = min(1.0, self._count / CONVERGED_AT)
        schedule: float = GAIN_FIRST * (GAIN_LAST / GAIN_FIRST) ** progress
        return max(schedule, 1.0 / (self._count + 1))
