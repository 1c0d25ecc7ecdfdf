"""Polygons, lines and points as a GeoPackage (OGC 12-128r18): SQLite with geometries in WKB."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from recon.types import F64
from service.scans.writing import writing

APPLICATION_ID, VERSION = 0x47504B47, 10300  # "GPKG", 1.3

SCHEMA = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL,
  definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL,
  m TINYINT NOT NULL, PRIMARY KEY (table_name, column_name),
  FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
"""


Columns = Mapping[str, Sequence[float | str]]
"""Values of each shape by name, real or text."""


Shape = F64 | Sequence[Sequence[F64]]
"""Of a POINT (1, 2) map metres, of a LINESTRING (N, 3) map metres and heights, of a MULTIPOLYGON
its polygons, each an outer ring and its holes, (N, 2) map metres, closed."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Shapes, all of one kind, and their columns."""

    table: str
    kind: Literal["POINT", "LINESTRING", "MULTIPOLYGON"]
    shapes: Sequence[Shape]
    columns: Columns


def write_layers(path: Path, epsg: int, layers: Sequence[Layer]) -> None:
    from pyproj import CRS

    with writing(path) as part, closing(sqlite3.connect(part)) as db:
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {VERSION}")
        db.executescript(SCHEMA)
        system = CRS.from_epsg(epsg)
        known = [
            ("Undefined Cartesian", -1, "NONE", -1, "undefined", None),
            ("Undefined geographic", 0, "NONE", 0, "undefined", None),
            ("WGS 84", 4326, "EPSG", 4326, CRS.from_epsg(4326).to_wkt("WKT1_GDAL"), None),
            (system.name, epsg, "EPSG", epsg, system.to_wkt("WKT1_GDAL"), None),
        ]
        db.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", known)
        for layer in layers:
            _put(db, epsg, layer)
        db.commit()


def _put(db: sqlite3.Connection, epsg: int, layer: Layer) -> None:
    table, kind, columns = layer.table, layer.kind, layer.columns
    kinds = {n: "TEXT" if v and isinstance(v[0], str) else "DOUBLE" for n, v in columns.items()}
    ends = np.concatenate([*(p[:, :2] for s in layer.shapes for p in _parts(s)), np.zeros((0, 2))])
    ends = ends if len(ends) else np.full((1, 2), np.nan)  # SQLite: NULL
    box = (*ends.min(axis=0).tolist(), *ends.max(axis=0).tolist())
    db.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, "
        "max_x, max_y, srs_id) VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
        (table, table, *box, epsg),
    )
    db.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, ?, 0)",
        (table, kind, epsg, kind == "LINESTRING"),
    )
    typed = "".join(f', "{n}" {of}' for n, of in kinds.items())
    db.execute(
        f'CREATE TABLE "{table}" (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {kind}{typed})'
    )
    marks = ", ".join("?" * (1 + len(columns)))
    names = "".join(f', "{n}"' for n in columns)
    head = b"GP\x00\x01" + struct.pack("<i", epsg)
    shapes = (head + _wkb(kind, shape) for shape in layer.shapes)
    rows = zip(shapes, *columns.values(), strict=True)
    db.executemany(f'INSERT INTO "{table}" (geom{names}) VALUES ({marks})', rows)


def _parts(shape: Shape) -> list[F64]:
    return [shape] if isinstance(shape, np.ndarray) else [ring for rings in shape for ring in rings]


def _wkb(kind: str, shape: Shape) -> bytes:
    """Little-endian WKB."""
    if isinstance(shape, np.ndarray):
        of, count = (1, b"") if kind == "POINT" else (1002, struct.pack("<I", len(shape)))
        return struct.pack("<BI", 1, of) + count + shape.astype("<f8").tobytes()
    parts = [struct.pack("<BII", 1, 6, len(shape))]
    for rings in shape:
        parts.append(struct.pack("<BII", 1, 3, len(rings)))
        parts += [struct.pack("<I", len(ring)) + ring.astype("<f8").tobytes() for ring in rings]
    return b"".join(parts)
