"""The coverage layer against brute force, and its files and endpoint."""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from recon import se3
from recon.surface import coverage
from recon.surface.coverage import CoverageMap
from recon.types import F64, DepthMap
from service.errors import InputError
from service.georeference import LocalFrame
from service.ground.portal import Portal, PortalConfig
from service.ground.state import OpenScans
from service.offline.exports.view import ExportOptions, ScanView, export
from service.scans.coverage import (
    FIGURES,
    IMAGE,
    LiveCoverage,
    coverage_of,
    covering,
)
from service.scans.folder import write_deliverables
from service.stream.codec import encode
from service.stream.records import Repose

if TYPE_CHECKING:
    from house_flight import HouseFlight

DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""A camera that looks straight down, the top of its image to the north."""

SIZE = (48, 80)


def looking_down(
    x: float, y: float, height_m: float = 40.0, yaw: float = 0.0, holes: int = 0
) -> DepthMap:
    """Level ground at z = 0 seen from above, with some pixels unknown."""
    h, w = SIZE
    K = np.array([[60.0, 0.0, (w - 1) / 2], [0.0, 60.0, (h - 1) / 2], [0.0, 0.0, 1.0]])
    R = se3.so3_exp(np.array([0.0, 0.0, yaw])) @ DOWN
    T = se3.compose(R, np.array([x, y, height_m]))
    depth = np.full(SIZE, height_m, np.float32)
    rng = np.random.default_rng(holes)
    sigma = rng.uniform(0.05, 0.5, SIZE).astype(np.float32)
    if holes:
        depth[rng.random(SIZE) < 0.2] = np.nan
        sigma[np.isnan(depth)] = np.nan
    return DepthMap(depth, sigma, np.ones(SIZE, np.uint8), K, T)


def points(depth: DepthMap) -> F64:
    """(N, 3) points, written out pixel by pixel."""
    out = []
    K, T = depth.K, depth.T_world_camera
    for v in range(SIZE[0]):
        for u in range(SIZE[1]):
            d = float(depth.depth_m[v, u])
            if np.isfinite(d):
                ray = np.array([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0])
                out.append([*(T[:3, :3] @ (d * ray) + T[:3, 3]), float(depth.sigma_m[v, u])])
    return np.array(out)


def best_sigma(depths: list[DepthMap], cell_m: float) -> dict[tuple[int, int], float]:
    """Least sigma by cell (east, north), over all points of all keyframes."""
    out: dict[tuple[int, int], float] = {}
    for depth in depths:
        for x, y, _, s in points(depth):
            key = (int(np.floor(x / cell_m)), int(np.floor(y / cell_m)))
            out[key] = min(out.get(key, np.inf), s)
    return out


def filled(depths: list[DepthMap], cell_m: float = 2.0) -> CoverageMap:
    layer = CoverageMap(cell_m)
    for seq, depth in enumerate(depths):
        layer.put(seq, seq * 10**9, depth)
    return layer


def as_cells(layer: CoverageMap) -> dict[tuple[int, int], float]:
    found = layer.grid()
    assert found is not None
    rows, cols = np.nonzero(found.known)
    west = round(found.grid.west_m / found.grid.cell_m)
    north = round(found.grid.north_m / found.grid.cell_m)
    return {
        (west + int(c), north - 1 - int(r)): float(found.sigma_m[r, c])
        for r, c in zip(rows, cols, strict=True)
    }


def test_best_sigma_per_cell_is_that_of_brute_force() -> None:
    depths = [looking_down(7.0 * k - 200.0, 3.0 * k, yaw=0.3 * k, holes=k + 1) for k in range(4)]
    expected = best_sigma(depths, 2.0)
    found = as_cells(filled(depths))
    assert found.keys() == expected.keys()
    assert found == pytest.approx(expected, rel=1e-5)


def test_views_count_the_images_that_cover_a_cell() -> None:
    depths = [looking_down(8.0 * k, 0.0, yaw=0.4 * k) for k in range(5)]
    found = filled(depths, 1.0).grid()
    assert found is not None
    rows, cols = np.nonzero(found.views >= 0)
    x = found.grid.west_m + cols + 0.5
    y = found.grid.north_m - rows - 0.5
    expected = np.zeros(len(x))
    sure = np.ones(len(x), bool)
    for depth in depths:
        local = se3.transform(
            se3.inverse(depth.T_world_camera), np.column_stack([x, y, np.zeros(len(x))])
        )
        u = depth.K[0, 0] * local[:, 0] / local[:, 2] + depth.K[0, 2]
        v = depth.K[1, 1] * local[:, 1] / local[:, 2] + depth.K[1, 2]
        inside = np.stack([u + 0.5, SIZE[1] - 0.5 - u, v + 0.5, SIZE[0] - 0.5 - v]).min(axis=0)
        expected += inside > 0
        sure &= np.abs(inside) > 1.5  # a pixel and a half is one cell: edges may go either way
    assert np.array_equal(found.views[rows, cols][sure], expected[sure])
    assert found.views.max() == 5


def test_a_moved_keyframe_leaves_what_a_fresh_map_has() -> None:
    before = [looking_down(9.0 * k, 0.0, holes=k + 1) for k in range(6)]
    after = [*before]
    after[2] = looking_down(60.0, 45.0, yaw=0.5, holes=3)
    layer = filled(before)
    layer.put(2, 2 * 10**9, after[2])
    again = layer.stale()
    assert 2 in again
    layer.refill((seq, after[seq]) for seq in again)
    assert layer.stale() == []
    fresh, moved = filled(after).grid(), layer.grid()
    assert fresh is not None and moved is not None
    assert moved.grid == fresh.grid
    assert np.array_equal(moved.views, fresh.views)
    for name in ("sigma_m", "height_m", "seen_s"):
        a, b = getattr(moved, name), getattr(fresh, name)
        assert np.allclose(a, b, rtol=1e-4, atol=1e-4, equal_nan=True), name


def test_a_tiny_correction_costs_nothing() -> None:
    layer = filled([looking_down(0.0, 0.0), looking_down(10.0, 0.0)])
    layer.put(1, 10**9, looking_down(10.01, 0.0))
    assert layer.stale() == []


def test_a_gap_between_two_lines_is_inside_and_the_border_is_not() -> None:
    lines = [looking_down(10.0 * k, y) for y in (0.0, 80.0) for k in range(12)]
    found = filled(lines, 1.0).grid()
    assert found is not None
    gap = found.gaps
    col, row = np.rint(found.grid.pixels(np.array([[55.0, 40.0]]))[0]).astype(int)
    assert gap[row, col]
    width = gap[:, col].sum()  # between the images: 80 m less an image's height of 32 m
    assert abs(width - (80 - SIZE[0] / 60 * 40)) <= 2
    assert not found.weak(1, 10.0)[0].any() and not found.weak(1, 10.0)[:, 0].any()


def test_memory_follows_the_area_and_not_the_number_of_keyframes() -> None:
    layer = CoverageMap(1.0)
    depth = looking_down(0.0, 0.0)
    for seq in range(300):
        layer.put(seq, seq, depth)
    assert layer.tiles <= 4
    found = layer.grid()
    assert found is not None and found.views.max() == 300


def test_a_keyframe_gone_astray_does_not_ask_for_a_grid_to_the_moon() -> None:
    layer = CoverageMap(0.5)
    for k in range(5):
        layer.put(k, k, looking_down(10.0 * k, 0.0))
    whole = layer.grid()
    for k, far_m in enumerate((5e4, -3e6, 4e8)):
        layer.put(10 + k, 10 + k, looking_down(far_m, 0.3 * far_m))
    cut = layer.grid()
    assert whole is not None and cut is not None
    assert cut.grid == whole.grid
    np.testing.assert_array_equal(cut.height_m, whole.height_m)


def test_an_empty_keyframe_and_a_bad_cell_are_refused() -> None:
    empty = looking_down(0.0, 0.0)
    nothing = np.full(SIZE, np.nan, np.float32)
    layer = CoverageMap(1.0)
    layer.put(0, 0, DepthMap(nothing, nothing, empty.views, empty.K, empty.T_world_camera))
    assert layer.grid() is None and 0 not in layer
    with pytest.raises(ValueError, match="cell_m"):
        CoverageMap(0.0)


def test_the_usual_cell_follows_the_ground_sample() -> None:
    assert coverage.usual_cell_m(looking_down(0, 0, 40.0)) == pytest.approx(2.0)
    assert coverage.usual_cell_m(looking_down(0, 0, 4.0)) == pytest.approx(0.2)


def test_the_layer_of_a_scan_has_the_house_in_its_heights(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path) as store:
        found = coverage_of(store)
    assert found is not None
    layer = found.layer
    spots = np.array([[10.0, 2.0], [10.0, -8.0]])
    (c1, r1), (c2, r2) = np.rint(layer.grid.pixels(spots)).astype(int)
    assert layer.height_m[r1, c1] == pytest.approx(6.0, abs=0.05)
    assert layer.height_m[r2, c2] == pytest.approx(0.0, abs=0.05)
    assert layer.sigma_m[r1, c1] == pytest.approx(0.05, rel=0.2)
    assert layer.views[r2, c2] == 5
    row, col = np.nonzero(layer.gaps)  # only what the roof hides next to the house
    north = layer.grid.north_m - (row + 0.5) * layer.grid.cell_m
    east = layer.grid.west_m + (col + 0.5) * layer.grid.cell_m
    assert (np.abs(np.abs(north - 2.0) - 4.6) < 1.0).all() and (np.abs(east - 10.0) < 7.5).all()


def test_a_live_layer_follows_new_keyframes_and_corrections(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path) as store:
        live = LiveCoverage(store)
        first = live.refresh()
        one = house.keyframe(5, 70.0)
        store.add_keyframe(5, encode(one, one.time_ns))
        store.add_reposes([Repose(1, 1, house.pose(5.0 + 30.0), 1.0, np.eye(6))])
        second, fresh = live.refresh(), coverage_of(store)
    assert first is not None and second is not None and fresh is not None
    assert second.figures() == fresh.figures()
    assert second.layer.grid.bounds[2] > first.layer.grid.bounds[2] + 30.0
    assert np.array_equal(second.layer.views, fresh.layer.views)


def test_a_fine_layer_that_comes_later_is_taken_in(tmp_path: Path, house: HouseFlight) -> None:
    one = house.keyframe(5, 70.0)
    layers = encode(one, one.time_ns)
    assert len(layers) == 2
    with house.flown(tmp_path) as store:
        store.add_keyframe(5, layers[:1])
        live = LiveCoverage(store)
        live.refresh()
        store.add_keyframe(5, layers[1:])
        late, fresh = live.refresh(), coverage_of(store)
    assert late is not None and fresh is not None
    assert late.figures() == fresh.figures()


def test_image_figures_and_geotiff(tmp_path: Path, house: HouseFlight) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    with house.flown(tmp_path) as store:
        write_deliverables(tmp_path, store)
        found = coverage_of(store)
    assert found is not None
    image = cv2.imread(str(tmp_path / IMAGE), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.shape == (*found.layer.grid.shape, 4)
    assert np.array_equal(image[..., 3] > 0, found.layer.known | found.layer.inside)
    said = json.loads((tmp_path / FIGURES).read_text())
    assert said["keyframes"] == 5 and len(said["corners_lat_lon"]) == 4
    assert json.loads((tmp_path / "scan.json").read_text())["coverage"] == said
    with ScanView(tmp_path) as scan:
        path = export(scan, "coverage", None, ExportOptions())
    frame = LocalFrame(*house.origin)
    with rasterio.open(path) as raster:
        assert raster.crs.to_epsg() == frame.epsg
        assert raster.descriptions == ("views", "sigma, m", "height, m")
        east, north, _ = frame.to_utm(np.array([[10.5, 2.5, 0.0]]))[0]
        views, sigma, height = next(raster.sample([(east, north)]))
    assert height == pytest.approx(house.origin[2] + 6.0, abs=0.1)
    assert views == 5 and 0.03 < sigma < 0.08


def test_without_a_surface_there_is_no_layer(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path / "one") as store:
        header = store.header
    from service.stream.store import ScanStore

    with ScanStore.create(tmp_path / "two" / "scan.db", header) as empty:
        assert coverage_of(empty) is None
        summary = write_deliverables(tmp_path / "two", empty)
    assert summary["coverage"] is None and not (tmp_path / "two" / IMAGE).exists()
    with pytest.raises(InputError, match="nothing to export"), ScanView(tmp_path / "two") as scan:
        export(scan, "coverage", None, ExportOptions())


def test_the_portal_shows_the_layer(tmp_path: Path, house: HouseFlight) -> None:
    house.flown(tmp_path / "drone-1" / "test-1").close()
    portal = Portal(PortalConfig(tmp_path, port=0, token="a-token-of-enough-letters"))
    portal.start()
    base = portal.url.split("/?")[0] + "/api/scans/drone-1/"
    try:
        with urllib.request.urlopen(base + "test-1/coverage.png", timeout=10) as answer:
            assert answer.read()[:8] == b"\x89PNG\r\n\x1a\n"
        with urllib.request.urlopen(base + "test-1/coverage.json", timeout=10) as answer:
            assert json.loads(answer.read())["keyframes"] == 5
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(base + "none/coverage.png", timeout=10)
    finally:
        portal.close()


def test_a_growing_scan_has_its_layer_written_next_to_it(
    tmp_path: Path, house: HouseFlight
) -> None:
    def figures() -> dict[str, Any]:
        path = tmp_path / FIGURES
        return dict(json.loads(path.read_text())) if path.exists() else {}

    def wait(keyframes: int) -> None:
        for _ in range(200):
            if figures().get("keyframes") == keyframes:
                return
            time.sleep(0.05)
        raise AssertionError(f"never {keyframes} keyframes: {figures()}")

    with house.flown(tmp_path) as store, covering(store, every_s=0.05):
        wait(5)
        one = house.keyframe(5, 30.0)
        store.add_keyframe(5, encode(one, one.time_ns))
        wait(6)
    assert cv2.imread(str(tmp_path / IMAGE)) is not None


def test_few_layers_are_kept_and_rarely_made_again(tmp_path: Path, house: HouseFlight) -> None:
    folders = [tmp_path / str(n) for n in range(3)]
    for folder in folders:
        house.flown(folder).close()
    kept = OpenScans(LiveCoverage, min_age_s=1000.0, max_scans=2)
    first = kept.view(folders[0])
    assert kept.view(folders[0]) is first
    for folder in folders[1:]:
        kept.view(folder)
    assert kept.view(folders[0]) is not first
    kept.close()
