"""Heights above another vertical datum, by a geoid grid that is written here."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import laspy
import numpy as np
import pytest
from house_flight import HillsideFlight
from pyproj import datadir
from typer.testing import CliRunner

from recon.types import F64
from service.cli import app
from service.errors import InputError
from service.georeference import LocalFrame, height_change, vertical_code
from service.offline.exports import EXPORTERS
from service.offline.exports.view import ExportOptions, ScanView, export
from service.scans.folder import write_deliverables
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

GRID = "us_nga_egm96_15.tif"
STEP_DEG = 0.25
UP_M, EAST_M, NORTH_M = 45.0, 3.0, -2.0
"""The geoid's height at the grid's middle, and what it gains per step east and north."""


@pytest.fixture
def geoid(tmp_path: Path, house: HouseFlight) -> Iterator[tuple[float, float]]:
    """PROJ finds a grid of EGM96 about the house; latitude and longitude of its middle node."""
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    lat, lon = (np.round(np.array(house.origin[:2]) / STEP_DEG) * STEP_DEG).tolist()
    steps = np.arange(-4, 5)
    image = UP_M + EAST_M * steps[None, :] - NORTH_M * steps[:, None]
    corner = lon - 4.5 * STEP_DEG, lat + 4.5 * STEP_DEG
    profile = {
        "driver": "GTiff", "width": 9, "height": 9, "count": 1, "dtype": "float32",
        "crs": "EPSG:4326",
        "transform": rasterio.transform.from_origin(*corner, STEP_DEG, STEP_DEG),
    }  # fmt: skip
    folder = tmp_path / "grids"
    folder.mkdir()
    with rasterio.open(folder / GRID, "w", **profile) as file:
        file.write(image.astype(np.float32), 1)
        file.update_tags(AREA_OR_POINT="Point", TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL")
        file.set_band_description(1, "geoid_undulation")
    before = datadir.get_data_dir()
    datadir.append_data_dir(str(folder))
    yield lat, lon
    datadir.set_data_dir(before)


@pytest.fixture
def scan_dir(tmp_path: Path, house: HouseFlight) -> Path:
    folder = tmp_path / "scan"
    house.flown(folder).close()
    return folder


TO_ELLIPSOID = ExportOptions(vertical_datum="EGM96", to_datum="ellipsoid", contour_m=2.5)


def both(scan_dir: Path, kind: str) -> tuple[Path, Path]:
    """A deliverable as flown, and with heights above the ellipsoid."""
    with ScanView(scan_dir) as scan:
        name = EXPORTERS[kind][1]
        flown = export(scan, kind, scan_dir / f"flown.{name}", ExportOptions(contour_m=2.5))
        return flown, export(scan, kind, scan_dir / f"new.{name}", TO_ELLIPSOID)


def geoid_m(geoid: tuple[float, float], lat: float, lon: float) -> float:
    return UP_M + ((lon - geoid[1]) * EAST_M + (lat - geoid[0]) * NORTH_M) / STEP_DEG


def test_rasters_are_raised_by_the_geoid(
    scan_dir: Path, house: HouseFlight, geoid: tuple[float, float]
) -> None:
    import rasterio

    lat, lon, _ = house.origin
    for kind in ("dsm", "dtm", "coverage"):
        paths = both(scan_dir, kind)
        with rasterio.open(paths[0]) as old, rasterio.open(paths[1]) as new:
            assert old.transform == new.transform
            band = 3 if kind == "coverage" else 1
            before, after = old.read(band, masked=True), new.read(band, masked=True)
            assert (before.mask == after.mask).mean() > 0.999
            rise = (after - before).compressed()
            assert np.median(rise) == pytest.approx(geoid_m(geoid, lat, lon), abs=0.01)
            assert np.quantile(np.abs(rise - np.median(rise)), 0.99) < 0.02
            assert new.tags()["HEIGHTS"] == "metres above ellipsoid"


def test_points_and_lines_are_raised_by_the_geoid(
    scan_dir: Path, house: HouseFlight, geoid: tuple[float, float], tmp_path: Path
) -> None:
    with ScanView(scan_dir) as scan:
        flown = laspy.read(export(scan, "laz", None, ExportOptions()))
        track = json.loads(export(scan, "geojson", None, ExportOptions()).read_text())
        kml = export(scan, "kml", None, ExportOptions()).read_text()
        new = laspy.read(export(scan, "laz", None, TO_ELLIPSOID))
        raised = json.loads(export(scan, "geojson", None, TO_ELLIPSOID).read_text())
        assert export(scan, "kml", None, TO_ELLIPSOID).read_text() == kml  # by definition AMSL
    geodetic = LocalFrame(*house.origin)
    at = geodetic.to_geodetic(geodetic.from_utm(np.asarray(flown.xyz)))
    expected = [geoid_m(geoid, *place) for place in at[:, :2]]
    np.testing.assert_allclose(new.xyz[:, 2] - flown.xyz[:, 2], expected, atol=0.002)
    np.testing.assert_array_equal(new.xyz[:, :2], flown.xyz[:, :2])
    assert np.ptp(expected) > 1e-4  # the geoid is not one number
    for a, b in zip(track["features"], raised["features"], strict=True):
        if a["geometry"]["type"] == "Point":
            lon, lat, height = a["geometry"]["coordinates"]
            rise = b["geometry"]["coordinates"][2] - height
            assert rise == pytest.approx(geoid_m(geoid, lat, lon), abs=0.002)


def test_a_track_above_the_ellipsoid_is_lowered_to_the_geoid(
    scan_dir: Path, house: HouseFlight, geoid: tuple[float, float]
) -> None:
    flown = kml_heights(scan_dir, None)[1]
    mode, lowered = kml_heights(scan_dir, "ellipsoid")
    assert mode == "absolute"
    np.testing.assert_allclose(flown - lowered, geoid_m(geoid, *house.origin[:2]), atol=0.01)


def test_without_a_grid_a_track_above_the_ellipsoid_lies_on_the_ground(scan_dir: Path) -> None:
    assert kml_heights(scan_dir, None)[0] == kml_heights(scan_dir, "EGM96")[0] == "absolute"
    assert kml_heights(scan_dir, "ellipsoid")[0] == "clampToGround"


def kml_heights(scan_dir: Path, datum: str | None) -> tuple[str, F64]:
    """The altitude mode of a track, and (N,) its heights."""
    with ScanView(scan_dir) as scan:
        text = export(scan, "kml", None, ExportOptions(vertical_datum=datum)).read_text()
    (mode,) = re.findall("<altitudeMode>(.*)</altitudeMode>", text)
    return mode, np.array([float(z) for z in re.findall("<gx:coord>.* (.*?)</gx:coord>", text)])


@pytest.mark.parametrize("kind", ["copc", "ply"])
def test_clouds_are_raised_by_the_geoid(
    scan_dir: Path, house: HouseFlight, geoid: tuple[float, float], kind: str
) -> None:
    if kind == "copc":
        pytest.importorskip("copclib")
    flown, raised = (_xyz(path) for path in both(scan_dir, kind))
    np.testing.assert_array_equal(raised[:, :2], flown[:, :2])
    rise = geoid_m(geoid, *house.origin[:2])
    np.testing.assert_allclose(raised[:, 2] - flown[:, 2], rise, atol=0.01)


def _xyz(path: Path) -> F64:
    """(N, 3) of a LAZ file or of our PLY, in order of place."""
    data = path.read_bytes()
    if not data.startswith(b"ply"):
        xyz = np.asarray(laspy.read(path).xyz)
        return np.asarray(xyz[np.lexsort(xyz.T[::-1])])
    head, _, body = data.partition(b"end_header\n")
    assert (b"above ellipsoid" if "new" in path.name else b"AMSL") in head
    count = int(head.partition(b"element vertex ")[2].split()[0])
    rows = np.frombuffer(body, np.uint8).reshape(count, -1)
    return np.asarray(rows[:, :24].copy().view("<f8"))


def test_contours_of_all_formats_are_above_the_other_datum(
    tmp_path: Path, geoid: tuple[float, float]
) -> None:
    HillsideFlight().flown(tmp_path / "hillside").close()
    with ScanView(tmp_path / "hillside") as scan:
        paths = {kind: export(scan, kind, None, TO_ELLIPSOID) for kind in ("gpkg", "dxf")}
        features = json.loads(export(scan, "contours", None, TO_ELLIPSOID).read_text())["features"]
    want = sorted(line["properties"]["height_m"] for line in features)
    assert want and min(want) > UP_M + 400.0  # the hillside lies at 408 m
    assert all(height % 2.5 == 0.0 for height in want)
    with sqlite3.connect(paths["gpkg"]) as file:
        found = file.execute("SELECT height_m FROM contours ORDER BY height_m").fetchall()
    assert [height for (height,) in found] == want
    first = re.findall(r"POLYLINE\n(?:.*\n)*?30\n(?:.*\n)*?30\n(\S+)", paths["dxf"].read_text())
    assert sorted(map(float, first)) == want


def test_enu_metres_stay_and_places_return(house: HouseFlight, geoid: tuple[float, float]) -> None:
    change = height_change("EGM96", "ellipsoid", *house.origin[:2])
    assert change is not None
    frame = LocalFrame(*house.origin, heights=change)
    enu = np.random.default_rng(1).uniform(-300, 300, (20, 3))
    np.testing.assert_allclose(frame.from_utm(frame.to_utm(enu)), enu, atol=1e-5)
    up = frame.to_geodetic(np.zeros((1, 3)))[0, 2] - house.origin[2]
    assert up == pytest.approx(geoid_m(geoid, *house.origin[:2]), abs=1e-3)
    back = height_change("ellipsoid", "EGM96", *house.origin[:2])
    assert back is not None
    place = np.array([[*house.origin]])
    np.testing.assert_allclose(back(change(place)), place, atol=1e-6)
    with pytest.raises(InputError, match="does not cover"):
        change(np.array([[-house.origin[0], house.origin[1] + 90.0, 0.0]]))


def test_a_grid_that_is_missing_is_named(scan_dir: Path) -> None:
    ask = ["export", str(scan_dir), "--to", "dsm", "--vertical-datum", "EGM96"]
    answer = CliRunner().invoke(app, [*ask, "--to-datum", "ellipsoid"])
    assert isinstance(answer.exception, InputError)
    said = str(answer.exception)
    assert GRID in said and "pyproj sync" in said and "/proj" in said
    assert not (scan_dir / "dsm.tif").exists()


def test_nothing_is_assumed(scan_dir: Path) -> None:
    ask = ["export", str(scan_dir), "--to", "laz", "--to-datum"]
    answer = CliRunner().invoke(app, [*ask, "ellipsoid"])
    assert isinstance(answer.exception, InputError)
    assert "give --vertical-datum" in str(answer.exception)
    answer = CliRunner().invoke(app, [*ask, "EPSG:4326", "--vertical-datum", "EGM96"])
    assert isinstance(answer.exception, InputError)
    assert "vertical coordinates" in str(answer.exception)
    with pytest.raises(InputError, match="no conversion"):  # America's heights, in Europe
        height_change("EPSG:5703", "ellipsoid", 48.0, 11.0)
    assert height_change("EPSG:5773", "EGM96", 48.0, 11.0) is None
    assert vertical_code("EPSG:5703") == 5703
    for bad in ("EPSG:", "EPSG:999999", "EPSG:x", ""):
        with pytest.raises(ValueError, match="give ellipsoid"):
            vertical_code(bad)


def test_heights_above_what_the_tags_state(scan_dir: Path) -> None:
    """In scan.json and in the deliverables, without a word of the operator."""
    import rasterio

    with ScanStore.open(scan_dir / "scan.db") as store:
        store.update_header(vertical_datum="ellipsoid")
        write_deliverables(scan_dir, store)
    facts = json.loads((scan_dir / "scan.json").read_text())
    assert facts["heights"] == "metres above ellipsoid"
    with ScanView(scan_dir) as scan:
        with rasterio.open(export(scan, "dsm", None, ExportOptions())) as dsm:
            assert dsm.tags()["HEIGHTS"] == "metres above ellipsoid"
        lines = json.loads(export(scan, "contours", None, ExportOptions(contour_m=2.5)).read_text())
        assert all("height_m" in line["properties"] for line in lines["features"])
        said = ExportOptions(vertical_datum="EGM96")
        with rasterio.open(export(scan, "dsm", None, said)) as dsm:
            assert dsm.tags()["HEIGHTS"] == "metres above EGM96"
