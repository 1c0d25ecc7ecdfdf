"""Sets of item numbers as inclusive ranges: what a scan has, holds or lacks."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from typing import Any

MAX_RANGES = 4096
"""A message may name this many ranges; the rest is for the next message."""
MAX_NUMBER = (1 << 32) - 1

Pairs = list[tuple[int, int]]


class RangeSet:
    """A set of numbers, kept as sorted ranges that neither overlap nor touch."""

    def __init__(self, pairs: Iterable[tuple[int, int]] = ()) -> None:
        self._pairs: Pairs = []
        for first, last in sorted(pairs):
            if self._pairs and first <= self._pairs[-1][1] + 1:
                first, last = self._pairs[-1][0], max(last, self._pairs[-1][1])
                self._pairs[-1] = (first, last)
            else:
                self._pairs.append((first, last))

    @classmethod
    def of(cls, numbers: Iterable[int]) -> RangeSet:
        """The set of ``numbers``."""
        return cls((n, n) for n in numbers)

    def add(self, number: int) -> None:
        """Put ``number`` into the set."""
        at = bisect_right(self._pairs, (number, MAX_NUMBER + 1))
        if at and self._pairs[at - 1][1] >= number:
            return
        first = last = number
        end = at
        if at and self._pairs[at - 1][1] == number - 1:
            at -= 1
            first = self._pairs[at][0]
        if end < len(self._pairs) and self._pairs[end][0] == number + 1:
            last = self._pairs[end][1]
            end += 1
        self._pairs[at:end] = [(first, last)]

    def discard(self, number: int) -> None:
        """Take ``number`` out of the set if it is there."""
        at = bisect_right(self._pairs, (number, MAX_NUMBER + 1)) - 1
        if at < 0 or self._pairs[at][1] < number:
            return
        first, last = self._pairs[at]
        rest = [(first, number - 1), (number + 1, last)]
        self._pairs[at : at + 1] = [(a, b) for a, b in rest if a <= b]

    def __contains__(self, number: int) -> bool:
        at = bisect_right(self._pairs, (number, MAX_NUMBER + 1))
        return at > 0 and self._pairs[at - 1][1] >= number

    def __len__(self) -> int:
        return sum(last - first + 1 for first, last in self._pairs)

    def __bool__(self) -> bool:
        return bool(self._pairs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RangeSet) and self._pairs == other._pairs

    def __repr__(self) -> str:
        return f"RangeSet({self._pairs})"

    def __iter__(self) -> Iterator[int]:
        for first, last in self._pairs:
            yield from range(first, last + 1)

    def newest_first(self) -> Iterator[int]:
        """The numbers, largest first."""
        for first, last in reversed(self._pairs):
            yield from range(last, first - 1, -1)

    def __sub__(self, other: RangeSet) -> RangeSet:
        """The numbers that are not in ``other``."""
        out: Pairs = []
        taken = iter([*other._pairs, (MAX_NUMBER + 2, MAX_NUMBER + 2)])
        a, b = next(taken)
        for low, last in self._pairs:
            first = low
            while b < first:
                a, b = next(taken)
            while a <= last:
                if first < a:
                    out.append((first, a - 1))
                first = b + 1
                if b > last:
                    break
                a, b = next(taken)
            if first <= last:
                out.append((first, last))
        return RangeSet(out)

    def copy(self) -> RangeSet:
        """A set of its own with the same numbers."""
        same = RangeSet()
        same._pairs = list(self._pairs)
        return same

    def pairs(self) -> Pairs:
        """The ranges (first, last), in order; at most the newest MAX_RANGES."""
        return self._pairs[-MAX_RANGES:]

    def text(self) -> str:
        """The ranges as ``1-5,7``, for a key expression."""
        return ",".join(str(a) if a == b else f"{a}-{b}" for a, b in self._pairs)


def ranges_from_text(text: str) -> RangeSet | None:
    """The set that :meth:`RangeSet.text` wrote; None for anything else."""
    pairs: Pairs = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        if not (first.isascii() and first.isdigit() and len(first) <= 10):
            return None
        if last and not (last.isascii() and last.isdigit() and len(last) <= 10):
            return None
        pairs.append((int(first), int(last or first)))
    return ranges_from_pairs(pairs)


def ranges_from_pairs(pairs: Any) -> RangeSet | None:
    """The set of decoded JSON ``[[first, last], …]``; None when it is anything else."""
    if not isinstance(pairs, list) or len(pairs) > MAX_RANGES:
        return None
    for pair in pairs:
        if not (isinstance(pair, (list, tuple)) and len(pair) == 2):
            return None
        if not all(type(n) is int and 0 <= n <= MAX_NUMBER for n in pair) or pair[0] > pair[1]:
            return None
    return RangeSet((a, b) for a, b in pairs)
