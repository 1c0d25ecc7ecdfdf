"""The textured mesh as 3D Tiles 1.1: a glTF for each tile of the mesh, placed on the globe."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from recon.types import F64
from service.georeference import LocalFrame
from service.offline.exports.flight import writing_folder
from service.offline.exports.model import default_mesh, glb, mesh_extras, mesh_parts
from service.offline.exports.view import ExportOptions, ScanView

SPAN_M = 1000.0


def write_mesh_tiles(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A folder with ``tileset.json`` and a glTF for each tile; heights are AMSL metres."""
    frame = scan.needs_place("3D Tiles")
    parts, _ = mesh_parts(scan, default_mesh(options), options)
    children = []
    with writing_folder(out) as folder:
        for number, part in enumerate(parts):
            name = f"{number}.glb"
            data = glb([(part.mesh, part.image)], mesh_extras(scan))
            (folder / name).write_bytes(data)
            box = _box(part.mesh.vertices_m)
            children.append(_tile(box, 0.0) | {"content": {"uri": name}})
        whole = _box(np.concatenate([part.mesh.vertices_m for part in parts]))
        size_m = float(np.linalg.norm(np.array(whole[3:]).reshape(3, 3).sum(axis=0)))
        transform = on_globe(frame).T.ravel().tolist()  # column by column
        root = _tile(whole, size_m) | {"transform": transform, "children": children}
        tileset = {"asset": {"version": "1.1"}, "geometricError": 2.0 * size_m, "root": root}
        (folder / "tileset.json").write_text(json.dumps(tileset, indent=1), encoding="utf-8")


def _tile(box: list[float], error_m: float) -> dict[str, Any]:
    return {"boundingVolume": {"box": box}, "geometricError": error_m, "refine": "ADD"}


def _box(vertices_m: F64) -> list[float]:
    """Middle and the three half axes of the box around (N, 3) vertices."""
    low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
    half = np.maximum(0.5 * (high - low), 1e-3)
    return [float(v) for v in (*(0.5 * (low + high)), *np.diag(half).ravel())]


def on_globe(frame: LocalFrame) -> F64:
    """(4, 4) ENU metres to earth-centred metres, with AMSL heights taken as ellipsoidal."""
    from pyproj import Transformer

    geodetic = frame.to_geodetic(np.vstack([np.zeros(3), SPAN_M * np.eye(3)]))
    to_centre = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    placed = np.column_stack(to_centre.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]))
    out = np.eye(4)
    out[:3, :3] = (placed[1:] - placed[0]).T / SPAN_M
    out[:3, 3] = placed[0]
    return out
