"""Scans that end at the ground station become a site with those of the same ground."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from site_scans import Errors, leg, write_scan

from service.ground.sites import Sites, companions, site_of
from service.ground.storage import DroneLimits
from service.offline.site.alignment import align_site
from service.scans.folder import write_deliverables
from service.stream.store import ScanStore
from service.workers import Worker, Workers

DAY = 86_400


def summary(folder: Path, start_s: float = 0.0, north: float = 0.0, finished: bool = True) -> Path:
    """A scan folder of a square of 0.001 degrees, with its scan.json only."""
    folder.mkdir(parents=True)
    (folder / "scan.db").touch()
    corners = [[47.0 + north + dn, 8.0 + de] for dn in (0.0, 0.001) for de in (0.0, 0.001)]
    facts = {
        "schema": 1, "times": {"started_unix_s": 1e9 + start_s}, "finished": finished,
        "coverage": {"corners_lat_lon": corners},
    }  # fmt: skip
    (folder / "scan.json").write_text(json.dumps(facts))
    return folder


def test_companions_share_ground_and_the_visit(tmp_path: Path) -> None:
    own = summary(tmp_path / "a" / "own")
    near = summary(tmp_path / "b" / "near", 0.9 * DAY, north=0.0009)
    summary(tmp_path / "a" / "touching", 10.0, north=0.00096)
    summary(tmp_path / "a" / "later", 1.1 * DAY)
    summary(tmp_path / "a" / "flying", 10.0, finished=False)
    summary(tmp_path / "site" / "made", 10.0)
    summary(tmp_path / ".bin" / "deleted", 10.0)
    assert companions(tmp_path, own) == [near]


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", '{"schema": 2}', '{"schema": 1, "times": {"started_unix_s": 1e99}}',
     '{"schema":1,"times":{"started_unix_s":1e9},"finished":true,'
     '"coverage":{"corners_lat_lon":[[1e9,0],[0,0],[0,0],[0,0]]}}'],
)  # fmt: skip
def test_a_damaged_summary_makes_no_companion(tmp_path: Path, text: str) -> None:
    own, near = (summary(tmp_path / "a" / name) for name in ("own", "near"))
    damaged = summary(tmp_path / "a" / "damaged")
    (damaged / "scan.json").write_text(text)
    assert companions(tmp_path, own) == [near]
    assert companions(tmp_path, damaged) == []


def test_a_scan_without_georeference_has_no_companion(tmp_path: Path) -> None:
    own, other = (summary(tmp_path / "a" / name) for name in ("own", "other"))
    facts = json.loads((other / "scan.json").read_text())
    (other / "scan.json").write_text(json.dumps(facts | {"coverage": None}))
    assert companions(tmp_path, own) == companions(tmp_path, other) == []


def test_a_site_is_found_again_by_any_member(tmp_path: Path) -> None:
    one, two, three = (tmp_path / d / s for d, s in (("b", "1"), ("a", "2"), ("a", "3")))
    new = site_of(tmp_path, [two, one])
    assert new == tmp_path / "site" / "b-1"
    new.mkdir(parents=True)
    (tmp_path / "site" / "a-0").mkdir()
    (tmp_path / "site" / "a-0" / "site.json").write_text("[")
    (new / "site.json").write_text(json.dumps({"scans": [{"folder": str(two.resolve())}]}))
    assert site_of(tmp_path, [three, two]) == new
    assert site_of(tmp_path, [three]) == tmp_path / "site" / "a-3"


@pytest.fixture
def working(tmp_path: Path) -> Iterator[tuple[Sites, Worker]]:
    workers, sites = Workers(), Sites(tmp_path, DroneLimits(reserve_bytes=0))
    worker = workers.start("sites", sites.run)
    yield sites, worker
    assert worker.join(10.0)


def flown(folder: Path, heading: float, errors: Errors) -> Path:
    write_scan(folder, leg(heading), errors)
    with ScanStore.open(folder / "scan.db") as store:
        write_deliverables(folder, store)
    return folder


def wait_for(path: Path, worker: Worker, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not path.exists() and not worker.fault and time.monotonic() < end:
        time.sleep(0.1)
    assert path.exists(), worker.fault


@pytest.mark.slow
def test_scans_that_end_are_aligned(tmp_path: Path, working: tuple[Sites, Worker]) -> None:
    sites, worker = working
    one = flown(tmp_path / "a" / "1", 0.0, Errors((1.0, 0.0, 0.5)))
    sites.put(one)  # alone: nothing happens
    two = flown(tmp_path / "b" / "2", np.pi / 2, Errors((-1.0, 0.0, -0.5)))
    sites.put(two)
    wait_for(tmp_path / "site" / "a-1" / "report.html", worker)
    document = json.loads((tmp_path / "site" / "a-1" / "site.json").read_text())
    assert [s["placed"] for s in document["scans"]] == ["aligned", "aligned"]
    assert document["revision"] == 1


@pytest.mark.slow
def test_a_scan_that_cannot_be_read_stops_no_other(
    tmp_path: Path, working: tuple[Sites, Worker]
) -> None:
    sites, worker = working
    one, _ = (summary(tmp_path / "a" / name) for name in "12")  # their stores are empty
    sites.put(one)
    end = time.monotonic() + 60.0
    while not worker.fault and time.monotonic() < end:
        time.sleep(0.05)
    assert str(tmp_path / "site" / "a-1") in worker.fault
    assert not worker.is_done and not (tmp_path / "site" / "a-1").exists()


def test_an_alignment_that_was_killed_is_begun_again(tmp_path: Path) -> None:
    one = write_scan(tmp_path / "one", leg(0.0, 3))
    site = tmp_path / "site"
    site.mkdir()
    (site / ".scan.db.new").write_bytes(b"half a store")
    assert align_site([one], site, deliver=False).document["revision"] == 1
    assert not (site / ".scan.db.new").exists()


def test_a_scan_that_was_deleted_leaves_the_site(tmp_path: Path) -> None:
    one, two = (write_scan(tmp_path / n, leg(a, 3)) for n, a in (("one", 0.0), ("two", 1.5)))
    align_site([one, two], tmp_path / "site", deliver=False)
    (one / "scan.db").unlink()
    document = align_site([two], tmp_path / "site", deliver=False).document
    assert [s["name"] for s in document["scans"]] == ["two"]
    assert any("one is no longer there" in note for note in document["notes"])
