"""A token bucket: how many bytes may be handed to the link now."""

from __future__ import annotations

import math

WINDOW_SHARE = 0.05
"""The bucket holds this share of a second, so no 1 s window exceeds the rate by more."""
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
        """The most that may be saved up: 5 % of a second, but room for one small part."""
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
