"""Compiled kernels on several cores: the rows of one call, shared out to threads.

A kernel releases the interpreter's lock, so plain threads are enough. Numba's own parallel loops
need OpenMP or TBB, abort the process when two threads enter them without, and take seconds to
compile each.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from threading import Event
from typing import Any, TypeVar

from numba import config, version_info

T = TypeVar("T")

RELEASE_S = 1e-4
"""Long enough for a waiting thread to wake up; work that releases every few ms loses little."""

CELLS_PER_THREAD = 1 << 20
"""Cells of a cost volume that are worth a thread: half a millisecond of simple work."""

if version_info.short in [(0, minor) for minor in range(60, 68)]:  # they load kernels alike
    from recon.compiled import load_code_alone

    load_code_alone()  # before the first kernel is loaded

_limit = 0  # threads that one call may use; 0: one per core


def cores() -> int:
    """The cores that this process may use, or NUMBA_NUM_THREADS."""
    return int(config.NUMBA_NUM_THREADS)


def limit_threads(threads: int) -> None:
    """Let each call of this process use so many threads, at most one per core; 0: one per core."""
    global _limit
    _limit = max(threads, 0)


def threads() -> int:
    """How many threads a call may use."""
    return min(_limit or cores(), cores())


def release_gil() -> None:
    """Let threads that wait for the interpreter run; long work calls it every few ms.

    Array operations give the interpreter up for an instant and get it back before a waiting thread
    has woken up, so that this thread waits as long as the work lasts.
    """
    Event().wait(RELEASE_S)


def shares(cells: int) -> int:
    """How many threads are worth it for work on so many cells."""
    return max(1, min(threads(), cells // CELLS_PER_THREAD))


@cache
def pool() -> ThreadPoolExecutor:
    """The threads that all callers share; none is started before it is needed."""
    return ThreadPoolExecutor(max(cores(), 1), thread_name_prefix="parallel")


def run_parallel(*calls: Callable[[], T]) -> list[T]:
    """The results of independent calls that run at the same time, begun in order."""
    results: list[Any] = [None] * len(calls)
    rest = iter(enumerate(calls))  # each thread takes the next one

    def run(first: int, end: int) -> None:
        try:
            for n, call in rest:
                results[n] = call()
        finally:
            deque(rest, maxlen=0)  # after a fault none begins

    parallel_for(run, len(calls))
    return results


def parallel_for(
    kernel: Callable[..., None], count: int, *arguments: Any, cells: int | None = None
) -> None:
    """Call ``kernel(first, end, *arguments)`` so that 0 to ``count`` is covered once.

    Work on ``cells`` numbers in all is shared out only where that is worth it.

    The bands run at the same time, so none may write what another reads. A band that no thread has
    begun when the caller is done with its own is the caller's too: no caller waits for the work of
    others, and a band may share out rows itself. An exception of the kernel is raised after all
    bands that have begun have ended.
    """
    bands = min(threads() if cells is None else shares(cells), count)
    if bands <= 1:
        kernel(0, count, *arguments)
        return
    edges = [count * k // bands for k in range(bands + 1)]
    faults: dict[int, Exception] = {}

    def run(first: int, end: int) -> None:
        try:
            kernel(first, end, *arguments)
        except Exception as fault:
            faults[first] = fault

    others = {pool().submit(run, *band): band for band in pairwise(edges[1:])}
    try:
        run(edges[0], edges[1])
        for one, band in others.items():
            if one.cancel():
                run(*band)
    finally:  # also after Ctrl-C, which is no Exception: what they read may be closed next
        wait(one for one in others if not one.cancel())
    if faults:
        raise faults[min(faults)]
