"""Rows of a call, shared out to threads."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from recon import parallel
from recon.types import F64


@pytest.fixture
def four(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine of four cores."""
    monkeypatch.setattr(parallel, "cores", lambda: 4)
    parallel.pool.cache_clear()
    yield
    parallel.pool.cache_clear()


@given(st.integers(0, 50), st.integers(1, 6))
def test_every_row_is_in_one_band(count: int, threads: int) -> None:
    seen = np.zeros(count, int)

    def note(begin: int, end: int) -> None:
        seen[begin:end] += 1

    parallel.limit_threads(threads)
    try:
        parallel.parallel_for(note, count)
    finally:
        parallel.limit_threads(0)
    assert (seen == 1).all()


def test_bands_run_at_the_same_time(four: None) -> None:
    together = threading.Barrier(4, timeout=20.0)

    def meet(begin: int, end: int) -> None:
        together.wait()

    parallel.parallel_for(meet, 4)


def test_an_interrupted_caller_waits_for_the_bands_that_have_begun(four: None) -> None:
    begun, ended = threading.Semaphore(0), threading.Semaphore(0)
    caller = threading.current_thread()

    def work(begin: int, end: int) -> None:
        if threading.current_thread() is caller:
            assert all(begun.acquire(timeout=20.0) for _ in range(3))
            raise KeyboardInterrupt
        begun.release()
        threading.Event().wait(0.05)
        ended.release()

    with pytest.raises(KeyboardInterrupt):
        parallel.parallel_for(work, 4)
    assert all(ended.acquire(blocking=False) for _ in range(3))


def test_no_call_uses_more_threads_than_the_limit(four: None) -> None:
    calls: list[tuple[int, int]] = []
    parallel.limit_threads(1)
    try:
        parallel.parallel_for(lambda begin, end: calls.append((begin, end)), 8)
    finally:
        parallel.limit_threads(0)
    assert calls == [(0, 8)]
    assert parallel.threads() == 4


@pytest.mark.parametrize("cells, pieces", [(0, 1), (1.9, 1), (2.0, 2), (3.9, 3), (9.0, 4)])
def test_each_thread_gets_work_that_is_worth_it(four: None, cells: float, pieces: int) -> None:
    calls: list[tuple[int, int]] = []

    def note(begin: int, end: int) -> None:
        calls.append((begin, end))

    parallel.parallel_for(note, 8, cells=int(cells * parallel.CELLS_PER_THREAD))
    assert len(calls) == pieces
    assert sum(end - begin for begin, end in calls) == 8


def test_a_caller_does_what_no_thread_has_begun(four: None) -> None:
    """A short call ends while a long one of another thread occupies all threads."""
    release, seen = threading.Event(), np.zeros(8, int)
    busy = [parallel.pool().submit(release.wait, 20.0) for _ in range(4)]

    def note(begin: int, end: int) -> None:
        seen[begin:end] += 1

    try:
        parallel.parallel_for(note, 8)
        assert not any(one.done() for one in busy)
    finally:
        release.set()
    assert (seen == 1).all()


def test_a_fault_is_raised_after_all_bands_have_ended(four: None) -> None:
    ended: list[int] = []

    def fail(begin: int, end: int) -> None:
        if begin in (0, 4):
            raise ValueError(f"row {begin}")
        threading.Event().wait(0.1)
        ended.append(begin)

    with pytest.raises(ValueError, match="row 0"):
        parallel.parallel_for(fail, 8)
    assert sorted(ended) == [2, 6]


@njit(nogil=True)
def _square(begin: int, end: int, values: F64, out: F64) -> None:
    for i in range(begin, end):
        out[i] = values[i] * values[i]


def test_two_threads_may_call_a_kernel_at_once(four: None) -> None:
    values = np.arange(100_000, dtype=np.float64)
    outs = [np.zeros_like(values) for _ in range(2)]

    def work(out: F64) -> None:
        for _ in range(20):
            parallel.parallel_for(_square, len(values), values, out)

    workers = [threading.Thread(target=work, args=(out,)) for out in outs]
    for one in workers:
        one.start()
    for one in workers:
        one.join()
    for out in outs:
        np.testing.assert_array_equal(out, values**2)


def test_calls_at_once_keep_their_order_and_meet(four: None) -> None:
    meet = threading.Barrier(2, timeout=20.0)
    assert parallel.run_parallel(lambda: meet.wait() >= 0, lambda: (meet.wait(), "second")[1]) == [
        True,
        "second",
    ]


def test_calls_within_calls_end(four: None) -> None:
    """A call that shares out its own work does not wait for threads that wait for it."""

    def inner() -> list[int]:
        return parallel.run_parallel(*(lambda n=n: n for n in range(5)))

    callers = [partial(parallel.run_parallel, inner, inner, inner) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        results = [f.result(timeout=30.0) for f in [pool.submit(call) for call in callers]]
    assert results == [[[0, 1, 2, 3, 4]] * 3] * 4


def test_an_exception_of_one_call_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        parallel.run_parallel(lambda: 1, lambda: 1 // 0)


def test_a_long_call_leaves_the_others_to_the_other_threads(four: None) -> None:
    done = threading.Semaphore(0)

    def long() -> bool:
        return all(done.acquire(timeout=20.0) for _ in range(7))

    assert parallel.run_parallel(long, *([done.release] * 7))[0]


def test_after_a_fault_no_further_call_begins(four: None) -> None:
    parallel.limit_threads(1)
    begun: list[int] = []
    try:
        with pytest.raises(ZeroDivisionError):
            parallel.run_parallel(lambda: begun.append(0), lambda: 1 // 0, lambda: begun.append(2))
    finally:
        parallel.limit_threads(0)
    assert begun == [0]
