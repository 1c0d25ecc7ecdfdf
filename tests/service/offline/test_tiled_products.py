"""Products of a site in tiles: the same as in one piece, here and on a Dask cluster."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree
from site_scans import Errors, leg, write_scan
from spied import spied

from recon.types import F64
from service.offline.exports import EXPORTERS, view
from service.offline.exports.clouds import PLY_TYPES, SAMPLES_PER_SIDE, octree_in_parts
from service.offline.exports.view import ExportOptions, ScanView, export
from service.offline.site import compare
from service.offline.site.alignment import align_site

rasterio = pytest.importorskip("rasterio")

if TYPE_CHECKING:
    from house_flight import HouseFlight

pytestmark = pytest.mark.slow

VOXEL_M = 0.3
TILE_POINTS = 30_000  # the flight of the house has 72,000
Counted = Callable[[], list[int]]


def exported(folder: Path, kind: str, out: Path, **options: Any) -> Path:
    with ScanView(folder, VOXEL_M) as scan:
        return export(scan, kind, out, ExportOptions(voxel_m=VOXEL_M, stored=True, **options))


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    """How many tiles each raster is made of, so far."""
    runs = spied(monkeypatch, view, "run_tiles")
    return lambda: [len(call.args[1]) for call in runs.call_args_list]


@pytest.mark.parametrize(("kind", "far"), [("dsm", 0.02), ("dtm", 0.05), ("ortho", 40.0)])
def test_a_raster_in_tiles_is_that_of_the_whole(
    tmp_path: Path, house: HouseFlight, counted: Counted, kind: str, far: float
) -> None:
    house.flown(tmp_path / "scan").close()
    whole = exported(tmp_path / "scan", kind, tmp_path / "whole.tif")
    parts = exported(tmp_path / "scan", kind, tmp_path / "parts.tif", tile_points=TILE_POINTS)
    assert counted() and counted()[0] > 2
    with rasterio.open(whole) as one, rasterio.open(parts) as two:
        assert one.crs == two.crs and one.res == two.res and one.descriptions == two.descriptions
        rows = round((two.transform.f - one.transform.f) / one.res[0])
        cols = round((one.transform.c - two.transform.c) / one.res[0])
        window = (rows, rows + one.height), (cols, cols + one.width)
        a, b = one.read(), two.read(window=window)
        assert two.read_masks(1).sum() == two.read_masks(1, window=window).sum()
        known, also = one.read_masks(1) > 0, two.read_masks(1, window=window) > 0
    # Where nothing stands in a tile, ground at the border of the survey need not be seen from far.
    assert (known & ~also).mean() < 0.005
    same = np.abs(a[0].astype(float) - b[0])[known & also] <= far
    assert same.mean() > 0.99


def test_points_in_tiles_are_those_of_the_whole(tmp_path: Path, house: HouseFlight) -> None:
    house.flown(tmp_path / "scan").close()
    whole = laspy.read(exported(tmp_path / "scan", "laz", tmp_path / "whole.laz"))
    tiled = exported(tmp_path / "scan", "laz", tmp_path / "parts.laz", tile_points=TILE_POINTS)
    parts = laspy.read(tiled)
    assert abs(len(parts) - len(whole)) < 0.003 * len(whole)
    places = {tuple(p) for p in np.round(whole.xyz, 2)}
    assert len({tuple(p) for p in np.round(parts.xyz, 2)}) > 0.99 * len(parts)  # each once
    assert np.mean([tuple(p) in places for p in np.round(parts.xyz, 2)]) > 0.99
    assert np.mean(parts.classification == 2) == pytest.approx(
        np.mean(whole.classification == 2), abs=0.02
    )


@pytest.mark.parametrize("kind", ["ply", "copc"])
def test_a_cloud_in_tiles_is_that_of_the_whole(
    tmp_path: Path, house: HouseFlight, counted: Counted, kind: str
) -> None:
    pytest.importorskip("copclib")
    house.flown(tmp_path / "scan").close()
    usual = EXPORTERS[kind][1]
    whole = exported(tmp_path / "scan", kind, tmp_path / usual)
    tiled = exported(tmp_path / "scan", kind, tmp_path / f"2-{usual}", tile_points=TILE_POINTS)
    assert counted() and counted()[0] > 2
    one, two = places_in(whole), places_in(tiled)
    assert abs(len(two) - len(one)) < 0.003 * len(one)
    assert np.mean(cKDTree(one).query(two)[0] < 0.02) > 0.99
    assert len(np.unique(np.round(two, 3), axis=0)) == len(two)  # each once


def places_in(path: Path) -> F64:
    """(N, 3) places of the points in a LAZ or a PLY."""
    if path.suffix == ".laz":
        return np.asarray(laspy.read(path).xyz)
    head, _, data = path.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(data, [(name, kind) for name, kind, _ in PLY_TYPES])
    assert f"element vertex {len(rows)}\n".encode() in head
    return np.column_stack([rows["x"], rows["y"], rows["z"]])


def test_contours_in_tiles_are_those_of_the_whole(tmp_path: Path, counted: Counted) -> None:
    write_scan(tmp_path / "scan", leg(0.0, 8))
    whole, parts = (
        contours_in(exported(tmp_path / "scan", "contours", tmp_path / f"{points}.geojson",
                             tile_points=points, contour_m=0.3))
        for points in (20_000_000, 60_000)
    )  # fmt: skip
    assert counted() and counted()[0] > 2 and len(parts) > len(whole) > 4
    tops = np.unique([line[0, 2] for line in whole])
    assert np.array_equal(np.unique([line[0, 2] for line in parts]), tops)
    one, two = np.concatenate(whole), np.concatenate(parts)
    metres = np.array([1.3e-5, 9e-6, 0.1])  # of longitude, latitude; no other height is near
    for a, b in ((one, two), (two, one)):
        assert np.mean(cKDTree(a / metres).query(b / metres)[0] < 0.5) > 0.98


def contours_in(path: Path) -> list[F64]:
    """(N, 3) longitude, latitude, height of each line."""
    lines = []
    for row in json.loads(path.read_text())["features"]:
        line = np.array(row["geometry"]["coordinates"])
        at = np.linspace(0, len(line) - 1, 40 * len(line))  # corners alone lie far apart
        each = (np.interp(at, np.arange(len(line)), column) for column in line.T)
        lines.append(np.column_stack([*each]))
    return lines


def test_3d_tiles_of_a_site_in_tiles_hold_all_points(
    tmp_path: Path, house: HouseFlight, counted: Counted
) -> None:
    tileset = pytest.importorskip("py3dtiles.tileset.tileset")
    house.flown(tmp_path / "scan").close()
    folder = exported(tmp_path / "scan", "3dtiles", tmp_path / "t", tile_points=TILE_POINTS)
    assert counted() and counted()[0] > 2
    tiles = tileset.TileSet.from_file(folder / "tileset.json").root_tile.get_all_children()
    leaves = [t.get_or_fetch_content(folder) for t in tiles if not t.children]
    held = sum(content.body.feature_table.header.points_length for content in leaves)
    with ScanView(tmp_path / "scan", VOXEL_M) as scan:
        assert held == pytest.approx(len(scan.fused.cloud), rel=0.003)


def test_the_files_of_a_site_in_tiles_are_those_of_the_whole(
    tmp_path: Path, counted: Counted
) -> None:
    scans = [write_scan(tmp_path / f"{k}", leg(k * np.pi / 2), day=k) for k in range(2)]
    clouds_of, facts = [], []
    for name, points in (("whole", 20_000_000), ("tiles", 60_000)):
        align_site(scans, tmp_path / name, options=ExportOptions(tile_points=points))
        clouds_of.append(laspy.read(tmp_path / name / "cloud.laz"))
        facts.append(json.loads((tmp_path / name / "scan.json").read_text()))
        assert facts[-1]["failed"] == {} and (tmp_path / name / "report.html").is_file()
    assert len(counted()) == 1 and counted()[0] > 1
    one, two = (np.asarray(cloud.xyz) for cloud in clouds_of)
    assert len(two) == pytest.approx(len(one), rel=0.003)
    assert len(two) == facts[1]["counts"]["points"]
    assert np.mean(cKDTree(one).query(two)[0] < 0.02) > 0.99
    for key in ("keyframes", "points_before_fusion"):
        assert facts[0]["counts"][key] == facts[1]["counts"][key]
    for key, off in (("area_m2", 0.01), ("voxel_m", 0.001), ("sigma_median_m", 0.1)):
        assert facts[1]["quality"][key] == pytest.approx(facts[0]["quality"][key], rel=off)


def test_an_octree_in_parts_has_every_point_once_in_its_node() -> None:
    rng = np.random.default_rng(5)
    xyz = np.column_stack([rng.uniform(0, 100, (300_000, 2)), rng.normal(50, 3, 300_000)])
    low, side, seen = np.zeros(3), 100.0, []
    samples: dict[tuple[int, ...], int] = {}
    for key, rows in octree_in_parts(xyz, low, side, 30_000):
        depth, *index = key
        unit = (xyz[rows] - low) / side
        assert (np.floor(unit * 2**depth).astype(int) == index).all() and key not in samples
        samples[key] = len(rows)
        seen.append(rows)
        if depth < 2:  # at most one to a cell
            cells = np.floor(unit * 2**depth * SAMPLES_PER_SIDE)
            assert len(np.unique(cells, axis=0)) == len(rows)
    assert np.array_equal(np.sort(np.concatenate(seen)), np.arange(len(xyz)))
    assert samples[0, 0, 0, 0] > 10_000 and max(key[0] for key in samples) >= 2
    for depth, *index in samples:  # each node is part of one above
        assert depth == 0 or (depth - 1, *(i // 2 for i in index)) in samples


def test_a_cluster_makes_the_same_raster(tmp_path: Path, house: HouseFlight) -> None:
    distributed = pytest.importorskip("distributed")
    house.flown(tmp_path / "scan").close()
    here = exported(tmp_path / "scan", "dsm", tmp_path / "here.tif", tile_points=TILE_POINTS)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        there = exported(
            tmp_path / "scan", "dsm", tmp_path / "there.tif", tile_points=TILE_POINTS,
            scheduler=cluster.scheduler_address,
        )  # fmt: skip
    with rasterio.open(here) as one, rasterio.open(there) as two:
        np.testing.assert_array_equal(one.read(), two.read())


def test_changes_in_tiles_are_those_of_the_whole(tmp_path: Path, counted: Counted) -> None:
    box, gone = (-1.0, 4.0, 1.5, 7.0, 1.5), (-2.0, -9.0, 1.0, -6.5, 1.5)
    one = write_scan(tmp_path / "one", leg(0.0), boxes=[gone])
    two = write_scan(tmp_path / "two", leg(0.0), Errors((0.3, 0.0, 0.1)), boxes=[box], day=1)
    site = align_site([one, two], tmp_path / "site", deliver=False)
    parts = tuple((m.first, m.last) for m in site.members)
    found = []
    with ScanView(tmp_path / "site") as view:
        for name, points in (("whole", 20_000_000), ("tiles", 120_000)):
            (tmp_path / name).mkdir()
            options = ExportOptions(cell_m=0.25, tile_points=points)
            done = compare.changes(view, tmp_path / name, (parts[0], parts[1]), options)
            found.append(done)
    assert counted()[0] > 1
    whole, tiled = (sorted(f.objects, key=lambda o: o.body.volume_m3) for f in found)
    assert [o.about["kind"] for o in whole] == ["removed", "added"]
    assert [o.about["kind"] for o in tiled] == ["removed", "added"]
    for a, b in zip(whole, tiled, strict=True):
        assert a.body.volume_m3 == pytest.approx(b.body.volume_m3, rel=0.1)
        assert a.about["east_m"] == pytest.approx(b.about["east_m"], abs=0.3)
    assert found[0].compared_m2 == pytest.approx(found[1].compared_m2, rel=0.02)
    with rasterio.open(tmp_path / "tiles" / "change.tif") as image:
        numbers = image.read(3, masked=True)
    assert sorted(np.unique(numbers.compressed())) == [0.0, 1.0, 2.0]
