"""``skyrelief export``: deliverables of a scan folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from service.errors import InputError
from service.exports import EXPORTERS

KINDS = "|".join(EXPORTERS)


def export(
    scan_dir: Annotated[Path, typer.Argument(help="scan folder (holds scan.db)")],
    to: Annotated[list[str], typer.Option("--to", help=f"{KINDS}; may be repeated")],
    out: Annotated[
        Path | None, typer.Option("--out", help="file to write; default: in the scan folder")
    ] = None,
    voxel_m: Annotated[
        float | None, typer.Option("--voxel-m", help="fused voxel size; default: pixel on ground")
    ] = None,
    cell_m: Annotated[
        float | None, typer.Option("--cell-m", help="cell of dsm, ortho, contours")
    ] = None,
    contour_m: Annotated[float, typer.Option("--contour-m", help="contour interval")] = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object at the end")] = False,
) -> None:
    """Write deliverables of a scan: clouds, surface model, orthophoto, tiles, mesh, flight."""
    from service.exports.view import ExportOptions, ScanView
    from service.exports.view import export as write

    for kind in to:
        if kind not in EXPORTERS:
            raise InputError(f"--to {kind}: there are {', '.join(EXPORTERS)}")
    if out is not None and len(to) > 1:
        raise InputError("--out names one file; give one --to with it")
    try:
        options = ExportOptions(voxel_m, cell_m, contour_m)
    except ValueError as error:
        raise InputError(f"export: {error}") from error
    written = {}
    with ScanView(scan_dir, voxel_m) as scan:
        for kind in to:
            written[kind] = str(write(scan, kind, out, options))
            if not as_json:
                print(written[kind])
    if as_json:
        print(json.dumps({"scan": str(scan_dir), "written": written}))
