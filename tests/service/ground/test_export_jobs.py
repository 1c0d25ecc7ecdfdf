"""Deliverables asked for in the portal: one that fails does not keep the others waiting."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from loopback import until

from service.errors import InputError, OutsideError
from service.ground.portal import Portal, PortalConfig
from service.ground.state import KEPT, MAX_WAITING_JOBS, Job, Jobs
from service.offline.exports.view import ExportOptions
from service.workers import Workers


def test_a_fault_of_ours_does_not_stop_the_exports_that_wait(tmp_path: Path) -> None:
    began, go_on = threading.Event(), threading.Event()

    def carry_out(job: Job) -> str:
        if job.folder.name == "bad":
            began.set()
            go_on.wait(10.0)
            raise ZeroDivisionError
        return "scan.kml"

    jobs = Jobs(Workers(), carry_out)
    jobs.start(tmp_path / "bad", "kml")
    assert began.wait(10.0)
    jobs.start(tmp_path / "good", "kml")
    go_on.set()
    assert until(lambda: not jobs.busy(tmp_path / "good"))
    assert [job["state"] for job in jobs.of(tmp_path / "good")] == ["done"]
    assert jobs.of(tmp_path / "bad")[0]["error"] == "failed; see the log"


def test_jobs_say_how_far_they_are_and_can_be_cancelled(tmp_path: Path) -> None:
    halfway, go_on = threading.Event(), threading.Event()

    def carry_out(job: Job) -> str:
        for n in job.progress.over(range(4), 4):
            if n == 2:
                job.progress("halfway")
                halfway.set()
                go_on.wait(10.0)
        return "scan.kml"

    jobs = Jobs(Workers(), carry_out)
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


def test_jobs_end_with_the_portal(tmp_path: Path) -> None:
    portal = Portal(PortalConfig(tmp_path, port=0))
    jobs, running = portal.jobs, threading.Event()

    def carry_out(job: Job) -> str:
        while True:
            job.progress("on and on")  # raises once it is cancelled
            running.set()

    jobs.carry_out = carry_out
    for kind in ("dsm", "laz"):
        jobs.start(tmp_path, kind)
    assert running.wait(10.0)
    portal.close()
    assert [job["state"] for job in jobs.listed()] == ["cancelled", "cancelled"]
    assert not jobs.busy(tmp_path)


def test_ended_jobs_leave_the_list_after_a_while(tmp_path: Path) -> None:
    jobs = Jobs(Workers(), lambda _: "scan.kml", shown_s=3600.0)
    brief = Jobs(Workers(), lambda _: "scan.kml", shown_s=-1.0)
    brief.start(tmp_path, "kml")
    jobs.start(tmp_path, "kml")
    assert until(lambda: not jobs.busy(tmp_path)) and len(jobs.listed()) == 1
    assert until(lambda: not brief.busy(tmp_path))
    assert brief.listed() == [] and len(brief.of(tmp_path)) == 1


def test_what_nobody_asked_for_waits_for_all_others(tmp_path: Path) -> None:
    order, may_begin, go_on = list[str](), threading.Event(), threading.Event()

    def carry_out(job: Job) -> str:
        order.append(job.kind)
        go_on.wait(10.0)
        return "scan.kml"

    jobs = Jobs(Workers(), carry_out)
    folder = tmp_path / "drone-1" / "test-1"
    unasked = jobs.start(folder, "glb", may_begin=may_begin.is_set)["number"]
    assert not jobs.busy(folder)  # it may be deleted meanwhile
    jobs.start(folder, "kml")
    jobs.start(folder, "laz")
    go_on.set()
    assert until(lambda: order == ["kml", "laz"] and not jobs.busy(folder))
    assert [job["state"] for job in jobs.of(folder)] == ["waiting", "done", "done"]
    may_begin.set()
    assert until(lambda: order == ["kml", "laz", "glb"])
    assert until(lambda: jobs.of(folder)[0]["state"] == "done")
    waiting = jobs.start(folder, "glb", may_begin=lambda: False)["number"]
    assert waiting > unasked
    assert jobs.start(folder, "glb")["number"] == waiting  # somebody asks: it begins
    assert until(lambda: order[3:] == ["glb"] and not jobs.busy(folder))


def test_what_is_asked_for_begins_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while one that was not asked for waits to be looked at again."""
    monkeypatch.setattr("service.ground.state.LOOK_S", 60.0)
    looked = threading.Event()

    def may_begin() -> bool:
        looked.set()
        return False

    jobs = Jobs(Workers(), lambda job: f"scan.{job.kind}")
    jobs.start(tmp_path, "glb", may_begin=may_begin)
    assert looked.wait(10.0)
    jobs.start(tmp_path, "kml")
    assert until(lambda: not jobs.busy(tmp_path))
    jobs.start(tmp_path, "glb")  # the one that waits
    assert until(lambda: [job["state"] for job in jobs.of(tmp_path)] == ["done", "done"])


def test_what_nobody_asked_for_fails_in_silence(tmp_path: Path) -> None:
    def carry_out(job: Job) -> str:
        raise InputError("there is too little surface")

    jobs = Jobs(Workers(), carry_out)
    jobs.start(tmp_path, "glb", may_begin=lambda: True)
    assert until(lambda: not jobs.listed())
    jobs.start(tmp_path, "glb")
    assert until(lambda: [job["state"] for job in jobs.listed()] == ["failed"])


def test_what_nobody_asked_for_takes_no_room_from_the_others(tmp_path: Path) -> None:
    """As after a card with hundreds of scans was taken in while another scan grows."""
    may_begin = threading.Event()
    jobs = Jobs(Workers(), lambda job: f"{job.folder.name}.{job.kind}")
    for n in range(MAX_WAITING_JOBS):
        jobs.start(tmp_path / str(n), "glb", may_begin=may_begin.is_set)
    with pytest.raises(InputError, match="too many"):
        jobs.start(tmp_path / "more", "glb", may_begin=may_begin.is_set)
    for _ in range(KEPT + 5):
        number = jobs.start(tmp_path / "asked", "kml")["number"]
        assert until(lambda: not jobs.busy(tmp_path / "asked"))
    assert number > KEPT
    may_begin.set()
    made = [tmp_path / str(n) for n in range(MAX_WAITING_JOBS)]
    assert until(lambda: all(jobs.of(folder)[0]["state"] == "done" for folder in made))


def test_a_running_job_that_nobody_asked_for_gives_way_and_begins_again(tmp_path: Path) -> None:
    order, began = list[str](), threading.Semaphore(0)

    def carry_out(job: Job) -> str:
        order.append(job.kind)
        began.release()
        while job.kind == "glb" and len(order) < 3:
            job.progress("meshing")
        return "mesh.glb"

    jobs = Jobs(Workers(), carry_out)
    jobs.start(tmp_path, "glb", may_begin=lambda: True)
    assert began.acquire(timeout=10.0)
    jobs.start(tmp_path, "kml")
    assert until(lambda: [job["state"] for job in jobs.of(tmp_path)] == ["done", "done"])
    assert order == ["glb", "kml", "glb"]
    order.clear()
    number = jobs.start(tmp_path, "glb", may_begin=lambda: True)["number"]
    assert until(lambda: len(order) == 1)
    again = jobs.start(tmp_path, "glb", may_begin=lambda: True)["number"]
    assert again > number  # the scan has changed since that one began
    jobs.cancel(again)
    jobs.cancel(number)
    assert until(lambda: [job["state"] for job in jobs.of(tmp_path)][2:] == ["cancelled"] * 2)


def test_nothing_begins_once_the_station_closes(tmp_path: Path) -> None:
    """The receiver closes after the portal, and says that a scan has ended."""
    jobs = Jobs(Workers(), lambda _: "mesh.glb")
    waiting = jobs.start(tmp_path, "glb", may_begin=lambda: False)["number"]
    jobs.close()
    assert [job["state"] for job in jobs.of(tmp_path)] == ["cancelled"]
    for may_begin in (None, lambda: True):
        with pytest.raises(OutsideError, match="ends"):
            jobs.start(tmp_path, "glb", may_begin=may_begin)
    assert [job["number"] for job in jobs.listed()] == [waiting]


def test_a_fault_in_what_follows_a_job_does_not_stop_the_others(tmp_path: Path) -> None:
    def ended(_: Job) -> None:
        raise RuntimeError("can't start new thread")

    jobs = Jobs(Workers(), lambda _: "scan.kml")
    jobs.ended = ended
    for kind in ("kml", "laz"):
        jobs.start(tmp_path, kind)
    assert until(lambda: [job["state"] for job in jobs.of(tmp_path)] == ["done", "done"])
