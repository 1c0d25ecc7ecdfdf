"""Threads under supervision: a fault is reported and repaired, and ends nothing else."""

from __future__ import annotations

import threading

from loopback import until

from service.workers import Worker, Workers, guarded


def test_a_worker_that_fails_is_started_again_and_reported() -> None:
    table, runs, other = Workers(pause_s=0.0), [], threading.Event()

    def fails_twice(worker: Worker) -> None:
        runs.append(worker.name)
        if len(runs) < 3:
            raise KeyError("first\nsecond")

    def waits(worker: Worker) -> None:
        other.set()
        worker.stop.wait()

    waiting = table.start("waiting", waits)
    failing = table.start("failing", fails_twice)
    assert until(lambda: failing.is_done)
    assert other.is_set()
    assert runs == ["failing"] * 3
    assert table.report() == [
        {"name": "waiting", "state": "running", "restarts": 0, "fault": ""},
        {"name": "failing", "state": "done", "restarts": 2, "fault": "KeyError: 'first\\nsecond'"},
    ]
    assert not table.failed
    assert waiting.join(10.0)


def test_the_budget_of_restarts_ends() -> None:
    table, runs = Workers(max_restarts=3, pause_s=0.0), []

    def fails(worker: Worker) -> None:
        runs.append(1)
        raise ValueError("always")

    worker = table.start("failing", fails)
    assert until(lambda: table.failed)
    assert worker.join(10.0)
    assert len(runs) == 4
    assert table.report()[0]["state"] == "failed"


def test_a_worker_without_a_beat_is_stalled() -> None:
    table, beat = Workers(), threading.Event()

    def work(worker: Worker) -> None:
        while not worker.stop.wait(0.001):
            if beat.is_set():
                worker.beat()

    worker = table.start("working", work, stall_s=0.3)
    assert until(lambda: table.stalled)
    beat.set()
    assert until(lambda: not table.stalled)
    assert worker.join(10.0) and not table.stalled


def test_a_fault_is_one_line() -> None:
    def fail() -> None:
        raise RuntimeError("one\ntwo")

    assert guarded("test", fail) == "RuntimeError: one"
    assert guarded("test", lambda: None) == ""
