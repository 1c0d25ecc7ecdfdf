"""``skyrelief mesh``: the textured mesh of a scan."""

from __future__ import annotations

import json
import sys
import time
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
    video: Annotated[
        Path | None,
        typer.Option(help="the flight's video or folder of pictures; default: as scan.json names"),
    ] = None,
    stored: Annotated[
        bool, typer.Option("--stored", help="texture from the scan's own small pictures")
    ] = False,
    video_epoch: Annotated[
        float | None, typer.Option(help="unix seconds of its start; default: the scan's start")
    ] = None,
    tile_points: Annotated[
        int, typer.Option(min=1000, help="points beyond which the site is cut into tiles")
    ] = 20_000_000,
    scheduler: Annotated[
        str | None, typer.Option(help="Dask scheduler that makes the tiles: tcp://HOST:8786")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="file to write; default: mesh.glb in the folder")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object at the end")] = False,
) -> None:
    """Mesh and texture a scan into one binary glTF file."""
    from service.errors import InputError
    from service.exports.model import MeshOptions, write_mesh
    from service.exports.view import ExportOptions, ScanView

    try:
        options = ExportOptions(
            voxel_m=voxel_m, progress=lambda text: print(f"mesh: {text}", file=sys.stderr)
        )
    except ValueError as error:
        raise InputError(f"mesh: {error}") from error
    epoch_ns = None if video_epoch is None else round(video_epoch * 1e9)
    if stored and video is not None:
        raise InputError("mesh: give either --video or --stored")
    how = MeshOptions(method, faces, tile_points, scheduler, video, not stored, epoch_ns)
    path = out or scan_dir / "mesh.glb"
    started = time.monotonic()
    with ScanView(scan_dir, voxel_m) as scan:
        figures = write_mesh(scan, path, how, options)
    figures["seconds"] = round(time.monotonic() - started, 1)
    if as_json:
        print(json.dumps({"file": str(path)} | figures))
    else:
        print(
            f"{path}: {figures['faces']} triangles in {figures['tiles']} tile(s), "
            f"{figures['method']}, {figures['seen']:.0%} seen by a picture, "
            f"{figures['seconds']} s"
        )
