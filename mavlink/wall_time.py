"""Unix time by the autopilot, which has it from its GNSS receiver.

A computer without a battery for its clock or a network does not know it. Only names and labels
rest on it: what is fused goes by the boot clock (:mod:`mavlink.clock`).
"""

from __future__ import annotations

import time

EARLIEST_UNIX_S = 1_735_689_600  # 2025-01-01: a clock before this was never set
LATEST_UNIX_S = 4_102_444_800  # 2100-01-01
DIFFER_NS = 5_000_000_000
"""Two clocks that differ by less agree: SYSTEM_TIME waits in queues, and whoever sets it may be
a second or two off."""


class WallTime:
    """Unix time less our monotonic clock, as SYSTEM_TIME last told it."""

    def __init__(self) -> None:
        self.offset_ns: int | None = None  # None before it was told

    def hear(self, unix_us: int, now_ns: int) -> None:
        """Take in ``time_unix_usec``, which is 0 or years ago before the first fix."""
        if EARLIEST_UNIX_S * 1_000_000 <= unix_us < LATEST_UNIX_S * 1_000_000:
            self.offset_ns = unix_us * 1000 - now_ns

    def correct(self, offset_ns: int) -> int:
        """The offset to use instead of the computer's own ``offset_ns``: that, or the
        autopilot's where the two do not agree."""
        told_ns = self.offset_ns
        return offset_ns if told_ns is None or agree(offset_ns, told_ns) else told_ns


def computer_offset_ns() -> int:
    """Unix time less the monotonic clock, by this computer's clock alone."""
    return time.time_ns() - time.monotonic_ns()


def agree(offset_ns: int, other_ns: int) -> bool:
    """True for clocks with these offsets that differ by no more than is usual."""
    return abs(offset_ns - other_ns) <= DIFFER_NS
