"""All maps of a scan in one folder, each opened by a reader of its own."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import sqlite3
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import cv2
import laspy
import numpy as np
import pytest
from house_flight import HillsideFlight
from spied import spied

from recon.types import F64, Keyframe
from service.errors import InputError, OutsideError
from service.georeference import LocalFrame
from service.offline.exports.report import made_maps
from service.offline.exports.view import ExportOptions, ScanView, export
from service.scans.folder import write_deliverables
from service.stream import codec
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

EPSG = 32632


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory, house: HouseFlight) -> Path:
    pytest.importorskip("rasterio", exc_type=ImportError)
    folder = tmp_path_factory.mktemp("maps") / "scan"
    house.flown(folder).close()
    with ScanView(folder) as scan:
        return export(scan, "all", None, ExportOptions(contour_m=5.0, cell_m=0.25))


def enu_of(house: HouseFlight, utm: F64) -> F64:
    return LocalFrame(*house.origin).from_utm(utm)


def from_wall(enu: F64) -> F64:
    """Metres outside (negative: inside) the house's walls."""
    return np.asarray(np.maximum(np.abs(enu[:, 0] - 10) - 6.0, np.abs(enu[:, 1] - 2) - 4.0))


def test_all_maps_on_a_full_disk_are_those_that_fit_and_a_failure(
    maps: Path, tmp_path: Path
) -> None:
    """No file may become larger than 100 kB, which ends as a full disk does."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with ScanView(maps.parent) as scan, pytest.raises(OutsideError, match="check the disk"):
            export(scan, "all", tmp_path / "out", ExportOptions(cell_m=0.25))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert "ortho" in manifest["failed"] and manifest["files"]


def test_the_manifest_lists_every_file_as_it_is(maps: Path) -> None:
    manifest = json.loads((maps / "manifest.json").read_text())
    assert manifest["failed"] == {} and manifest["epsg"] == EPSG
    assert "no vertical coordinate system" in manifest["heights"]
    names = {f["name"] for f in manifest["files"]}
    assert names == {p.name for p in maps.iterdir()} - {"manifest.json"}
    for entry in manifest["files"]:
        data = (maps / entry["name"]).read_bytes()
        assert entry["bytes"] == len(data)
        assert entry["sha256"] == hashlib.sha256(data).hexdigest()


def test_the_maps_share_what_they_are_made_from(
    tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cloud, surface, bare ground and contours are computed once for all of them."""
    from service.offline.exports import contours, surface, view

    spies = [
        spied(monkeypatch, view, "fused_cloud"),
        spied(monkeypatch, surface, "_open_to_the_sky"),
        spied(monkeypatch, surface, "terrain"),
        spied(monkeypatch, contours, "contour_lines"),
    ]
    house.flown(tmp_path / "scan").close()
    with ScanView(tmp_path / "scan") as scan:
        export(scan, "all", None, ExportOptions())
    assert [spy.call_count for spy in spies] == [1, 1, 1, 1]


def test_each_keyframe_is_decoded_once_and_stays_as_it_is(
    tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded = []
    real = codec.decode

    def decode(layers: Sequence[bytes]) -> Keyframe | None:
        decoded.append(real(layers))
        return decoded[-1]

    monkeypatch.setattr(codec, "decode", decode)
    house.flown(tmp_path / "scan").close()
    with ScanView(tmp_path / "scan") as scan:
        decoded.clear()
        export(scan, "all", None, ExportOptions())
        keyframes = len(scan.store.seqs())
    assert len(decoded) == keyframes
    with ScanStore.open(tmp_path / "scan" / "scan.db") as store:
        fresh = {k.seq: k for k in store.keyframes()}
    for one in decoded[:keyframes]:
        assert one is not None
        for name in ("depth_m", "sigma_m", "views"):
            np.testing.assert_array_equal(
                getattr(one.depth, name), getattr(fresh[one.seq].depth, name)
            )
        np.testing.assert_array_equal(one.bgr, fresh[one.seq].bgr)
        np.testing.assert_array_equal(one.fresh, fresh[one.seq].fresh)


def test_the_ground_runs_on_below_the_house(maps: Path, house: HouseFlight) -> None:
    import rasterio

    with rasterio.open(maps / "dtm.tif") as image:
        assert image.crs.to_epsg() == EPSG and image.descriptions[1] == "bridged"
        height, is_bridged = image.read()
        rows, cols = np.nonzero(height != -9999.0)
        east, north = rasterio.transform.xy(image.transform, rows, cols)
    enu = enu_of(house, np.column_stack([east, north, height[rows, cols]]))
    inside = from_wall(enu) < -0.5
    assert inside.sum() > 500 and is_bridged[rows, cols][inside].all()
    assert np.abs(enu[:, 2]).max() < 0.3


def test_points_of_the_ground_have_its_class(maps: Path, house: HouseFlight) -> None:
    las: Any = laspy.read(str(maps / "cloud.laz"))
    enu = enu_of(house, np.column_stack([las.x, las.y, las.z]))
    distance, kind = from_wall(enu), np.asarray(las.classification)
    assert set(kind) == {1, 2}
    assert (kind[distance < -1.0] == 1).all() and (kind[distance > 2.0] == 2).mean() > 0.99


def contours_gpkg(path: Path) -> list[tuple[float, F64]]:
    """By the standard: magic, version, flags, srs, then little-endian WKB of a line."""
    with sqlite3.connect(path) as file:
        assert file.execute("PRAGMA application_id").fetchone()[0] == 0x47504B47
        kind = file.execute("SELECT * FROM gpkg_geometry_columns").fetchall()
        assert kind == [("contours", "geom", "LINESTRING", EPSG, 1, 0)]
        box = file.execute("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents").fetchone()
        rows = file.execute("SELECT geom, height_amsl_m, label FROM contours").fetchall()
    out = []
    for data, height_m, label in rows:
        magic, _, _, srs, order, form, count = struct.unpack_from("<2sBBiBII", data)
        assert (magic, srs, order, form) == (b"GP", EPSG, 1, 1002)
        line = np.frombuffer(data, "<f8", offset=17).reshape(count, 3)
        assert (line[:, 2] == height_m).all() and label == ("410" if height_m == 410.0 else "")
        line = line[:, :2]
        assert (line >= np.array(box[:2])).all() and (line <= np.array(box[2:])).all()
        out.append((height_m, line))
    return out


def contours_dxf(path: Path) -> list[tuple[float, F64]]:
    """Pairs of a group code and a value; vertices between POLYLINE and SEQEND."""
    words = path.read_text().split("\n")
    pairs = list(zip(words[::2], words[1::2], strict=False))
    out: list[tuple[float, F64]] = []
    place: list[list[float]] = []
    for code, value in pairs:
        if (code, value) == ("0", "POLYLINE"):
            place = []
        elif (code, value) == ("0", "VERTEX"):
            place.append([])
        elif (code, value) == ("0", "SEQEND"):
            xyz = np.array(place)
            out.append((float(xyz[0, 2]), xyz[:, :2]))
        elif code in ("10", "20", "30") and place:
            place[-1].append(float(value))
    assert pairs[0] == ("0", "SECTION") and ("0", "EOF") in pairs
    return out


def test_contours_are_the_same_in_every_format(tmp_path: Path) -> None:
    hillside = HillsideFlight()
    hillside.origin = (*hillside.origin[:2], 410.2)
    hillside.flown(tmp_path).close()
    with ScanView(tmp_path) as scan:
        paths = [export(scan, k, None, ExportOptions()) for k in ("gpkg", "dxf", "contours")]
    gpkg, dxf = contours_gpkg(paths[0]), contours_dxf(paths[1])
    features = json.loads(paths[2].read_text())["features"]
    assert len(gpkg) == len(dxf) == len(features)
    assert {height_m for height_m, _ in gpkg} == {409.0, 410.0, 411.0}
    for (height_m, line), (level_m, same), feature in zip(gpkg, dxf, features, strict=True):
        assert height_m == level_m == feature["properties"]["height_amsl_m"]
        assert feature["properties"]["index"] == (height_m == 410.0)
        np.testing.assert_allclose(line, same, atol=0.001)
        enu = enu_of(hillside, np.column_stack([line, np.full(len(line), height_m)]))
        np.testing.assert_allclose(enu[:, 2], hillside.slope * enu[:, 1], atol=0.05)
        place = np.array(feature["geometry"]["coordinates"])
        assert place.shape == (len(line), 3) and (place[:, 2] == height_m).all()
    words = paths[1].read_text().split("\n")
    assert words[words.index("TEXT") + 2] == "CONTOUR_LABELS" and "410" in words


def test_level_ground_with_a_house_has_no_contours(maps: Path) -> None:
    assert contours_gpkg(maps / "contours.gpkg") == contours_dxf(maps / "contours.dxf") == []


@pytest.mark.slow
def test_the_report_shows_orthophoto_and_surface_model(tmp_path: Path, house: HouseFlight) -> None:
    folder = tmp_path / "scan"
    with house.flown(folder) as store:
        heights = write_deliverables(folder, store)["heights"]
    frame, options = LocalFrame(*house.origin), ExportOptions(cell_m=0.25)
    assert made_maps(folder, heights) is None
    before = (folder / "report.html").read_text()
    with ScanView(folder) as scan:
        for kind in ("dsm", "ortho", "report"):
            export(scan, kind, None, options)
    after = (folder / "report.html").read_text()
    assert after != before and after.count("<img") == before.count("<img")
    found = made_maps(folder, heights)
    assert found is not None
    spots = frame.to_utm(np.array([[10.0, 2.0, 6.0], [10.0, 12.0, 0.0]]))
    (row, ground), (col, east) = found.grid.cells(spots[:, :2])
    assert found.height_m[row, col] == pytest.approx(spots[0, 2], abs=0.3)
    assert found.height_m[ground, east] == pytest.approx(spots[1, 2], abs=0.3)
    assert found.rgb[row, col, 0] > 150 > 90 > found.rgb[row, col, 2]  # red, as the roof
    assert made_maps(folder, "metres above ellipsoid") is None
    os.utime(folder / "dsm.tif", ns=(0, 0))  # of an earlier state of the scan
    assert made_maps(folder, heights) is None
    (folder / "scan.json").write_text("{}")
    with ScanView(folder) as scan, pytest.raises(InputError, match=r"scan\.json cannot be read"):
        export(scan, "report", None, options)


def test_an_overlay_is_never_made_of_an_older_orthophoto(maps: Path, tmp_path: Path) -> None:
    (tmp_path / "ortho.tif").write_bytes(b"of another scan")
    with ScanView(maps.parent) as scan:
        out = export(scan, "kmz", tmp_path / "ortho.kmz", ExportOptions(cell_m=0.25))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ortho.kmz", "ortho.tif"]
    with zipfile.ZipFile(out) as new, zipfile.ZipFile(maps / "ortho.kmz") as made_with_all:
        assert new.read("ortho.png") == made_with_all.read("ortho.png")


def test_the_overlay_shows_the_house_at_its_place(maps: Path, house: HouseFlight) -> None:
    with zipfile.ZipFile(maps / "ortho.kmz") as file:
        box = ElementTree.fromstring(file.read("doc.kml"))
        image = cv2.imdecode(np.frombuffer(file.read("ortho.png"), np.uint8), cv2.IMREAD_UNCHANGED)
    space = "{http://www.opengis.net/kml/2.2}"
    west, south, east, north = (
        float(next(box.iter(space + side)).text or "")
        for side in ("west", "south", "east", "north")
    )
    assert image is not None
    blue, _, red, opacity = image.transpose(2, 0, 1)
    red_area = ((red > 150) & (blue < 90) & (opacity > 0)).astype(np.uint8)
    # Images show a line of the roof's edge on the hidden ground behind it.
    rows, cols = np.nonzero(cv2.morphologyEx(red_area, cv2.MORPH_OPEN, np.ones((5, 5))))
    lat = north - (rows + 0.5) / image.shape[0] * (north - south)
    lon = west + (cols + 0.5) / image.shape[1] * (east - west)
    enu = LocalFrame(*house.origin).to_enu(
        np.column_stack([lat, lon, np.full(len(lat), house.origin[2])])
    )
    assert np.median(enu[:, 0]) == pytest.approx(10.0, abs=0.4)
    assert np.median(enu[:, 1]) == pytest.approx(2.0, abs=0.4)


def test_the_stac_item_describes_the_rasters(maps: Path, house: HouseFlight) -> None:
    import rasterio

    item = json.loads((maps / "stac.json").read_text())
    assert set(item["assets"]) == {"ortho", "dsm", "dtm", "coverage"}
    west, south, east, north = item["bbox"]
    lat, lon, _ = house.origin
    assert west < lon + 1e-4 < east and south < lat < north and north - south < 0.01
    for asset in item["assets"].values():
        with rasterio.open(maps / asset["href"]) as image:
            assert asset["proj:shape"] == [image.height, image.width]
            assert asset["proj:transform"] == list(image.transform)[:6]
