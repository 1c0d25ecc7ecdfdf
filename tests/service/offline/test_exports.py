"""Every deliverable opened by a reader of its own, and its place checked against the truth."""

from __future__ import annotations

import datetime as dt
import json
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer
from scipy.ndimage import binary_fill_holes
from spied import spied
from typer.testing import CliRunner

from recon.types import F64, Keyframe
from service.cli import app
from service.commands.deliverables import product_list
from service.errors import InputError, OutsideError
from service.georeference import LocalFrame
from service.offline.exports import EXPORTERS
from service.offline.exports.clouds import octree
from service.offline.exports.view import ExportOptions, ScanView, export
from service.progress import Progress
from service.scans.fused_cloud import adjusted_gps_s
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight


HOLE_AT = (10.0, -7.0)


@pytest.fixture
def scan_dir(tmp_path: Path, house: HouseFlight) -> Path:
    folder = tmp_path / "scan"
    house.flown(folder).close()
    return folder


def written(folder: Path, kind: str, options: ExportOptions | None = None) -> Path:
    with ScanView(folder) as scan:
        return export(scan, kind, None, options or ExportOptions())


def to_enu(utm: F64, epsg: int, house: HouseFlight) -> F64:
    """ENU metres by pyproj and the closed-form frame."""
    back = Transformer.from_crs(f"EPSG:{epsg}", "EPSG:4979", always_xy=True)
    lon, lat, alt = back.transform(*np.asarray(utm, float).T)
    return LocalFrame(*house.origin).to_enu(np.column_stack([lat, lon, alt]))


def assert_is_the_house(enu: F64, house: HouseFlight, tolerance_m: float = 0.05) -> None:
    """Away from its walls every point lies on the true surface, and all of it is there."""
    x, y, z = enu.T
    from_wall = np.maximum(np.abs(x - 10) - 6.0, np.abs(y - 2) - 4.0)
    clear = np.abs(from_wall) > 0.6
    assert np.abs(z[clear] - house.roof_m(x, y)[clear]).max() < tolerance_m
    assert ((from_wall < -0.6) & (z > 5)).sum() > 300
    assert np.ptp(x) == pytest.approx(160 / 140 * 40 + 20, abs=1.5)


def test_ply_by_open3d(scan_dir: Path, house: HouseFlight) -> None:
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    path = written(scan_dir, "ply")
    cloud = o3d.io.read_point_cloud(str(path))
    assert_is_the_house(to_enu(np.asarray(cloud.points), 32632, house), house)
    assert b"comment EPSG:32632, metres AMSL" in path.read_bytes()[:300]


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_and_laz(scan_dir: Path, tmp_path: Path, house: HouseFlight, name: str) -> None:
    with ScanView(scan_dir) as scan:
        export(scan, "laz", tmp_path / name, ExportOptions())
    cloud = laspy.read(tmp_path / name)
    assert cloud.header.are_points_compressed == name.endswith("laz")
    assert_is_the_house(to_enu(np.column_stack([cloud.x, cloud.y, cloud.z]), 32632, house), house)


@pytest.mark.parametrize("kind", ["laz", "copc"])
def test_points_have_the_gps_time_of_their_keyframe(
    scan_dir: Path, house: HouseFlight, kind: str
) -> None:
    if kind == "copc":
        pytest.importorskip("copclib")
    cloud = laspy.read(written(scan_dir, kind))
    assert set(cloud.classification) == {1, 2}
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    epoch = dt.datetime(1980, 1, 6, tzinfo=dt.timezone.utc).timestamp()
    with ScanStore.open(scan_dir / "scan.db") as store:
        # GPS is 18 s ahead of UTC since 2017.
        times = [k.time_ns / 1e9 - epoch + 18 - 1e9 for k in store.keyframes()]
    found = np.unique(np.asarray(cloud.gps_time))
    assert len(found) > 1
    assert np.abs(found[:, None] - np.array(times)).min(axis=1).max() < 1e-6


@pytest.mark.parametrize(
    ("datum", "codes"), [("EGM96", [32632, 5773]), ("EGM2008", [32632, 3855]), ("ellipsoid", [])]
)
@pytest.mark.parametrize("kind", ["laz", "copc", "dsm", "dtm"])
def test_the_operator_says_what_heights_are_above(
    scan_dir: Path, kind: str, datum: str, codes: list[int]
) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    if kind == "copc":
        pytest.importorskip("copclib")
    path = written(scan_dir, kind, ExportOptions(vertical_datum=datum))
    if path.suffix == ".tif":
        with rasterio.open(path) as image:
            crs = CRS.from_wkt(image.crs.to_wkt())
            assert image.tags()["HEIGHTS"] == f"metres above {datum}"
    else:
        header = laspy.read(path).header
        crs = header.parse_crs()
        records = [*header.vlrs, *(header.evlrs or ())]
        (record,) = [one for one in records if one.record_id == 2112]
        # LAS 1.4 asks for OGC 01-009, which has no heights above the ellipsoid on a map
        assert record.string.startswith("COMPD_CS[" if codes else "PROJCRS[")
    assert [part.to_epsg() for part in crs.sub_crs_list] == codes
    if path.suffix != ".tif" or codes:
        assert len(crs.axis_info) == 3 and crs.axis_info[2].direction == "up"
    assert codes or crs.to_2d().to_epsg() == 32632


def test_an_unknown_datum_is_refused(scan_dir: Path) -> None:
    ask = ["export", str(scan_dir), "--to", "dsm", "--vertical-datum", "NN"]
    answer = CliRunner().invoke(app, ask)
    assert isinstance(answer.exception, InputError) and "EGM2008" in str(answer.exception)


def test_gps_time_counts_the_leap_seconds() -> None:
    def at(*when: int) -> float:
        unix = dt.datetime(*when, tzinfo=dt.timezone.utc).timestamp()  # type: ignore[misc,arg-type]
        return float(adjusted_gps_s(np.array([round(unix * 1e9)]))[0])

    assert at(1980, 1, 6) == -1e9
    assert at(2011, 9, 14, 1, 46, 25) == 0.0  # GPS second 1e9, by IERS: 15 s ahead
    assert at(2015, 7, 1) - at(2015, 6, 30, 23, 59, 59) == 2.0
    assert at(2017, 1, 1) - at(1980, 1, 6) == 13_510 * 86_400 + 18


def test_copc_of_a_scan_without_a_place(tmp_path: Path, house: HouseFlight) -> None:
    pytest.importorskip("copclib")
    house.flown(tmp_path, georeferenced=False).close()
    cloud = laspy.read(written(tmp_path, "copc"))
    points = np.column_stack([cloud.x, cloud.y, cloud.z])
    assert_is_the_house(points, house)
    assert cloud.header.parse_crs() is None


def test_copc_by_laspy(scan_dir: Path, house: HouseFlight) -> None:
    pytest.importorskip("copclib")
    path = written(scan_dir, "copc")
    with laspy.CopcReader.open(path) as reader:
        everything = reader.query()
        coarse = reader.query(resolution=5.0)
    with ScanView(scan_dir) as scan:
        assert len(everything) == len(scan.fused.cloud)
        np.testing.assert_allclose(
            np.sort(everything["sigma_m"]), np.sort(scan.fused.cloud.sigma_m), rtol=1e-6
        )
    assert 0 < len(coarse) <= len(everything)
    xyz = np.column_stack([everything.x, everything.y, everything.z])
    assert_is_the_house(to_enu(xyz, 32632, house), house)
    whole = laspy.read(path)
    assert whole.header.point_count == len(everything)
    assert whole.header.parse_crs().to_epsg() == 32632
    assert whole.header.creation_date.isoformat() == "2023-11-14"  # of the flight, as in LAZ
    assert whole.header.system_identifier == "camera stereo"


def test_octree_holds_every_point_once_inside_its_node() -> None:
    rng = np.random.default_rng(4)
    xyz = rng.normal(0, [30, 30, 2], (120_000, 3))
    low, side = xyz.min(axis=0) - 0.1, float(np.ptp(xyz, axis=0).max()) + 0.2
    seen = np.zeros(len(xyz), int)
    depths = set()
    for (depth, *index), rows in octree(xyz, low, side):
        seen[rows] += 1
        depths.add(depth)
        size = side / 2**depth
        corner = low + np.array(index) * size
        assert (xyz[rows] >= corner - 1e-9).all() and (xyz[rows] <= corner + size + 1e-9).all()
    assert (seen == 1).all()
    assert depths == set(range(len(depths))) and len(depths) > 1


def test_dsm_by_rasterio(scan_dir: Path, house: HouseFlight) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    path = written(scan_dir, "dsm", ExportOptions(cell_m=0.5))
    with rasterio.open(path) as image:
        assert image.crs.to_epsg() == 32632
        assert image.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        height = image.read(1, masked=True)
        rows, cols = np.nonzero(image.read_masks(1))
        east, north = rasterio.transform.xy(image.transform, rows, cols)
    utm = np.column_stack([east, north, height[rows, cols]])
    enu = to_enu(utm, 32632, house)
    # A wall falls somewhere within a cell, and a cell's upper surface is the roof.
    from_wall = np.maximum(np.abs(enu[:, 0] - 10) - 6.0, np.abs(enu[:, 1] - 2) - 4.0)
    clear = np.abs(from_wall) > 1.0
    error = enu[clear, 2] - house.roof_m(enu[clear, 0], enu[clear, 1])
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert clear.sum() * 0.25 > 1300


def test_dsm_says_what_is_filled(scan_dir: Path, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    with ScanStore.open(scan_dir / "scan.db") as store:
        store.finish({"scale": {"sigma": 0.05}})
    bands = []
    for strict in (True, False):
        path = written(scan_dir, "dsm", ExportOptions(cell_m=0.2, strict=strict))
        with rasterio.open(path) as image:
            assert image.descriptions[2] == "filled"
            assert image.units == ("metre", "metre", None, "metre")
            heights = image.read(1, masked=True)
            assert float(image.tags(1)["STATISTICS_MAXIMUM"]) == pytest.approx(heights.max())
            assert "alpha" not in [kind.name for kind in image.colorinterp]
            bands.append(image.read())
    strict_m, (height, sigma, origin, absolute) = bands[0][0], bands[1]
    assert not (bands[0][2] > 0.0).any()
    assert ((strict_m == -9999.0) & (height != -9999.0) == (origin > 0.0)).all()
    assert (origin == 1.0).sum() > 100 and (sigma[origin > 0.0] > 0.0).all()
    known = height != -9999.0
    assert ((absolute > 0.04 * 40.0) == known).all()  # the scale's 5 %; sigma is within the map
    assert np.median(sigma[known]) < 0.1
    assert (binary_fill_holes(known) == known).all()


def test_a_missing_package_is_reported_before_the_work(
    scan_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    steps: list[str] = []
    with (
        ScanView(scan_dir, None, Progress(lambda now: steps.append(now.text))) as scan,
        pytest.raises(OutsideError, match="export to dsm needs the package rasterio"),
    ):
        export(scan, "dsm", None, ExportOptions())
    assert steps == []


def test_what_deliverables_share_is_made_once_and_holds_up_nothing_else(scan_dir: Path) -> None:
    with ScanView(scan_dir) as scan, ThreadPoolExecutor(2) as pool:
        began, may_end = threading.Event(), threading.Event()

        def make() -> bool:
            began.set()
            return may_end.wait(30.0)

        made = Mock(side_effect=make)
        both = [pool.submit(scan.shared, "long", made) for _ in range(2)]
        assert began.wait(30.0)
        try:
            assert scan.shared("short", lambda: may_end.is_set()) is False
        finally:
            may_end.set()
        assert [one.result(30.0) for one in both] == [True, True]
        made.assert_called_once()


def test_what_could_not_be_made_is_tried_again(scan_dir: Path) -> None:
    with ScanView(scan_dir) as scan:
        with pytest.raises(InputError, match="disk"):
            scan.shared("part", Mock(side_effect=InputError("the disk is full")))
        assert scan.shared("part", lambda: 3) == 3


def test_ortho_by_rasterio(scan_dir: Path, house: HouseFlight) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    with rasterio.open(written(scan_dir, "ortho")) as image:
        red, _, blue, opacity = image.read()
        assert image.crs.to_epsg() == 32632
        house_rows, house_cols = np.nonzero((red > 150) & (blue < 90) & (opacity > 0))
        east, north = rasterio.transform.xy(image.transform, house_rows, house_cols)
    alt = np.full(len(east), house.origin[2])
    enu = to_enu(np.column_stack([east, north, alt]), 32632, house)
    assert np.median(enu[:, 0]) == pytest.approx(10.0, abs=0.3)
    assert np.median(enu[:, 1]) == pytest.approx(2.0, abs=0.3)


def test_a_large_cell_of_the_orthophoto_shows_its_mean(scan_dir: Path) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    with rasterio.open(written(scan_dir, "ortho")) as image:
        fine, cell_m, west, north = image.read(), *(image.transform[k] for k in (0, 2, 5))
    with rasterio.open(written(scan_dir, "ortho", ExportOptions(cell_m=4 * cell_m))) as image:
        coarse = image.read()
        left, top = (west - image.transform.c) / cell_m, (image.transform.f - north) / cell_m
    rows, cols = (4 * side for side in coarse.shape[1:])
    spread = np.zeros((4, rows, cols))
    spread[:, round(top) :, round(left) :][:, : fine.shape[1], : fine.shape[2]] = fine
    blocks = spread.reshape(4, rows // 4, 4, cols // 4, 4)
    whole = (blocks[3] == 255).all(axis=(1, 3))
    off = np.abs(blocks[:3].mean(axis=(2, 4)) - coarse[:3])[:, whole]
    assert whole.sum() > 100 and np.quantile(off, 0.99) < 4.0


@pytest.mark.parametrize("side_m", [3.0, 9.0])
def test_ortho_closes_holes(tmp_path: Path, house: HouseFlight, side_m: float) -> None:
    """Level ground without depth, which the images show, gets its colours."""
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)

    class WithHole(type(house)):  # type: ignore[misc]
        """Without depth where the ground is level."""

        def keyframe(self, seq: int, east_m: float, sigma_m: float = 0.05) -> Keyframe:
            one: Keyframe = super().keyframe(seq, east_m, sigma_m)
            v, u = np.indices(one.depth.depth_m.shape)
            ray = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self.K).T
            xy = ray[..., :2] * one.depth.depth_m[..., None] * (1.0, -1.0) + (east_m, 0.0)
            one.depth.depth_m[(np.abs(xy - HOLE_AT) < side_m / 2).all(axis=-1)] = np.nan
            return one

    WithHole().flown(tmp_path).close()
    with rasterio.open(written(tmp_path, "ortho")) as image:
        place = LocalFrame(*house.origin).to_utm(np.array([[*HOLE_AT, 0.0]]))[0]
        row, col = rasterio.transform.rowcol(image.transform, place[0], place[1])
        rgb, opacity = image.read([1, 2, 3])[:, row, col], image.read(4)[row, col]
    assert opacity == 255
    assert (rgb > (65, 115, 55)).all() and (rgb < (115, 155, 95)).all()  # between both fields


def test_no_contour_runs_around_a_house_on_level_ground(scan_dir: Path) -> None:
    found = json.loads(written(scan_dir, "contours", ExportOptions(contour_m=1.7)).read_text())
    assert found["features"] == []  # the ground lies at 408 m


def test_geojson_and_kml_follow_the_flight(scan_dir: Path, house: HouseFlight) -> None:
    features = json.loads(written(scan_dir, "geojson").read_text())["features"]
    track = np.array(features[0]["geometry"]["coordinates"])
    enu = LocalFrame(*house.origin).to_enu(track[:, [1, 0, 2]])
    np.testing.assert_allclose(enu[:, 0], [0, 5, 10, 15, 20], atol=0.01)
    np.testing.assert_allclose(enu[:, 2], 40.0, atol=0.01)
    assert [f["properties"]["keyframe"] for f in features[1:]] == [0, 1, 2, 3, 4]
    text = written(scan_dir, "kml").read_text()
    assert text.count("<gx:coord>") == text.count("<when>") == 5
    assert "2023-11-14T22:13:20.123Z" in text


def test_3d_tiles_hold_all_points_on_the_globe(scan_dir: Path, house: HouseFlight) -> None:
    pytest.importorskip("py3dtiles")
    from py3dtiles.tileset.tileset import TileSet

    folder = written(scan_dir, "3dtiles")
    tileset = TileSet.from_file(folder / "tileset.json")
    tiles = list(tileset.root_tile.get_all_children())
    leaves = [t for t in tiles if not t.children]
    count = 0
    for tile in leaves:
        content: Any = tile.get_or_fetch_content(folder)
        count += content.body.feature_table.header.points_length
    with ScanView(scan_dir) as scan:
        assert count == len(scan.fused.cloud)
    T = np.array(tileset.root_tile.transform).reshape(4, 4)
    place = [float(v) for v in (T[3, :3] if np.abs(T[3, :3]).max() > 1e3 else T[:3, 3])]
    globe = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon, lat, _ = globe.transform(place[0], place[1], place[2])
    assert lat == pytest.approx(house.origin[0], abs=1e-3)
    assert lon == pytest.approx(house.origin[1], abs=1e-3)


def test_3d_tiles_on_a_full_disk_end_in_one_line(
    scan_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    convert = pytest.importorskip("py3dtiles.convert")
    from py3dtiles.exceptions import WorkerException

    def full(*_: object, **__: object) -> None:
        raise WorkerException("builtins.OSError: [Errno 28] No space left on device")

    monkeypatch.setattr(convert, "convert", full)
    with pytest.raises(OutsideError, match=r"No space left on device.*check the disk"):
        written(scan_dir, "3dtiles")
    assert not list(scan_dir.glob(".3dtiles*"))


def test_an_old_deliverable_stays_until_the_new_one_is_whole(scan_dir: Path) -> None:
    first = written(scan_dir, "3dtiles")
    (first / "mine.txt").write_text("old")
    written(scan_dir, "3dtiles")
    assert not (first / "mine.txt").exists()
    assert not [p for p in scan_dir.iterdir() if p.name.startswith(".")]


def test_without_georeference_local_files_are_written_and_maps_refused(
    tmp_path: Path, house: HouseFlight, caplog: pytest.LogCaptureFixture
) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    house.flown(tmp_path / "s", georeferenced=False).close()
    maps = written(tmp_path / "s", "all")
    assert "contours is not written" in caplog.text and "kmz is not written" in caplog.text
    assert not list(maps.glob("contours.*"))
    with rasterio.open(maps / "dsm.tif") as image:
        assert image.descriptions[0] == "height above the scan's origin, m"
    assert written(tmp_path / "s", "ply").exists()
    for kind in ("contours", "geojson", "kml", "3dtiles"):
        with pytest.raises(InputError, match="no georeference"):
            written(tmp_path / "s", kind)


def test_every_line_of_the_table_can_be_loaded() -> None:
    from importlib import import_module

    for target, _, text in EXPORTERS.values():
        module, _, name = target.partition(":")
        assert callable(getattr(import_module(f"service.offline.exports.{module}"), name))
        assert len(text) < 60


def test_the_command(scan_dir: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke
    done = run(app, ["export", str(scan_dir), "--to", "laz", "--to", "kml", "--json"])
    assert done.exit_code == 0
    names = json.loads(done.stdout.splitlines()[-1])["written"]
    assert Path(names["laz"]).is_file() and Path(names["kml"]).is_file()
    for bad, text in [
        (["export", str(scan_dir), "--to", "docx"], "there are ply"),
        (["export", str(tmp_path), "--to", "laz"], "scan.db"),
        (["export", str(tmp_path / "none"), "--to", "laz"], "not a folder"),
        (["export", str(scan_dir), "--to", "laz", "--to", "ply", "--out", "x"], "one file"),
        (["export", str(scan_dir), "--to", "dsm", "--cell-m", "-1"], "positive"),
        (["export", str(scan_dir), "--to", "dsm", "--cell-m", "0.0001"], "too large"),
    ]:
        failed = run(app, bad)
        assert isinstance(failed.exception, InputError)
        assert text in str(failed.exception)


def test_an_empty_scan_is_refused(tmp_path: Path) -> None:
    from service.stream.records import ScanHeader
    from service.stream.store import ScanStore

    ScanStore.create(tmp_path / "scan.db", ScanHeader("x", "d", 0)).close()
    with pytest.raises(InputError, match="no points"):
        written(tmp_path, "laz")


def test_each_product_is_described_without_another() -> None:
    """The portal orders them in its own way."""
    assert not [text for _, _, text in EXPORTERS.values() if "the same" in text.lower()]


def test_each_product_has_one_line_of_a_terminal() -> None:
    assert all(len(line) <= 78 for line in product_list().splitlines())


def test_the_orthophoto_of_an_empty_scan_reads_no_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from service.stream.records import ScanHeader

    rasters = pytest.importorskip("service.offline.exports.rasters", exc_type=ImportError)
    ScanStore.create(tmp_path / "scan.db", ScanHeader("x", "d", 0)).close()
    read = spied(monkeypatch, rasters, "shared_images")
    with pytest.raises(InputError, match="no points"):
        written(tmp_path, "ortho")
    read.assert_not_called()
