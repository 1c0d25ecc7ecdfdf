"""Work in the background: order, waiting, giving way, faults."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import Mock
from weakref import WeakSet

import numpy as np
import pytest
from loopback import until
from some_views import view_at

from recon.pipeline.mapper import Mapper
from recon.pipeline.views import StereoView, VirtualStereoCamera
from recon.types import Camera
from service.background import BackgroundWorker
from service.flight.pipeline import is_lost_if_dropped

ROWS = "dense", "placing"


def halves(work: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """All the work in the first half."""

    def first(item: Any) -> Callable[[], Any]:
        made = work(item)
        return lambda: made

    return first


def test_results_come_in_order_and_nothing_is_dropped() -> None:
    def work(n: int) -> int:
        time.sleep(0.002 * (n % 3))
        return n * n

    jobs = BackgroundWorker(ROWS, halves(work), 2)
    out = []
    for n in range(30):
        jobs.offer(n)
        out += jobs.finished()
    out += jobs.finished(everything=True)
    jobs.close()
    assert out == [(n, n * n) for n in range(30)] and jobs.dropped == 0


def test_the_first_half_of_the_next_goes_on_beside_the_second() -> None:
    began = [threading.Event() for _ in range(3)]

    def work(n: int) -> Callable[[], bool]:
        began[n].set()
        return lambda: n == 2 or began[n + 1].wait(20)

    jobs = BackgroundWorker(ROWS, work, 2)
    for n in range(3):
        jobs.offer(n)
    assert jobs.finished(everything=True) == [(0, True), (1, True), (2, True)]
    jobs.close()


def test_what_prepares_the_work_is_done_before_it() -> None:
    done: list[int] = []
    jobs = BackgroundWorker(ROWS, halves(done.append), 2)
    jobs.prepare(lambda: done.append(7))
    jobs.prepare(lambda: 1 // 0)
    jobs.offer(1)
    assert jobs.finished(everything=True) == [(1, None)] and done == [7, 1]
    jobs.close()


def test_a_fault_of_a_second_half_reaches_the_caller() -> None:
    def work(n: int) -> Callable[[], float]:
        return lambda: 1 / n

    for rows in (ROWS, None):
        jobs = BackgroundWorker(rows, work, 4)
        for n in (2, 0, 4):
            jobs.offer(n)
        assert jobs.finished(everything=True) == [(2, 0.5)]
        with pytest.raises(ZeroDivisionError):
            jobs.finished(everything=True)
        assert jobs.finished(everything=True) == [(4, 0.25)]
        jobs.close()


def test_live_the_oldest_that_has_not_begun_gives_way() -> None:
    gate = threading.Event()

    def work(n: int) -> int:
        gate.wait(5)
        return n

    jobs = BackgroundWorker(ROWS, halves(work), 2, live=True)
    for n in range(10):
        jobs.offer(n)
    gate.set()
    kept = [n for n, _ in jobs.finished(everything=True)]
    jobs.close()
    assert kept[0] == 0 and kept[-1] == 9 and len(kept) == 3 and jobs.dropped == 7


def test_live_the_first_half_is_no_further_ahead_than_the_queue_is_long() -> None:
    gate, begun = threading.Event(), list[int]()

    def work(n: int) -> Callable[[], int]:
        begun.append(n)
        return lambda: n if gate.wait(20) else -1

    jobs = BackgroundWorker(ROWS, work, 3, live=True)
    for n in range(3):
        jobs.offer(n)
        assert until(lambda: jobs.is_free)
    for n in range(3, 20):
        jobs.offer(n)
        time.sleep(0.002)  # for the first thread to begin it, if it may
    assert begun == [0, 1, 2] and jobs.dropped == 16
    gate.set()
    assert [n for n, _ in jobs.finished(everything=True)] == [0, 1, 2, 19]
    jobs.close()


def test_a_first_depth_that_gives_way_is_no_lost_view() -> None:
    gate = threading.Event()

    def work(view: StereoView) -> None:
        gate.wait(5)

    jobs = BackgroundWorker(ROWS, halves(work), 2, live=True, counts=is_lost_if_dropped)
    views = [view_at(seq, np.eye(4)) for seq in range(4)]
    first = replace(views[2], is_first_depth=True)
    for view in (views[0], first, *views[1:3]):  # no more than the queue takes but for the first
        jobs.offer(view)
    assert jobs.dropped == 0
    jobs.offer(views[3])
    assert jobs.dropped == 1
    gate.set()
    kept = [view.seq for view, _ in jobs.finished(everything=True)]
    jobs.close()
    assert kept == [0, 2, 3]


def test_live_what_gave_way_is_forgotten_while_the_work_at_hand_hangs() -> None:
    class Item:
        pass

    gate, items = threading.Event(), WeakSet[Item]()
    jobs: BackgroundWorker[Item, bool] = BackgroundWorker(
        ROWS, halves(lambda _: gate.wait(5)), 2, live=True
    )
    for _ in range(50):
        item = Item()
        items.add(item)
        jobs.offer(item)
        del item
    assert len(items) == 3 and jobs.dropped == 47
    gate.set()
    assert len(jobs.finished(everything=True)) == 3
    jobs.close()
    assert len(items) == 0


def test_a_fault_reaches_the_caller() -> None:
    def work(n: int) -> int:
        raise RuntimeError("no luck")

    jobs = BackgroundWorker(ROWS, halves(work), 2)
    jobs.offer(1)
    with pytest.raises(RuntimeError, match="no luck"):
        jobs.finished(everything=True)
    jobs.close()


def test_what_was_done_before_a_fault_is_not_lost() -> None:
    def work(n: int) -> int:
        if n == 2:
            raise RuntimeError("no luck")
        return n

    jobs = BackgroundWorker(None, halves(work), 4)
    for n in range(5):
        jobs.offer(n)
    assert jobs.finished() == [(0, 0), (1, 1)]
    with pytest.raises(RuntimeError, match="no luck"):
        jobs.finished()
    assert jobs.finished() == [(3, 3), (4, 4)]


def test_without_a_thread_the_work_is_done_at_once() -> None:
    seen: list[int] = []
    jobs: BackgroundWorker[int, None] = BackgroundWorker(None, halves(seen.append), 2, live=True)
    jobs.offer(1)
    assert seen == [1] and len(jobs.finished()) == 1


def test_a_worker_that_is_not_closed_ends_with_its_owner() -> None:
    before = set(threading.enumerate())  # other tests may have left some
    jobs = BackgroundWorker(ROWS, halves(str), 2)
    jobs.offer(1)
    assert jobs.finished(everything=True) == [(1, "1")]
    assert {t.name for t in set(threading.enumerate()) - before}.issuperset(ROWS)
    del jobs
    assert until(lambda: set(threading.enumerate()) <= before)


def test_a_fault_at_the_end_of_a_scan_leaves_no_thread_behind() -> None:
    def work(n: int) -> int:
        raise RuntimeError("no luck")

    before = set(threading.enumerate())
    jobs: list[BackgroundWorker[int, int]] = []

    def worker(_: object) -> Any:
        jobs.append(BackgroundWorker(ROWS, halves(work), 2))
        return jobs[-1]

    mapper: Any = Mapper(Camera(np.diag([60.0, 60.0, 1.0]), np.zeros(5), (80, 60)), worker=worker)
    mapper.views = Mock(VirtualStereoCamera, **{"ready.return_value": [1, 2, 3]})
    with pytest.raises(RuntimeError, match="no luck"):
        mapper.finish()
    assert jobs and set(threading.enumerate()) <= before


def test_after_an_end_nothing_waits_for_work_that_lasts() -> None:
    gate, end = threading.Event(), threading.Event()

    def work(n: int) -> int:
        if n == 1:
            end.set()
            gate.wait(60)
        return n

    jobs = BackgroundWorker(ROWS, halves(work), 2)
    jobs.end_by(end, patience_s=0.01)
    for n in range(9):  # the fifth would wait for the second
        jobs.offer(n)
    kept = jobs.finished(everything=True)
    jobs.close()
    assert kept == [(0, 0)] and jobs.dropped == 8
    gate.set()
