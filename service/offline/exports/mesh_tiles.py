"""Meshed and textured tiles. Each is cut exactly at its borders."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from recon.mapping.cloud_fusion import cloud_of
from recon.surface.meshing import Mesh, cut, height_mesh, poisson_mesh
from recon.surface.raster import fill_holes, grid_over, rasterise, smoothed
from recon.surface.texturing import texture
from recon.types import F64, U8, Keyframe, PointCloud
from service.offline.exports.images import scan_images
from service.offline.exports.view import ExportOptions
from service.offline.tiles import Tile
from service.progress import Progress
from service.scans.fused_cloud import fused_cloud
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

MARGIN_VOXELS = 25
TEXTURE_STEPS = 15
"""Reports of :func:`recon.surface.texturing.texture`."""


@dataclass(frozen=True, slots=True)
class TileJob:
    """One tile's mesh, in plain values; its box is in the scan's ENU metres."""

    tile: Tile
    voxel_m: float
    method: str  # height or poisson
    largest_faces: int
    largest_texture_px: int
    options: ExportOptions = field(default_factory=ExportOptions)  # where images come from


@dataclass(frozen=True, slots=True, eq=False)
class TilePart:
    """A tile's mesh and texture, and what it was made of."""

    mesh: Mesh
    image: U8
    figures: dict[str, Any]


def mesh_tile(job: TileJob, progress: Progress | None = None) -> TilePart | None:
    """The textured mesh of a tile; None when there is too little surface in it."""
    progress = progress or Progress()
    tile = job.tile
    store = ScanStore.open(Path(tile.folder) / "scan.db")
    try:
        store.only(tile.seqs)
        keyframes = list(store.keyframes())
        with progress.part("fusing the cloud", 0.15):
            cloud = fused_cloud(store, job.voxel_m, progress, tile.wide).cloud
        try:
            with progress.part("surface", 0.3):
                mesh = cut(_surface(job, cloud, keyframes, progress), tile.box)
        except ValueError as error:
            log.debug("tile %s: %s", tile.box, error)
            return None
        if not len(mesh.faces):
            return None
        with progress.part(f"{len(mesh.faces)} triangles; reading images", 0.25):
            views = scan_images(keyframes, Path(tile.folder), store.header, job.options, progress)
    finally:
        store.close()
    with progress.part("texture"):
        done = texture(mesh, views, job.largest_texture_px, progress.counting(TEXTURE_STEPS))
    figures = {
        "faces": len(done.mesh.faces),
        "vertices": len(done.mesh.vertices_m),
        "seen": round(done.seen_share, 4),
        "views": done.views_used,
        "charts": done.charts,
        "texture_px": [done.image.shape[1], done.image.shape[0]],
    }
    return TilePart(done.mesh, done.image, figures)


def _surface(
    job: TileJob,
    cloud: PointCloud,
    keyframes: Sequence[Keyframe],
    progress: Progress,
) -> Mesh:
    """The untextured mesh, with colours at its vertices."""
    if job.method == "poisson":
        progress("Poisson surface")
        return poisson_mesh(cloud, _seen_from(cloud, keyframes), job.voxel_m, job.largest_faces)
    if not len(cloud):
        raise ValueError("no points")
    progress("filling and smoothing the surface")
    grid = grid_over(cloud.xyz_m[:, :2].astype(np.float64), job.voxel_m, margin_cells=1)
    raster = fill_holes(rasterise(cloud, grid), largest_cells=8)
    progress("triangles")
    mesh = height_mesh(smoothed(raster), job.largest_faces)
    rgb = raster.rgb[raster.grid.cells(mesh.vertices_m[:, :2])]
    return Mesh(mesh.vertices_m, mesh.faces, None, rgb)


def _seen_from(cloud: PointCloud, keyframes: Sequence[Keyframe]) -> F64:
    """(N, 3) the camera that looked at each fused point: that of the nearest stored point."""
    from scipy.spatial import cKDTree

    places, cameras = [], []
    for k in keyframes:
        step = k.fresh.copy()
        step[1::3] = step[2::3] = False
        step[:, 1::3] = step[:, 2::3] = False
        part = cloud_of(k.depth, k.bgr, step)
        places.append(part.xyz_m)
        cameras.append(np.tile(k.depth.T_world_camera[:3, 3], (len(part), 1)))
    nearest = cKDTree(np.concatenate(places)).query(cloud.xyz_m, workers=-1)[1]
    return np.asarray(np.concatenate(cameras)[nearest])
