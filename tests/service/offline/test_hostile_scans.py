"""Whole scans with records that no camera made: the rest of the scan is delivered."""

from __future__ import annotations

import json
import sqlite3
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from house_flight import HouseFlight

from recon.surface import coverage, raster
from recon.types import DepthMap, Keyframe, Pose
from service.errors import InputError
from service.offline.exports.view import ExportOptions, ScanView, export
from service.offline.refine.refinement import RefineOptions, refine
from service.scans.folder import CLOUD, CSV, PREVIEW, TUM, write_deliverables
from service.stream.codec import encode
from service.stream.records import Repose, pack_pose, pack_repose
from service.stream.store import ScanStore

pytestmark = pytest.mark.slow


def layer_with(data: bytes, at: int, kind: str, *values: float) -> bytes:
    """``data`` with fields overwritten and its checksum made right (wire.md 1.1)."""
    out = bytearray(data)
    struct.pack_into(f"<{kind}", out, at, *values)
    struct.pack_into("<I", out, 218, zlib.crc32(bytes(out[:218] + out[222:])))
    return bytes(out)


def record_with(data: bytes, at: int, kind: str, *values: float) -> bytes:
    """The same for poses and re-poses (wire.md 2)."""
    out = bytearray(data)
    struct.pack_into(f"<{kind}", out, at, *values)
    struct.pack_into("<I", out, len(out) - 4, zlib.crc32(bytes(out[:-4])))
    return bytes(out)


def test_impossible_records_in_a_store_change_no_file(tmp_path: Path, house: HouseFlight) -> None:
    """They are written past every check, straight into the tables."""
    for name in ("honest", "hostile"):
        house.flown(tmp_path / name).close()
    chunks, poses, reposes = [], [], []
    layers = encode(house.keyframe(7, 3.0), 1)
    for seq, (at, kind, values) in enumerate(
        [
            (42, "2f", (0.002, 0.002)),
            (42, "2f", (0.5, 0.5)),
            (34, "f", (1e-30,)),
            (58, "3d", (1e300, 0.0, 0.0)),
            (50, "2f", (1e30, 1e30)),
            (12, "q", (-(2**63),)),
        ],
        start=10,
    ):
        for number, data in enumerate(layers):
            odd = layer_with(layer_with(data, 8, "I", seq), at, kind, *values)
            chunks.append((seq, number, 2, 1, zlib.crc32(odd), 1, odd))
    good = pack_pose(house.record(9, 1.0))
    for number, (at, kind, values) in enumerate(
        [(156, "d", (1e308,)), (16, "d", (1e200,)), (196, "f", (np.inf,)), (4, "q", (2**63 - 1,))],
        start=100,
    ):
        poses.append((number, number, record_with(good, at, kind, *values)))
    for number, scale in enumerate((1e30, 1e-30, -1.0, np.nan), start=100):
        better = pack_repose(Repose(number - 100, 99, house.pose(0.0), 1.0, np.eye(6)))
        reposes.append((number, number - 100, 99, record_with(better, 152, "f", scale)))
    db = sqlite3.connect(tmp_path / "hostile" / "scan.db")
    db.executemany("INSERT INTO chunks VALUES (?, ?, ?, ?, ?, ?, ?)", chunks)
    db.executemany("INSERT INTO poses VALUES (?, ?, ?)", poses)
    db.executemany("INSERT INTO reposes VALUES (?, ?, ?, ?)", reposes)
    db.commit()
    db.close()
    for name in ("honest", "hostile"):
        with ScanStore.open(tmp_path / name / "scan.db") as store:
            assert write_deliverables(tmp_path / name, store)["failed"] == {}
    for file in (CLOUD, TUM, CSV, PREVIEW, "coverage.png", "scan.json"):
        honest, hostile = (tmp_path / name / file for name in ("honest", "hostile"))
        assert honest.read_bytes() == hostile.read_bytes(), file


def strewn(store: ScanStore, house: HouseFlight) -> None:
    """Depths from two millimetres to ninety kilometres in one keyframe."""
    k, rng = house.keyframe(9, 3.0), np.random.default_rng(0)
    depth_m = np.exp(rng.uniform(np.log(2e-3), np.log(9e4), (90, 160))).astype(np.float32)
    d = k.depth
    depth = DepthMap(depth_m, d.sigma_m, d.views, d.K, d.T_world_camera)
    store.add_keyframe(9, encode(Keyframe(9, k.time_ns, depth, k.bgr, k.pose, k.fresh), 1))


def wide(store: ScanStore, house: HouseFlight) -> None:
    """The widest lens that is let through."""
    layers = encode(house.keyframe(9, 3.0), 1)
    assert store.add_keyframe(9, [layer_with(data, 42, "2f", 1.5, 1.5) for data in layers]) == 2


def far(store: ScanStore, house: HouseFlight) -> None:
    """A keyframe at the edge of what is in reach, and a pose there."""
    store.add_keyframe(9, encode(house.keyframe(9, 9.9e5), 1))
    store.add_pose(house.record(9, 9.9e5))


def odd_words(store: ScanStore, house: HouseFlight) -> None:
    """A configuration and a summary of other types than ours."""
    store.update_header(
        configuration={"scan": {"resolution_m": 10**400}, "fusion": 5, "camera": [1]},
        camera={"K": house.K.ravel().tolist(), "distortion": [1e300] * 5},
        notes=("<script>&]]>", "x" * 60_000),
    )
    store.finish({"graph": {"left_out": [1], "keyframes": "x"}, "scale": {"from": 5}})


def at_the_pole(store: ScanStore, house: HouseFlight) -> None:
    """Where longitude means nothing."""
    store.update_header(origin_lat_deg=-90.0, origin_lon_deg=-360.0, origin_alt_amsl_m=-1e5)


@pytest.mark.parametrize("change", [strewn, wide, far, odd_words, at_the_pole])
@pytest.mark.slow
def test_extreme_records_within_bounds_give_files_or_one_line(
    tmp_path: Path,
    house: HouseFlight,
    change: Callable[[ScanStore, HouseFlight], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The largest grids are a tenth of what they may be: they take most of the time."""
    monkeypatch.setattr(coverage, "MAX_CELLS", coverage.MAX_CELLS // 10)
    monkeypatch.setattr(raster, "MIN_CELLS", raster.MIN_CELLS // 10)
    with house.flown(tmp_path) as store:
        change(store, house)
        summary = write_deliverables(tmp_path, store)
    assert summary["failed"] == {} and summary["counts"]["points"] > 0
    json.loads((tmp_path / "scan.json").read_text(), parse_constant=pytest.fail)
    for kind in ("dsm", "contours", "mcap", "geojson", "coverage"):
        try:
            with ScanView(tmp_path) as scan:
                export(scan, kind, None, ExportOptions())
        except InputError as error:
            assert "\n" not in str(error)


def test_poses_far_apart_are_adjusted_and_stay(tmp_path: Path, house: HouseFlight) -> None:
    """Two keyframes a million metres above and below the others."""
    with house.flown(tmp_path) as store:
        for seq, up_m in ((9, 9e5), (10, -9e5)):
            k = house.keyframe(seq, 1.0)
            T = k.depth.T_world_camera.copy()
            T[2, 3] = up_m
            d = k.depth
            depth = DepthMap(d.depth_m, d.sigma_m, d.views, d.K, T)
            pose = Pose(T, np.eye(6))
            store.add_keyframe(
                seq, encode(Keyframe(seq, k.time_ns, depth, k.bgr, pose, k.fresh), 1)
            )
        store.finish({})
    found = refine(tmp_path, RefineOptions(None, None, None, True))
    assert found["keyframes"] == 7 and found["scale"] == pytest.approx(1.0)
    assert found["moved_m"]["most"] < 0.01
