"""The scan folder's files from a store of exact synthetic keyframes, read by other readers."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import laspy
import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from spied import spied

from recon import se3
from recon.types import F64
from service.errors import OutsideError
from service.georeference import LocalFrame
from service.ground.scan_facts import facts_of
from service.progress import Progress
from service.scans.folder import (
    CLOUD,
    CSV,
    PREVIEW,
    REPORT,
    THUMBNAIL,
    TUM,
    write_deliverables,
)
from service.scans.fused_cloud import Extent, fused_cloud, strip_edges
from service.scans.retention import close_open_scans
from service.scans.writing import SUMMARY
from service.stream.records import Repose, ScanHeader
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight


def enu_of(cloud: laspy.LasData, house: HouseFlight) -> F64:
    """(N, 3) ENU metres of a UTM cloud, by pyproj's own pipeline."""
    utm = np.column_stack([cloud.x, cloud.y, cloud.z])
    epsg = cloud.header.parse_crs().to_epsg()
    lon, lat, alt = Transformer.from_crs(f"EPSG:{epsg}", "EPSG:4979", always_xy=True).transform(
        *utm.T
    )
    return LocalFrame(*house.origin).to_enu(np.column_stack([lat, lon, alt]))


def test_writing_the_files_reports_how_far_it_is(tmp_path: Path, house: HouseFlight) -> None:
    reported: list[tuple[str, float]] = []
    progress = Progress(lambda p: reported.append((p.text, p.share)))
    with house.flown(tmp_path) as store, progress.part("the files", 0.5):
        write_deliverables(tmp_path, store, progress=progress)
    shares = [share for _, share in reported]
    assert shares == sorted(shares) and len(set(shares)) > 5 and 0.3 < shares[-1] < 0.5
    assert "fusing the cloud" in dict(reported) and reported[-1][0] == "writing the files"


def test_cloud_is_where_the_house_stands(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        summary = write_deliverables(tmp_path, store)
    cloud = laspy.read(tmp_path / CLOUD)
    assert (cloud.header.version.major, cloud.header.version.minor) == (1, 4)
    assert cloud.header.point_format.id == 7
    assert cloud.header.are_points_compressed
    assert cloud.header.parse_crs().to_epsg() == 32632 == summary["epsg"]
    (record,) = [one for one in cloud.header.vlrs if one.record_id == 2112]
    assert record.string.startswith("PROJCS[")  # WKT 1, as LAS 1.4 asks for it
    assert cloud.header.creation_date.isoformat() == "2023-11-14"
    enu = enu_of(cloud, house)
    np.testing.assert_allclose(enu[:, 2], house.roof_m(enu[:, 0], enu[:, 1]), atol=6.01)
    inside = (np.abs(enu[:, 0] - 10) < 5.5) & (np.abs(enu[:, 1] - 2) < 3.5)
    outside = (np.abs(enu[:, 0] - 10) > 6.5) | (np.abs(enu[:, 1] - 2) > 4.5)
    assert np.abs(enu[inside, 2] - 6.0).max() < 0.03
    assert np.abs(enu[outside, 2]).max() < 0.03
    assert inside.sum() > 500
    red = np.asarray(cloud.red)[inside] / 257
    assert np.median(red) == pytest.approx(200, abs=12)
    assert np.asarray(cloud["sigma_m"]).dtype == np.float32
    assert 0.02 < np.median(cloud["sigma_m"]) < 0.06
    assert np.isnan(cloud["sigma_absolute_m"]).all()  # the flight has measured no scale
    assert summary["quality"]["sigma_absolute_median_m"] is None
    assert np.asarray(cloud["views"]).dtype == np.uint8
    assert np.asarray(cloud["views"]).max() >= 4  # seen from several keyframes
    # Nothing of the ground that the cameras saw is missing.
    assert summary["quality"]["area_m2"] == pytest.approx(
        (160 / 140 * 40 + 20) * (90 / 140 * 40), rel=0.03
    )


def test_heights_in_the_world_are_as_sure_as_the_scale(tmp_path: Path, house: HouseFlight) -> None:
    """5 % of 40 m, and of 34 m to the roof."""
    with house.flown(tmp_path) as store:
        store.finish({"scale": {"sigma": 0.05}})
        summary = write_deliverables(tmp_path, store)
    cloud = laspy.read(tmp_path / CLOUD)
    enu, whole = enu_of(cloud, house), np.asarray(cloud["sigma_absolute_m"])
    assert np.median(whole[enu[:, 2] > 5.0]) == pytest.approx(1.7, abs=0.1)
    assert np.median(whole[enu[:, 2] < 1.0]) == pytest.approx(2.0, abs=0.1)
    assert np.median(cloud["sigma_m"]) < 0.06  # which neighbours do not notice
    assert summary["quality"]["sigma_absolute_median_m"] == pytest.approx(2.0, abs=0.1)


def test_heights_by_air_pressure_are_as_sure_as_the_weather(
    tmp_path: Path, house: HouseFlight
) -> None:
    """At one place, over weeks, DJI's drones without RTK state heights that differ by 150 m."""
    with house.flown(tmp_path) as store:
        store.finish({"scale": {"sigma": 0.05}, "assumed": ["altitude", "pressure"]})
        summary = write_deliverables(tmp_path, store)
    assert np.median(laspy.read(tmp_path / CLOUD)["sigma_absolute_m"]) == pytest.approx(70.0, 0.01)
    quality = summary["quality"]
    assert quality["sigma_absolute_median_m"] == pytest.approx(70.0, 0.01)
    assert quality["sigma_median_m"] < 0.06
    assert any("err by 70 m together" in reason for reason in quality["trust"]["reasons"])


def test_voxels_are_as_fine_as_the_pixels_on_the_ground(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        summary = write_deliverables(tmp_path, store)
        coarse = fused_cloud(store, 1.0)
        store.update_header(configuration={"scan": {"resolution_m": 1.0}})  # the operator's wish
        wished = write_deliverables(tmp_path, store)
    assert wished["quality"]["voxel_m"] == 1.0
    assert wished["counts"]["points"] == len(coarse.cloud)
    assert summary["quality"]["voxel_m"] == pytest.approx(40 / 140, abs=1e-3)
    assert coarse.voxel_m == 1.0
    assert len(coarse.cloud) < summary["counts"]["points"] / 5


def test_both_ends_write_the_same_bytes(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path / "air") as air:
        ground = ScanStore.create(tmp_path / "ground" / "scan.db", air.header)
        for kind, numbers in air.numbers().items():
            for number in sorted(numbers, reverse=True):
                data = air.record(kind, number)
                assert data is not None
                ground.put_record(kind, number, data)
        write_deliverables(tmp_path / "air", air)
        write_deliverables(tmp_path / "ground", ground)
        ground.close()
    for name in (CLOUD, TUM, CSV, SUMMARY, PREVIEW, REPORT):
        assert (tmp_path / "air" / name).read_bytes() == (tmp_path / "ground" / name).read_bytes()


def test_trajectory_files(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        write_deliverables(tmp_path, store)
    rows = [line.split() for line in (tmp_path / TUM).read_text().splitlines()]
    assert rows[1][0] == "1700000001.123456789"
    numbers = np.array(rows, float)
    np.testing.assert_allclose(numbers[:, 1], 5.0 * np.arange(5))
    np.testing.assert_allclose(
        Rotation.from_quat(numbers[0, 4:]).as_matrix(), house.nadir, atol=1e-9
    )
    with open(tmp_path / CSV, newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 5
    assert table[0]["lat_deg"] == "47.390000000"
    assert table[0]["agl_m"] == ""
    assert float(table[0]["pitch_deg"]) == -90.0
    assert table[0]["sources"] == "vision+gnss"


def test_a_pose_written_again_replaces_the_first(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        store.add_pose(house.record(2, 11.5))
        poses = store.poses()
        summary = write_deliverables(tmp_path, store)
    assert len(poses) == 5
    numbers = np.loadtxt(tmp_path / TUM)
    np.testing.assert_allclose(numbers[:, 1], [0.0, 5.0, 11.5, 15.0, 20.0])
    with open(tmp_path / CSV, newline="") as file:
        flown = [float(row["distance_m"]) for row in csv.DictReader(file)]
    assert flown == [0.0, 5.0, 11.5, 15.0, 20.0]
    assert summary["quality"]["distance_m"] == 20.0


def test_a_reposed_keyframe_moves_its_points(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        for seq in range(5):
            T = se3.compose(house.nadir, np.array([5.0 * seq + 100.0, 0.0, house.height_m]))
            store.add_reposes([Repose(seq, 1, T, 1.0, np.eye(6))])
        write_deliverables(tmp_path, store)
    enu = enu_of(laspy.read(tmp_path / CLOUD), house)
    assert np.median(enu[enu[:, 2] > 5.5, 0]) == pytest.approx(110.0, abs=0.3)


def test_without_georeference_the_cloud_is_local_and_says_so(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path, georeferenced=False) as store:
        store.finish({"drops": {"late": 3}})
        summary = write_deliverables(tmp_path, store)
    cloud = laspy.read(tmp_path / CLOUD)
    assert cloud.header.parse_crs() is None
    assert np.abs(cloud.x).max() < 60
    assert np.asarray(cloud.z).max() == pytest.approx(6.0, abs=0.03)
    written = json.loads((tmp_path / SUMMARY).read_text())
    assert written == summary
    assert written["epsg"] is None and written["origin"] is None
    assert any("no georeference" in note for note in written["notes"])
    assert written["run"] == {"drops": {"late": 3}}


def test_an_empty_scan_still_makes_every_file(tmp_path: Path, house: HouseFlight) -> None:
    store = ScanStore.create(tmp_path / "scan.db", ScanHeader("empty", "d", house.start_ns))
    summary = write_deliverables(tmp_path, store)
    store.close()
    assert summary["counts"] == {
        "keyframes": 0,
        "points": 0,
        "points_before_fusion": 0,
        "poses": 0,
    }
    assert len(laspy.read(tmp_path / CLOUD)) == 0
    assert (tmp_path / TUM).read_text() == ""
    assert cv2.imread(str(tmp_path / PREVIEW)) is not None


def test_the_thumbnail_shows_the_ground_alone_within_the_extent(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path) as store:
        summary = write_deliverables(tmp_path, store)
    image = cv2.imread(str(tmp_path / THUMBNAIL), cv2.IMREAD_UNCHANGED)
    assert image is not None and max(image.shape) == 480 and image.shape[2] == 4
    west, south, east, north = summary["coverage"]["bounds_m"]
    px_m = 480 / max(east - west, north - south)
    assert abs(image.shape[1] - (east - west) * px_m) < 1.0
    red = (image[..., 2] > 150) & (image[..., 1] < 90) & (image[..., 3] > 128)
    rows, cols = np.nonzero(red)
    roof = np.array([cols.min() / px_m + west, north - rows.max() / px_m])
    assert np.abs(roof - (4.0, -2.0)).max() < 0.5  # the house's south-west corner


def test_preview_and_report_say_what_limits_the_trust(tmp_path: Path, house: HouseFlight) -> None:
    rows = []
    for name, assumed in (("sure", []), ("lens", ["lens", "level", "height"])):
        with house.flown(tmp_path / name) as store:
            store.finish({"assumed": assumed})
            summary = write_deliverables(tmp_path / name, store)
        image = cv2.imread(str(tmp_path / name / PREVIEW))
        assert image is not None
        rows.append(len(image))
    assert summary["quality"]["trust"]["level"] == "doubtful"
    assert rows[1] > rows[0]  # the reasons need another line
    assert "doubtful; the lens is assumed" in (tmp_path / "lens" / REPORT).read_text("utf-8")


def test_nothing_half_written_is_left(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        (tmp_path / "blocked").mkdir()
        (tmp_path / "blocked" / CLOUD).mkdir()  # a folder where the file should go
        with pytest.raises(OutsideError, match=CLOUD):
            write_deliverables(tmp_path / "blocked", store)
        write_deliverables(tmp_path, store)
    assert not list(tmp_path.rglob("*.part"))


def test_the_report_says_what_was_flown_and_nothing_runs_in_it(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path) as store:
        store.update_header(notes=("<script>alert(1)</script>",))
        run = {"frames": 5, "refusals": {"too <little> motion": 3}, "stage_ms": {"track": 2.5}}
        store.finish(run)
        write_deliverables(tmp_path, store)
    page = (tmp_path / REPORT).read_text()
    assert "<script" not in page and "&lt;script&gt;" in page
    assert "too &lt;little&gt; motion" in page
    assert "EPSG:32632" in page and "47.3900000" in page
    assert page.count("data:image/png;base64,") == 3  # two maps and the coverage
    assert page.count("data:image/jpeg;base64,") == 4  # cover, two maps, a keyframe's stages
    assert page.count("<svg") == 5  # the map; no height above ground was recorded
    _, *curves = re.findall(r"<svg.*?</figure>", page)
    for curve in curves:
        heights = re.findall(r">([-+.0-9e]+)</text>", curve)
        assert re.findall(r">(\d+) s</text>", curve) == ["0", "1", "2", "3", "4"] and heights
        low, high = map(float, re.findall(r": (\S+) to (\S+), over 4 s", curve)[0])
        assert all(low - 0.01 <= float(height) <= high + 0.01 for height in heights)
    assert "@media print" in page
    assert "http" not in page  # nothing is fetched
    rows = dict(re.findall(r"<tr><td>(.*?)</td><td>(.*?)</td></tr>", page))
    assert rows["duration"] == "4 s"
    assert rows["speed, median"] == "5.0 m/s"


def test_a_large_site_is_fused_strip_by_strip_to_the_same_cloud(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path) as store:
        whole = fused_cloud(store)
        strips = fused_cloud(store, strip_points=9000)
        coarse = fused_cloud(store, strip_points=9000, largest_points=18_000)
    for name in ("xyz_m", "rgb", "sigma_m", "views"):
        np.testing.assert_array_equal(getattr(strips.cloud, name), getattr(whole.cloud, name))
    assert coarse.voxel_m == pytest.approx(2 * whole.voxel_m)
    assert "enlarged" in coarse.notes[0]


def test_fusion_decodes_a_keyframe_for_its_points_and_for_what_it_sees(
    tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    with house.flown(tmp_path) as store:
        decoded = spied(monkeypatch, store, "keyframe")
        fused_cloud(store, min_strip_points=1)
        assert Counter(call.args[0] for call in decoded.call_args_list) == dict.fromkeys(
            store.seqs(), 2
        )


def test_strips_hold_equal_shares() -> None:
    extents = [Extent(k, 1000, 0.2, (5.0 * k, 0.0, 5.0 * k + 40.0, 30.0)) for k in range(100)]
    edges = strip_edges(extents, 9000)
    assert edges[0] == -np.inf and edges[-1] == np.inf
    assert len(edges) == 13
    x = np.concatenate([np.linspace(e.box[0], e.box[2], 1000) for e in extents])
    shares = np.histogram(x, [x.min() - 1, *edges[1:-1], x.max() + 1])[0]
    assert shares.max() < 9000
    assert strip_edges([], 10) == [-np.inf, np.inf]


def test_a_file_that_cannot_be_made_costs_itself_only(
    tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise OverflowError("cannot convert float infinity to integer\nand more")

    monkeypatch.setattr("service.scans.folder.write_laz", broken)
    with house.flown(tmp_path) as store:
        summary = write_deliverables(tmp_path, store)
    why = {CLOUD: "OverflowError: cannot convert float infinity to integer"}
    trouble = facts_of(tmp_path)["trouble"]  # what the portal's list shows
    assert trouble == f"could not be made: {CLOUD} ({why[CLOUD]})"
    assert summary["failed"] == json.loads((tmp_path / SUMMARY).read_text())["failed"] == why
    assert not (tmp_path / CLOUD).exists()
    assert all((tmp_path / name).stat().st_size for name in (TUM, CSV, PREVIEW, REPORT))
    assert summary["counts"]["points"] > 0


def test_without_a_cloud_the_track_is_still_written(
    tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise MemoryError("Unable to allocate 213 TiB")

    monkeypatch.setattr("service.scans.folder.fused_cloud", broken)
    monkeypatch.setattr("service.scans.folder.write_coverage_files", broken)
    with house.flown(tmp_path) as store:
        summary = write_deliverables(tmp_path, store)
    assert set(summary["failed"]) == {CLOUD, "coverage.png"}
    assert summary["counts"]["poses"] == 5
    assert len((tmp_path / TUM).read_text().splitlines()) == 5
    assert "Unable to allocate" in (tmp_path / SUMMARY).read_text()


@pytest.mark.slow
def test_a_file_that_the_disk_refused_is_tried_again_at_the_next_start(
    tmp_path: Path, house: HouseFlight
) -> None:
    folder = tmp_path / "scan"
    with house.flown(folder) as store:
        store.finish({"points": 1})
        (folder / PREVIEW / "in the way").mkdir(parents=True)
        with pytest.raises(OutsideError, match=PREVIEW):
            write_deliverables(folder, store)
    assert list(json.loads((folder / SUMMARY).read_text())["failed"]) == [PREVIEW]
    assert all((folder / name).stat().st_size for name in (CLOUD, TUM, CSV, REPORT))
    (folder / PREVIEW / "in the way").rmdir()
    (folder / PREVIEW).rmdir()
    assert close_open_scans(tmp_path, ours=()) == ["scan"]
    assert (folder / PREVIEW).is_file()
    assert json.loads((folder / SUMMARY).read_text())["failed"] == {}
    assert close_open_scans(tmp_path, ours=()) == []
