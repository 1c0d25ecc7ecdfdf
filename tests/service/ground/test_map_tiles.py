"""Map tiles of a scan over HTTP: where its house lies, and what happens while it grows."""

from __future__ import annotations

import importlib
import json
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from portal_client import ONE, Client, flown_store, serving, store
from pyproj import Transformer

from recon.types import F64, U8
from service.georeference import LocalFrame
from service.ground.live_map import LiveMap, degrees, mercator, on_map, pixel_m
from service.ground.map_tiles import contour_mask, interval_m
from service.ground.state import OpenScans
from service.stream.codec import encode, encode_image
from service.stream.records import Repose
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

__all__ = ["store"]  # the fixture

FRAME = LocalFrame(47.39, 8.54, 408.0)
TO_MERCATOR = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True)
HALF_M = 20037508.342789244
ZOOM = 18  # a pixel is 0.4 m there; the flight's points are 0.3 m apart
ROOF, ROOF_BGR = (10.0, 2.0), (40, 40, 200)
GROUND, NOWHERE = (-10.0, -5.0), (80.0, 80.0)
TILES = "/tiles/drone-1/test-1"


def pixel(enu: tuple[float, float], zoom: int) -> tuple[int, int]:
    """Column and row of a place on the whole map of a zoom, by PROJ."""
    lat, lon, _ = FRAME.to_geodetic(np.array([[*enu, 0.0]]))[0]
    x, y = TO_MERCATOR.transform(lon, lat)
    side = 256 << zoom
    return int((x / HALF_M + 1.0) / 2.0 * side), int((1.0 - y / HALF_M) / 2.0 * side)


def at(client: Client, layer: str, enu: tuple[float, float], zoom: int = ZOOM) -> U8:
    """(4,) BGRA that the map shows at a place."""
    col, row = pixel(enu, zoom)
    image = tile(client, layer, zoom, col // 256, row // 256)
    return np.asarray(image[row % 256, col % 256])


def tile(client: Client, layer: str, z: int, x: int, y: int) -> U8:
    status, data, headers = client.ask(f"{TILES}/{layer}/{z}/{x}/{y}.png")
    assert status == 200 and headers["content-type"] == "image/png"
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), np.uint8)
    assert image.shape == (256, 256, 4)
    return image


@pytest.fixture
def client(store: Path) -> Iterator[Client]:
    """The map is looked at again with every request."""
    with serving(store, map_age_s=0.0) as one:
        yield one


@pytest.mark.parametrize("zoom", [ZOOM - 3, ZOOM, ZOOM + 3])
def test_the_house_lies_where_it_is(client: Client, zoom: int) -> None:
    assert np.abs(at(client, "ortho", ROOF, zoom)[:3].astype(int) - ROOF_BGR).max() < 12
    assert at(client, "ortho", ROOF, zoom)[3] == 255
    assert at(client, "ortho", GROUND, zoom)[2] < 130 and at(client, "ortho", GROUND, zoom)[3]
    assert at(client, "ortho", NOWHERE, zoom)[3] == 0


def test_the_thumbnail_is_the_whole_map(client: Client) -> None:
    about = client.ask(f"{TILES}/ortho.json")[1]
    west, south, east, north = about["bounds"]
    status, data, _ = client.ask(f"{TILES}/thumbnail.png")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert status == 200 and image is not None
    high, wide = image.shape[:2]
    assert 240 <= max(high, wide) <= 481
    lat, lon, _ = FRAME.to_geodetic(np.array([[*ROOF, 0.0]]))[0]
    row, col = (north - lat) / (north - south) * high, (lon - west) / (east - west) * wide
    roof = image[int(row), int(col)]
    bright = np.minimum(np.multiply(ROOF_BGR, about["exposure"]), 255)
    assert np.abs(roof[:3] - bright).max() < 20 and roof[3] == 255
    assert image[..., 3].any(axis=0).mean() > 0.98 and image[..., 3].any(axis=1).mean() > 0.98


def test_the_borders_of_the_roof_lie_right(client: Client) -> None:
    """The roof is 12 m wide; its west end is 4 m east of the origin."""
    col, row = pixel(ROOF, ZOOM)
    west, east = (pixel((x, 2.0), ZOOM)[0] for x in (4.0, 16.0))
    wide = np.hstack([tile(client, "ortho", ZOOM, col // 256 + k, row // 256) for k in (-1, 0, 1)])
    line = wide[row % 256].astype(int)
    red = np.flatnonzero((line[:, 2] > 150) & (line[:, 1] < 90)) + (col // 256 - 1) * 256
    assert abs(int(red.min()) - west) <= 2 and abs(int(red.max()) + 1 - east) <= 2


def test_a_new_keyframe_and_a_correction_are_on_the_map(
    client: Client, store: Path, house: HouseFlight
) -> None:
    east, moved_east = (55.0, 0.0), (105.0, 0.0)
    assert at(client, "ortho", east)[3] == 0
    before = client.ask(f"{TILES}/ortho.json")[1]
    with ScanStore.open(store / "drone-1/test-1/scan.db") as scan:
        one = house.keyframe(5, 50.0)
        scan.add_keyframe(5, encode(one, one.time_ns))
    assert at(client, "ortho", east)[3] == 255
    after = client.ask(f"{TILES}/ortho.json")[1]
    assert after["version"] != before["version"] and after["bounds"][2] > before["bounds"][2]
    with ScanStore.open(store / "drone-1/test-1/scan.db") as scan:
        scan.add_reposes([Repose(5, 1, house.pose(100.0), 1.0, np.eye(6))])
    assert at(client, "ortho", moved_east)[3] == 255
    assert at(client, "ortho", east)[3] == 0  # it left
    assert np.abs(at(client, "ortho", ROOF)[:3].astype(int) - ROOF_BGR).max() < 12


def test_the_version_of_a_layer_is_that_of_its_tiles(store: Path, house: HouseFlight) -> None:
    """Else a page that saw the version of now would keep the tile of before."""
    with serving(store, map_age_s=0.0, coverage_age_s=1000.0) as client:

        def versions() -> tuple[str, str]:
            answers = [client.ask(f"{TILES}/{layer}.json") for layer in ("ortho", "coverage")]
            assert all(headers["cache-control"] == "no-cache" for _, _, headers in answers)
            return answers[0][1]["version"], answers[1][1]["version"]

        east, before = (55.0, 0.0), versions()
        with ScanStore.open(store / "drone-1/test-1/scan.db") as scan:
            one = house.keyframe(5, 50.0)
            scan.add_keyframe(5, encode(one, one.time_ns))
        after = versions()
        assert at(client, "ortho", east)[3] == 255 and after[0] != before[0]
        assert at(client, "coverage", east)[3] == 0 and after[1] == before[1]  # 1000 s old


def test_the_surest_point_of_a_place_is_shown(store: Path, house: HouseFlight) -> None:
    with ScanStore.open(store / "drone-1/test-1/scan.db") as scan:
        unsure = house.keyframe(5, 10.0, sigma_m=0.5)
        unsure.bgr[:] = (255, 0, 255)
        scan.add_keyframe(5, encode(unsure, unsure.time_ns))
        sure = house.keyframe(6, 20.0, sigma_m=0.01)
        sure.bgr[:] = (255, 255, 0)
        scan.add_keyframe(6, encode(sure, sure.time_ns))
    with serving(store) as client:
        shown = [at(client, "ortho", place)[:3].tolist() for place in (ROOF, GROUND)]
    assert np.abs(np.subtract(shown[0], (255, 255, 0))).max() < 12
    assert shown[1][0] < 200  # where the sure one does not reach the others still hold


def test_what_nothing_measured_has_the_colour_of_the_image_and_no_height(
    store: Path, house: HouseFlight
) -> None:
    """Crowns of trees, to which stereo gives no depth, are no white blobs."""
    east, crown_bgr = 300.0, (30, 220, 240)
    one = house.keyframe(5, east)
    rows, cols = slice(35, 55), slice(70, 90)
    one.depth.depth_m[rows, cols] = np.nan
    one.bgr[rows, cols] = crown_bgr
    with ScanStore.open(store / "drone-1/test-1/scan.db") as scan:
        scan.add_keyframe(5, encode(one, one.time_ns), encode_image(one.bgr))
    with serving(store) as client:
        assert np.abs(at(client, "ortho", (east, 0.0))[:3].astype(int) - crown_bgr).max() < 40
        assert at(client, "ortho", (east, 0.0))[3] == 255
        assert at(client, "terrain", (east, 0.0))[3] == 0
        assert at(client, "dsm", (east, 0.0))[3] == 0
        assert at(client, "ortho", NOWHERE)[3] == 0


def test_an_image_that_cannot_be_read_shows_nothing_between_what_is_measured(
    store: Path, house: HouseFlight
) -> None:
    one = house.keyframe(5, 300.0)
    one.depth.depth_m[35:55, 70:90] = np.nan
    image = encode_image(one.bgr)
    cut = image[: image.index(b"\xff\xc0") + 19]  # its size, and nothing more
    with ScanStore.open(store / "drone-1/test-1/scan.db") as scan:
        scan.add_keyframe(5, encode(one, one.time_ns), cut)
    with serving(store) as client:
        assert at(client, "ortho", (300.0, 0.0))[3] == 0
        assert at(client, "ortho", (300.0, 8.0))[3] == 255


def test_shading_and_contours_show_the_walls_alone(client: Client) -> None:
    flat = at(client, "dsm", GROUND)
    assert flat[3] == 255 and abs(int(flat[0]) - round(255 * math.sqrt(0.5))) <= 3
    assert at(client, "dsm", NOWHERE)[3] == 0
    col, row = pixel(ROOF, ZOOM - 1)  # the one contour between ground and roof is at 410 m
    image = tile(client, "dsm", ZOOM - 1, col // 256, row // 256)
    assert np.abs(image[image[..., 3] > 0][:, 0].astype(int) - int(flat[0])).max() > 60
    lines = tile(client, "contours", ZOOM - 1, col // 256, row // 256)[..., 3] > 0
    rows, cols = np.nonzero(lines)
    assert len(rows) > 20
    for r, c in zip(rows, cols, strict=True):
        x, y = (c - col % 256) * 0.81 + ROOF[0], (row % 256 - r) * 0.81 + ROOF[1]
        outside = max(abs(x - 10.0) - 6.0, abs(y - 2.0) - 4.0)
        assert abs(outside) < 2.5, (x, y)


def test_terrain_gives_the_heights_and_the_track_the_way(
    client: Client, house: HouseFlight
) -> None:
    for place, want_m in ((ROOF, 6.0), (GROUND, 0.0)):
        b, g, r, known = at(client, "terrain", place).astype(np.float64)
        assert known == 255
        assert abs(256.0 * r + g + b / 256.0 - 32768.0 - house.origin[2] - want_m) < 0.02
    assert at(client, "terrain", NOWHERE)[3] == 0
    status, data, headers = client.ask(ONE + "/track.geojson")
    assert status == 200 and headers["content-type"] == "application/geo+json"
    line = np.array(json.loads(data)["geometry"]["coordinates"])
    places = LocalFrame(*house.origin).to_enu(line[:, [1, 0, 2]])
    assert np.abs(places[:, 1]).max() < 0.01 and np.abs(places[:, 2] - house.height_m).max() < 0.01


def test_coverage_is_a_layer(client: Client) -> None:
    assert at(client, "coverage", (10.0, 0.0))[3] > 100
    assert at(client, "coverage", NOWHERE)[3] == 0


def test_an_exported_orthophoto_is_shown_while_it_is_newer(client: Client, store: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    folder = store / "drone-1/test-1"
    x, y, _ = FRAME.to_utm(np.array([[-20.0, 25.0, 0.0]]))[0]
    profile = {"driver": "GTiff", "width": 400, "height": 400, "count": 4, "dtype": "uint8",
               "crs": f"EPSG:{FRAME.epsg}",
               "transform": rasterio.transform.from_origin(x, y, 0.1, 0.1)}  # fmt: skip
    blue = np.zeros((4, 400, 400), np.uint8)
    blue[2:] = 255
    with rasterio.open(folder / "ortho.tif", "w", **profile) as image:
        image.write(blue)
    assert at(client, "ortho", ROOF).tolist() == [255, 0, 0, 255]
    assert at(client, "ortho", (22.0, 0.0))[3] == 0  # east of the raster
    later = (folder / "ortho.tif").stat().st_mtime + 10
    os.utime(folder / "scan.json", (later, later))  # the scan was refined
    assert np.abs(at(client, "ortho", ROOF)[:3].astype(int) - ROOF_BGR).max() < 12


@pytest.mark.parametrize("height_m", [4e4, -3.4e38])
def test_heights_beyond_the_encoding_are_unknown(
    client: Client, store: Path, height_m: float
) -> None:
    rasterio = pytest.importorskip("rasterio")
    x, y, _ = FRAME.to_utm(np.array([[-20.0, 25.0, 0.0]]))[0]
    profile = {"driver": "GTiff", "width": 400, "height": 400, "count": 1, "dtype": "float32",
               "crs": f"EPSG:{FRAME.epsg}",
               "transform": rasterio.transform.from_origin(x, y, 0.1, 0.1)}  # fmt: skip
    with rasterio.open(store / "drone-1/test-1/dsm.tif", "w", **profile) as image:
        image.write(np.full((1, 400, 400), height_m, np.float32))
    assert at(client, "terrain", ROOF)[3] == 0


KINDS = ["garbage", "another format", "one band", "large block", "flat pixels", "other planet"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_raster_that_is_no_map_is_refused_and_names_no_other_file(
    client: Client, store: Path, tmp_path: Path, kind: str
) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = store / "drone-1/test-1/ortho.tif"
    world = rasterio.Affine(1e5, 0, -HALF_M, 0, -1e5, HALF_M)
    profile = {"driver": "GTiff", "width": 64, "height": 64, "count": 4, "dtype": "uint8",
               "crs": "EPSG:3857", "transform": world}  # fmt: skip
    if kind == "garbage":
        path.write_bytes(b"no raster" * 100)
    elif kind == "another format":
        secret = tmp_path / "secret.tif"
        with rasterio.open(secret, "w", **profile) as image:
            image.write(np.full((4, 64, 64), 200, np.uint8))
        importlib.import_module("rasterio.shutil").copy(secret, path, driver="VRT")
    elif kind == "one band":
        with rasterio.open(path, "w", **profile | {"count": 1}):
            pass
    elif kind == "flat pixels":
        with rasterio.open(path, "w", **profile | {"transform": rasterio.Affine(*(1, 0, 0) * 2)}):
            pass
    elif kind == "other planet":
        with rasterio.open(path, "w", **profile | {"crs": 'LOCAL_CS["x",UNIT["metre",1]]'}):
            pass
    else:
        wide = {"width": 1 << 14, "height": 1 << 14, "tiled": True, "sparse_ok": True,
                "blockxsize": 1 << 13, "blockysize": 1 << 13, "compress": "deflate"}  # fmt: skip
        with rasterio.open(path, "w", **profile | wide):
            pass
    status, text, _ = client.ask(f"{TILES}/ortho/0/0/0.png")
    assert status == 400 and "ortho.tif" in str(text)


def test_tilejson_and_kml_say_where_the_tiles_are(client: Client) -> None:
    document = client.ask(f"{TILES}/dsm.json")[1]
    assert document["tilejson"] == "3.0.0"
    assert document["tiles"] == [f"{client.base}{TILES}/dsm/{{z}}/{{x}}/{{y}}.png"]
    assert "intervals_m" not in document
    assert "exposure" not in document  # it is shaded
    exposure = client.ask(f"{TILES}/ortho.json")[1]["exposure"]
    assert exposure == pytest.approx(230 / 200, abs=0.01)  # the roof is the brightest
    intervals = client.ask(f"{TILES}/contours.json")[1]["intervals_m"]
    assert intervals[ZOOM] == interval_m(pixel_m(ZOOM, 47.4))
    assert intervals[24] == intervals[23]  # tiles beyond the finest are enlarged
    west, south, east, north = document["bounds"]
    assert west < 8.54 < east and south < 47.39 < north and east - west < 0.002
    status, text, headers = client.ask(f"{TILES}/ortho.kml")
    assert status == 200 and headers["content-type"].startswith("application/vnd.google-earth.kml")
    space = {"k": "http://www.opengis.net/kml/2.2"}
    overlays = ElementTree.fromstring(text).findall(".//k:GroundOverlay", space)
    assert 0 < len(overlays) <= 25
    boxes = []
    for one in overlays:
        address = one.findtext("k:Icon/k:href", "", space)
        assert client.ask(address.removeprefix(client.base))[0] == 200
        names = ("west", "south", "east", "north")
        boxes.append([float(one.findtext(f"k:LatLonBox/k:{n}", "", space)) for n in names])
    low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
    assert low[0] <= west and low[1] <= south and high[2] >= east and high[3] >= north


def test_wmts_shows_the_house_to_gdal(client: Client) -> None:
    """GDAL's WMTS driver reads the capabilities and fetches the tiles that they name."""
    rasterio = pytest.importorskip("rasterio")
    status, text, headers = client.ask(f"{TILES}/wmts.xml")
    assert status == 200 and headers["content-type"].startswith("application/xml")
    name = {"o": "http://www.opengis.net/ows/1.1", "w": "http://www.opengis.net/wmts/1.0"}
    layers = ElementTree.fromstring(text).findall("w:Contents/w:Layer/o:Identifier", name)
    assert [one.text for one in layers] == ["ortho", "dsm", "contours", "coverage"]
    address = f"WMTS:{client.base}{TILES}/wmts.xml,layer=ortho"
    lat, lon, _ = FRAME.to_geodetic(np.array([[*ROOF, 0.0]]))[0]
    with rasterio.open(address) as map_:
        assert map_.crs.to_epsg() == 3857
        row, col = map_.index(*TO_MERCATOR.transform(lon, lat))
        window = rasterio.windows.Window(col - 1, row - 1, 3, 3)
        shown = map_.read(window=window)[:, 1, 1]
    assert np.abs(shown[:3].astype(int) - ROOF_BGR[::-1]).max() < 12 and shown[3] == 255


@pytest.mark.parametrize(
    "path",
    [
        f"{TILES}/ortho/18/-1/0.png",
        f"{TILES}/ortho/2/4/0.png",
        f"{TILES}/ortho/99/0/0.png",
        f"{TILES}/ortho/0/{'9' * 5000}/0.png",
        f"{TILES}/secret/1/0/0.png",
        f"{TILES}/secret.json",
        "/tiles/drone-1/none/ortho/1/0/0.png",
        "/tiles/drone-1/none/wmts.xml",
        "/tiles/..%2f/test-1/ortho.json",
        "/tiles/basemap.json",
        "/tiles/basemap/0/0/0",
    ],
)
def test_other_tiles_are_refused(client: Client, path: str) -> None:
    assert 400 <= client.ask(path)[0] < 500


def test_a_deleted_scan_can_be_deleted_while_its_map_is_open(client: Client) -> None:
    assert at(client, "ortho", ROOF)[3] == 255
    assert client.ask(ONE, "DELETE")[0] == 200
    assert client.ask(f"{TILES}/ortho.json")[0] == 404


def test_a_long_scan_is_read_in_turns(tmp_path: Path, house: HouseFlight) -> None:
    folder = flown_store(tmp_path, house) / "drone-1/test-1"
    with ScanStore.open(folder / "scan.db") as scan:
        found = LiveMap(scan)
        for read in range(1, 8):
            found.refresh(read_s=-1.0)
            assert found.version == min(read, 5)


def test_a_map_gets_the_fine_layer_that_the_receiver_stores_later(
    tmp_path: Path, house: HouseFlight
) -> None:
    folder = tmp_path / "scan"
    maps = OpenScans(LiveMap, min_age_s=0.0, max_scans=3)
    with house.flown(folder) as receiver:
        one = house.keyframe(9, 30.0)
        coarse, fine = encode(one, one.time_ns)
        receiver.add_keyframe(9, [coarse])
        assert maps.view(folder).version == 6
        receiver.add_keyframe(9, [fine])
        assert maps.view(folder).version == 7
    maps.close()


def test_what_has_no_surface_any_more_has_no_part_in_the_exposure(
    tmp_path: Path, house: HouseFlight
) -> None:
    white = house.keyframe(9, 30.0)
    white = replace(white, bgr=np.full_like(white.bgr, 255))
    unknown = np.full_like(white.depth.depth_m, np.nan)
    bare = replace(white, depth=replace(white.depth, depth_m=unknown))
    with house.flown(tmp_path / "scan") as scan:
        found = LiveMap(scan)
        found.refresh(read_s=math.inf)
        before = found.exposure
        scan.add_keyframe(9, encode(white, white.time_ns)[:1])
        found.refresh(read_s=math.inf)
        assert found.exposure == 1.0 < before
        scan.add_keyframe(9, encode(bare, bare.time_ns)[1:])
        found.refresh(read_s=math.inf)
        assert found.version == 7 and found.exposure == before


def enu(n: int) -> F64:
    return np.random.default_rng(n).uniform((-500, -500, -40), (500, 500, 60), (200, 3))


def test_places_on_the_map_are_those_of_proj() -> None:
    points = enu(1)
    geodetic = FRAME.to_geodetic(points)
    x, y = TO_MERCATOR.transform(geodetic[:, 1], geodetic[:, 0])
    want = np.column_stack([x / HALF_M + 1.0, 1.0 - y / HALF_M]) / 2.0
    exact = mercator(geodetic[:, 0], geodetic[:, 1])
    assert np.abs(exact - want).max() * 2.0 * HALF_M < 1e-6
    found = on_map(FRAME, points)
    assert np.abs(found[:, :2] - want).max() * 2.0 * HALF_M < 0.1  # over a kilometre
    assert np.abs(found[:, 2] - geodetic[:, 2]).max() < 0.05
    assert degrees(*want[7]) == pytest.approx(geodetic[7, :2], abs=1e-9)


def test_contours_lie_where_the_height_passes_a_multiple() -> None:
    ramp = np.tile(np.linspace(0.05, 9.95, 100, dtype=np.float32), (50, 1))
    ramp[:5] = np.nan
    columns = np.flatnonzero(contour_mask(ramp, 1.0)[20])
    assert np.allclose(ramp[20, columns], np.arange(1, 10) - 0.05, atol=0.06)
    assert not contour_mask(ramp, 1.0)[:4].any()
    assert not contour_mask(np.zeros((9, 9), np.float32), 1.0).any()


@pytest.mark.parametrize(("cell_m", "want"), [(0.1, 0.5), (0.2, 1.0), (0.4, 2.0), (1.6, 10.0)])
def test_intervals_of_contours_are_round(cell_m: float, want: float) -> None:
    assert interval_m(cell_m) == pytest.approx(want)
    assert pixel_m(0, 60.0) == pytest.approx(math.pi * 6378137.0 / 256)


@pytest.fixture
def adrift(tmp_path: Path, house: HouseFlight) -> Iterator[Client]:
    root = tmp_path / "scans"
    with house.flown(root / "drone-1/test-1", georeferenced=False):
        pass
    with serving(root) as client:
        yield client


@pytest.mark.parametrize("layer", ["ortho", "coverage"])
def test_without_a_place_there_is_no_map(adrift: Client, layer: str) -> None:
    for path in (f"{layer}/1/0/0.png", "thumbnail.png"):
        status, answer, _ = adrift.ask(f"{TILES}/{path}")
        assert status == 404 and "georeference" in answer["error"]
