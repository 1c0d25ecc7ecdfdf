"""The benchmark of sites: many scans in tiles, drones at once, boxes counted against truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bench_site
import bench_site_drones
import bench_site_scale
import numpy as np
import pytest
from bench_options import DataOptions

from service.bench import BenchResult
from service.sim.recording import ORIGIN

rasterio = pytest.importorskip("rasterio")


def test_a_site_of_scans_is_measured_by_its_products() -> None:
    results = bench_site_scale.run(DataOptions(scans=4), ("dsm", "change"), ())
    figures = {result.what: result for result in results}
    peak = figures["dsm: peak memory"]
    assert peak.note == "4 scans, 2 tiles" and 100 < peak.value < 2000
    assert figures["change: processor time of a tile, median"].value > 0.0
    assert 0.0 < figures["dsm: error of height, median"].value < bench_site_scale.SIGMA_M
    boxes = figures["change: objects"]
    assert boxes.note == "12 boxes placed" and 6 <= boxes.value <= 12


def test_drones_at_once_are_shown_together_and_keep_their_size(tmp_path: Path) -> None:
    figures = {result.what: result for result in bench_site_drones.run(tmp_path, 8.0, (0.0, 90.0))}
    assert figures["four drones: shown together, after the first overlap"].note.startswith("1 of 1")
    apart = figures["four drones: shown apart at the end"]
    assert apart.peer_value is not None and apart.value < 0.3 < 1.0 < apart.peer_value
    assert abs(figures["four drones: site too small by"].value) < 1.0
    assert figures["four drones: middles apart in the site"].note.startswith("one site, 1 pairs")


BOXES = [((0.0, 0.0), 2), ((10.0, 0.0), 1), ((0.0, 12.0), 2), ((-45.0, 0.0), 2)]
"""Middle and date; the last is outside the map."""


def counted(folder: Path, objects: list[tuple[float, float, float]]) -> dict[str, BenchResult]:
    """The figures for these objects: m east and north of the truth's origin, and volume."""
    (folder / "truth").mkdir()
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    boxes = [
        {"outline_m": (square + middle).tolist(), "volume_m3": 4.0, "date": date}
        for middle, date in BOXES
    ]
    (folder / "truth" / "changes.json").write_text(json.dumps(boxes))
    east, north = ORIGIN.to_utm(np.zeros((1, 3)))[0, :2]
    profile: dict[str, Any] = {
        "driver": "GTiff", "height": 160, "width": 160, "count": 1, "dtype": "float32",
        "nodata": -9999.0,
        "transform": rasterio.transform.from_origin(east - 40.0, north + 40.0, 0.5, 0.5),
    }  # fmt: skip
    with rasterio.open(folder / "change.tif", "w", **profile) as image:
        image.write(np.zeros((1, 160, 160), np.float32))
    rows = [{"east_m": east + x, "north_m": north + y, "volume_m3": v} for x, y, v in objects]
    change = {"objects": rows, "compared_m2": 5000.0}
    results = bench_site.change_results(change, folder, folder / "change.tif", np.zeros(3))
    return {result.what: result for result in results}


def test_boxes_count_by_place_and_sign(tmp_path: Path) -> None:
    objects = [(0.4, 0.3, 4.4), (10.0, 0.2, 3.0), (25.0, 25.0, 1.0)]  # right, wrong sign, nothing
    found = counted(tmp_path, objects)
    assert found["boxes found"].value == pytest.approx(100.0 / 3.0)
    assert found["boxes found"].note.startswith("of 3")
    assert found["false objects"].value == pytest.approx(2.0)  # one on half a hectare
    assert found["volume of the boxes found, error"].value == pytest.approx(10.0)
