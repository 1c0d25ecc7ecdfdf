"""The report of a scan, with its orthophoto and surface model as maps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from recon.surface.raster import Raster
from service.errors import InputError
from service.offline.exports.rasters import NODATA_M, SOME_MAP, open_map, over, transform_of, warped
from service.offline.exports.view import ExportOptions, ScanView
from service.scans.coverage import coverage_of
from service.scans.drawing import draw_maps
from service.scans.folder import middle_stages, surface
from service.scans.report import maps_of, report_html
from service.scans.writing import SUMMARY, write_whole

LARGEST_CELLS = 1400
"""Along a side of the report's maps, which are as fine as the orthophoto if these allow."""


def write_report(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """``report.html`` again, with ortho.tif and dsm.tif of the scan folder as its maps.

    Files older than scan.json are of an earlier state of the scan, and not used. Raises
    InputError when scan.json cannot be read.
    """
    folder, store = scan.folder, scan.store
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        made = made_maps(folder, summary["heights"])
        scan.progress("maps of the cloud; export ortho and dsm first" if made is None else "report")
        cloud, raster, coverage = scan.fused.cloud, surface(scan.fused), coverage_of(store)
        shown = middle_stages(folder, store)
        maps = None
        if made is not None:  # an orthophoto has its own light
            track_m = np.array([p.T_world_camera[:3, 3] for p in scan.poses]).reshape(-1, 3)
            frame = scan.flown_frame
            track_m = track_m if frame is None else frame.to_utm(track_m)
            maps = draw_maps(made, track_m, LARGEST_CELLS, 0.0, is_shaded=False)
        elif raster is not None:
            maps = maps_of(summary, scan.poses, raster)
        page = report_html(summary, scan.poses, cloud, raster, coverage, shown, maps)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{folder / SUMMARY} cannot be read; make the scan's files again"
        ) from error
    write_whole(out, page)


def made_maps(folder: Path, heights: str) -> Raster | None:
    """Colours of the orthophoto and heights of the surface model, where they lie on the map.

    None where one of them is missing, older than scan.json, or above another datum than
    ``heights`` says.
    """
    ortho, dsm, made = (folder / name for name in ("ortho.tif", "dsm.tif", SUMMARY))
    if not (ortho.is_file() and dsm.is_file()):
        return None
    if min(p.stat().st_mtime_ns for p in (ortho, dsm)) < made.stat().st_mtime_ns:
        return None
    with open_map(dsm, 2) as image, open_map(ortho, 3) as colours:
        if image.tags().get("HEIGHTS") != heights:
            return None
        west, south, east, north = image.bounds
        cell_m = max(colours.transform.a, max(east - west, north - south) / LARGEST_CELLS)
        grid = over(image.bounds, cell_m)
        here = transform_of(grid), image.crs or SOME_MAP, grid.shape
        height, sigma, *_ = warped(image, *here, is_smooth=False)
        rgb = warped(colours, *here)[:3].transpose(1, 2, 0)
    known = height != NODATA_M
    return Raster(
        grid,
        np.where(known, height, np.nan).astype(np.float32),
        np.where(known, sigma, np.nan).astype(np.float32),
        np.where(known[..., None], rgb, 0).astype(np.uint8),
    )
