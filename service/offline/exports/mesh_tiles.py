"""A site meshed and textured tile by tile, on this machine or on a Dask cluster.

A tile is made from the store alone by :func:`mesh_tile`, the same function here and there, so
the result is the same. Tiles are made from their own points and those a margin around, and
cut exactly at their borders.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from recon.mapping.cloud_fusion import cloud_of, fuse, without
from recon.mapping.free_space import seen_through, spread
from recon.mapping.voxel_map import ground_sample_m
from recon.surface.meshing import Mesh, cut, height_mesh, poisson_mesh
from recon.surface.raster import fill_holes, grid_over, rasterise, smoothed
from recon.surface.texture_views import TextureView
from recon.surface.texturing import texture
from recon.types import F64, U8, Keyframe, PointCloud
from service.errors import OutsideError, SkyreliefError
from service.offline.exports.images import stored_images, video_images
from service.packages import needing
from service.progress import Progress
from service.scans.fused_cloud import fused_cloud
from service.scans.main_piece import main_keyframes
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

MARGIN_VOXELS = 25
CONNECT_S = 10.0
POLL_S = 0.2
TEXTURE_STEPS = 15
"""Reports of :func:`recon.surface.texturing.texture`."""
EVERYWHERE = (-np.inf, -np.inf, np.inf, np.inf)

Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class TileJob:
    """One tile, in plain values, so that it can travel to another machine."""

    folder: str  # of the scan; a cluster's machines see it at the same place
    box: Box  # west, south, east, north in the scan's ENU metres
    voxel_m: float
    method: str  # height or poisson
    largest_faces: int
    largest_texture_px: int
    video: str | None = None
    video_epoch_ns: int | None = None
    video_named: bool = True  # False: found by itself; without it the stored images do


@dataclass(frozen=True, slots=True, eq=False)
class TilePart:
    """A tile's mesh and texture, and what it was made of."""

    mesh: Mesh
    image: U8
    figures: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Footprint:
    """Ground that one keyframe covers, and how finely."""

    seq: int
    points: int
    sample_m: float
    box: Box


def footprints(store: ScanStore) -> list[Footprint]:
    """The ground covered by each keyframe with points."""
    out = []
    for k in main_keyframes(store):
        sample = ground_sample_m(k.depth)
        xyz = cloud_of(k.depth, k.bgr, k.fresh).xyz_m
        if sample is not None and len(xyz):
            (west, south), (east, north) = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
            box = (float(west), float(south), float(east), float(north))
            out.append(Footprint(k.seq, len(xyz), sample, box))
    return out


def tile_boxes(prints: Sequence[Footprint], max_points: int) -> list[Box]:
    """Boxes that cover the site, each with about ``max_points`` stored points at most.

    One box without borders when all points are fewer. Empty boxes are left out. Points are
    taken as spread evenly over each keyframe's rectangle.
    """
    if sum(p.points for p in prints) <= max_points:
        return [EVERYWHERE]
    boxes = np.array([p.box for p in prints])
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    side = float((high - low).max())
    for _ in range(12):
        tiles = list(_grid(low, high, side))
        held = [_points_in(prints, tile) for tile in tiles]
        if max(held) <= max_points:
            break
        side /= 1.5
    return [tile for tile, points in zip(tiles, held, strict=True) if points > 0.0]


def _grid(low: F64, high: F64, side: float) -> Iterator[Box]:
    """Tiles of equal size, none wider than ``side``; the outer ones reach to infinity."""
    across = [max(1, int(np.ceil((high[a] - low[a]) / side - 1e-9))) for a in (0, 1)]
    edges = [np.linspace(low[a], high[a], across[a] + 1) for a in (0, 1)]
    for line in edges:
        line[0], line[-1] = -np.inf, np.inf
    for south, north in pairwise(edges[1]):
        for west, east in pairwise(edges[0]):
            yield float(west), float(south), float(east), float(north)


def _points_in(prints: Sequence[Footprint], tile: Box) -> float:
    total = 0.0
    for p in prints:
        shares = [
            max(0.0, min(p.box[a + 2], tile[a + 2]) - max(p.box[a], tile[a]))
            / max(p.box[a + 2] - p.box[a], 1e-6)
            for a in (0, 1)
        ]
        total += p.points * shares[0] * shares[1]
    return total


def mesh_tile(job: TileJob, progress: Progress | None = None) -> TilePart | None:
    """The textured mesh of a tile; None when there is too little surface in it."""
    progress = progress or Progress()
    store = ScanStore.open(Path(job.folder) / "scan.db")
    try:
        margin = MARGIN_VOXELS * job.voxel_m
        wide = tuple(np.add(job.box, (-margin, -margin, margin, margin)))
        seqs = [p.seq for p in footprints(store) if _overlap(p.box, wide)]
        keyframes = [k for seq in seqs if (k := store.keyframe(seq)) is not None]
        with progress.part("fusing the cloud", 0.15):
            if job.box == EVERYWHERE:
                cloud = fused_cloud(store, job.voxel_m, progress).cloud
            else:
                cloud = _fused(keyframes, wide, job.voxel_m)
        try:
            with progress.part("surface", 0.3):
                mesh = cut(_surface(job, cloud, keyframes, progress), job.box)
        except ValueError as error:
            log.debug("tile %s: %s", job.box, error)
            return None
        if not len(mesh.faces):
            return None
        with progress.part(f"{len(mesh.faces)} triangles; reading images", 0.25):
            views = _images(job, keyframes, store.header, progress)
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


def _images(
    job: TileJob,
    keyframes: Sequence[Keyframe],
    header: ScanHeader,
    progress: Progress,
) -> list[TextureView]:
    """The views of the job's video, else of the store."""
    if job.video is None:
        return stored_images(keyframes)
    try:
        return video_images(keyframes, header, Path(job.video), job.video_epoch_ns, progress)
    except SkyreliefError as error:
        if job.video_named:
            raise
        progress(f"textures from the scan's own images after all: {error}")
        return stored_images(keyframes)


def _overlap(a: Iterable[float], b: Iterable[float]) -> bool:
    (aw, as_, ae, an), (bw, bs, be, bn) = a, b
    return aw <= be and ae >= bw and as_ <= bn and an >= bs


def _fused(keyframes: Sequence[Keyframe], box: tuple[Any, ...], voxel_m: float) -> PointCloud:
    """The fused cloud inside ``box``, without what other keyframes see through."""

    def inside() -> Iterator[PointCloud]:
        for k in keyframes:
            part = cloud_of(k.depth, k.bgr, k.fresh)
            x, y = part.xyz_m[:, 0], part.xyz_m[:, 1]
            yield without(part, (x < box[0]) | (x > box[2]) | (y < box[1]) | (y > box[3]))

    cloud = fuse(inside(), voxel_m)
    if not len(cloud):
        return cloud
    return without(cloud, seen_through(cloud, (k.depth for k in spread(keyframes))))


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


def run_tiles(jobs: Sequence[TileJob], scheduler: str | None, progress: Progress) -> list[TilePart]:
    """All tiles with surface, in their order.

    With ``scheduler`` (``tcp://HOST:8786``) they are made by a Dask cluster. OutsideError when it
    cannot be reached. If it disconnects meanwhile, one line reports it and the missing tiles are
    made here.
    """
    done: dict[int, TilePart | None] = {}
    if scheduler is not None:
        for n, part in _on_cluster(jobs, scheduler, progress):
            done[n] = part
            progress(f"tile {len(done)} of {len(jobs)} came from the cluster")
    for n, job in enumerate(jobs):
        if n not in done:
            with progress.part(f"tile {n + 1} of {len(jobs)}", 1.0 / (len(jobs) - n)):
                done[n] = mesh_tile(job, progress)
    return [part for n in range(len(jobs)) if (part := done[n]) is not None]


def _on_cluster(
    jobs: Sequence[TileJob], scheduler: str, progress: Progress
) -> Iterator[tuple[int, TilePart | None]]:
    """(number, part) of the tiles that the cluster delivers; ends early when it goes away."""
    with needing("a cluster"):
        from distributed import Client
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise OutsideError(
            f"no Dask scheduler answers at {scheduler} ({type(error).__name__}); start one with "
            "'dask scheduler', or leave out --scheduler"
        ) from error
    try:
        futures = client.map(mesh_tile, jobs, pure=False)
        for n, future in enumerate(futures):
            while not future.done():
                time.sleep(POLL_S)
                if client.status not in ("running", "connecting"):
                    raise ConnectionError("no connection")
            if future.status == "error" and isinstance(future.exception(), SkyreliefError):
                raise future.exception()
            if future.status != "finished":
                raise ConnectionError(future.status)
            yield n, future.result(timeout=60.0)
    except (OSError, TimeoutError) as error:
        progress(f"the cluster at {scheduler} disconnected ({error}); the rest is made here")
    finally:
        client.close(timeout=2.0)
