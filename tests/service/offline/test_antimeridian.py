"""Products of a scan that lies across 180 degrees of longitude (RFC 7946, 3.1.9 and 5.2)."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from house_flight import HillsideFlight

from service.georeference import cut_at_180
from service.offline.exports.view import ExportOptions, ScanView, export

NAME = "barn & <b>field"
KINDS = ("kmz", "ortho", "contours", "geojson", "stac")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight over a hillside, whose origin lies 8 m west of 180 degrees."""
    pytest.importorskip("rasterio", exc_type=ImportError)
    folder = tmp_path_factory.mktemp("dateline")
    moved = HillsideFlight()
    moved.origin = (-16.83, 179.999925, 408.0)
    with moved.flown(folder) as store:
        store.update_header(scan_id=NAME)
    with ScanView(folder) as scan:
        options = ExportOptions(contour_m=1.0, cell_m=0.5, stored=True)
        for kind in KINDS:
            export(scan, kind, None, options)
    return folder


def test_the_overlay_lies_across_180_degrees(exported: Path) -> None:
    with zipfile.ZipFile(exported / "ortho.kmz") as file:
        box = ElementTree.fromstring(file.read("doc.kml"))
    space = "{http://www.opengis.net/kml/2.2}"
    assert next(box.iter(space + "name")).text == NAME
    west, east = (float(next(box.iter(space + side)).text or "") for side in ("west", "east"))
    assert 179.999 < west < 180.0 < east < 180.001


def test_the_stac_item_has_its_west_above_its_east(exported: Path) -> None:
    item = json.loads((exported / "stac.json").read_text())
    west, south, east, north = item["bbox"]
    assert 179.999 < west < 180.0 and -180.0 < east < -179.999 and south < north
    assert item["geometry"]["type"] == "MultiPolygon"
    sides = [np.array(rings[0])[:, 0] for rings in item["geometry"]["coordinates"]]
    assert [(s.min(), s.max()) for s in sides] == [(west, 180.0), (-180.0, east)]


@pytest.mark.parametrize("name", ["flight.geojson", "contours.geojson"])
def test_lines_are_cut(exported: Path, name: str) -> None:
    features = json.loads((exported / name).read_text())["features"]
    shapes = [f["geometry"] for f in features if f["geometry"]["type"] != "Point"]
    cut = [s for s in shapes if s["type"] == "MultiLineString"]
    assert cut
    for shape in shapes:
        parts = shape["coordinates"] if shape in cut else [shape["coordinates"]]
        for part in parts:
            assert np.ptp(np.array(part)[:, 0]) < 0.001


def test_a_line_is_cut_where_it_crosses() -> None:
    line = np.array([[179.0, 0.0, 5.0], [-179.0, 2.0, 7.0], [-178.0, 2.0, 7.0], [179.5, 2.0, 7.0]])
    one, two, three = cut_at_180(line)
    np.testing.assert_allclose(one, [[179.0, 0.0, 5.0], [180.0, 1.0, 6.0]])
    np.testing.assert_allclose(two[[0, 1, 2]], [[-180.0, 1.0, 6.0], [-179.0, 2.0, 7.0], line[2]])
    np.testing.assert_allclose(two[3], [-180.0, 2.0, 7.0])
    np.testing.assert_allclose(three, [[180.0, 2.0, 7.0], [179.5, 2.0, 7.0]])
    (same,) = cut_at_180(line[1:3])
    np.testing.assert_array_equal(same, line[1:3])
