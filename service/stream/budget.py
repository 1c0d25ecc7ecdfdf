"""A token bucket that limits how many bytes may be sent now, and an estimate of the link's rate."""

from __future__ import annotations

import math
from collections import deque

WINDOW_SHARE = 0.03
"""The bucket holds this share of a second, so that no 1 s window exceeds the rate by more; the rest
of 5 % covers buffers on the way."""
MIN_PART_BYTES = 512
MAX_PART_BYTES = 16_384
_ENVELOPE_BYTES = 80  # key expression, Zenoh framing
_SEGMENT_BYTES, _SEGMENT_HEADER_BYTES = 1400, 52  # TCP/IP


def wire_bytes(payload: int) -> int:
    """Approximate bytes on the link for one message of ``payload`` bytes."""
    size = payload + _ENVELOPE_BYTES
    return size + _SEGMENT_HEADER_BYTES * -(-size // _SEGMENT_BYTES)


class TokenBucket:
    """A token bucket; the caller supplies the time in seconds."""

    def __init__(self, rate_bytes_s: float, now: float) -> None:
        self.rate_bytes_s = rate_bytes_s
        self._tokens = 0.0
        self._at = now

    def set_rate(self, rate_bytes_s: float, now: float) -> None:
        self._refill(now)
        self.rate_bytes_s = rate_bytes_s

    @property
    def depth_bytes(self) -> float:
        """Capacity: 3 % of a second, but at least one small part."""
        return max(self.rate_bytes_s * WINDOW_SHARE, float(wire_bytes(MIN_PART_BYTES)))

    @property
    def part_bytes(self) -> int:
        """Maximum size of a part that fits into the bucket with its envelope."""
        room = int(self.depth_bytes / (1 + _SEGMENT_HEADER_BYTES / _SEGMENT_BYTES))
        room -= _ENVELOPE_BYTES + _SEGMENT_HEADER_BYTES
        return max(MIN_PART_BYTES, min(MAX_PART_BYTES, room))

    def ready_in(self, size: int, now: float) -> float:
        """Seconds until ``size`` bytes may be sent; zero when they may be sent now."""
        self._refill(now)
        lacking = min(float(size), self.depth_bytes) - self._tokens
        if lacking <= 1e-6:
            return 0.0
        return lacking / self.rate_bytes_s if self.rate_bytes_s > 0 else math.inf

    def take(self, size: int, now: float) -> None:
        """Spend ``size`` bytes; the bucket may go negative."""
        self._refill(now)
        self._tokens -= size

    def _refill(self, now: float) -> None:
        passed = max(0.0, now - self._at)
        self._tokens = min(self.depth_bytes, self._tokens + passed * self.rate_bytes_s)
        self._at = max(self._at, now)


class RateEstimate:
    """The rate that the link really carries, from the receiver's reports.

    Bytes sent and not yet received, beyond their recent minimum, are queued or lost. When two
    consecutive reports show more than half a second of them, the allowed rate falls below the best
    recent throughput; then it climbs, fast up to where the queue began and slowly from there. A
    single stall of a lossy link is not a queue. Losses that a lower rate does not reduce are the
    link's: the rate does not fall again.
    """

    QUEUE_S = 0.5
    MIN_QUEUE_BYTES = 8_000
    FALL = 0.8  # of the throughput
    CLIMB, CREEP = 0.05, 0.005  # of the configured rate, per report
    FLOOR = 0.03  # of the configured rate
    MIN_REPORT_S = 0.8  # reports closer together are merged
    MAX_GAP_S = 10.0  # after a longer gap the estimate restarts
    REST = 2  # reports after a fall that are ignored
    PATIENCE = 2  # bad reports in a row before the rate falls
    SAME = 0.6  # a loss that shrank by less than this factor does not depend on the rate
    FORGET = 0.99  # decay per report of the loss attributed to the link

    def __init__(self, configured_bytes_s: float) -> None:
        self.configured_bytes_s = configured_bytes_s
        self.rate_bytes_s = configured_bytes_s
        self._knee = configured_bytes_s
        self._at = -math.inf
        self._received = 0
        self._totals: deque[tuple[int, int]] = deque(maxlen=20)  # sent, received
        self._through: deque[float] = deque(maxlen=4)
        self._rest = 0
        self._bad = 0
        self._lost_at_fall = 0.0
        self._own_loss = 0.0

    def restart(self) -> None:
        """Forget bytes in flight, such as those on a dead connection; the rate stays."""
        self._totals.clear()
        self._through.clear()
        self._bad = 0

    def report(self, sent_bytes: int, received_bytes: int, now: float) -> float:
        """The rate to use, given the total bytes sent and received so far."""
        passed = now - self._at
        if passed < self.MIN_REPORT_S:
            return self.rate_bytes_s
        if passed > self.MAX_GAP_S or received_bytes < self._received:
            self.restart()
        self._through.append(max(0, received_bytes - self._received) / passed)
        self._at, self._received = now, received_bytes
        self._totals.append((sent_bytes, received_bytes))
        self._own_loss *= self.FORGET
        if self._rest > 0:
            self._rest -= 1
        elif self._is_bad():
            self._bad += 1
            if self._bad >= self.PATIENCE:
                self._judge()
        else:
            self._bad = 0
            step = self.CLIMB if self.rate_bytes_s < self._knee else self.CREEP
            climbed = self.rate_bytes_s + step * self.configured_bytes_s
            self.rate_bytes_s = min(self.configured_bytes_s, climbed)
        return self.rate_bytes_s

    def _is_bad(self) -> bool:
        under_way = [sent - received for sent, received in self._totals]
        queue = under_way[-1] - min(under_way)
        own = self._own_loss * (self._totals[-1][0] - self._totals[0][0])
        return queue - own > max(self.MIN_QUEUE_BYTES, self.QUEUE_S * max(self._through))

    def _judge(self) -> None:
        """Lower the rate, or attribute the loss to the link."""
        (sent0, received0), (sent1, received1) = self._totals[0], self._totals[-1]
        lost = 1.0 - (received1 - received0) / max(1, sent1 - sent0)
        if lost > 0 and self._lost_at_fall > 0 and lost > self.SAME * self._lost_at_fall:
            self._own_loss = min(0.9, 1.2 * lost)
            self._lost_at_fall = 0.0
            self._knee = self.configured_bytes_s
        else:
            self._lost_at_fall = lost
            floor = self.FLOOR * self.configured_bytes_s
            through = max(self._through)
            self._knee = max(floor, 0.9 * through)
            self.rate_bytes_s = max(floor, min(self.rate_bytes_s, self.FALL * through))
        self._totals.clear()
        self._rest, self._bad = self.REST, 0
