"""The files of a site's folder: those of a scan, the cloud of a large one in tiles."""

from __future__ import annotations

from pathlib import Path

from service.offline.exports.clouds import VOXELS_MARGIN_M, points_of
from service.offline.exports.view import ExportOptions, ScanView
from service.offline.tiles import TILE_POINTS
from service.progress import Progress
from service.scans.folder import resolution_m, write_deliverables
from service.scans.fused_cloud import TiledCloud
from service.stream.store import ScanStore


def write_files(
    folder: Path,
    tile_points: int = TILE_POINTS,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> None:
    """Write the files of the site in ``folder``; errors as of :func:`write_deliverables`."""
    with ScanStore.open(folder / "scan.db") as store, ScanView(folder, None, progress) as view:
        options = ExportOptions(
            voxel_m=resolution_m(store.header), tile_points=tile_points, scheduler=scheduler
        )
        cut, tiled = view.tiling(options, VOXELS_MARGIN_M), None
        if len(cut.tiles) > 1:
            tiled = TiledCloud(
                points_of(view, options, is_classified=False), options.voxel_m or cut.sample_m,
                cut.sample_m, len(cut.prints), sum(p.points for p in cut.prints), cut.bounds,
            )  # fmt: skip
        write_deliverables(folder, store, {}, tiled=tiled)
