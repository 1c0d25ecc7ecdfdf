"""Threads under supervision: a fault is reported and repaired, and ends nothing else."""

from __future__ import annotations

import re
import sys
import threading

import pytest
from loopback import until
from paths import ROOT

from service.workers import ROWS, Row, Worker, Workers, guarded, row_of, running


def test_a_worker_that_fails_is_started_again_and_reported() -> None:
    table, runs, other = Workers(pause_s=0.0), [], threading.Event()

    def fails_twice(worker: Worker) -> None:
        runs.append(worker.name)
        if len(runs) < 3:
            raise KeyError("first\nsecond")

    def waits(worker: Worker) -> None:
        other.set()
        worker.stop.wait()

    waiting = table.start(Row("waiting", "", restarts=True), waits)
    failing = table.start(Row("failing", "", restarts=True), fails_twice)
    assert until(lambda: failing.is_done)
    assert other.is_set()
    assert runs == ["failing"] * 3
    shown = ("name", "state", "restarts", "fault")
    assert [{key: entry[key] for key in shown} for entry in table.report()] == [
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

    worker = table.start(Row("failing", "", restarts=True, is_essential=True), fails)
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

    worker = table.start(Row("working", "", deadline_s=0.3, restarts=True), work)
    assert until(lambda: table.stalled)
    beat.set()
    assert until(lambda: not table.stalled)
    assert worker.join(10.0) and not table.stalled


def test_a_fault_is_one_line() -> None:
    def fail() -> None:
        raise RuntimeError("one\ntwo")

    assert guarded("test", fail) == "RuntimeError: one"
    assert guarded("test", lambda: None) == ""


def test_a_worker_without_restarts_is_run_once() -> None:
    table, runs = Workers(pause_s=0.0), []

    def fails(worker: Worker) -> None:
        runs.append(1)
        raise ValueError("once")

    worker = table.start(Row("failing", ""), fails)
    assert until(lambda: worker.is_done)
    assert (runs, worker.fault, worker.has_failed) == ([1], "ValueError: once", False)


def test_work_is_repeated_also_after_faults() -> None:
    table, runs = Workers(), []

    def fails() -> None:
        runs.append(1)
        raise OSError("the disk is full")

    worker = table.every("housekeeping", 0.001, fails)
    assert until(lambda: len(runs) > 2)
    assert worker.fault == "the disk is full"
    assert worker.join(10.0)


def test_workers_stop_in_the_order_of_the_table() -> None:
    table, ended = Workers(), []

    def work(worker: Worker) -> None:
        worker.stop.wait()
        ended.append(worker.name)

    for name in ("health", "housekeeping", "scan", "files", "datalink"):
        table.start(name, work)
    table.stop()
    assert ended == ["scan", "files", "datalink", "housekeeping", "health"]


def test_what_runs_is_shown_by_its_row() -> None:
    table, release = Workers(), threading.Event()

    def waits(worker: Worker) -> None:
        release.wait()

    table.start("coverage", waits)
    table.start("camera", waits, lambda: 2, lambda: 0.5)
    own = threading.Thread(target=release.wait, name="mavlink beat")
    own.start()
    found = {entry["name"]: entry for entry in running()}
    release.set()
    own.join()
    camera = found["camera"]
    assert (camera["waiting"], camera["bound"], camera["when_full"]) == (2, 2, "drop oldest")
    assert (camera["lag_s"], camera["state"]) == (0.5, "running")
    assert found["coverage"]["bound"] is None
    assert found["mavlink beat"]["state"] == "running"
    assert list(found) == sorted(found, key=lambda name: ROWS.index(row_of(name)))


def test_what_runs_is_shown_while_tables_come_and_go() -> None:
    stop, before = threading.Event(), sys.getswitchinterval()

    def make() -> None:
        while not stop.is_set():
            tables = [Workers() for _ in range(50)]
            del tables

    maker = threading.Thread(target=make)
    sys.setswitchinterval(1e-6)
    maker.start()
    try:
        for _ in range(3000):
            running()
    finally:
        sys.setswitchinterval(before)
        stop.set()
        maker.join()


def test_a_worker_outside_the_table_is_refused() -> None:
    with pytest.raises(KeyError, match="no row"):
        Workers().start("made up", lambda _: None)


STARTERS = re.compile(
    r"\b(?:Thread|(?<!psutil\.)Process|Popen|\w+PoolExecutor|Timer|start_new_thread)\("
)
OUTSIDE = {
    "recon/parallel.py": "the rows of one compiled call; recon knows nothing of service",
    "service/workers.py": "it is the executor",
    "service/bench/": "benchmarks make their own load, peers and links",
    "service/commands/__init__.py": "a signal's handler must not wait for the table's lock",
    "service/commands/demo.py": "it starts the other commands, as a person would",
    "mavlink/component/vehicle.py": "mavlink knows nothing of service; rows by name",
    "mavlink/wire/link.py": "the same",
    "mavlink/wire/first_beat.py": "the same",
    "mavlink/wire/stand_in.py": "the same",
}
"""Where a thread or process starts without the table, and why."""


def test_only_the_executor_starts_threads_and_processes() -> None:
    root = ROOT
    found = set()
    for room in ("service", "mavlink", "recon"):
        for path in sorted((root / room).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            if "node_modules" not in name and STARTERS.search(path.read_text(encoding="utf-8")):
                found.add(name)
    assert {name for name in found if not name.startswith(tuple(OUTSIDE))} == set()
    assert {name for name in OUTSIDE if not any(f.startswith(name) for f in found)} == set()
