"""Work on the ground of a scan or a site, cut into tiles, on this machine or on a Dask cluster.

A tile is made from the store alone by the same function here and there, so the result is the same.
It is made from its own points and those a margin around it, and cut exactly at its borders, so that
memory follows the tile and not the site.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from recon.mapping.cloud_fusion import cloud_of
from recon.mapping.voxel_map import ground_sample_m
from recon.types import F64
from service.errors import OutsideError, SkyreliefError
from service.georeference import LocalFrame
from service.packages import needing
from service.progress import Progress
from service.scans.fused_cloud import EVERYWHERE, Box
from service.scans.main_piece import Keyframes, main_keyframes, main_seqs
from service.stream.store import ScanStore

Job = TypeVar("Job")
Made = TypeVar("Made")

TILE_POINTS = 20_000_000
POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class KeyframeFootprint:
    """Ground that one keyframe covers, and how finely."""

    seq: int
    points: int
    sample_m: float
    box: Box


@dataclass(frozen=True, slots=True)
class Tile:
    """Ground of one tile, in plain values, so that it can travel to another machine."""

    folder: str  # of the scan; a cluster's machines see it at the same place
    box: Box  # the ground itself, m
    wide: Box  # where its points come from, ENU m of the scan
    seqs: tuple[int, ...]  # the keyframes that reach into ``wide``


@dataclass(frozen=True, slots=True)
class Tiling:
    """Tiles that cover the ground once; ``prints`` are empty where one tile is everything."""

    tiles: tuple[Tile, ...]
    prints: tuple[KeyframeFootprint, ...] = ()

    @property
    def bounds(self) -> Box:
        """(west, south, east, north) of all footprints."""
        return _bounds(self.prints)

    @property
    def sample_m(self) -> float:
        """Median ground sample distance."""
        return float(np.median([p.sample_m for p in self.prints]))


def footprints(store: Keyframes) -> list[KeyframeFootprint]:
    out = []
    for k in main_keyframes(store):
        sample = ground_sample_m(k.depth)
        xyz = cloud_of(k.depth, k.bgr, k.fresh).xyz_m
        if sample is not None and len(xyz):
            (west, south), (east, north) = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
            box = (float(west), float(south), float(east), float(north))
            out.append(KeyframeFootprint(k.seq, len(xyz), sample, box))
    return out


def tiling(
    folder: Path, store: Keyframes, max_points: int, margin_m: float,
    frame: LocalFrame | None = None,
) -> Tiling:  # fmt: skip
    """Tiles with about ``max_points`` stored points, and the points ``margin_m`` around each.

    Their boxes are in the scan's ENU metres, with ``frame`` in metres of its UTM zone. One tile is
    everything when the keyframes' pixels are no more than ``max_points``.
    """
    seqs = main_seqs(store)
    first = store.keyframe(seqs[0]) if seqs else None
    if first is None or len(seqs) * first.fresh.size <= max_points:
        return Tiling((Tile(str(folder.resolve()), EVERYWHERE, EVERYWHERE, tuple(seqs)),))
    # By a reader of its own, which does not hold what it has decoded.
    with ScanStore.open(folder / "scan.db", read_only=True) as fresh:
        prints = footprints(fresh)
    return Tiling(tuple(tiles_over(folder, prints, max_points, margin_m, frame)), tuple(
        _on_map(prints, frame)
    ))  # fmt: skip


def tiles_over(
    folder: Path, prints: Sequence[KeyframeFootprint], max_points: int, margin_m: float,
    frame: LocalFrame | None = None,
) -> list[Tile]:  # fmt: skip
    """As :func:`tiling`, over these footprints."""
    placed = _on_map(prints, frame)
    bounds = grown(_bounds(placed), margin_m) if placed else EVERYWHERE
    out = []
    for box in tile_boxes(placed, max_points):
        wide = box
        if box != EVERYWHERE:
            wide = grown(box, margin_m)
            inner = np.clip(wide, np.tile(bounds[:2], 2), np.tile(bounds[2:], 2))
            wide = _corners_box(inner, None if frame is None else frame.from_utm)
        seqs = tuple(p.seq for p in prints if overlap(p.box, wide))
        out.append(Tile(str(folder.resolve()), box, wide, seqs))
    return out


def _on_map(
    prints: Sequence[KeyframeFootprint], frame: LocalFrame | None
) -> list[KeyframeFootprint]:
    if frame is None:
        return list(prints)
    return [replace(p, box=_corners_box(np.array(p.box), frame.to_utm)) for p in prints]


def _corners_box(box: F64, move: Callable[[F64], F64] | None) -> Box:
    west, south, east, north = (float(v) for v in box)
    if move is None:
        return west, south, east, north
    corners = np.array([[x, y, 0.0] for x in (west, east) for y in (south, north)])
    (west, south), (east, north) = (f(move(corners)[:, :2], axis=0) for f in (np.min, np.max))
    return float(west), float(south), float(east), float(north)


def _bounds(prints: Sequence[KeyframeFootprint]) -> Box:
    boxes = np.array([p.box for p in prints])
    west, south = boxes[:, :2].min(axis=0)
    east, north = boxes[:, 2:].max(axis=0)
    return float(west), float(south), float(east), float(north)


def grown(box: Box, by_m: float) -> Box:
    return box[0] - by_m, box[1] - by_m, box[2] + by_m, box[3] + by_m


def tile_boxes(prints: Sequence[KeyframeFootprint], max_points: int) -> list[Box]:
    """Boxes that cover the site, each with about ``max_points`` stored points at most.

    One box without borders when all points are fewer. Empty boxes are left out. Points are
    taken as spread evenly over each keyframe's rectangle.
    """
    if sum(p.points for p in prints) <= max_points:
        return [EVERYWHERE]
    bounds = _bounds(prints)
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
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


def _points_in(prints: Sequence[KeyframeFootprint], tile: Box) -> float:
    total = 0.0
    for p in prints:
        shares = [
            max(0.0, min(p.box[a + 2], tile[a + 2]) - max(p.box[a], tile[a]))
            / max(p.box[a + 2] - p.box[a], 1e-6)
            for a in (0, 1)
        ]
        total += p.points * shares[0] * shares[1]
    return total


def overlap(a: Iterable[float], b: Iterable[float]) -> bool:
    (aw, as_, ae, an), (bw, bs, be, bn) = a, b
    return aw <= be and ae >= bw and as_ <= bn and an >= bs


def run_tiles(
    make: Callable[..., Made],
    jobs: Sequence[Job],
    scheduler: str | None,
    progress: Progress,
    connect_s: float = 10.0,
) -> Iterator[Made]:
    """``make(job, progress)`` of all jobs, in their order; only the one that is read is held.

    With ``scheduler`` (``tcp://HOST:8786``) they are made by a Dask cluster. OutsideError when it
    cannot be reached within ``connect_s``. If it disconnects meanwhile, one line reports it and the
    missing tiles are made here.
    """
    count = 0
    if scheduler is not None:
        for made in _on_cluster(make, jobs, scheduler, progress, connect_s):
            count += 1
            progress(f"tile {count} of {len(jobs)} came from the cluster")
            yield made
    for n, job in enumerate(jobs[count:], count):
        with progress.part(f"tile {n + 1} of {len(jobs)}", 1.0 / (len(jobs) - n)):
            made = make(job, progress)
        yield made


def _on_cluster(
    make: Callable[..., Made],
    jobs: Sequence[Job],
    scheduler: str,
    progress: Progress,
    connect_s: float,
) -> Iterator[Made]:
    """The first tiles, as many as the cluster delivers before it goes away."""
    with needing("a cluster"):
        from distributed import Client
    try:
        client = Client(scheduler, timeout=connect_s, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise OutsideError(
            f"no Dask scheduler answers at {scheduler} ({type(error).__name__}); start one with "
            "'dask scheduler', or leave out --scheduler"
        ) from error
    try:
        futures: list[Any] = client.map(make, jobs, pure=False)[::-1]
        while futures:
            future = futures.pop()  # the cluster forgets a tile that has come
            while not future.done():
                time.sleep(POLL_S)
                if client.status not in ("running", "connecting"):
                    raise ConnectionError("no connection")
            if future.status == "error" and isinstance(future.exception(), SkyreliefError):
                raise future.exception()
            if future.status != "finished":
                raise ConnectionError(future.status)
            yield future.result(timeout=60.0)
    except (OSError, TimeoutError) as error:
        progress(f"the cluster at {scheduler} disconnected ({error}); the rest is made here")
    finally:
        client.close(timeout=2.0)
