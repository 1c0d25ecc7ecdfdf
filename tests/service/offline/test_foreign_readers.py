"""Files of lines and overlays as GDAL reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from house_flight import HillsideFlight

from service.offline.exports.view import ExportOptions, ScanView, export

EPSG = "EPSG:32632"


@pytest.fixture(scope="module")
def hillside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of ground that rises from 408 to 412 m."""
    folder = tmp_path_factory.mktemp("hillside")
    flight = HillsideFlight()
    flight.origin = (*flight.origin[:2], 410.2)
    flight.flown(folder).close()
    return folder


def written(folder: Path, kind: str) -> Path:
    with ScanView(folder) as scan:
        return export(scan, kind, None, ExportOptions(cell_m=0.25))


def features(scan_dir: Path, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The only layer as GDAL reads it, and its columns."""
    pyogrio = pytest.importorskip("pyogrio")
    path = written(scan_dir, kind)
    facts = pyogrio.read_info(path, force_total_bounds=True)
    meta, _, _, columns = pyogrio.raw.read(path)
    return facts, dict(zip(meta["fields"], columns, strict=True))


@pytest.mark.parametrize(("kind", "system"), [("contours", "EPSG:4979"), ("gpkg", EPSG)])
def test_gdal_reads_contours(hillside: Path, kind: str, system: str) -> None:
    facts, columns = features(hillside, kind)
    assert facts["crs"] == system and facts["geometry_type"] == "LineString Z"
    assert set(columns["height_amsl_m"]) == {409.0, 410.0, 411.0}
    is_index = columns["index" if kind == "contours" else "is_index"].astype(bool)
    assert set(columns["label"][is_index]) == {"410"} and not any(columns["label"][~is_index])


def test_gdal_reads_the_same_lines_as_dxf(hillside: Path) -> None:
    gpkg, _ = features(hillside, "gpkg")
    dxf, columns = features(hillside, "dxf")
    labels = columns["Layer"] == "CONTOUR_LABELS"
    assert set(columns["Layer"]) == {"CONTOUR", "CONTOUR_INDEX", "CONTOUR_LABELS"}
    assert set(columns["Text"][labels]) == {"410"} and (~labels).sum() == gpkg["features"]
    np.testing.assert_allclose(dxf["total_bounds"], gpkg["total_bounds"], atol=0.001)


@pytest.mark.parametrize("kind", ["geojson", "kml"])
def test_gdal_reads_the_flight(hillside: Path, kind: str) -> None:
    facts, columns = features(hillside, kind)
    lat, lon, _ = HillsideFlight().origin
    west, south, east, north = facts["total_bounds"]
    assert facts["crs"] == "EPSG:4326"
    assert south <= lat + 1e-6 and lat - 1e-6 <= north and north - south < 1e-4
    assert west == pytest.approx(lon, abs=1e-6)
    assert (east - west) * 111_320 * np.cos(np.radians(lat)) == pytest.approx(20.0, abs=0.2)
    if kind == "geojson":
        assert np.isfinite(columns["keyframe"].astype(float)).sum() == 5


def test_gdal_places_the_overlay_over_the_orthophoto(hillside: Path) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    from rasterio.warp import transform_bounds

    with rasterio.open(written(hillside, "ortho")) as image:
        should = transform_bounds(image.crs, "EPSG:4326", *image.bounds)
    with rasterio.open(written(hillside, "kmz")) as overlay:
        assert overlay.crs == "EPSG:4326"
        np.testing.assert_allclose(overlay.bounds, should, atol=2e-6)
        assert overlay.read().any()
