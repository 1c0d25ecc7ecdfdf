"""Basemaps that an operator gives: MBTiles and PMTiles, written here after their specifications."""

from __future__ import annotations

import gzip
import sqlite3
import struct
from contextlib import closing, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from basemaps import TILES, Tiles, mbtiles
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from portal_client import TOKEN, Client

from recon.types import U8
from service.errors import InputError
from service.ground.basemap import open_basemap, tile_number, tile_of, tile_px
from service.ground.portal import Portal, PortalConfig


def decoded(data: bytes) -> U8:
    """(256, 256, channels) of a PNG."""
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), np.uint8)


def along(z: int, d: int) -> tuple[int, int]:
    """Column and row of the ``d``-th tile of a zoom: the curve of the specification, forwards."""
    x = y = 0
    s = 1
    while s < 1 << z:
        rx = 1 & (d // 2)
        ry = 1 & (d ^ rx)
        if ry == 0:
            if rx == 1:
                x, y = s - 1 - x, s - 1 - y
            x, y = y, x
        x, y, d, s = x + s * rx, y + s * ry, d // 4, 2 * s
    return x, y


def number(z: int, x: int, y: int) -> int:
    """A tile's number by looking for it."""
    first = sum(1 << 2 * k for k in range(z))
    return first + next(d for d in range(4**z) if along(z, d) == (x, y))


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def directory(entries: list[tuple[int, int, int, int]]) -> bytes:
    """Of (first tile, run, bytes, offset)."""
    steps = np.diff([0, *(e[0] for e in entries)]).tolist()
    offsets, end = [], -1
    for _, _, size, offset in entries:
        offsets.append(0 if offset == end else offset + 1)
        end = offset + size
    columns = [steps, [e[1] for e in entries], [e[2] for e in entries], offsets]
    body = b"".join(varint(int(v)) for column in columns for v in column)
    return varint(len(entries)) + body


def pmtiles(path: Path, tiles: Tiles, packed: bool = True, leaves: bool = False,
            kind: int = 2) -> Path:  # fmt: skip
    numbers = sorted((number(*tile), data) for tile, data in tiles.items())
    entries, blob = [], b""
    for n, data in numbers:
        entries.append((n, 1, len(data), len(blob)))
        blob += data
    pack = gzip.compress if packed else bytes
    leaf_bytes = b""
    if leaves:
        root_entries = []
        for part in (entries[:6], entries[6:]):
            leaf = pack(directory(part))
            root_entries.append((part[0][0], 0, len(leaf), len(leaf_bytes)))
            leaf_bytes += leaf
        root = pack(directory(root_entries))
    else:
        root = pack(directory(entries))
    n = len(entries)
    at = 127
    places = [at, len(root), at + len(root), 0, at + len(root), len(leaf_bytes),
              at + len(root) + len(leaf_bytes), len(blob), n, n, n]  # fmt: skip
    head = struct.pack("<7sB11Q", b"PMTiles", 3, *places)
    head += bytes([1, 2 if packed else 1, 1, kind, 0, 2])
    head += struct.pack("<4iB2i", *[0] * 7)
    assert len(head) == 127
    path.write_bytes(head + root + leaf_bytes + blob)
    return path


KINDS = ["mbtiles", "pmtiles", "plain", "leaves"]


def given_as(kind: str, folder: Path) -> Path:
    if kind == "mbtiles":
        return mbtiles(folder / "a.mbtiles", TILES)
    return pmtiles(folder / "a.pmtiles", TILES, kind != "plain", kind == "leaves")


@pytest.mark.parametrize("kind", KINDS)
def test_every_tile_is_found_at_its_place(tmp_path: Path, kind: str) -> None:
    found = open_basemap(given_as(kind, tmp_path))
    assert (found.max_zoom, found.media_type) == (2, "image/png")
    for (z, x, y), data in TILES.items():
        assert found.tile(z, x, y) == data, (z, x, y)
    assert found.tile(2, 3, 3) is None and found.tile(3, 0, 0) is None


def test_the_curve_is_that_of_the_specification() -> None:
    assert [tile_number(*t) for t in [(0, 0, 0), (1, 0, 0), (1, 0, 1), (1, 1, 1), (1, 1, 0)]] == [
        0, 1, 2, 3, 4,
    ]  # fmt: skip
    assert tile_number(12, 3423, 1763) == 19078479


@given(st.integers(0, 5), st.data())
def test_the_curve_backwards(z: int, data: st.DataObject) -> None:
    x, y = (data.draw(st.integers(0, (1 << z) - 1)) for _ in range(2))
    assert tile_number(z, x, y) == number(z, x, y)


def test_what_cannot_be_used_is_said_in_one_line(tmp_path: Path) -> None:
    broken = tmp_path / "b.pmtiles"
    broken.write_bytes(b"PMTiles\x03" + b"\0" * 200)
    text = tmp_path / "b.mbtiles"
    text.write_text("no database")
    for path, why in [
        (tmp_path / "a.tif", "name it .mbtiles or .pmtiles"),
        (tmp_path / "none.pmtiles", "no such file"),
        (broken, "cannot be read"),
        (text, "cannot be read"),
        (mbtiles(tmp_path / "v.mbtiles", TILES, "pbf"), "images are needed"),
        (pmtiles(tmp_path / "v.pmtiles", TILES, kind=1), "are not images"),
    ]:
        with pytest.raises(InputError, match=why):
            open_basemap(path)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(KINDS[1:]), st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255))),
       st.integers(0, 400))  # fmt: skip
def test_damaged_pmtiles_give_an_error_or_a_tile(
    tmp_path: Path, kind: str, changes: list[tuple[int, int]], cut: int
) -> None:
    """Whatever header and directories claim, a request ends, with bytes of the file at most."""
    data = bytearray(given_as(kind, tmp_path).read_bytes())
    for at, value in changes:
        data[at] = value
    path = tmp_path / "damaged.pmtiles"
    path.write_bytes(bytes(data[: len(data) - cut]))
    with suppress(InputError):
        found = open_basemap(path)
        for z, x, y in TILES:
            tile = tile_of(found, z, x, y)
            assert tile is None or len(tile) <= len(data)


def test_a_directory_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    bomb = gzip.compress(bytes(4 << 20))
    path = pmtiles(tmp_path / "bomb.pmtiles", TILES)
    data = bytearray(path.read_bytes())
    struct.pack_into("<2Q", data, 8, len(data), len(bomb))
    path.write_bytes(bytes(data) + bomb)
    with pytest.raises(InputError, match="too large"):
        open_basemap(path)


def test_mbtiles_that_are_no_images_or_never_end_are_refused(tmp_path: Path) -> None:
    path = mbtiles(tmp_path / "a.mbtiles", {})
    with closing(sqlite3.connect(path)) as base:
        base.execute("INSERT INTO tiles VALUES (0, 0, 0, 1000000000000)")
        base.commit()
    with pytest.raises(InputError, match="damaged"):
        tile_of(open_basemap(path), 0, 0, 0)
    with closing(sqlite3.connect(path)) as base:
        base.execute("INSERT INTO tiles VALUES (1000000000, 0, 0, 0)")
        base.commit()
    with pytest.raises(InputError, match="zooms"):
        open_basemap(path)
    with closing(sqlite3.connect(path)) as base:
        base.execute("DROP TABLE tiles")
        endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i FROM n"
        columns = "i AS zoom_level, 0 AS tile_column, 0 AS tile_row, 0 AS tile_data"
        base.execute(f"CREATE VIEW tiles AS SELECT {columns} FROM ({endless})")
        base.commit()
    with pytest.raises(InputError, match="interrupted"):
        open_basemap(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_the_size_of_a_tile_is_read_before_it_is_decoded(suffix: str) -> None:
    shown = np.random.default_rng(0).integers(0, 255, (48, 96, 3), np.uint8)
    for quality in ([], [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []):
        assert tile_px(cv2.imencode(suffix, shown, quality)[1].tobytes()) == (96, 48)
    large = bytearray(cv2.imencode(".png", shown)[1].tobytes())
    struct.pack_into(">II", large, 16, 1 << 20, 1 << 10)
    for data in (bytes(large), b"", b"RIFF", b"text"):
        with pytest.raises(ValueError, match="not an image of a tile's size"):
            tile_px(data)


@pytest.mark.parametrize("kind", ["mbtiles", "leaves"])
def test_the_portal_serves_it_also_below_its_finest_zoom(tmp_path: Path, kind: str) -> None:
    (tmp_path / "scans").mkdir()
    config = PortalConfig(tmp_path / "scans", port=0, token=TOKEN, basemap=given_as(kind, tmp_path))
    portal = Portal(config)
    portal.start()
    try:
        client = Client(portal)
        document = client.ask("/tiles/basemap.json")[1]
        assert document["maxzoom"] == 2
        assert document["tiles"] == [f"{client.base}/tiles/basemap/{{z}}/{{x}}/{{y}}"]
        status, data, headers = client.ask("/tiles/basemap/2/1/2")
        assert (status, data, headers["content-type"]) == (200, TILES[2, 1, 2], "image/png")
        for x, halves in ((8, 2), (15, 1)):  # at zoom 5 each is an eighth of tile 2/1
            data = client.ask(f"/tiles/basemap/5/{x}/16")[1]
            shown = decoded(data)
            want = np.array((90, 70, 130)) // halves
            assert np.abs(shown[128, 128, :3].astype(int) - want).max() <= 1
        assert client.ask("/tiles/basemap/99999999999/0/0")[0] == 404
        status, data, _ = client.ask("/tiles/basemap/2/3/3")
        assert status == 200 and not decoded(data)[..., 3].any()
    finally:
        portal.close()
