"""Polygons as a GeoPackage (OGC 12-128r18): an SQLite file with geometries in WKB."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

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


def write_polygons(
    path: Path, table: str, epsg: int, shapes: Sequence[Sequence[Sequence[F64]]],
    columns: Mapping[str, Sequence[float | str]],
) -> None:  # fmt: skip
    """Write multipolygons with their columns, real or text, as one layer.

    ``shapes[n]`` are polygons, each an outer ring and its holes, (N, 2) map metres, closed.
    """
    from pyproj import CRS

    kinds = {n: "TEXT" if v and isinstance(v[0], str) else "DOUBLE" for n, v in columns.items()}
    points = [p for shape in shapes for rings in shape for ring in rings for p in ring]
    box = [f(p[k] for p in points) if points else None for f in (min, max) for k in (0, 1)]
    with writing(path) as part:
        part.unlink(missing_ok=True)
        db = sqlite3.connect(part)
        try:
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
            db.execute(
                "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, "
                "max_x, max_y, srs_id) VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
                (table, table, *box, epsg),
            )
            db.execute(
                "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', 'MULTIPOLYGON', ?, 0, 0)",
                (table, epsg),
            )
            typed = "".join(f', "{n}" {kind}' for n, kind in kinds.items())
            db.execute(
                f'CREATE TABLE "{table}" (fid INTEGER PRIMARY KEY AUTOINCREMENT, '
                f"geom MULTIPOLYGON{typed})"
            )
            marks = ", ".join("?" * (1 + len(columns)))
            names = "".join(f', "{n}"' for n in columns)
            rows = [
                (_blob(shape, epsg), *(v[n] for v in columns.values()))
                for n, shape in enumerate(shapes)
            ]
            db.executemany(f'INSERT INTO "{table}" (geom{names}) VALUES ({marks})', rows)
            db.commit()
        finally:
            db.close()


def _blob(polygons: Sequence[Sequence[F64]], epsg: int) -> bytes:
    """The header without an envelope, then the multipolygon as little-endian WKB."""
    parts = [b"GP\x00\x01", struct.pack("<i", epsg), struct.pack("<BII", 1, 6, len(polygons))]
    for rings in polygons:
        parts.append(struct.pack("<BII", 1, 3, len(rings)))
        for ring in rings:
            parts.append(struct.pack("<I", len(ring)))
            parts.append(ring.astype("<f8").tobytes())
    return b"".join(parts)
