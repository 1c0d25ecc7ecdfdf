"""How well each piece of ground was seen, updated with each keyframe.

The ground is cut into square cells, held in tiles that exist only where something was seen,
so memory follows the area. Per cell: in how many keyframes' images it lies, the best sigma
and the mean height of the surface measured there, and when that was. A keyframe that is
moved takes its share of the views along; the surface of the tiles it touched is summed up
again from the keyframes that touch them.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from numba import njit

from recon.camera_model import rays
from recon.surface.raster import Grid
from recon.table import Rows, Table
from recon.types import F32, F64, I64, Array, Bool, DepthMap

TILE = 64
"""Cells along a tile's side."""

CELL_SAMPLES = 4.0
"""Width of a cell on the ground, in pixels of a keyframe, about."""

MAX_TILES = 5_000
"""Tiles at most (20 million cells, 400 MB); what lies beyond them is counted."""

MAX_CELLS = 25_000_000
"""Maximum size of the rectangle about all tiles (500 MB); of a larger one only the middle is
shown."""

LONGEST_CELLS = 1 << 15
"""Maximum size of a footprint along either axis: an image is some hundred cells across."""

SMALLEST_CELL_M, LARGEST_CELL_M = 1e-3, 1e3

Tile = tuple[int, int]


@dataclass(slots=True, eq=False)
class _Cells:
    views: Array = field(default_factory=lambda: np.zeros((TILE, TILE), np.int32))
    sigma: F32 = field(default_factory=lambda: np.full((TILE, TILE), np.inf, np.float32))
    height: F32 = field(default_factory=lambda: np.zeros((TILE, TILE), np.float32))
    weight: F32 = field(default_factory=lambda: np.zeros((TILE, TILE), np.float32))
    seen_s: F32 = field(default_factory=lambda: np.full((TILE, TILE), -np.inf, np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class CoverageGrid:
    """The layer on one north-up grid; NaN where no surface was measured."""

    grid: Grid
    views: Array  # (rows, cols) uint16: keyframes whose image covers the cell
    sigma_m: F32  # (rows, cols) best 1 sigma of a point in the cell
    height_m: F32  # (rows, cols) mean by the inverse of the variance
    seen_s: F32  # (rows, cols) when a surface was last measured, seconds from the first keyframe
    inside: Bool  # (rows, cols) within what was flown: the hull of the images' middles, and
    # a quarter of an image about it
    core: Bool  # (rows, cols) within that hull itself

    @property
    def known(self) -> Bool:
        """(rows, cols) cells with a measured surface."""
        return np.isfinite(self.sigma_m)

    @property
    def gaps(self) -> Bool:
        """(rows, cols) cells within the hull where no surface was measured."""
        return self.inside & ~self.known

    def seldom(self, min_views: int) -> Bool:
        """(rows, cols) cells of the core that too few images cover; ends of lines are not."""
        return np.asarray(self.core & (self.views < min_views))

    def unsure(self, max_sigma_m: float) -> Bool:
        """(rows, cols) flown cells with a sigma above the limit."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.inside & (self.sigma_m > max_sigma_m))

    def weak(self, min_views: int, max_sigma_m: float) -> Bool:
        """(rows, cols) cells worth another flight: gaps, seldom seen or unsure."""
        return np.asarray(self.gaps | self.seldom(min_views) | self.unsure(max_sigma_m))


def usual_cell_m(depth: DepthMap) -> float | None:
    """A round cell size (1, 2 or 5 times a power of ten) that suits a keyframe; None if empty."""
    known = np.isfinite(depth.depth_m)
    if not known.any():
        return None
    target = CELL_SAMPLES * float(np.median(depth.depth_m[known])) / float(depth.K[0, 0])
    target = min(max(target, SMALLEST_CELL_M), LARGEST_CELL_M)
    power = 10.0 ** np.floor(np.log10(target))
    return float(min((power * m for m in (1, 2, 5, 10)), key=lambda c: abs(np.log(c / target))))


def _near(keys: I64) -> I64:
    """The (N, 2) tiles whose rectangle has at most MAX_CELLS: all, or those about the middle.

    A diverged track must not allocate an unbounded grid.
    """
    if float(np.prod((np.ptp(keys, axis=0) + 1.0) * TILE)) <= MAX_CELLS:
        return keys
    half = (int(np.sqrt(MAX_CELLS)) // TILE - 1) // 2
    middle = keys[np.abs(keys - np.median(keys, axis=0)).sum(axis=1).argmin()]
    return np.asarray(keys[np.all(np.abs(keys - middle) <= half, axis=1)])


class CoverageMap:
    """The layer of one scan. Not safe between threads."""

    def __init__(self, cell_m: float) -> None:
        """Raises ValueError unless ``cell_m`` is positive."""
        if not (np.isfinite(cell_m) and cell_m > 0):
            raise ValueError(f"cell_m is {cell_m}, must be positive")
        self.cell_m = float(cell_m)
        self.refused = 0  # tiles beyond MAX_TILES, and footprints too large to be one
        self._tiles: dict[Tile, _Cells] = {}
        self._table = Table(PLACE)  # of keyframes
        self._seqs, self._rows = array("q"), array("q")  # keyframes in order, and their rows
        self._stale: set[Tile] = set()
        self._first_ns: int | None = None

    def __contains__(self, seq: int) -> bool:
        return self._row(seq) is not None

    def places(self) -> Rows:
        """Rows of :data:`PLACE` of all keyframes, in order of their number."""
        return np.asarray(self._table.rows[np.array(self._rows)])

    @property
    def tiles(self) -> int:
        return len(self._tiles)

    def put(self, seq: int, time_ns: int, depth: DepthMap, finer: bool = False) -> None:
        """Add a keyframe, or move it to its corrected pose.

        A keyframe that moved leaves stale tiles; :meth:`refill` recomputes them. So does one with
        ``finer`` depth than before. One without any depth is skipped.
        """
        row = footprint(depth)
        if row is None:
            return
        if self._first_ns is None:
            self._first_ns = time_ns
        at = self._row(seq)
        before = None if at is None else self._table.rows[at]
        if before is not None:
            shift_m = np.abs(before["corners_m"] - row["corners_m"][0]).max()
            if not finer and shift_m < 0.25 * self.cell_m:
                return  # too little to change any cell
            self._count(before["corners_m"], -1)
            self._stale |= self._within(before)
        self._count(row["corners_m"][0], +1)
        row["seq"], row["seen_s"] = seq, (time_ns - self._first_ns) * 1e-9
        if at is None:
            touched = self._add_surface(row[0], depth, None)
        else:
            touched = self._tiles_of(self._points(depth)[0])
            self._stale |= touched
        if touched:
            tiles = np.array(sorted(touched))
            row["low"], row["high"] = tiles.min(axis=0), tiles.max(axis=0)
        else:
            row["low"], row["high"] = 0, -1  # nowhere
        self._keep(at, row)

    def _row(self, seq: int) -> int | None:
        """Place of a keyframe's row; None when there is none."""
        i = bisect_left(self._seqs, seq)
        return self._rows[i] if i < len(self._seqs) and self._seqs[i] == seq else None

    def _keep(self, at: int | None, row: Rows) -> None:
        if at is not None:
            self._table.rows[at] = row[0]
            return
        seq = int(row["seq"][0])
        i = bisect_left(self._seqs, seq)
        self._seqs.insert(i, seq)
        self._rows.insert(i, len(self._table))
        self._table.append(row)

    def _within(self, place: np.void) -> set[Tile]:
        """The tiles where a keyframe may have surface."""
        (left, low), (right, high) = place["low"].tolist(), place["high"].tolist()
        return {(i, j) for i, j in self._tiles if left <= i <= right and low <= j <= high}

    def stale(self) -> list[int]:
        """Keyframes whose depth :meth:`refill` needs: they may have surface in a stale tile."""
        if not self._stale:
            return []
        rows = self._table.rows
        due = np.zeros(len(rows), np.bool_)
        for tile in self._stale:
            due |= np.all((rows["low"] <= tile) & (tile <= rows["high"]), axis=1)
        return [int(seq) for seq in rows["seq"][due]]

    def refill(self, depths: Iterable[tuple[int, DepthMap]]) -> None:
        """Sum up the surface of the stale tiles again, from the keyframes of :meth:`stale`."""
        for key in self._stale:
            if key in self._tiles:
                self._tiles[key] = _Cells(self._tiles[key].views)
        for seq, depth in depths:
            at = self._row(seq)
            if at is not None:
                self._add_surface(self._table.rows[at], depth, self._stale)
        self._stale = set()

    def grid(self) -> CoverageGrid | None:
        """All tiles on one grid, cut to the seen area; None while there is nothing."""
        if not self._tiles:
            return None
        keys = _near(np.array(list(self._tiles)))
        (west, south), (east, north) = keys.min(axis=0), keys.max(axis=0) + 1
        shape = (int(north - south) * TILE, int(east - west) * TILE)
        names = ("views", "sigma", "height", "seen_s", "weight")
        full = {n: np.zeros(shape, getattr(_Cells(), n).dtype) for n in names}
        for i, j in keys.tolist():
            cells = self._tiles[i, j]
            row, col = (j - south) * TILE, (i - west) * TILE
            for name in names:
                full[name][row : row + TILE, col : col + TILE] = getattr(cells, name)
        box = _box((full["weight"] > 0) | (full["views"] > 0))
        rows, cols = box
        top = int(south) * TILE + rows.stop
        left = int(west) * TILE + cols.start
        cut = {n: a[box][::-1] for n, a in full.items()}
        where = cut["weight"] > 0
        grid = Grid(left * self.cell_m, top * self.cell_m, self.cell_m, where.shape)
        nan = np.float32(np.nan)
        return CoverageGrid(
            grid,
            np.clip(cut["views"], 0, 65535).astype(np.uint16),
            np.where(where, cut["sigma"], nan),
            np.where(where, cut["height"], nan),
            np.where(where, cut["seen_s"], nan),
            *self._hull(grid),
        )

    # ---- footprints ------------------------------------------------------------------------

    def _count(self, corners_m: F64, change: int) -> None:
        """Add ``change`` to the views of all cells whose centre the footprint (4, 2) covers."""
        corners = corners_m / self.cell_m - 0.5  # whole numbers at cell centres
        low = np.floor(corners.min(axis=0)).astype(int)
        size = np.ceil(corners.max(axis=0)).astype(int) - low + 1
        if size.max() > LONGEST_CELLS or size[0] * size[1] > MAX_CELLS:
            self.refused += 1
            return
        mask = np.zeros((size[1], size[0]), np.uint8)
        shift = 8
        points = np.rint((corners - low) * (1 << shift)).astype(np.int32)
        cv2.fillConvexPoly(mask, points[:, None], 1, cv2.LINE_8, shift)
        for key, here, there in _spread(low, size):
            cells = self._tile(key)
            if cells is not None:
                cells.views[here] += change * mask[there].astype(np.int32)

    def _hull(self, grid: Grid) -> tuple[Bool, Bool]:
        """Cells within what was flown, and its core, as CoverageGrid has them."""
        places = self._table.rows
        middles, corners = places["centre_m"], places["corners_m"]
        width = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
        height = np.linalg.norm(corners[:, 2] - corners[:, 1], axis=1)
        around = 0.25 * float(np.median(np.minimum(width, height))) / self.cell_m
        mask = np.zeros(grid.shape, np.uint8)
        far_away = float(1 << 24)  # what OpenCV draws without overflow
        spots = np.rint(grid.pixels(middles).clip(-far_away, far_away)).astype(np.int32)
        cv2.fillConvexPoly(mask, cv2.convexHull(spots[:, None]), 1)
        far = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5)
        return np.asarray(far <= around), mask > 0

    # ---- surface ---------------------------------------------------------------------------

    def _points(self, depth: DepthMap) -> tuple[Array, F32, F32]:
        """(N, 2) cells, (N,) heights and (N,) sigmas of a keyframe's points."""
        count = int(np.isfinite(depth.depth_m).sum())
        arrays = (depth.depth_m, depth.sigma_m, depth.K, depth.T_world_camera)
        points: tuple[I64, F32, F32] = _surface_points(
            count, *map(np.ascontiguousarray, arrays), self.cell_m
        )
        return points

    @staticmethod
    def _tiles_of(cells: Array) -> set[Tile]:
        """The tiles with points; none where they are scattered over more than MAX_TILES."""
        tile = cells // TILE
        low, high = tile.min(axis=0), tile.max(axis=0)
        if np.prod((high - low + 1).astype(np.float64)) > 1 << 20:  # a stray point far away
            there = np.unique(tile, axis=0)
            return set() if len(there) > MAX_TILES else {(int(i), int(j)) for i, j in there}
        rows = int(high[1] - low[1]) + 1
        there = np.flatnonzero(np.bincount((tile[:, 0] - low[0]) * rows + tile[:, 1] - low[1]))
        if len(there) > MAX_TILES:
            return set()
        return {(int(low[0]) + int(k) // rows, int(low[1]) + int(k) % rows) for k in there}

    def _add_surface(self, place: np.void, depth: DepthMap, only: set[Tile] | None) -> set[Tile]:
        """Merge a keyframe's points into its tiles (``only`` these); the tiles touched."""
        cells, height, sigma = self._points(depth)
        touched = self._tiles_of(cells)
        self.refused += not touched
        when = np.float32(place["seen_s"])
        wanted = touched if only is None else touched & only
        for key, here in _by_tile(cells, wanted):
            held = self._tile(key)
            if held is None:
                continue
            local = cells[here] - np.array(key) * TILE
            _merge(local, height[here], sigma[here], when, held.sigma, held.height, held.weight,
                   held.seen_s)  # fmt: skip
        return touched

    def _tile(self, key: Tile) -> _Cells | None:
        """The tile of a key, made when missing; None when there are too many."""
        found = self._tiles.get(key)
        if found is None:
            if len(self._tiles) >= MAX_TILES:
                self.refused += 1
                return None
            found = self._tiles[key] = _Cells()
        return found


def _by_tile(cells: I64, wanted: set[Tile]) -> Iterator[tuple[Tile, I64]]:
    """Each of the ``wanted`` tiles with the points (rows of ``cells``) in it, in their order."""
    if not wanted:
        return
    tile = cells // TILE
    number = (tile[:, 0] << 32) + tile[:, 1]
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order])) + 1
    for points in np.split(order, starts):
        key = (int(tile[points[0], 0]), int(tile[points[0], 1]))
        if key in wanted:
            yield key, points


def _spread(
    low: Array, size: Array
) -> Iterable[tuple[Tile, tuple[slice, slice], tuple[slice, slice]]]:
    """The tiles that a window of cells spans, each with its part of the tile and the window.

    Rows of tiles count north.
    """
    first, last = low // TILE, (low + size - 1) // TILE
    for i in range(int(first[0]), int(last[0]) + 1):
        for j in range(int(first[1]), int(last[1]) + 1):
            corner = np.array([i, j]) * TILE
            a, b = np.maximum(low, corner), np.minimum(low + size, corner + TILE)
            here, there = a - corner, a - low
            n = b - a
            yield (
                (i, j),
                (slice(here[1], here[1] + n[1]), slice(here[0], here[0] + n[0])),
                (slice(there[1], there[1] + n[1]), slice(there[0], there[0] + n[0])),
            )


def _box(used: Bool) -> tuple[slice, slice]:
    """The rows and columns that hold anything, or one cell."""
    rows, cols = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
    if not len(rows):
        return slice(0, 1), slice(0, 1)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


@njit(cache=True, nogil=True)
def _surface_points(
    count: int, depth: F32, sigma: F32, K: F64, T: F64, cell_m: float
) -> tuple[I64, F32, F32]:
    """Cells, heights and sigmas of the pixels with depth; ``T`` is T_world_camera."""
    cells = np.empty((count, 2), np.int64)
    height, spread = np.empty(count, np.float32), np.empty(count, np.float32)
    n = 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = float(depth[v, u])
            if np.isfinite(z):
                x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
                for k in range(2):
                    place = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
                    cells[n, k] = int(np.floor(place / cell_m))
                height[n] = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
                s = sigma[v, u]
                spread[n] = max(s if np.isfinite(s) else np.float32(1e3), np.float32(1e-4))
                n += 1
    return cells, height, spread


@njit(cache=True, nogil=True)
def _merge(
    cells: Array, z: F32, sigma: F32, when: float, best: F32, mean: F32, weight: F32, last: F32
) -> None:
    """Take points into a tile: least sigma, weighted mean height, latest time."""
    for p in range(len(z)):
        col, row = cells[p, 0], cells[p, 1]
        w = 1.0 / (sigma[p] * sigma[p])
        weight[row, col] += w
        mean[row, col] += (z[p] - mean[row, col]) * w / weight[row, col]
        best[row, col] = min(best[row, col], sigma[p])
        last[row, col] = max(last[row, col], when)


FARTHEST = 3.0
"""An image sees the ground up to this many times its median depth."""

PLACE = np.dtype(
    [
        ("seq", np.int64),
        ("seen_s", np.float64),  # from the first keyframe
        ("corners_m", np.float64, (4, 2)),  # east and north, around the image
        ("centre_m", np.float64, (2,)),  # where the middle of the image looks
        ("camera_m", np.float64, (3,)),
        ("low", np.int64, (2,)),  # first and last of the tiles with surface of it
        ("high", np.int64, (2,)),
    ]
)
"""A row of the table: what is kept of a keyframe."""


def footprint(depth: DepthMap) -> Rows | None:
    """A row of :data:`PLACE` with the camera and the ground that its image covers, taken as level
    at its median height; None without any depth."""
    known = np.isfinite(depth.depth_m)
    if not known.any():
        return None
    h, w = depth.depth_m.shape
    T = depth.T_world_camera
    middle_m = float(np.median(depth.depth_m[known]))
    edge = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]])
    spots = np.vstack([edge, [[(w - 1) / 2, (h - 1) / 2]]])
    ways = rays(depth.K, spots) @ T[:3, :3].T
    drop_m = -float(middle_m * ways[4, 2])  # from the camera to the ground in its middle
    with np.errstate(divide="ignore"):
        reach = np.where(ways[:, 2] < 0, -max(drop_m, 0.0) / ways[:, 2], np.inf)
    reach = np.minimum(reach, FARTHEST * middle_m)
    ground = T[:2, 3] + reach[:, None] * ways[:, :2]
    row = np.zeros(1, PLACE)
    row["corners_m"], row["centre_m"], row["camera_m"] = ground[:4], ground[4], T[:3, 3]
    return row
