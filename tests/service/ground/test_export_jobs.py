"""Deliverables asked for in the portal: one that fails does not keep the others waiting."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from loopback import until

from service.errors import InputError
from service.ground import state
from service.ground.portal import Portal, PortalConfig
from service.ground.state import Job, Jobs
from service.offline.exports.view import ExportOptions
from service.progress import Progress
from service.workers import Workers


class View:
    """Stands in for a scan that is opened."""

    def __init__(self, folder: Path, progress: Progress) -> None:
        self.name, self.progress = folder.name, progress

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def test_a_fault_of_ours_does_not_stop_the_exports_that_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, go_on = threading.Event(), threading.Event()

    def export(scan: View, *_: Any) -> Path:
        if scan.name == "bad":
            began.set()
            go_on.wait(10.0)
            raise ZeroDivisionError
        return Path("scan.kml")

    monkeypatch.setattr(state, "ScanView", View)
    monkeypatch.setattr(state, "export", export)
    jobs = Jobs(Workers())
    jobs.start(tmp_path / "bad", "kml")
    assert began.wait(10.0)
    jobs.start(tmp_path / "good", "kml")
    go_on.set()
    assert until(lambda: not jobs.busy(tmp_path / "good"))
    assert [job["state"] for job in jobs.of(tmp_path / "good")] == ["done"]
    assert jobs.of(tmp_path / "bad")[0]["error"] == "failed; see the log"


def test_jobs_say_how_far_they_are_and_can_be_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    halfway, go_on = threading.Event(), threading.Event()

    def export(scan: View, *_: Any) -> Path:
        for n in scan.progress.over(range(4), 4):
            if n == 2:
                scan.progress("halfway")
                halfway.set()
                go_on.wait(10.0)
        return Path("scan.kml")

    monkeypatch.setattr(state, "ScanView", View)
    monkeypatch.setattr(state, "export", export)
    jobs = Jobs(Workers())
    folder = tmp_path / "drone-1" / "test-1"
    first, second, third = (jobs.start(folder, kind)["number"] for kind in ("kml", "laz", "dsm"))
    assert halfway.wait(10.0)
    running = jobs.listed()[0]
    assert (running["percent"], running["doing"], running["state"]) == (50, "halfway", "running")
    assert (running["drone"], running["scan"], running["kind"]) == ("drone-1", "test-1", "kml")
    again = [jobs.start(folder, kind)["number"] for kind in ("kml", "laz", "dsm")]
    assert again == [first, second, third]  # asked for twice, made once
    strict = ExportOptions(strict=True)
    other = jobs.start(folder, "dsm", options=strict)["number"]
    assert other > third and jobs.cancel(other)["state"] == "cancelled"
    assert jobs.cancel(second)["state"] == "cancelled"  # it waits: at once
    jobs.cancel(first)
    go_on.set()
    assert until(lambda: not jobs.busy(folder))
    assert [j["state"] for j in jobs.listed()] == ["cancelled", "cancelled", "done", "cancelled"]
    for number in (first, third, 99):
        with pytest.raises(InputError, match=f"no job {number}"):
            jobs.cancel(number)


def test_jobs_end_with_the_portal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    portal = Portal(PortalConfig(tmp_path, port=0))
    jobs, running = portal._jobs, threading.Event()

    def carry_out(job: Job) -> str:
        while True:
            job.progress("on and on")  # raises once it is cancelled
            running.set()

    monkeypatch.setattr(state, "carry_out", carry_out)
    for kind in ("dsm", "laz"):
        jobs.start(tmp_path, kind)
    assert running.wait(10.0)
    portal.close()
    assert [job["state"] for job in jobs.listed()] == ["cancelled", "cancelled"]
    assert not jobs.busy(tmp_path)


def test_ended_jobs_leave_the_list_after_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state, "carry_out", lambda _: "scan.kml")
    jobs = Jobs(Workers())
    jobs.start(tmp_path, "kml")
    assert until(lambda: not jobs.busy(tmp_path)) and len(jobs.listed()) == 1
    monkeypatch.setattr(state, "SHOWN_S", -1.0)
    assert jobs.listed() == [] and len(jobs.of(tmp_path)) == 1
