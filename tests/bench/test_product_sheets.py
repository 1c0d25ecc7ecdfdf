"""The sheets of products: where roof edges lie, and that each image shows the same ground."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from product_sheets import Page, edges, for_documents, frame_on_plane, from_above, window

from recon.surface.raster import Grid
from recon.types import F32
from service.offline.exports.rasters import NODATA_M

GRID = Grid(500_000.0, 5_000_100.0, 0.25, (200, 200))


def house() -> F32:
    """(200, 200) heights: level ground, and a roof of 10 m by 20 m whose middle is the grid's."""
    height = np.full(GRID.shape, 400.0, np.float32)
    height[80:120, 60:140] = 405.0
    return height


def test_edges_are_the_four_sides_of_the_roof() -> None:
    found = edges(house(), GRID)
    assert len(found) == 4 and all(height == 405.0 for _, height in found)
    off = np.array([place for place, _ in found]) - [500_025.0, 5_000_075.0]
    assert sorted(np.abs(np.round(off)).tolist()) == [[0, 5], [0, 5], [10, 0], [10, 0]]


def test_a_window_shows_orthophoto_heights_and_contours_of_its_ground(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    from pyproj import Transformer

    place = rasterio.transform.from_origin(GRID.west_m, GRID.north_m, GRID.cell_m, GRID.cell_m)
    how = {"driver": "GTiff", "height": 200, "width": 200, "crs": "EPSG:32632", "transform": place}
    height = house()
    height[:50] = NODATA_M
    with rasterio.open(tmp_path / "dsm.tif", "w", count=1, dtype="float32", **how) as file:
        file.write(height, 1)
    roof = (height == 405.0).astype(np.uint8) * 200
    with rasterio.open(tmp_path / "ortho.tif", "w", count=4, dtype="uint8", **how) as file:
        file.write(np.stack([roof, roof * 0, roof * 0, roof]))
    to_degrees = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    line = to_degrees.transform([500_015.0, 500_035.0], [5_000_075.0, 5_000_075.0])
    shape = {"type": "LineString", "coordinates": np.transpose(line).tolist()}
    (tmp_path / "contours.geojson").write_text(json.dumps({"features": [{"geometry": shape}]}))
    grid = window(np.array([500_025.0, 5_000_075.0]), 0.125, 200)
    images = from_above(tmp_path, grid, np.array([400.0, 405.0]))
    red = images["ortho"][..., 2] == 200
    rows, cols = np.nonzero(red)
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (60, 139, 20, 179)
    assert not images["ortho"][..., :2].any()
    assert (images["contours"][99:101, 40:160, 1] > 100).any(axis=0).all()
    assert images["dsm"].shape == (200, 200, 3) and (images["dsm"][0, 0] != 128).any()


def test_a_page_holds_the_images_of_its_rows(tmp_path: Path) -> None:
    page = Page(tmp_path / "out")
    page.row({"now": np.zeros((4, 4, 3), np.uint8), "truth": np.ones((4, 4, 3), np.uint8)})
    text = "".join(page.parts)
    names = [p.name for p in (tmp_path / "out").iterdir()]
    assert len(names) == 2 and all(name in text for name in names)


def test_without_a_frame_that_holds_an_edge_the_row_says_so() -> None:
    assert list(frame_on_plane(None, [], GRID, 405.0)) == ["not in one frame"]


@pytest.mark.parametrize("count", [1, 3, 4])
def test_the_documents_image_shows_each_roof_edge_once(count: int) -> None:
    rows = [np.full((10, 30, 3), 50 + n, np.uint8) for n in range(count)]
    image = for_documents([np.full((20, 20, 3), 9, np.uint8)], rows)
    for n in range(count):
        assert (image == 50 + n).all(axis=2).sum() == 300
    assert (image == 9).all(axis=2).sum() == 400
