"""Sites: scans gathered, aligned and compared; what cannot be part of a site says why."""

from __future__ import annotations

import fcntl
import json
import re
import shutil
import sqlite3
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import site_scans
from site_scans import ELSEWHERE, FRAME, HEIGHT_M, Box, Errors, height, leg, write_scan
from typer.testing import CliRunner

from recon import se3
from recon.types import F64
from service.cli import app
from service.errors import InputError
from service.georeference import LocalFrame, between_frames
from service.offline.refine.refinement import RefineOptions, refine
from service.offline.site import alignment
from service.offline.site.alignment import AlignedSite, align_site
from service.offline.site.compare import compare
from service.stream.store import ScanStore

pytestmark = pytest.mark.slow

NORTH, EAST = leg(0.0), leg(np.pi / 2)
WRONG = Errors((1.1, -0.7, 0.9), (0.002, -0.001, 0.004), 1.002)


def errors_m(site: Path, truth: list[F64]) -> F64:
    """(N, 3) how far the ground below each camera lies off the truth, of the site's keyframes."""
    with ScanStore.open(site / "scan.db") as store:
        found = list(store.keyframes())
    assert len(found) == len(truth)
    out = []
    for one, T in zip(found, truth, strict=True):
        z = float(np.nanmedian(one.depth.depth_m))
        spot = se3.transform(one.depth.T_world_camera, np.array([[0.0, 0.0, z]]))[0]
        near = T[:3, 3] + T[:3, 2] * HEIGHT_M
        out.append(spot[:2] - near[:2])
    return np.array(out)


@pytest.fixture(scope="module")
def merged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    """Two crossing scans with errors of opposite sign and origins apart, as one site."""
    folder = tmp_path_factory.mktemp("site")
    shift = tuple(-v for v in WRONG.shift_m)
    other = Errors((shift[0], shift[1], shift[2]), (0.0, 0.002, -0.003), 0.998)
    one = write_scan(folder / "one", NORTH, WRONG)
    two = write_scan(folder / "two", EAST, other, frame=ELSEWHERE)
    done = CliRunner().invoke(
        app, ["site", "align", "--out", str(folder / "site"), str(one), str(two)]
    )
    assert done.exit_code == 0, done.output
    assert re.search(r"one - two: \d+ ties, \d\.\d\d -> 0\.\d\d m apart", done.output)
    return folder / "site", [one, two]


def test_origins_apart_are_joined_by_a_rigid_motion() -> None:
    T = between_frames(FRAME, ELSEWHERE)
    points = np.random.default_rng(1).normal(size=(5, 3)) * 200.0
    np.testing.assert_allclose(
        se3.transform(T, points), FRAME.to_enu(ELSEWHERE.to_geodetic(points)), atol=1e-6
    )


def test_crossing_scans_meet_between_their_fixes(merged: tuple[Path, list[Path]]) -> None:
    site, _ = merged
    document = json.loads((site / "site.json").read_text())
    (pair,) = document["pairs"]
    assert pair["ties"] >= 3 and pair["apart_before_m"] > 2.0
    off = errors_m(site, [*NORTH, *EAST])
    one, two = off[:6].mean(axis=0), off[6:].mean(axis=0)
    assert np.linalg.norm(one - two) < 0.1  # 0.1 % of the height is 0.04 m; keyframes are coarse
    assert np.linalg.norm(0.5 * (one + two)) < 0.25  # of 1.3 m each had: they cancel
    assert [s["placed"] for s in document["scans"]] == ["aligned", "aligned"]


def test_a_track_that_bends_is_straightened_by_the_ties(tmp_path: Path) -> None:
    there, back = leg(0.0, 12), leg(np.pi, 12)
    bent = write_scan(tmp_path / "bent", there, Errors(bend_m=0.3))
    straight = write_scan(tmp_path / "straight", back)
    align_site([bent, straight], tmp_path / "site", deliver=False)
    with ScanStore.open(tmp_path / "site" / "scan.db") as store:
        found = list(store.keyframes())
    poses = zip(found, [*there, *back], strict=True)
    off = [one.depth.T_world_camera[2, 3] - T[2, 3] for one, T in poses]
    assert np.ptp(np.subtract(off[:12], off[:11:-1])) < 0.15  # 0.3 m as flown


def test_scans_themselves_stay_as_they_are(merged: tuple[Path, list[Path]]) -> None:
    site, (one, _) = merged
    with ScanStore.open(one / "scan.db") as store, ScanStore.open(site / "scan.db") as joined:
        assert all(store.repose(seq) is None for seq in store.seqs())
        chunk = joined.keyframe(0)
        assert chunk is not None and (repose := joined.repose(0)) is not None
        assert repose.revision == 1


def test_a_site_is_a_scan_folder_for_every_export(merged: tuple[Path, list[Path]]) -> None:
    site, _ = merged
    assert (site / "cloud.laz").is_file() and (site / "report.html").is_file()
    done = CliRunner().invoke(app, ["export", str(site), "--to", "dsm", "--to", "ortho"])
    assert done.exit_code == 0, done.output
    assert (site / "dsm.tif").is_file()


def test_control_points_place_all_scans_of_a_site(
    merged: tuple[Path, list[Path]], tmp_path: Path
) -> None:
    site = tmp_path / "site"
    shutil.copytree(merged[0], site)
    truth, shift = [*NORTH, *EAST], np.array([0.5, -0.3, 0.4])  # the survey's from the fixes
    rows = ["name,x,y,z,lat,lon,alt_amsl_m"]
    with ScanStore.open(site / "scan.db") as store:
        for seq in (0, 2, 5, 6, 8):  # three in the first scan, two in the second
            one = store.keyframe(seq)
            assert one is not None
            ahead = np.array([[0.0, 0.0, float(one.depth.depth_m[67, 119])]])
            here = FRAME.to_utm(se3.transform(one.depth.T_world_camera, ahead))[0]
            spot = truth[seq][:3, 3].copy()
            spot[2] = height(spot[:1], spot[1:2])[0]
            lat, lon, alt = FRAME.to_geodetic((spot + shift)[None])[0]
            rows.append(
                f"P{seq},{here[0]:.3f},{here[1]:.3f},{here[2]:.3f},{lat:.9f},{lon:.9f},{alt:.3f}"
            )
    (tmp_path / "points.csv").write_text("\n".join(rows))
    assert refine(site, RefineOptions(tmp_path / "points.csv"))["changed"]
    off = errors_m(site, truth)
    for scan in (slice(0, 6), slice(6, 12)):
        np.testing.assert_allclose(off[scan].mean(axis=0), shift[:2], atol=0.08)


def test_aligning_again_keeps_the_history_and_adds_scans(
    merged: tuple[Path, list[Path]], tmp_path: Path
) -> None:
    site, _ = merged
    third = write_scan(tmp_path / "three", leg(np.pi / 4, 4), Errors((0.5, 0.5, 0.0)))
    document = align_site([third], site, deliver=False).document
    assert document["revision"] == 2 and len(document["history"]) == 2
    assert [s["name"] for s in document["scans"]] == ["one", "two", "three"]
    assert len(document["pairs"]) >= 2


def test_every_two_of_three_scans_of_one_place_are_tied(tmp_path: Path) -> None:
    flown = [(leg(np.radians(turn)), shift) for turn, shift in ((0, 0.8), (90, -0.8), (30, 0.2))]
    scans = [
        write_scan(tmp_path / f"{k}", poses, Errors((shift, 0.0, 0.5)), day=k)
        for k, (poses, shift) in enumerate(flown)
    ]
    document = align_site(scans, tmp_path / "site", deliver=False).document
    assert len(document["pairs"]) == 3
    assert all(pair["ties"] >= 3 for pair in document["pairs"]), document["pairs"]


def test_two_alignments_of_one_site_at_once_wait_for_each_other(tmp_path: Path) -> None:
    names = ("one", "two", "three")
    scans = [write_scan(tmp_path / n, NORTH[:2], day=k) for k, n in enumerate(names)]
    align_site([scans[0]], tmp_path / "site", deliver=False)

    def join(scan: Path) -> AlignedSite:
        return align_site([scan], tmp_path / "site", deliver=False)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(join, scans[1:]))
    document = json.loads((tmp_path / "site/site.json").read_text())
    assert {s["name"] for s in document["scans"]} == {"one", "two", "three"}
    assert document["revision"] == 3


def test_an_alignment_that_waits_for_one_that_fails_says_why_it_fails_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = write_scan(tmp_path / "nowhere", EAST[:2], frame=None)
    held, waits, flock = threading.Event(), threading.Event(), fcntl.flock

    def counted(handle: int, operation: int) -> None:
        if held.is_set():
            waits.set()  # the first one fails only now
        flock(handle, operation)

    def failing(*args: object) -> None:
        held.set()
        assert waits.wait(30.0)
        time.sleep(0.2)
        raise InputError("refused")

    monkeypatch.setattr(fcntl, "flock", counted)
    with ThreadPoolExecutor(1) as pool:
        with monkeypatch.context() as broken:
            broken.setattr(alignment, "gather", failing)
            first = pool.submit(align_site, [nowhere], tmp_path / "site", deliver=False)
            assert held.wait(30.0)
        with pytest.raises(InputError, match="no usable scan"):
            align_site([nowhere], tmp_path / "site", deliver=False)
        with pytest.raises(InputError, match="refused"):
            first.result()
    assert not (tmp_path / "site").exists()


def test_what_cannot_be_tied_stays_and_is_named(tmp_path: Path) -> None:
    one = write_scan(tmp_path / "one", NORTH[:3])
    winter = write_scan(tmp_path / "winter", EAST[:3], Errors((0.8, 0.0, 0.0)), ground=2)
    document = align_site([one, winter], tmp_path / "site", deliver=False).document
    assert any("winter" in n and "stays" in n for n in document["notes"])
    assert document["scans"][1]["placed"] == "by its fixes"
    assert document["scans"][1]["moved_m"] == [0.0, 0.0, 0.0]
    with pytest.raises(InputError, match="have no ties"):
        compare(one, winter, tmp_path / "change")


def test_the_same_ground_in_other_light_is_tied(tmp_path: Path) -> None:
    noon = write_scan(tmp_path / "noon", NORTH, WRONG)
    evening = write_scan(tmp_path / "evening", EAST, ground=site_scans.DUSK, day=1)
    document = align_site([noon, evening], tmp_path / "site", deliver=False).document
    assert document["pairs"][0]["ties"] >= 3 and document["notes"] == []
    off = errors_m(tmp_path / "site", [*NORTH, *EAST])
    assert np.linalg.norm(off[:6].mean(axis=0) - off[6:].mean(axis=0)) < 0.1


def test_an_alignment_by_few_ties_is_called_uncertain(tmp_path: Path) -> None:
    one, two = write_scan(tmp_path / "one", NORTH[2:3]), write_scan(tmp_path / "two", EAST[2:4])
    document = align_site([one, two], tmp_path / "site", deliver=False).document
    assert document["pairs"][0]["ties"] == 2
    assert any(
        "one and two share only 2 tie(s)" in n and "not sure" in n for n in document["notes"]
    )


def test_scans_of_two_zones_become_one_site(tmp_path: Path) -> None:
    west, east = LocalFrame(47.39, 5.9998, 408.0), LocalFrame(47.39, 6.0003, 411.0)
    one = write_scan(tmp_path / "one", NORTH, Errors((0.5, 0.3, 0.2)), frame=west, truth=west)
    two = write_scan(tmp_path / "two", EAST, Errors((-0.5, -0.3, -0.2)), frame=east, truth=west)
    document = align_site([one, two], tmp_path / "site", deliver=False).document
    assert document["epsg"] == 32631 and document["pairs"][0]["ties"] >= 3
    assert any("several zones [32631, 32632]" in note for note in document["notes"])
    off = errors_m(tmp_path / "site", [*NORTH, *EAST])
    assert np.linalg.norm(off[:6].mean(axis=0) - off[6:].mean(axis=0)) < 0.1


def test_bad_scans_are_named(tmp_path: Path) -> None:
    one = write_scan(tmp_path / "one", NORTH[:2])
    nowhere = write_scan(tmp_path / "nowhere", EAST[:2], frame=None)
    flying = write_scan(tmp_path / "flying", EAST[:2], finished=False)
    document = align_site([one, nowhere, one], tmp_path / "site", deliver=False).document
    assert [s["name"] for s in document["scans"]] == ["one"]
    assert any("nowhere has no georeference" in n for n in document["notes"])
    with pytest.raises(InputError, match="not finished"):
        align_site([one, flying], tmp_path / "other")
    with pytest.raises(InputError, match="no usable scan"):
        align_site([nowhere], tmp_path / "third")
    with pytest.raises(InputError, match="contains no scan"):
        align_site([tmp_path], tmp_path / "fourth")
    with pytest.raises(InputError, match="is not a site"):
        align_site([one], one)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "site.json").write_text('{"title": "my web site"}')
    with pytest.raises(InputError, match=r"site\.json cannot be read"):
        align_site([one], tmp_path / "foreign")
    assert [path.name for path in (tmp_path / "foreign").iterdir()] == ["site.json"]
    with pytest.raises(InputError, match="one scan"):
        compare(one, one, tmp_path / "fifth")


def test_the_same_recording_twice_counts_once(tmp_path: Path) -> None:
    one = write_scan(tmp_path / "one", NORTH[:2])
    again = write_scan(tmp_path / "again" / "one", NORTH[:2])
    document = align_site([one, again], tmp_path / "site", deliver=False).document
    assert len(document["scans"]) == 1 and "counted once" in document["notes"][0]


BOXES: list[Box] = [(2.0, 3.0, 5.0, 5.0, 1.0), (-8.0, -6.0, -5.0, -3.0, 0.8)]


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One box removed and one added between two crossing flights."""
    folder = tmp_path_factory.mktemp("change")
    one = write_scan(folder / "may", NORTH, Errors((0.6, 0.2, -0.8)), BOXES[:1])
    two = write_scan(folder / "june", EAST, Errors((-0.4, 0.5, 0.6)), BOXES[1:], day=30)
    done = CliRunner().invoke(
        app, ["site", "compare", str(one), str(two), "--out", str(folder / "out"), "--json"]
    )
    assert done.exit_code == 0, done.output
    assert "site: seeking ties\n" in done.output and "site: comparing the" in done.output
    return folder / "out"


def test_a_box_removed_and_one_added_are_found(changed: Path) -> None:
    document = json.loads((changed / "change.json").read_text())
    kinds = sorted(o["kind"] for o in document["objects"])
    assert kinds == ["added", "removed"]
    for one in document["objects"]:
        box = BOXES[0] if one["kind"] == "removed" else BOXES[1]
        true = (box[2] - box[0]) * (box[3] - box[1]) * box[4]
        sign = -1.0 if one["kind"] == "removed" else 1.0
        assert one["volume_m3"] * sign == pytest.approx(true, rel=0.15)
    assert "2 object(s)" in (changed / "report.html").read_text()
    page = (changed / "change.html").read_text()
    assert " UTC. Right:" in page
    assert "resize:horizontal" in page and "<script" not in page and "http" not in page


def test_the_joined_surface_is_that_of_the_later_date(changed: Path) -> None:
    import laspy

    cloud = laspy.read(str(changed / "cloud.laz"))
    xyz = FRAME.from_utm(np.column_stack([cloud.x, cloud.y, cloud.z]))
    for box, stands in zip(BOXES, (False, True), strict=True):
        west, south, east, north, tall = box
        x, y = xyz[:, 0], xyz[:, 1]
        on = (x > west + 0.6) & (x < east - 0.6) & (y > south + 0.6) & (y < north - 0.6)
        above = xyz[on, 2] - height(x[on], y[on])
        level = float(np.median(above)) - float(np.median(xyz[:, 2] - height(x, y, BOXES[1:])))
        assert len(above) > 20
        assert level == pytest.approx(tall if stands else 0.0, abs=0.12)


def test_change_files_open_elsewhere(changed: Path) -> None:
    import rasterio

    with rasterio.open(changed / "change.tif") as image:
        assert image.crs.to_epsg() == FRAME.epsg and image.count == 3
        assert image.tags()["HEIGHTS"] == "metres, after less before"
        height = image.read(1, masked=True)
        assert float(height.max()) > 0.5 and float(height.min()) < -0.5
    db = sqlite3.connect(changed / "change.gpkg")
    assert db.execute("PRAGMA application_id").fetchone()[0] == 0x47504B47
    rows = db.execute("SELECT geom, kind, area_m2 FROM changes").fetchall()
    db.close()
    for blob, _, area in rows:
        assert blob[:4] == b"GP\x00\x01" and struct.unpack("<i", blob[4:8])[0] == FRAME.epsg
        polygon = struct.unpack_from("<BIIBIII", blob, 8)
        assert polygon[1] == 6 and polygon[4] == 3
        ring = np.frombuffer(blob, "<f8", 2 * polygon[6], 8 + struct.calcsize("<BIIBIII"))
        x, y = ring.reshape(-1, 2).T
        assert abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2 == pytest.approx(area, rel=0.3)


def test_of_bare_ground_only_the_pit_is_shown(tmp_path: Path) -> None:
    pit: Box = (2.0, 3.0, 6.0, 7.0, -1.0)
    one = write_scan(tmp_path / "one", NORTH, Errors((0.6, 0.2, -0.8)), BOXES[1:])
    two = write_scan(tmp_path / "two", EAST, Errors((-0.4, 0.5, 0.6)), [pit], day=30)
    words = ["site", "compare", str(one), str(two), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*words, "--bare", "--json"])
    assert done.exit_code == 0, done.output
    (found,) = json.loads((tmp_path / "out/change.json").read_text())["objects"]
    assert found["kind"] == "removed"
    assert found["volume_m3"] == pytest.approx(-16.0, rel=0.15)


def test_flights_without_change_show_none(tmp_path: Path) -> None:
    one = write_scan(tmp_path / "one", NORTH, Errors((0.6, 0.2, -0.8)), BOXES)
    two = write_scan(tmp_path / "two", EAST, Errors((-0.4, 0.5, 0.6)), BOXES, day=30)
    document = compare(one, two, tmp_path / "out")
    assert document["objects"] == []
    net = document["volumes_m3"]["net"]
    assert net["value"] == 0.0
