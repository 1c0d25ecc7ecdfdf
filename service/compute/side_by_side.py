"""Reconstruction beside tracking: one worker thread, a bounded queue, results in order."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

import numba

from service.compute.threading_layer import kernels_may_overlap

In = TypeVar("In")
Out = TypeVar("Out")


class SideBySide(Generic[In, Out]):
    """Runs ``work`` on what is offered, in a thread of its own and in order.

    A recording drops nothing: a full queue makes :meth:`offer` wait. Live, the oldest work that
    has not begun gives way and :attr:`dropped` counts it. Without a thread (``beside`` False, or
    kernels that may not overlap here) the work is done within :meth:`offer`. Compiled kernels
    share the cores between the two: two that each want all of them only wait for one another.
    ``threads`` are what both use together; 0 is one per core.
    """

    def __init__(
        self,
        work: Callable[[In], Out],
        most_waiting: int,
        live: bool,
        beside: bool = True,
        threads: int = 0,
    ) -> None:
        self._work, self._most, self._live = work, most_waiting, live
        self._worker: ThreadPoolExecutor | None = None
        if beside and kernels_may_overlap():
            most = numba.config.NUMBA_NUM_THREADS
            half = max(1, min(threads or most, most) // 2)
            numba.set_num_threads(half)  # of the calling thread: the other half is the worker's
            self._worker = ThreadPoolExecutor(1, "dense", numba.set_num_threads, (half,))
        self._queue: deque[tuple[In, Future[Out]]] = deque()
        self.dropped = 0
        self._began_s: float | None = None

    @property
    def busy_s(self) -> float:
        """Seconds for which the work at hand has been going on; 0 when there is none."""
        began_s = self._began_s
        return 0.0 if began_s is None else time.monotonic() - began_s

    def _do(self, item: In) -> Out:
        self._began_s = time.monotonic()
        try:
            return self._work(item)
        finally:
            self._began_s = None

    def offer(self, item: In) -> None:
        """Hand over one piece of work."""
        if self._worker is None:
            done: Future[Out] = Future()
            done.set_result(self._do(item))
            self._queue.append((item, done))
            return
        self._queue.append((item, self._worker.submit(self._do, item)))
        waiting = [f for _, f in self._queue if not f.done()]
        if len(waiting) <= self._most + 1:  # one is being worked on
            return
        if not self._live:
            waiting[0].exception()  # waits
        elif any(f.cancel() for f in waiting[1:]):
            self.dropped += 1

    def finished(self, everything: bool = False) -> list[tuple[In, Out]]:
        """What is done, in order; ``everything`` waits for the rest. Raises what work raised."""
        out = []
        while self._queue and (everything or self._queue[0][1].done()):
            item, future = self._queue.popleft()
            if not future.cancelled():
                out.append((item, future.result()))
        return out

    def close(self) -> None:
        """Let the thread end; what has not begun is not done."""
        if self._worker is not None:
            self._worker.shutdown(wait=True, cancel_futures=True)
