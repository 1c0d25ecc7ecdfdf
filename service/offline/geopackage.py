"""Polygons, lines and points as a GeoPackage (OGC 12-128r18): SQLite with geometries in WKB."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

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


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Shapes in WKB, all of one kind, their places in map metres, and their columns."""

    table: str
    kind: str
    shapes: Sequence[bytes]
    places: Sequence[F64]  # (N, 2) each
    columns: Columns
    with_heights: int = 0  # whether the shapes have them


def polygons(table: str, shapes: Sequence[Sequence[Sequence[F64]]], columns: Columns) -> Layer:
    """A layer of multipolygons.

    ``shapes[n]`` are polygons, each an outer ring and its holes, (N, 2) map metres, closed.
    """
    places = [ring for shape in shapes for rings in shape for ring in rings]
    return Layer(table, "MULTIPOLYGON", [_polygons(s) for s in shapes], places, columns)


def lines(table: str, shapes: Sequence[F64], columns: Columns) -> Layer:
    """A layer of lines, (N, 3) each: map metres and heights."""
    places = [line[:, :2] for line in shapes]
    return Layer(table, "LINESTRING", [_line(line) for line in shapes], places, columns, 1)


def points(table: str, places: F64, columns: Columns) -> Layer:
    """A layer of points, (N, 2) map metres."""
    wkb = [struct.pack("<BIdd", 1, 1, x, y) for x, y in places.tolist()]
    return Layer(table, "POINT", wkb, [places], columns)


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
    ends = np.concatenate([*layer.places, np.zeros((0, 2))])
    ends = ends if len(ends) else np.full((1, 2), np.nan)  # SQLite: NULL
    box = (*ends.min(axis=0).tolist(), *ends.max(axis=0).tolist())
    db.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, "
        "max_x, max_y, srs_id) VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
        (table, table, *box, epsg),
    )
    db.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, ?, 0)",
        (table, kind, epsg, layer.with_heights),
    )
    typed = "".join(f', "{n}" {of}' for n, of in kinds.items())
    db.execute(
        f'CREATE TABLE "{table}" (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {kind}{typed})'
    )
    marks = ", ".join("?" * (1 + len(columns)))
    names = "".join(f', "{n}"' for n in columns)
    rows = [
        (b"GP\x00\x01" + struct.pack("<i", epsg) + shape, *(v[n] for v in columns.values()))
        for n, shape in enumerate(layer.shapes)
    ]
    db.executemany(f'INSERT INTO "{table}" (geom{names}) VALUES ({marks})', rows)


def _polygons(polygons: Sequence[Sequence[F64]]) -> bytes:
    """A MultiPolygon as little-endian WKB."""
    parts = [struct.pack("<BII", 1, 6, len(polygons))]
    for rings in polygons:
        parts.append(struct.pack("<BII", 1, 3, len(rings)))
        parts += [struct.pack("<I", len(ring)) + ring.astype("<f8").tobytes() for ring in rings]
    return b"".join(parts)


def _line(line: F64) -> bytes:
    """A LineString Z as little-endian WKB."""
    return struct.pack("<BII", 1, 1002, len(line)) + np.asarray(line, "<f8").tobytes()
