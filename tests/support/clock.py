"""A clock that a test turns."""

from __future__ import annotations


class Clock:
    """A clock that a test turns."""

    now = 100.0

    def __call__(self) -> float:
        return self.now
