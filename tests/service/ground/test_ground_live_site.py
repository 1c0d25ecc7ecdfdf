"""The ground station shows scans in flight in the site: process, file, news for the portal."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from site_scans import ELSEWHERE, FRAME, START_NS, Errors, header_of, layers, leg, write_scan

from recon.types import F64
from service.georeference import between_frames
from service.ground.live_site import FILE, MAX_SCANS, Follower, SiteNews, run
from service.ground.sites import references
from service.offline.site.alignment import align_site
from service.scans.folder import write_deliverables
from service.stream.store import ScanStore
from service.workers import Workers, running

NORTH, EAST = leg(0.0, 4), leg(np.pi / 2, 4)
WRONG = Errors((1.1, -0.7, 0.9))


def flying(folder: Path, poses: list[F64], errors: Errors | None = None) -> Path:
    """A scan in flight whose coordinates have an origin of their own."""
    with ScanStore.create(folder / "scan.db", header_of(folder.name, ELSEWHERE)) as store:
        for seq, T in enumerate(poses):
            store.add_keyframe(seq, layers(seq, T, errors, frame=ELSEWHERE))
    return folder


def landed(folder: Path, poses: list[F64], errors: Errors | None = None) -> Path:
    write_scan(folder, poses, errors)
    with ScanStore.open(folder / "scan.db") as store:
        write_deliverables(folder, store)
    return rested(folder)


def rested(folder: Path) -> Path:
    """It has not grown for long."""
    for path in folder.glob("scan.db*"):
        os.utime(path, (0, 0))
    return folder


def followed(store: Path) -> Follower:
    follower = Follower(store)
    while follower.turn(time.time()):
        pass
    return follower


def said(folder: Path) -> dict[tuple[str, str], dict[str, object]]:
    text = SiteNews(folder.parent.parent, folder).message()
    return {(one["drone"], one["scan"]): one for one in json.loads(text or "{}")["scans"]}


@pytest.mark.slow
def test_two_scans_in_flight_are_shown_in_one_another(tmp_path: Path) -> None:
    one = flying(tmp_path / "a" / "1", NORTH, WRONG)
    two = write_scan(tmp_path / "b" / "2", EAST, finished=False)
    followed(tmp_path)
    here, there = (said(folder) for folder in (one, two))
    assert set(here) == set(there) == {("a", "1"), ("b", "2")}
    assert here["a", "1"]["own"] and not here["b", "2"]["own"]
    T = np.reshape(np.array(here["b", "2"]["T"], np.float64), (4, 4)).T
    own = np.reshape(np.array(here["a", "1"]["T"], np.float64), (4, 4)).T
    to_one = between_frames(ELSEWHERE, FRAME)
    spot = np.array([2.0, 1.0, 0.0, 1.0])
    as_one_has_it = to_one @ (spot + np.append(WRONG.shift_m, 0.0))
    np.testing.assert_allclose(T @ spot, own @ as_one_has_it, atol=0.15)
    assert np.linalg.norm(own[:3, 3]) > 0.3


def test_what_is_known_is_not_said_again(tmp_path: Path) -> None:
    one = flying(tmp_path / "a" / "1", NORTH[:1])
    followed(tmp_path)
    news = SiteNews(one.parent.parent, one)
    assert news.message() is not None and news.message() is None
    (tmp_path / FILE).write_text('[{"drone": 1e999}]')
    assert json.loads(news.message() or "") == {"type": "site", "scans": []}
    (tmp_path / FILE).unlink()
    assert json.loads(news.message() or "") == {"type": "site", "scans": []}


@pytest.mark.slow
def test_a_scan_in_flight_meets_the_site_on_the_ground(tmp_path: Path) -> None:
    members = [landed(tmp_path / "a" / "1", NORTH), landed(tmp_path / "a" / "2", NORTH[1:])]
    site = tmp_path / "site" / "a-1"
    align_site(members, site)
    alone = landed(tmp_path / "c" / "4", leg(0.5, 2))
    assert set(references(tmp_path, 1.7e9, ())) == {alone, site}
    assert set(references(tmp_path, 1.7e9, members[:1])) == {alone, members[1]}
    assert references(tmp_path, 1.8e9, ()) == []
    one = flying(tmp_path / "b" / "3", EAST, WRONG)
    followed(tmp_path)
    assert ("site", "a-1") in said(one) and ("a", "1") not in said(one)


@pytest.mark.slow
def test_the_last_visit_is_shown_as_an_earlier_date(tmp_path: Path) -> None:
    for name, day in (("april", -60), ("may", -30)):
        scan = write_scan(tmp_path / name / "1", NORTH, day=day)
        with ScanStore.open(scan / "scan.db") as store:
            write_deliverables(scan, store)
        rested(scan)
    may, now = tmp_path / "may" / "1", START_NS / 1e9
    here, elsewhere = (FRAME.lat_deg, FRAME.lon_deg), (FRAME.lat_deg + 0.01, FRAME.lon_deg)
    assert references(tmp_path, now, (), elsewhere) == references(tmp_path, now, ()) == []
    assert references(tmp_path, now, (), here) == [may]
    flown = flying(tmp_path / "b" / "3", EAST, WRONG)
    followed(tmp_path)
    shown = said(flown)
    assert set(shown) == {("may", "1"), ("b", "3")}
    assert shown["may", "1"]["earlier"] and not shown["b", "3"]["earlier"]
    assert ("b", "3") not in said(may)  # a scan shows none that came later


@pytest.mark.parametrize("damage", ["text", "empty", "pose", "gone"])
@pytest.mark.slow
def test_a_broken_scan_stops_no_other(tmp_path: Path, damage: str) -> None:
    broken = tmp_path / "bad" / "0"
    far = [T.copy() for T in NORTH[:2]]
    for T in far:
        T[:3, 3] += 1e4 if damage == "pose" else 0.0
    flying(broken, far)
    one = flying(tmp_path / "a" / "1", NORTH[:3], WRONG)
    two = write_scan(tmp_path / "b" / "2", EAST[:3], finished=False)
    follower = Follower(tmp_path)
    follower.turn(time.time())
    if damage == "text":
        (broken / "scan.db").write_text("no database" * 1000)
    if damage == "empty":
        (broken / "scan.db").write_bytes(b"")
    if damage == "gone":
        for path in broken.iterdir():
            path.unlink()
    while follower.turn(time.time()):
        pass
    assert {("a", "1"), ("b", "2")} <= set(said(one)) and said(one)["a", "1"]["ties"] != 0
    assert set(said(two)) == set(said(one))


def test_a_scan_that_ended_is_followed_while_others_fly(tmp_path: Path) -> None:
    one = flying(tmp_path / "a" / "1", NORTH[:3])
    two = write_scan(tmp_path / "b" / "2", EAST[:3], finished=False)
    follower = followed(tmp_path)
    with ScanStore.open(two / "scan.db") as store:
        store.finish({"frames": 3})
    follower.turn(time.time())
    assert ("b", "2") in said(one) and MAX_SCANS > 2
    rested(one)
    follower.turn(time.time())
    assert said(one) == {}


def wait_for(reached: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not reached() and time.monotonic() < end:
        time.sleep(0.1)
    assert reached()


@pytest.mark.slow
def test_the_process_is_started_again_when_it_is_killed(tmp_path: Path) -> None:
    one = flying(tmp_path / "a" / "1", NORTH[:1])

    def process() -> int:
        names = (re.fullmatch(r"live site, process (\d+)", row["name"]) for row in running())
        return next((int(found[1]) for found in names if found), 0)

    worker = Workers().start("live site", partial(run, tmp_path))
    try:
        wait_for(lambda: bool((tmp_path / FILE).exists() and said(one)))
        killed = process()
        os.kill(killed, signal.SIGKILL)
        wait_for(lambda: worker.restarts == 1 and process() not in (0, killed))
        wait_for(lambda: bool((tmp_path / FILE).exists() and said(one)))
    finally:
        assert worker.join(10.0)
    assert not (tmp_path / FILE).exists()
