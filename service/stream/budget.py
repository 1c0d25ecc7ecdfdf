"""A token bucket: how many bytes may be handed to the link now."""

from __future__ import annotations

import math
from collections import deque

WINDOW_SHARE = 0.03
"""The bucket holds this share of a second, so no 1 s window exceeds the rate by more; the rest
of 5 % is left to what buffers add on the way."""
MIN_PART_BYTES = 512
MAX_PART_BYTES = 16_384
_ENVELOPE_BYTES = 80  # key expression, Zenoh framing
_SEGMENT_BYTES, _SEGMENT_HEADER_BYTES = 1400, 52  # TCP/IP


def wire_bytes(payload: int) -> int:
    """Bytes on the link, about, for one message of ``payload`` bytes."""
    size = payload + _ENVELOPE_BYTES
    return size + _SEGMENT_HEADER_BYTES * -(-size // _SEGMENT_BYTES)


class TokenBucket:
    """Bytes against time; the clock is the caller's, in seconds."""

    def __init__(self, rate_bytes_s: float, now: float) -> None:
        self._rate = rate_bytes_s
        self._tokens = 0.0
        self._at = now

    @property
    def rate_bytes_s(self) -> float:
        """Bytes per second allowed."""
        return self._rate

    def set_rate(self, rate_bytes_s: float, now: float) -> None:
        """Change the rate from now on."""
        self._refill(now)
        self._rate = rate_bytes_s

    @property
    def depth_bytes(self) -> float:
        """The most that may be saved up: 3 % of a second, but room for one small part."""
        return max(self._rate * WINDOW_SHARE, float(wire_bytes(MIN_PART_BYTES)))

    @property
    def part_bytes(self) -> int:
        """How large a part may be so that the bucket can hold it with its envelope."""
        room = int(self.depth_bytes / (1 + _SEGMENT_HEADER_BYTES / _SEGMENT_BYTES))
        room -= _ENVELOPE_BYTES + _SEGMENT_HEADER_BYTES
        return max(MIN_PART_BYTES, min(MAX_PART_BYTES, room))

    def ready_in(self, size: int, now: float) -> float:
        """Seconds until ``size`` bytes may go; zero when they may go now."""
        self._refill(now)
        lacking = min(float(size), self.depth_bytes) - self._tokens
        if lacking <= 1e-6:
            return 0.0
        return lacking / self._rate if self._rate > 0 else math.inf

    def take(self, size: int, now: float) -> None:
        """Spend ``size`` bytes; what exceeds the bucket is owed."""
        self._refill(now)
        self._tokens -= size

    def _refill(self, now: float) -> None:
        passed = max(0.0, now - self._at)
        self._tokens = min(self.depth_bytes, self._tokens + passed * self._rate)
        self._at = max(self._at, now)


class RateEstimate:
    """What the link really carries, from what the far end says it received.

    Bytes sent and not yet received beyond the least of late are a queue, or lost. When two
    reports in a row find more than half a second of them, the allowed rate falls below what
    came through at best of late; then it climbs, fast to where that began and slowly from
    there on. One stall of a lossy link is no queue. Losses that a lower rate does not lessen
    are the link's own and no reason to fall again.
    """

    QUEUE_S = 0.5
    MIN_QUEUE_BYTES = 8_000
    FALL = 0.8  # of what came through
    CLIMB, CREEP = 0.05, 0.005  # of the configured rate, per report
    FLOOR = 0.03  # of the configured rate
    MIN_REPORT_S = 0.8  # reports closer together are joined
    MAX_GAP_S = 10.0  # after a longer gap the estimate restarts
    REST = 2  # reports after a fall that are not judged
    PATIENCE = 2  # bad reports in a row before the rate falls
    SAME = 0.6  # a share lost that shrank by less than this did not depend on the rate
    FORGET = 0.99  # per report, of the share lost that is taken for the link's own

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
        """Forget what was under way, such as on a connection that died; the rate stays."""
        self._totals.clear()
        self._through.clear()
        self._bad = 0

    def report(self, sent_bytes: int, received_bytes: int, now: float) -> float:
        """The rate to use, given the totals sent and received so far."""
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
        """Fall, or take what is lost for the link's own."""
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
