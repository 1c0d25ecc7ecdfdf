"""Values that no record may hold, byte by byte from docs/wire.md; grids cannot be inflated."""

from __future__ import annotations

import json
import math
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from house_flight import HouseFlight

from recon import se3
from recon.surface.coverage import CoverageMap, usual_cell_m
from recon.surface.raster import grid_over
from recon.types import F64, DepthMap
from service.errors import InputError
from service.stream import codec
from service.stream.records import (
    Repose,
    ScanHeader,
    header_from_json,
    pack_pose,
    pack_repose,
    unpack_motion,
    unpack_pose,
    unpack_repose,
)
from service.stream.store import ScanStore
from service.stream.validity import MAX_SLOPE, is_pinhole, summary_from_json

HEADER: dict[str, Any] = {"scan_id": "s", "drone": "d", "started_unix_ns": 1}


def sealed_layer(data: bytes, at: int, kind: str, *values: float) -> bytes:
    """``data`` with fields overwritten and its checksum made right again (wire.md 1.1)."""
    out = bytearray(data)
    struct.pack_into(f"<{kind}", out, at, *values)
    struct.pack_into("<I", out, 218, zlib.crc32(bytes(out[:218] + out[222:])))
    return bytes(out)


def sealed(data: bytes, at: int, kind: str, *values: float) -> bytes:
    """The same for a pose or re-pose, whose checksum is at the end (wire.md 2)."""
    out = bytearray(data)
    struct.pack_into(f"<{kind}", out, at, *values)
    struct.pack_into("<I", out, len(out) - 4, zlib.crc32(bytes(out[:-4])))
    return bytes(out)


@pytest.fixture(scope="module")
def fine(house: HouseFlight) -> bytes:
    return codec.encode(house.keyframe(0, 0.0), 1)[-1]


@pytest.mark.parametrize(
    ("at", "kind", "values"),
    [
        (42, "2f", (0.002, 0.002)),  # focal lengths
        (42, "2f", (0.5, 0.5)),
        (42, "2f", (140.0, 20.0)),
        (42, "2f", (1e9, 1e9)),
        (50, "2f", (1e7, 44.5)),  # principal point
        (50, "2f", (79.5, math.nan)),
        (34, "f", (1e-30,)),  # inverse depth of code 0
        (34, "f", (-1.0,)),
        (38, "f", (math.inf,)),  # its step
        (58, "d", (1e8,)),  # position
        (58, "d", (math.nan,)),
        (82, "4d", (0.0, 0.0, 0.0, 0.0)),  # rotation
        (114, "f", (math.nan,)),  # covariance
        (12, "q", (-(2**63),)),  # time
        (12, "q", (2**63 - 1,)),
    ],
)
def test_a_layer_that_no_camera_made_is_dropped(
    fine: bytes, at: int, kind: str, values: tuple[float, ...]
) -> None:
    assert codec.peek(sealed_layer(fine, 58, "3d", 1.0, 2.0, 3.0)) is not None
    assert codec.peek(sealed_layer(fine, at, kind, *values)) is None


@pytest.mark.parametrize(
    ("at", "kind", "values"),
    [
        (4, "q", (2**63 - 1,)),  # time
        (16, "d", (-1e7,)),  # position
        (72, "f", (math.inf,)),  # covariance
        (156, "d", (1e308,)),  # latitude
        (164, "d", (-361.0,)),  # longitude
        (172, "d", (1e6,)),  # altitude
        (180, "f", (3e38,)),  # height above ground
        (196, "f", (math.nan,)),  # speed
        (208, "f", (math.inf,)),  # sigma
    ],
)
def test_a_pose_that_cannot_be_is_dropped(
    house: HouseFlight, at: int, kind: str, values: tuple[float, ...]
) -> None:
    good = pack_pose(house.record(0, 0.0))
    assert unpack_pose(sealed(good, 156, "2d", -90.0, 360.0)) is not None
    assert unpack_pose(sealed(good, 156, "d", math.nan)) is not None  # not known
    assert unpack_pose(sealed(good, at, kind, *values)) is None


@pytest.mark.parametrize(("at", "kind", "value"), [
    (152, "f", 1e5), (152, "f", 1e-5), (152, "f", -1.0), (152, "f", math.nan),
    (12, "d", 1e7), (68, "f", math.nan),
])  # fmt: skip
def test_a_repose_that_cannot_be_is_dropped(at: int, kind: str, value: float) -> None:
    good = pack_repose(Repose(0, 1, np.eye(4), 1.0, np.eye(6)))
    assert unpack_repose(sealed(good, 152, "f", 20.0)) is not None
    assert unpack_repose(sealed(good, at, kind, value)) is None


def test_a_repose_puts_no_surface_out_of_reach(house: HouseFlight) -> None:
    far = house.keyframe(0, 0.0)
    far.depth.depth_m[0, 0] = 5e4
    moved = Repose(0, 1, np.eye(4), 1000.0, np.eye(6)).applied_to(far)
    assert np.isnan(moved.depth.depth_m[0, 0])
    np.testing.assert_allclose(moved.depth.depth_m[0, 1], 1000.0 * far.depth.depth_m[0, 1])


@pytest.mark.parametrize(
    "more",
    [
        {"origin_lat_deg": 1e308},
        {"origin_lon_deg": -361},
        {"origin_alt_amsl_m": 1e9},
        {"started_unix_ns": -1},
        {"started_unix_ns": 10**40},
        {"started_unix_ns": 2**63 - 1},
        {"epsg": 10**30},
        {"scan_id": "a/b"},
        {"scan_id": "a\u0007"},
        {"scan_id": ""},
        {"drone": "d" * 200},
        {"camera": {"K": [0.002, 0, 1, 0, 0.002, 1, 0, 0, 1], "width": 640, "height": 480}},
        {"camera": {"K": [1, 2]}},
        {"camera": {"width": -5}},
        {"notes": "not a list"},
        {"notes": ["x"] * 20_000},
    ],
)
def test_a_header_that_cannot_be_is_refused(more: dict[str, Any]) -> None:
    assert header_from_json(json.dumps(HEADER).encode()) is not None
    assert header_from_json(json.dumps(HEADER | more).encode()) is None


@pytest.mark.parametrize(("edge", "outward"), [
    ((7.5 - 10.0 * MAX_SLOPE, 2.5), (-1.0, 0.0)),  # the last column is the furthest
    ((-0.5 + 10.0 * MAX_SLOPE, 2.5), (1.0, 0.0)),  # the first column
    ((3.5, 5.5 - 20.0 * MAX_SLOPE), (0.0, -1.0)),  # the last row
    ((3.5, -0.5 + 20.0 * MAX_SLOPE), (0.0, 1.0)),  # the first row
])  # fmt: skip
def test_no_edge_of_an_image_is_further_than_the_largest_slope(
    edge: tuple[float, float], outward: tuple[float, float]
) -> None:
    def fits(px: float) -> bool:
        cx, cy = np.add(edge, np.multiply(px, outward)).tolist()
        return is_pinhole((10.0, 20.0, cx, cy), (8, 6))

    assert fits(-0.1)
    assert not fits(0.1)


@pytest.mark.parametrize("text", [
    json.dumps(HEADER).encode("utf-16"), json.dumps(HEADER).encode("utf-8-sig"),
    b'{"scan_id":"s","drone":"d","started_unix_ns":1,"x":"\xff"}',
    b"[" * 100_000, b"",
])  # fmt: skip
def test_a_header_is_strict_utf_8(text: bytes) -> None:
    assert header_from_json(text) is None


@pytest.mark.parametrize("text", [
    '{"keyframes": 3}'.encode("utf-16"), b'{"x":"\xff"}', b"[1]", b"null", b'{"x":NaN}',
    b'{"x":' + b"[" * 100_000 + b"]" * 100_000 + b"}", b'{"keyframes": -1}',
    b'{"warnings": 3}', b'{"stage_ms": [1]}', b'{"graph": []}', b'{"distance_m": 1e999}',
    b'{"x":"' + b"a" * 2_000_000 + b'"}',
])  # fmt: skip
def test_a_summary_that_cannot_be_is_dropped_and_the_store_goes_on(
    tmp_path: Path, text: bytes
) -> None:
    assert summary_from_json(text) is None
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("s", "d", 1)) as store:
        assert not store.put_record("summary", zlib.crc32(text), text)
        good = b'{"keyframes": 3, "more": [1]}'
        assert store.put_record("summary", zlib.crc32(good), good)
        assert store.summary == {"keyframes": 3, "more": [1]}


def test_a_header_of_another_scan_does_not_replace_this_ones(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("s", "d", 1)) as store:
        for other in (ScanHeader("t", "d", 2), ScanHeader("s", "e", 2)):
            data = other.to_json()
            assert not store.put_record("header", zlib.crc32(data), data)
        data = ScanHeader("s", "d", 2).to_json()
        assert store.put_record("header", zlib.crc32(data), data)


def test_what_is_not_finite_in_our_own_summary_is_null(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("s", "d", 1)) as store:
        store.finish({"scale": {"sigma": math.nan}, "seconds": math.inf})
        assert store.summary == {"scale": {"sigma": None}, "seconds": None}


def test_an_opened_store_with_an_impossible_header_says_so(tmp_path: Path) -> None:
    import sqlite3

    path = tmp_path / "scan.db"
    ScanStore.create(path, ScanHeader("s", "d", 1)).close()
    with sqlite3.connect(path) as db:
        text = json.dumps(HEADER | {"origin_lat_deg": 1e308})
        db.execute("UPDATE meta SET value = ? WHERE key = 'header'", (text,))
    db.close()
    with pytest.raises(InputError, match="origin_lat_deg"):
        ScanStore.open(path)


def flat(K: F64, depth_m: float, T: F64, size: tuple[int, int] = (48, 64)) -> DepthMap:
    depth = np.full(size, depth_m, np.float32)
    views = np.full(size, 2, np.uint8)
    return DepthMap(depth, np.full(size, 0.05, np.float32), views, K, T)


def test_a_image_of_half_the_world_does_not_inflate_the_coverage_map() -> None:
    K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
    down = se3.compose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 40.0]))
    layer_map = CoverageMap(0.1)
    layer_map.put(0, 0, flat(K, 40.0, down))
    before = layer_map.grid()
    wide = K.copy()
    wide[0, 0] = wide[1, 1] = 0.6  # 89 degrees to either side
    layer_map.put(1, 1, flat(wide, 9e4, down))  # 10^16 cells of 0.1 m
    after = layer_map.grid()
    assert layer_map.refused
    assert before is not None and after is not None
    np.testing.assert_array_equal(after.known, before.known)
    layer_map.put(1, 1, flat(K, 40.0, down), finer=True)  # the true one replaces it
    layer_map.refill([(0, flat(K, 40.0, down)), (1, flat(K, 40.0, down))])
    both = layer_map.grid()
    assert both is not None and both.views.max() == 2


def test_cells_stay_between_a_millimetre_and_a_kilometre() -> None:
    K = np.array([[6e4, 0.0, 31.5], [0.0, 6e4, 23.5], [0.0, 0.0, 1.0]])
    assert usual_cell_m(flat(K, 1e-3, np.eye(4))) == 1e-3
    K[0, 0] = K[1, 1] = 0.6
    assert usual_cell_m(flat(K, 1e5, np.eye(4))) == 1e3


def test_a_few_stray_points_do_not_choose_the_size_of_a_grid() -> None:
    xy = np.array([[0.0, 0.0], [1e4, 1e4], [1.0, 1.0]])
    with pytest.raises(ValueError, match="too large"):
        grid_over(xy, 0.8)  # 156 million cells for three points
    assert grid_over(xy, 10.0).shape == (1001, 1001)
    for cell_m in (1e-320, 1e-300):
        with pytest.raises(ValueError, match="too large"):
            grid_over(xy, cell_m)


def test_a_huge_quaternion_is_none_without_a_word() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert unpack_motion([0.0, 0.0, 0.0, *[1e300] * 4]) is None
        assert unpack_motion([0.0, 0.0, 0.0, 1.0, math.nan, 0.0, 0.0]) is None
