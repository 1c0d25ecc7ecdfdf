"""Many clouds fused into one: inverse-variance means per voxel, lone contradicted points left out.

The voxel keys are those of :mod:`recon.mapping.voxel_map`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
from numba import njit

from recon.mapping.voxel_map import find_slot, rehash, voxel_key
from recon.parallel import parallel_for, run_parallel
from recon.table import Rows
from recon.types import F32, F64, I32, I64, U8, Bool, DepthMap, PointCloud

CORRELATION = 0.55
"""Correlation of the errors of two keyframes at one place: they share frames, poses and texture."""

_Fused = tuple[I64, PointCloud]
"""Keys of voxels, sorted, and the mean point of each."""

MAX_SIGMA_SHARE = 0.1
"""Of the depth. Stereo's own readings stay below 0.04; a larger sigma says that other views of the
ground contradict the image. Where its median is larger, nothing of the image holds."""

LONE_NEIGHBOURS = 3
"""A point with fewer occupied voxels than this among the 26 around it stands alone."""

ISLAND_SHIFT, ISLAND_POINTS = 3, 128
"""Cells of 2**3 voxels a side that touch are one piece of surface; a piece of fewer points than two
cells have on a plane is an island."""


def fuse(clouds: Iterable[PointCloud], voxel_m: float) -> PointCloud:
    """One point per voxel of ``voxel_m``: mean position, colour and sigma, views summed.

    Points count by the inverse of their variance. Points of one cloud in one voxel are
    neighbours in one depth image, so together they count as the best of them for sigma and
    views; errors of clouds have :data:`CORRELATION`. A single-view point that
    stands alone is left out when surface seen more often, above or below it, contradicts it, and so
    are islands of mostly single-view points above or below such surface. Order is that of the
    voxel keys (x first), whatever the order of points in a cloud.
    """
    return without_contradicted(*fuse_strips([lambda: clouds], [-np.inf, np.inf], voxel_m))


def fuse_strips(
    strips: Sequence[Callable[[], Iterable[PointCloud]]], edges_m: Sequence[float], voxel_m: float
) -> _Fused:
    """The means of :func:`fuse`, in strips of x, so that the sums of one per core are held.

    ``strips[n]`` gives the clouds that reach into ``edges_m[n] <= x < edges_m[n + 1]``; their
    points outside are skipped. Finite edges are moved to the voxel border below them, so the result
    is that of the whole. :func:`without_contradicted` then leaves out what ``fuse`` does.
    """
    borders = np.floor(np.asarray(edges_m, np.float64) / voxel_m)

    def fused(strip: Callable[[], Iterable[PointCloud]], low: float, high: float) -> _Fused:
        sums = _Sums()
        times: list[I64 | None] = []
        for number, cloud in enumerate(strip()):
            times.append(cloud.time_ns)
            sums.add(cloud, number, voxel_m, low, high)
        return sums.means(_first_of_each(times))

    rows = zip(strips, borders[:-1], borders[1:], strict=True)
    found = run_parallel(*(partial(fused, *row) for row in rows))
    return np.concatenate([of[0] for of in found]), joined([of[1] for of in found])


def without_contradicted(keys: I64, means: PointCloud) -> PointCloud:
    """The ``means`` of :func:`fuse_strips` less the lone points and islands that :func:`fuse`
    leaves out."""
    lone = np.zeros(len(means), np.bool_)
    parallel_for(_lone_contradicted, len(lone), keys, means.xyz_m, means.sigma_m, means.views, lone)
    lone |= _islands(keys, means.views)
    return means if not lone.any() else without(means, lone)


def _first_of_each(times_ns: Sequence[I64 | None]) -> I64 | None:
    """The time of each cloud (0 for an empty one); None when one does not know it."""
    known = [t for t in times_ns if t is not None]
    if len(known) < len(times_ns):
        return None
    return np.array([t[0] if len(t) else 0 for t in known], np.int64)


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """One cloud of all; without times when one has none."""
    times = [cloud.time_ns for cloud in clouds if cloud.time_ns is not None]
    return PointCloud(
        np.concatenate([cloud.xyz_m for cloud in clouds]),
        np.concatenate([cloud.rgb for cloud in clouds]),
        np.concatenate([cloud.sigma_m for cloud in clouds]),
        np.concatenate([cloud.views for cloud in clouds]),
        time_ns=np.concatenate(times) if len(times) == len(clouds) else None,
    )


def without(cloud: PointCloud, mask: Bool) -> PointCloud:
    """The points of ``cloud`` that ``mask`` (N,) does not mark."""
    keep = np.flatnonzero(~mask)  # rows are gathered several times faster than masked
    return PointCloud(
        cloud.xyz_m.take(keep, 0), cloud.rgb.take(keep, 0), cloud.sigma_m.take(keep),
        cloud.views.take(keep), None if cloud.time_ns is None else cloud.time_ns.take(keep),
    )  # fmt: skip


_SUM = np.dtype(
    [
        ("xyz", np.float64, 3),  # sum of w xyz over points, w one over the variance
        ("weight", np.float64),  # of w
        ("rgb", np.float32, 3),  # of w rgb
        ("independent", np.float64),  # sum over clouds of the best w
        ("best_of_last", np.float64),  # w in the last cloud
        ("best", np.float64),  # w of all
        ("best_cloud", np.int32),  # which has that
        ("last", np.int32),  # cloud
        ("views", np.int32),  # sum over clouds of the most views
        ("views_of_last", np.int32),  # the most in the last cloud
    ],
    align=True,
)
"""What is known of a voxel; clouds count from 1."""


class _Sums:
    """The running sums of ``fuse``, in a dense array found through a hash of voxel keys."""

    def __init__(self) -> None:
        self.keys: I64 = np.full(1 << 16, -1, np.int64)
        self.ids: I32 = np.zeros(1 << 16, np.int32)
        self.sums: Rows = np.zeros(1 << 15, _SUM)
        self.count = 0

    def add(self, cloud: PointCloud, number: int, voxel_m: float, low: float, high: float) -> None:
        """Add one cloud's points whose voxel's x index lies in [low, high)."""
        while len(self.sums) < self.count + len(cloud):
            held, self.sums = self.sums, np.zeros(2 * len(self.sums), _SUM)
            self.sums[: len(held)] = held
        slots = len(self.keys)
        while slots < 2 * (self.count + len(cloud)):
            slots *= 2
        if slots > len(self.keys):
            self.keys, self.ids = rehash(self.keys, self.ids, slots)
        self.count = _accumulate(
            self.keys,
            self.ids,
            self.sums,
            self.count,
            number + 1,
            np.ascontiguousarray(cloud.xyz_m, np.float32),
            np.ascontiguousarray(cloud.rgb, np.uint8),
            np.ascontiguousarray(cloud.sigma_m, np.float32),
            np.ascontiguousarray(cloud.views, np.uint8),
            1.0 / voxel_m,
            low,
            high,
        )

    def means(self, times_ns: I64 | None) -> _Fused:
        """The voxel keys, sorted, and the mean point of each; ``times_ns`` of the clouds."""
        at = np.flatnonzero(self.keys != -1)
        at = at[np.argsort(self.keys[at])]
        keys, rows = self.keys[at], self.ids[at]
        time_ns = None if times_ns is None else times_ns[self.sums["best_cloud"][rows] - 1]
        xyz, rgb, sigma, views = _means(rows, self.sums)
        return keys, PointCloud(xyz, rgb, sigma, views, time_ns=time_ns)


@njit(cache=True, nogil=True)
def _means(rows: I32, sums: Rows) -> tuple[F32, U8, F32, U8]:
    """Places, colours, sigmas and views of the means, in the order of ``rows`` (N,)."""
    count = len(rows)
    xyz, rgb = np.empty((count, 3), np.float32), np.empty((count, 3), np.uint8)
    sigma, views = np.empty(count, np.float32), np.empty(count, np.uint8)
    for n in range(count):
        of = sums[rows[n]]
        for k in range(3):
            xyz[n, k] = of.xyz[k] / of.weight
            rgb[n, k] = min(max(np.rint(of.rgb[k] / of.weight), 0.0), 255.0)
        best, independent = 1.0 / of.best, 1.0 / of.independent
        sigma[n] = np.sqrt(CORRELATION * best + (1.0 - CORRELATION) * independent)
        views[n] = min(of.views, 255)
    return xyz, rgb, sigma, views


@njit(cache=True, nogil=True)
def _accumulate(
    keys: I64, ids: I32, sums: Rows, count: int, number: int, xyz: F32, rgb: U8, sigma: F32,
    views: U8, inverse: float, low: float, high: float,
) -> int:  # fmt: skip
    """Add the points in [low, high) of the x index to the sums; the new number of voxels. Points
    without a sigma are left out."""
    for n in range(xyz.shape[0]):
        s = sigma[n]
        if not (s > 0.0 and s < 1e6):
            continue
        x, y, z = float(xyz[n, 0]), float(xyz[n, 1]), float(xyz[n, 2])
        if not low <= np.floor(x * inverse) < high:
            continue
        key = voxel_key(x, y, z, inverse)
        if key == -1:
            continue
        t = find_slot(keys, key)
        if keys[t] == -1:
            keys[t] = key
            ids[t] = count
            count += 1
        of = sums[ids[t]]
        w = 1.0 / (float(s) * float(s))
        of.xyz[0] += w * x
        of.xyz[1] += w * y
        of.xyz[2] += w * z
        of.weight += w
        for c in range(3):
            of.rgb[c] += w * rgb[n, c]
        if of.last != number:
            of.last = number
            of.views_of_last = 0
            of.best_of_last = 0.0
        if w > of.best_of_last:
            of.independent += w - of.best_of_last
            of.best_of_last = w
        if w > of.best:
            of.best = w
            of.best_cloud = number
        if views[n] > of.views_of_last:
            of.views += views[n] - of.views_of_last
            of.views_of_last = views[n]
    return count


@njit(cache=True, nogil=True)
def _lone_contradicted(
    begin: int, end: int, keys: I64, xyz: F32, sigma: F32, views: U8, out: Bool
) -> None:
    """Mark lone single-view points with better, more often seen surface above or below. ``keys``
    are sorted, so a column of voxels is one run of rows."""
    n = keys.shape[0]
    low = (1 << 21) - 1
    for p in range(begin, end):
        if views[p] > 1:
            continue
        neighbours = -1  # the point itself
        contradicted = False
        height = keys[p] & low
        for di in range(-1, 2):
            for dj in range(-1, 2):
                column = (keys[p] & ~low) + (np.int64(di) << 42) + (np.int64(dj) << 21)
                q = np.searchsorted(keys, column)
                while q < n and (keys[q] & ~low) == column:
                    if abs((keys[q] & low) - height) <= 1:
                        neighbours += 1
                    if views[q] > 1 and sigma[q] < sigma[p]:
                        apart = abs(xyz[q, 2] - xyz[p, 2])
                        contradicted |= apart > 3.0 * (sigma[p] + sigma[q])
                    q += 1
        out[p] = contradicted and neighbours < LONE_NEIGHBOURS


BITS = 21  # of the number of a cell along each axis in its key, x first


def pieces(cells: I64) -> I64:
    """(N,) which piece of surface each of the cells, sorted keys, is of: cells that touch."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = []
    for step in _steps()[14:]:
        n = np.searchsorted(cells, cells + step)
        held = np.flatnonzero(cells[np.minimum(n, len(cells) - 1)] == cells + step)
        pairs.append(np.stack([held, n[held]]))
    ends = np.concatenate(pairs, axis=1)
    links = coo_matrix((np.ones(ends.shape[1], bool), ends), (len(cells), len(cells)))
    return np.asarray(connected_components(links, False)[1], np.int64)


def _steps() -> I64:
    """(27,) from a cell's key to those around it."""
    steps = [(a << 2 * BITS) + (b << BITS) + c for a, b, c in np.ndindex(3, 3, 3)]
    return np.asarray(np.array(steps) - steps[13], np.int64)


def _islands(keys: I64, views: U8) -> Bool:
    """(N,) points of islands that are mostly seen once, where a column of cells at the island
    or next to it also has surface that is seen more often."""
    axis = (1 << BITS - ISLAND_SHIFT) - 1  # a shift moves bits of one axis to the next
    mask = axis << 2 * BITS | axis << BITS | axis
    cells, cell = np.unique(keys >> ISLAND_SHIFT & mask, return_inverse=True)
    part = pieces(cells)
    points = np.bincount(cell)
    singles = np.bincount(cell[views <= 1], minlength=len(cells))
    count, once = np.bincount(part, points), np.bincount(part, singles)
    is_island = (count < ISLAND_POINTS) & (2 * once > count)
    columns = np.unique(cells[(points > singles) & ~is_island[part]] >> BITS)
    suspect = np.flatnonzero(is_island[part])
    around = (_steps()[1::3] >> BITS)[None] + (cells[suspect] >> BITS)[:, None]
    refuted = np.zeros(len(count), np.bool_)
    refuted[part[suspect[np.isin(around, columns).any(axis=1)]]] = True
    return np.asarray(refuted[part][cell])


def cloud_of(
    depth: DepthMap, bgr: U8, mask: Bool | None = None, time_ns: int | None = None
) -> PointCloud:
    """World points of the pixels with a resolved depth, in row order, where ``mask`` if given.
    ``bgr`` is (h, w, 3) on the grid of the depth."""
    known = np.isfinite(depth.depth_m) & (depth.depth_m > 0.0) & np.isfinite(depth.sigma_m)
    resolved = known & (depth.sigma_m < MAX_SIGMA_SHARE * depth.depth_m)
    known = resolved & (2 * resolved.sum() >= known.sum())
    if mask is not None:
        known &= mask
    arrays = (depth.depth_m, bgr, depth.K, depth.T_world_camera)
    xyz, rgb = _coloured_places(known, int(known.sum()), *map(np.ascontiguousarray, arrays))
    times = None if time_ns is None else np.broadcast_to(np.int64(time_ns), (len(xyz),))
    return PointCloud(xyz, rgb, depth.sigma_m[known], depth.views[known], time_ns=times)


@njit(cache=True, nogil=True)
def _coloured_places(
    known: Bool, count: int, depth: F32, bgr: U8, K: F64, T: F64
) -> tuple[F32, U8]:
    """(count, 3) places, m, and RGB of the ``known`` pixels; ``T`` is T_world_camera."""
    xyz, rgb = np.empty((count, 3), np.float32), np.empty((count, 3), np.uint8)
    n = 0
    for v in range(known.shape[0]):
        for u in range(known.shape[1]):
            if known[v, u]:
                z = float(depth[v, u])
                x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
                for k in range(3):
                    xyz[n, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
                    rgb[n, k] = bgr[v, u, 2 - k]
                n += 1
    return xyz, rgb
