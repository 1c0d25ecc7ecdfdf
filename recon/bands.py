"""Compiled kernels on several cores: the rows of one call, shared out to threads.

A kernel releases the interpreter's lock, so plain threads are enough. Numba's own parallel loops
need OpenMP or TBB, abort the process when two threads enter them without, and take seconds to
compile each.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

from numba import config

T = TypeVar("T")


class _Limit(threading.local):
    """How many threads a call from this thread may use."""

    threads = 0  # one per core


_limit = _Limit()


def cores() -> int:
    """The cores that this process may use, or NUMBA_NUM_THREADS."""
    return int(config.NUMBA_NUM_THREADS)


def limit_threads(threads: int) -> None:
    """Let calls from this thread use so many threads, at most one per core; 0: one per core."""
    _limit.threads = max(threads, 0)


def threads() -> int:
    """How many threads a call from this thread uses."""
    return min(_limit.threads or cores(), cores())


@cache
def _pool() -> ThreadPoolExecutor:
    """The threads that all callers share; none is started before it is needed.

    A call from one of them shares nothing out: it would wait for threads that wait themselves.
    """
    return ThreadPoolExecutor(
        max(cores(), 1), thread_name_prefix="bands", initializer=limit_threads, initargs=(1,)
    )


def at_once(*calls: Callable[[], T]) -> list[T]:
    """The results of independent calls that run at the same time."""
    results: list[Any] = [None] * len(calls)

    def run(first: int, end: int) -> None:
        for n in range(first, end):
            results[n] = calls[n]()

    in_bands(run, len(calls))
    return results


def in_bands(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """Call ``kernel(first, end, *arguments)`` so that 0 to ``count`` is covered once.

    The bands run at the same time, so none may write what another reads. An exception of the
    kernel is raised after all bands have ended.
    """
    bands = min(threads(), count)
    if bands <= 1:
        kernel(0, count, *arguments)
        return
    edges = [count * k // bands for k in range(bands + 1)]
    others = [_pool().submit(kernel, first, end, *arguments) for first, end in pairwise(edges[1:])]
    try:
        kernel(edges[0], edges[1], *arguments)
    finally:
        wait(others)
    for one in others:
        one.result()
