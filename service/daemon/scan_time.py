"""What is said of the clock by which a scan is named and its times are given."""

from __future__ import annotations

from mavlink.wall_time import agree, computer_offset_ns


def disagreement(offset_ns: int) -> list[str]:
    """Nothing, or that a scan with this offset (unix time less monotonic clock) goes by another
    clock than the computer's."""
    own_ns = computer_offset_ns()
    if agree(offset_ns, own_ns):
        return []
    return [f"Companion's clock is {_apart(own_ns - offset_ns)}: the scan takes the autopilot's"]


def set_since(offset_ns: int, now_ns: int) -> list[str]:
    """Nothing, or how far the times of a scan with ``offset_ns`` are off by what is known now."""
    if agree(offset_ns, now_ns):
        return []
    return [
        "the clock was set while scanning, or the autopilot told the time only then: the scan's "
        f"times are {_apart(offset_ns - now_ns)}"
    ]


def _apart(ahead_ns: int) -> str:
    seconds = abs(ahead_ns) / 1e9
    unit_s, unit = next(u for u in ((86_400, "days"), (3600, "h"), (1, "s")) if seconds >= u[0])
    return f"{seconds / unit_s:.0f} {unit} {'ahead' if ahead_ns > 0 else 'behind'}"
