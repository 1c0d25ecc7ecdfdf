"""Progress and cancellation of long work, for the portal and the terminal. The work reports to it
and is stopped by it: after :meth:`Progress.cancel` the next report raises :class:`CancelledError`.
A :class:`Stopwatch` sums up the time of each stage.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import TypeVar

T = TypeVar("T")

MIN_SHARE, MIN_S = 0.02, 2.0  # before this much is done the time left is a guess


class CancelledError(Exception):
    """The work was cancelled. It is not a failure, so handlers of failures do not catch it."""


class Progress:
    """The share of some work that is done. One thread works, or several with :meth:`branches`;
    any thread may read and cancel."""

    def __init__(
        self,
        show: Callable[[Progress], None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``show`` is called after every report; ``clock`` gives seconds."""
        self.text, self.share = "", 0.0
        self._end = 1.0  # of the part that is being done
        self._show = show
        self._is_cancelled = False
        self._may_stop = True
        self._clock = clock
        self._started = clock()

    def __call__(self, text: str) -> None:
        """Set the text of the current step. Raises CancelledError after :meth:`cancel`."""
        self.text = text
        self._report()

    def cancel(self) -> None:
        """Stop the work at its next report, unless it is past :meth:`commit`."""
        self._is_cancelled = True

    def commit(self, text: str) -> None:
        """Set the text of the current step; from here on the work cannot be cancelled."""
        self.text = text
        self._report()
        self._may_stop = False

    @contextmanager
    def part(self, text: str, of_rest: float = 1.0) -> Iterator[None]:
        """The work inside takes this share of the remaining work around it."""
        end = self._end
        self._end = self.share + of_rest * (end - self.share)
        try:
            self(text)
            yield
            self.share = self._end
        finally:
            self._end = end

    def over(self, items: Iterable[T], number: int) -> Iterator[T]:
        """The ``items``, about ``number``, as equal shares of the current part."""
        say = self.counting(number)
        for item in items:
            say(self.text)
            yield item

    def counting(self, calls: int) -> Callable[[str], None]:
        """As the object itself; about so many calls are the current part."""
        start, width = self.share, self._end - self.share
        numbers = count()

        def say(text: str) -> None:
            self.share = start + width * min(next(numbers) / max(calls, 1), 1.0)
            self(text)

        return say

    def branches(self, number: int) -> list[Progress]:
        """One object for each of several threads, as equal shares of the current part; its text is
        that of all which have not ended."""
        start, width = self.share, self._end - self.share
        out: list[Progress] = []
        lock = threading.Lock()

        def show(one: Progress) -> None:
            with lock:
                self.share = start + width * sum(b.share for b in out) / number
                self("; ".join(b.text for b in out if b.text and b.share < 1.0) or one.text)

        out += [Progress(show) for _ in range(number)]
        return out

    @property
    def left_s(self) -> float | None:
        """Seconds that the rest takes at the pace so far; None while that is unknown."""
        spent = self._clock() - self._started
        if spent < MIN_S or self.share < MIN_SHARE:
            return None
        return spent * (1.0 - self.share) / self.share

    def begin(self) -> None:
        """Count the time from now on: the work has waited."""
        self._started = self._clock()

    def _report(self) -> None:
        if self._is_cancelled and self._may_stop:
            raise CancelledError("cancelled")
        self._show(self)


class Stopwatch:
    """Adds up seconds and calls per named stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.calls: dict[str, int] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
            self.calls[stage] = self.calls.get(stage, 0) + 1

    def mean_ms(self) -> dict[str, float]:
        return {s: 1e3 * t / self.calls[s] for s, t in self.seconds.items()}
