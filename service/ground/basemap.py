"""A basemap that the operator gives: raster tiles of an MBTiles or a PMTiles (version 3) file.

MBTiles 1.3 is a SQLite database with rows counted from the south. PMTiles orders tiles along a
Hilbert curve; directories of runs give their bytes. The file may be untrusted: its claims are
checked before memory or time is spent on it.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from contextlib import closing
from functools import lru_cache
from pathlib import Path

from service.errors import InputError
from service.stream.planes import image_size

MEDIA = {"png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg", "webp": "image/webp"}
PM_MEDIA = {2: "image/png", 3: "image/jpeg", 4: "image/webp"}
PM_PLAIN, PM_GZIP = 1, 2
PM_HEADER = struct.Struct("<7sB11Q6B4iB2i")
MAX_DIRECTORY_BYTES, MAX_TILE_BYTES = 1 << 20, 1 << 23
MAX_DIRECTORIES, DEEPEST_DIRECTORY = 16, 4
MAX_ZOOM = 30
MAX_SIDE_PX = 4096
MAX_STEPS = 20_000_000  # instructions of SQLite for one question; an index needs some hundred
FAULTS = (sqlite3.Error, OSError, ValueError, struct.error, zlib.error)


def open_basemap(path: Path) -> Basemap:
    """The basemap in ``path``. Raises InputError, in one line, when it cannot be used."""
    kinds: dict[str, type[Basemap]] = {".mbtiles": MBTiles, ".pmtiles": PMTiles}
    if path.suffix.lower() not in kinds:
        raise InputError(f"basemap {path}: name it .mbtiles or .pmtiles")
    if not path.is_file():
        raise InputError(f"basemap {path}: no such file")
    try:
        return kinds[path.suffix.lower()](path)
    except FAULTS as error:
        raise InputError(f"basemap {path} cannot be read ({error})") from error


def tile_of(basemap: Basemap, zoom: int, x: int, y: int) -> bytes | None:
    """The image of a tile, rows counted from the north; None where there is none. Raises
    InputError where the file is damaged."""
    try:
        return basemap.tile(zoom, x, y)
    except FAULTS as error:
        raise InputError(f"the basemap is damaged ({error})") from error


def tile_px(data: bytes) -> tuple[int, int]:
    """(width, height) in the header of a PNG, JPEG or WebP image; ValueError for any other."""
    kind = data[12:16]
    if data[:8] == b"\x89PNG\r\n\x1a\n" and kind == b"IHDR":
        w, h = struct.unpack_from(">II", data, 16)
    elif data[:4] == b"RIFF" and kind == b"VP8X":
        w, h = (1 + int.from_bytes(data[at : at + 3], "little") for at in (24, 27))
    elif data[:4] == b"RIFF" and kind == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        w, h = 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    elif data[:4] == b"RIFF" and kind == b"VP8 ":
        w, h = (int.from_bytes(data[at : at + 2], "little") & 0x3FFF for at in (26, 28))
    else:
        w, h = image_size(data) or (0, 0)
    if not (0 < w <= MAX_SIDE_PX and 0 < h <= MAX_SIDE_PX):
        raise ValueError("a tile is not an image of a tile's size")
    return w, h


class MBTiles:
    def __init__(self, path: Path) -> None:
        self._uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        with closing(self._open()) as database:
            about = dict(database.execute("SELECT name, value FROM metadata"))
            zooms = database.execute("SELECT MIN(zoom_level), MAX(zoom_level) FROM tiles")
            low, high = zooms.fetchone()
        if high is not None and not 0 <= int(low) <= int(high) <= MAX_ZOOM:
            raise ValueError(f"its zooms are {low} to {high}")
        if about.get("format") not in MEDIA or high is None:
            raise ValueError(f"its format is {about.get('format')}; images are needed")
        self.media_type, self.max_zoom = MEDIA[about["format"]], int(high)
        self.about = {"minzoom": int(low), "maxzoom": self.max_zoom, "name": path.stem}

    def _open(self) -> sqlite3.Connection:
        database = sqlite3.connect(self._uri, uri=True)
        database.set_progress_handler(lambda: 1, MAX_STEPS)  # tiles may be an endless view
        return database

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        sql = (
            "SELECT tile_data FROM tiles WHERE zoom_level=? AND tile_column=? AND tile_row=?"
            " AND LENGTH(tile_data) <= ?"
        )
        with closing(self._open()) as database:
            at = zoom, x, (1 << zoom) - 1 - y
            row = database.execute(sql, (*at, MAX_TILE_BYTES)).fetchone()
        if row is not None and not isinstance(row[0], bytes):
            raise ValueError("a tile is not an image")
        return None if row is None else row[0]


class PMTiles:
    def __init__(self, path: Path) -> None:
        self._path, self._size = path, path.stat().st_size
        head = PM_HEADER.unpack(self._read(0, PM_HEADER.size))
        if head[:2] != (b"PMTiles", 3):
            raise ValueError("it is not PMTiles version 3")
        root, root_bytes, _, _, self._leaves, _, self._data = head[2:9]
        self._packing, packing, kind, low, self.max_zoom = head[14:19]
        if not low <= self.max_zoom <= MAX_ZOOM:
            raise ValueError(f"its zooms are {low} to {self.max_zoom}")
        if kind not in PM_MEDIA or packing not in (0, PM_PLAIN):
            raise ValueError("its tiles are not images")
        if self._packing not in (PM_PLAIN, PM_GZIP):
            raise ValueError("its directories are neither plain nor packed by gzip")
        self.media_type = PM_MEDIA[kind]
        self.about = {"minzoom": low, "maxzoom": self.max_zoom, "name": path.stem}
        self._directory = lru_cache(maxsize=MAX_DIRECTORIES)(self._directory_at)
        self._root = root, root_bytes
        self._directory(*self._root)

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        wanted, where = tile_number(zoom, x, y), self._root
        for _ in range(DEEPEST_DIRECTORY):
            entries = self._directory(*where)
            found = next((e for e in reversed(entries) if e[0] <= wanted), None)
            if found is None:
                return None
            first, run, length, offset = found
            if run:
                inside = wanted < first + run
                if length > MAX_TILE_BYTES:
                    raise ValueError("a tile is too large")
                return self._read(self._data + offset, length) if inside else None
            where = self._leaves + offset, length
        return None

    def _read(self, offset: int, length: int) -> bytes:
        if offset + length > self._size:
            raise ValueError("it is cut short")
        with open(self._path, "rb") as file:
            file.seek(offset)
            return file.read(length)

    def _directory_at(self, offset: int, length: int) -> list[tuple[int, int, int, int]]:
        """(first tile, run, bytes, offset) of each entry; a run of 0 is another directory."""
        if length > MAX_DIRECTORY_BYTES:
            raise ValueError("a directory is too large")
        data = self._read(offset, length)
        if self._packing == PM_GZIP:
            unpacker = zlib.decompressobj(wbits=31)
            data = unpacker.decompress(data, MAX_DIRECTORY_BYTES)
            if not unpacker.eof:
                raise ValueError("a directory is too large, or cut short")
        n, *rest = _varints(data) or [0]
        if len(rest) < 4 * n:
            raise ValueError("a directory is cut short")
        columns = [rest[k * n : (k + 1) * n] for k in range(4)]
        out: list[tuple[int, int, int, int]] = []
        first = at = 0
        for step, run, size, place in zip(*columns, strict=True):
            first += step
            at = place - 1 if place else at  # 0: directly after the entry before
            out.append((first, run, size, at))
            at += size
        return out


def _varints(data: bytes) -> list[int]:
    """Numbers of 7 bits a byte, the lowest first; ValueError for more than 64 bits."""
    out: list[int] = []
    value = shift = 0
    for byte in data:
        if shift > 63:
            raise ValueError("a directory holds a number of more than 64 bits")
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            out.append(value)
            value = shift = 0
    return out


def tile_number(zoom: int, x: int, y: int) -> int:
    """A tile's place on the Hilbert curve, after all tiles of coarser zooms."""
    number: int = (4**zoom - 1) // 3
    side = 1 << zoom
    half = side // 2
    while half:
        rx, ry = int(x & half > 0), int(y & half > 0)
        number += half * half * ((3 * rx) ^ ry)
        if not ry:
            if rx:
                x, y = side - 1 - x, side - 1 - y
            x, y = y, x
        half //= 2
    return number


Basemap = MBTiles | PMTiles
