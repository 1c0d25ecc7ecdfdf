"""Sets of item numbers as inclusive ranges."""

from __future__ import annotations

import re
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

MAX_RANGES = 4096  # maximum ranges per message; the rest goes into the next message
MAX_NUMBER = (1 << 32) - 1

Pairs = list[tuple[int, int]]


class RangeSet:
    """A set of numbers up to :data:`MAX_NUMBER`, as sorted ranges that neither overlap nor touch.
    Sixteen bytes each: a scan of hours has one for every keyframe."""

    __slots__ = ("_edges",)

    def __init__(self, pairs: Iterable[tuple[int, int]] = ()) -> None:
        self._edges = array("Q")  # of each range its first number, and the one after its last
        for first, last in sorted(pairs):
            if self._edges and first <= self._edges[-1]:
                self._edges[-1] = max(last + 1, self._edges[-1])
            else:
                self._edges.extend((first, last + 1))

    @classmethod
    def of(cls, numbers: Iterable[int]) -> RangeSet:
        return cls((n, n) for n in numbers)

    def add(self, number: int) -> None:
        if number not in self:
            self._flip(number)

    def discard(self, number: int) -> None:
        if number in self:
            self._flip(number)

    def _flip(self, number: int) -> None:
        """Both edges of a number come or go, whether it is added or removed."""
        for edge in (number, number + 1):
            at = bisect_left(self._edges, edge)
            if at < len(self._edges) and self._edges[at] == edge:
                self._edges.pop(at)
            else:
                self._edges.insert(at, edge)

    def __contains__(self, number: int) -> bool:
        return bisect_right(self._edges, number) % 2 == 1

    def __len__(self) -> int:
        return sum(self._edges[1::2]) - sum(self._edges[::2])

    def __bool__(self) -> bool:
        return bool(self._edges)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RangeSet) and self._edges == other._edges

    def __repr__(self) -> str:
        return f"RangeSet({self._ranges()})"

    def _ranges(self) -> Pairs:
        return [(a, b - 1) for a, b in zip(self._edges[::2], self._edges[1::2], strict=True)]

    def __iter__(self) -> Iterator[int]:
        for first, last in self._ranges():
            yield from range(first, last + 1)

    def newest_first(self) -> Iterator[int]:
        for at in range(len(self._edges) - 1, 0, -2):  # of many ranges often only the last counts
            yield from range(self._edges[at] - 1, self._edges[at - 1] - 1, -1)

    def __sub__(self, other: RangeSet) -> RangeSet:
        if not self or self == other:  # most often
            return RangeSet()
        edges = np.union1d(self._edges, other._edges)
        own, taken = (np.searchsorted(s._edges, edges, "right") % 2 for s in (self, other))
        out = RangeSet()
        out._edges.frombytes(edges[np.diff(own > taken, prepend=False)].tobytes())
        return out

    @property
    def last(self) -> int:
        """The largest number; -1 for none."""
        return self._edges[-1] - 1 if self._edges else -1

    def copy(self) -> RangeSet:
        same = RangeSet()
        same._edges = self._edges[:]
        return same

    @property
    def range_count(self) -> int:
        """Number of ranges: the cost of storing or comparing the set."""
        return len(self._edges) // 2

    def pairs(self) -> Pairs:
        """The ranges (first, last), in order; at most the newest MAX_RANGES."""
        newest = RangeSet()
        newest._edges = self._edges[-2 * MAX_RANGES :]
        return newest._ranges()

    def text(self) -> str:
        """The ranges as ``1-5,7``, for a key expression."""
        return ",".join(str(a) if a == b else f"{a}-{b}" for a, b in self._ranges())


def ranges_from_text(text: str) -> RangeSet | None:
    """The set that :meth:`RangeSet.text` wrote; None for anything else."""
    pairs: Pairs = []
    for part in text.split(",", MAX_RANGES):
        found = re.fullmatch(r"(\d{1,10})(?:-(\d{1,10}))?", part, re.ASCII)
        if found is None:
            return None
        pairs.append((int(found[1]), int(found[2] or found[1])))
    return ranges_from_pairs(pairs)


def ranges_from_pairs(pairs: Any) -> RangeSet | None:
    """The set of decoded JSON ``[[first, last], …]``; None for anything else."""
    if not isinstance(pairs, list) or len(pairs) > MAX_RANGES:
        return None
    for pair in pairs:
        if not (isinstance(pair, (list, tuple)) and len(pair) == 2):
            return None
        if not all(type(n) is int and 0 <= n <= MAX_NUMBER for n in pair) or pair[0] > pair[1]:
            return None
    return RangeSet((a, b) for a, b in pairs)
