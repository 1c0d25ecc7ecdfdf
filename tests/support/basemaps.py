"""Tiles of a basemap, and an MBTiles file of them."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np

Tiles = dict[tuple[int, int, int], bytes]


def image(z: int, x: int, y: int) -> bytes:
    """A PNG whose colour says which tile it is, its left half darker."""
    whole = np.full((256, 256, 3), (40 * z + 10, 60 * x + 10, 60 * y + 10), np.uint8)
    whole[:, :128] //= 2
    return bytes(cv2.imencode(".png", whole)[1].tobytes())


TILES: Tiles = {(z, x, y): image(z, x, y) for z in range(3) for x in range(1 << z)
                for y in range(1 << z) if (z, x, y) != (2, 3, 3)}  # fmt: skip


def mbtiles(path: Path, tiles: Tiles, kind: str = "png") -> Path:
    with closing(sqlite3.connect(path)) as base:
        base.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        base.execute("CREATE TABLE tiles (zoom_level, tile_column, tile_row, tile_data)")
        base.execute("INSERT INTO metadata VALUES ('format', ?)", (kind,))
        for (z, x, y), data in tiles.items():
            base.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (z, x, (1 << z) - 1 - y, data))
        base.commit()
    return path
