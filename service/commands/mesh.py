"""``skyrelief mesh``: the textured mesh of a scan."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer


def mesh(
    scan_dir: Annotated[Path, typer.Argument(help="scan folder (holds scan.db)")],
    method: Annotated[str, typer.Option("--method", help="auto, height or poisson")] = "auto",
    faces: Annotated[int, typer.Option("--faces", min=100, help="triangles at most")] = 400_000,
    voxel_m: Annotated[
        float | None, typer.Option("--voxel-m", help="fused voxel size; default: pixel on ground")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="file to write; default: mesh.glb in the folder")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object at the end")] = False,
) -> None:
    """Mesh and texture a scan into one binary glTF file."""
    from service.errors import InputError
    from service.exports.model import write_mesh
    from service.exports.view import ExportOptions, ScanView

    try:
        options = ExportOptions(
            voxel_m=voxel_m, progress=lambda text: print(f"mesh: {text}", file=sys.stderr)
        )
    except ValueError as error:
        raise InputError(f"mesh: {error}") from error
    path = out or scan_dir / "mesh.glb"
    with ScanView(scan_dir, voxel_m) as scan:
        figures = write_mesh(scan, path, method, faces, options)
    if as_json:
        print(json.dumps({"file": str(path)} | figures))
    else:
        print(f"{path}: {figures['faces']} triangles, {figures['method']}")
