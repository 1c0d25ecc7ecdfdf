"""Work on the ground of a scan or a site, cut into tiles, on this machine or on a Dask cluster.

A tile is made from the store alone by the same function here and there, so the result is the same.
It is made from its own points and those a margin around it, and cut exactly at its borders, so that
memory follows the tile and not the site.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from recon.types import F64
from service.errors import OutsideError, SkyreliefError
from service.georeference import LocalFrame
from service.packages import needing
from service.progress import Progress
from service.scans.fused_cloud import EVERYWHERE, Box, Extent, extents_of
from service.scans.main_piece import Keyframes, main_seqs
from service.stream.store import ScanStore

Job = TypeVar("Job")
Made = TypeVar("Made")

TILE_POINTS = 20_000_000
MARGIN_VOXELS = 25
POLL_S = 0.2
MIN_SHARE = 0.01
"""Of the site's longer side: a smaller tile is mostly margin."""


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
    prints: tuple[Extent, ...] = ()

    @property
    def bounds(self) -> Box:
        """(west, south, east, north) of all footprints."""
        return union(p.box for p in self.prints)

    @property
    def sample_m(self) -> float:
        """Median ground sample distance."""
        return float(np.median([p.ground_sample_m for p in self.prints]))


def tiling(
    folder: Path, store: Keyframes, max_points: int, margin_m: float,
    frame: LocalFrame | None = None, voxel_m: float | None = None,
) -> Tiling:  # fmt: skip
    """Tiles with about ``max_points`` stored points, and the points ``margin_m`` around each, or
    MARGIN_VOXELS of ``voxel_m`` where these are more; by default of the ground sample distance.

    Their boxes are in the scan's ENU metres, with ``frame`` in metres of its UTM zone. One tile is
    everything when the keyframes' pixels are no more than ``max_points``.
    """
    name, seqs = str(folder.resolve()), main_seqs(store)
    first = store.keyframe(seqs[0]) if seqs else None
    prints: list[Extent] = []
    if first is not None and len(seqs) * first.fresh.size > max_points:
        # By a reader of its own, which does not hold what it has decoded.
        with ScanStore.open(folder / "scan.db", read_only=True) as fresh:
            prints, _ = extents_of(fresh, Progress())
    if not prints:
        return Tiling((Tile(name, EVERYWHERE, EVERYWHERE, tuple(seqs)),))
    to_map, from_map = (None, None) if frame is None else (frame.to_utm, frame.from_utm)
    placed = [replace(p, box=box_around(p.box, to_map)) for p in prints]
    cut = Tiling((), tuple(placed))
    margin_m = max(margin_m, MARGIN_VOXELS * (voxel_m or cut.sample_m))
    bounds = grown(cut.bounds, margin_m)
    tiles = []
    for box in tile_boxes(placed, max_points):
        wide = box
        if box != EVERYWHERE:
            inner = np.clip(grown(box, margin_m), np.tile(bounds[:2], 2), np.tile(bounds[2:], 2))
            wide = box_around(inner, from_map)
        own = tuple(p.seq for p in prints if overlap(p.box, wide))
        tiles.append(Tile(name, box, wide, own))
    return replace(cut, tiles=tuple(tiles))


def box_around(box: Sequence[float] | F64, move: Callable[[F64], F64] | None) -> Box:
    """The box around the corners of a box that were moved."""
    west, south, east, north = (float(v) for v in box)
    if move is None:
        return west, south, east, north
    corners = move(np.array([[x, y, 0.0] for x in (west, east) for y in (south, north)]))
    return *corners[:, :2].min(axis=0).tolist(), *corners[:, :2].max(axis=0).tolist()


def union(boxes: Iterable[Box]) -> Box:
    """The box around some boxes, at least one."""
    west, south, east, north = zip(*boxes, strict=True)
    return min(west), min(south), max(east), max(north)


def grown(box: Box, by_m: float) -> Box:
    return box[0] - by_m, box[1] - by_m, box[2] + by_m, box[3] + by_m


def tile_boxes(prints: Sequence[Extent], max_points: int) -> list[Box]:
    """Boxes that cover the site, each with about ``max_points`` stored points at most.

    One box without borders when all points are fewer; a box of more is halved across its longer
    side, down to MIN_SHARE of the site's. Empty boxes are left out. Points are taken as spread
    evenly over each keyframe's rectangle.
    """
    if sum(p.points for p in prints) <= max_points:
        return [EVERYWHERE]
    bounds = union(p.box for p in prints)
    min_m = MIN_SHARE * max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    rest, out = [[*EVERYWHERE]], list[Box]()
    while rest:
        west, south, east, north = box = rest.pop()
        points = sum(p.points * _share(p.box, box) for p in prints)
        inner = np.clip(box, np.tile(bounds[:2], 2), np.tile(bounds[2:], 2))
        axis = int(np.argmax(inner[2:] - inner[:2]))
        if points > max_points and inner[axis + 2] - inner[axis] > min_m:
            low, high = box.copy(), box.copy()
            low[axis + 2] = high[axis] = float(0.5 * (inner[axis] + inner[axis + 2]))
            rest += [high, low]
        elif points > 0.0:
            out.append((west, south, east, north))
    return out


def _share(part: Box, box: Sequence[float]) -> float:
    """Of a rectangle that lies in a box."""
    (west, south, east, north), (w, s, e, n) = part, box
    across = max(0.0, min(east, e) - max(west, w)) / max(east - west, 1e-6)
    return across * max(0.0, min(north, n) - max(south, s)) / max(north - south, 1e-6)


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
    except (OSError, asyncio.TimeoutError, ValueError) as error:  # no OSError in Python 3.10
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
    except (OSError, asyncio.TimeoutError) as error:
        progress(f"the cluster at {scheduler} disconnected ({error}); the rest is made here")
    finally:
        client.close(timeout=2.0)
