"""TIMESYNC: the autopilot's boot clock against our monotonic clock, as PX4's filter does it.

We send ts1 = our ns with tc1 = 0; the autopilot echoes ts1 with tc1 = its boot time in ns.
Constants of PX4's Timesync.hpp: gains from 0.05 down to 0.003 over 500 samples, a deviation
of 100 ms is an outlier, five in a row start over. DEVIATION: the gate on the round trip is
10 ms there; here it is the larger of that and twice the shortest of the last minute, so that
a slow radio still synchronises.
"""

from __future__ import annotations

import struct
from collections import deque
from typing import Any

from mavlink.wire.dialect import dialect
from mavlink.wire.messages import Address

MS = 1_000_000
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
    """A question to one component, so that routers need not pass it on to others.

    Its target stands in common.xml, but not in pymavlink's dialect.
    """

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
    """Offset of our clock to a remote boot clock (ours = remote + offset), in ns."""

    def __init__(self) -> None:
        self._sent: deque[int] = deque(maxlen=REMEMBER)
        self._asked: deque[int] = deque(maxlen=REMEMBER)  # also those that were answered
        self._rounds: deque[int] = deque(maxlen=60)
        self._base_ns = 0
        self._offset_ns = 0.0
        self._skew_ns = 0.0
        self._count = 0
        self._outliers = 0
        self._next_ns = 0
        self.resets = 0
        self.rejected = 0

    @property
    def offset_ns(self) -> int | None:
        """Our clock minus the remote one; None before enough answers came."""
        if self._count < USABLE_AT:
            return None
        return self._base_ns + round(self._offset_ns)

    @property
    def round_trip_ns(self) -> int | None:
        """The shortest round trip of late."""
        return min(self._rounds, default=None)

    def reset(self) -> None:
        """Start over, as after a reboot of the autopilot."""
        self._count = self._outliers = 0
        self._skew_ns = 0.0
        self._rounds.clear()
        self._sent.clear()
        self.resets += 1

    def request(self, now_ns: int, target: Address = EVERYONE) -> object | None:
        """The TIMESYNC to send now; None when it is not time."""
        if now_ns < self._next_ns:
            return None
        quick = self._count < USABLE_AT
        self._next_ns = now_ns + (FAST_REQUEST_NS if quick else REQUEST_EVERY_NS)
        self._sent.append(now_ns)
        self._asked.append(now_ns)
        return TimesyncRequest(now_ns, target)

    def next_timer(self) -> int:
        """When the next request is due, in ns."""
        return self._next_ns

    def round_trip_of(self, ts1: int, received_ns: int) -> int | None:
        """How long ago we asked this question, in ns; None when it is not one of our last."""
        return received_ns - ts1 if ts1 in self._asked and received_ns >= ts1 else None

    def answer(self, tc1: int, ts1: int, received_ns: int) -> bool:
        """Take an answer in; True when it was used. Answers to others are not ours."""
        if tc1 <= 0 or ts1 not in self._sent:
            return False
        self._sent.remove(ts1)
        round_trip = received_ns - ts1
        if not 0 <= round_trip <= LONGEST_ROUND_NS:
            self.rejected += 1
            return False
        self._rounds.append(round_trip)
        if round_trip > max(GATE_NS, 2 * min(self._rounds)):
            self.rejected += 1
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
            self.rejected += 1
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
