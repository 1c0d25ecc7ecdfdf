"""Surface models of a scan with a house, where keyframes decide what holes may hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy import ndimage

from recon.surface.raster import Raster, rasterise_points
from recon.types import F64, U8, Array, Bool
from service.offline.exports.surface import UNCERTAIN, cell_places, complete_model
from service.offline.exports.view import ScanView
from service.stream.codec import encode
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

EYES_M = (-5.0, 0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
CELL_M = 0.25


def flown(folder: Path, house: HouseFlight, change: Callable[[F64, Array], Array]) -> Path:
    """A scan without a place. ``change`` takes where each pixel's ray is at the roof's height,
    east, and its depth."""
    header = ScanHeader("test-1", "drone-1", house.start_ns, camera={"fx": 140.0}, software="0.0")
    with ScanStore.create(folder / "scan.db", header) as store:
        for seq, east_m in enumerate(EYES_M):
            view = house.keyframe(seq, east_m)
            a = (np.arange(view.fresh.shape[1]) - house.K[0, 2]) / house.K[0, 0]
            depth = change(east_m + a * (house.height_m - 6.0), view.depth.depth_m.copy())
            view = replace(view, depth=replace(view.depth, depth_m=depth))
            store.add_keyframe(seq, encode(view, view.time_ns))
    return folder


def model(
    folder: Path, house: HouseFlight, change: Callable[[F64, Array], Array]
) -> tuple[Raster, U8, F64]:
    """The model of such a scan, what it rests on, and (rows, cols, 3) places of its cells."""
    with ScanView(flown(folder, house, change)) as scan:
        found, origin = complete_model(scan, CELL_M)
        return found, origin, cell_places(scan, found.grid, found.height_m)


def on_roof(places: F64, margin_m: float) -> Bool:
    """Cells inside the walls by at least the margin."""
    x, y = np.abs(places[..., 0] - 10.0), np.abs(places[..., 1] - 2.0)
    return np.asarray((x < 6.0 - margin_m) & (y < 4.0 - margin_m))


def test_no_ground_is_filled_in_below_what_hides_the_air(
    tmp_path: Path, house: HouseFlight
) -> None:
    """The roof's last 1.5 m in the east have no depth in any image."""

    def change(x: F64, depth: Array) -> Array:
        depth[(depth < house.height_m - 3.0) & (x > 14.5)] = np.nan
        return depth

    found, _, places = model(tmp_path, house, change)
    inside = on_roof(places, 0.75) & found.known
    assert (found.height_m[inside] > 5.0).all() and inside.sum() > 400


def test_doubtful_edges_of_a_roof_that_keyframes_confirm_are_marked(
    tmp_path: Path, house: HouseFlight
) -> None:
    found, origin, places = model(tmp_path, house, lambda x, depth: depth)
    edge = on_roof(places, 0.5) & ~on_roof(places, 1.0) & found.known
    assert (origin[edge] == UNCERTAIN).sum() > 0.2 * edge.sum()
    assert (np.abs(found.height_m[edge] - 6.0) < 0.3).all()


def test_gaps_of_two_cells_between_level_ones_count_as_measured_with_twice_the_sigma(
    tmp_path: Path, house: HouseFlight
) -> None:
    with ScanView(flown(tmp_path, house, lambda x, depth: depth)) as scan:
        cloud, found = scan.fused.cloud, scan.raster(CELL_M)
        points = rasterise_points(scan.xyz_m, cloud.rgb, cloud.sigma_m, scan.grid(CELL_M))
    more = found.known & ~points.known
    assert more.sum() > 50
    height_m = found.height_m[more]  # of the ground or the roof, nothing in between
    assert (np.minimum(np.abs(height_m), np.abs(height_m - 6.0)) < 0.2).all()
    usual_m = np.median(points.sigma_m[points.known])
    assert np.median(found.sigma_m[more]) == pytest.approx(2.0 * usual_m, rel=0.2)
    wide = ndimage.distance_transform_edt(~points.known) > 2.0
    assert wide.any() and not found.known[wide].any()
