"""Space that views see through: points that stereo invented, and places open to the sky.

A keyframe that sees surface well behind a point, all around the pixel where the point would be,
shows that the point's place is empty. One that sees surface at the point confirms it (Merrell et
al. 2007, doi:10.1109/ICCV.2007.4408984). A long scan has millions of points and a thousand
keyframes, of which each sees a few tiles of the ground.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from numba import njit

from recon.parallel import parallel_for
from recon.types import F32, F64, I16, I64, U8, Array, Bool, DepthMap, PointCloud

U32 = npt.NDArray[np.uint32]

PLACES = 2048  # points in a tile, about
SAMPLED = 100_000  # number of places that the size of a tile is estimated from
HALF = 1 << 15  # rows and columns of tiles to either side; farther points share the last ones


class Tiles:
    """``xyz_m`` (N, 3) float32 are the places in the order of their tiles, ``order`` (N,) where
    they were; tile ``t`` holds those from ``first[t]`` to ``first[t + 1]``. A caller that is done
    with a tile sets ``is_decided[t]``.
    """

    def __init__(self, xyz_m: F32 | F64) -> None:
        """Sort (N, 3) places in the world."""
        key = _keys(xyz_m)
        self.order: I64 = np.argsort(key, kind="stable")
        self.xyz_m: F32 = np.ascontiguousarray(xyz_m[self.order], np.float32)
        key = key[self.order]
        edges = np.flatnonzero(key[1:] != key[:-1]) + 1
        self.first: I64 = np.concatenate([[0], edges, [len(key)]]) if len(key) else np.zeros(1, int)
        self.is_decided: Bool = np.zeros(len(self), np.bool_)
        low, high = self._ends(np.minimum), self._ends(np.maximum)
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)

    def _ends(self, pick: np.ufunc) -> F64:
        """(T, 3) the least or greatest coordinates in each tile."""
        if not len(self):
            return np.zeros((0, 3))
        return np.asarray(pick.reduceat(self.xyz_m, self.first[:-1]), np.float64)

    def __len__(self) -> int:
        """How many tiles hold a place."""
        return len(self.first) - 1

    def in_view(
        self, depth: DepthMap, slack_m: float = 0.0, up_m: tuple[float, float] = (0.0, 0.0)
    ) -> I64:
        """(M,) undecided tiles that may hold a place in the image, no more than ``slack_m`` behind
        the farthest surface in it; or one that is raised by ``up_m``, from and to."""
        planes = _planes(depth, slack_m)
        if planes is None:
            return np.zeros(0, np.int64)
        low, high = up_m
        up = np.array([0.0, 0.0, 0.5])
        middle, half = self._middle + up * (low + high), self._half + up * (high - low)
        reach = middle @ planes[:, :3].T + half @ np.abs(planes[:, :3]).T + planes[:, 3]
        return np.flatnonzero((reach >= 0.0).all(axis=1) & ~self.is_decided)

    def look(self, kernel: Any, depth: DepthMap, reached: I64, *arrays: Array | int) -> None:
        """Run a compiled ``kernel`` on the tiles that are ``reached``, with a keyframe's depth,
        sigma and camera, and with ``arrays`` of its own."""
        if len(reached):
            parallel_for(
                kernel, len(reached), reached, self.first, self.xyz_m, self.is_decided,
                np.ascontiguousarray(depth.depth_m, np.float32),
                np.ascontiguousarray(depth.sigma_m, np.float32),
                np.ascontiguousarray(depth.K, np.float64), np.linalg.inv(depth.T_world_camera),
                *arrays,
            )  # fmt: skip


def _keys(xyz_m: F32 | F64) -> U32:
    """(N,) the same number for places of one tile; columns of memory are few: N is large."""
    if not len(xyz_m):
        return np.zeros(0, np.uint32)
    some = np.asarray(xyz_m[:: max(1, len(xyz_m) // SAMPLED), :2], np.float64)
    low, high = np.percentile(some, [5.0, 95.0], axis=0)  # a stray point enlarges no tile
    area = float(np.prod(high - low)) / 0.81
    side = max(math.sqrt(area / len(xyz_m) * PLACES), float((high - low).max()) / 1024, 1e-3)
    key = np.zeros(len(xyz_m), np.uint32)
    for axis in (0, 1):
        number = (xyz_m[:, axis] - float(low[axis])) / side + HALF
        key <<= np.uint32(16)
        key |= np.clip(number, 0, 2 * HALF - 1).astype(np.uint32)
    return key


def _planes(depth: DepthMap, slack_m: float) -> F64 | None:
    """(6, 4) planes around the depth map's surface, positive inside; None without any depth."""
    known = np.isfinite(depth.depth_m)
    if not known.any():
        return None
    h, w = depth.depth_m.shape
    far = float(depth.depth_m[known].max()) + slack_m
    (fx, _, cx), (_, fy, cy) = depth.K[:2]
    inside = np.array(
        [
            [fx, 0.0, cx + 1.0, 0.0],
            [-fx, 0.0, w - cx, 0.0],
            [0.0, fy, cy + 1.0, 0.0],
            [0.0, -fy, h - cy, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, -1.0, far],
        ]
    )
    planes: F64 = inside @ np.linalg.inv(depth.T_world_camera)
    return planes


AGREES_SIGMAS = 2.5
BEHIND_SIGMAS = 4.0
WINDOW_PX = 2  # surface must be behind the point at every known pixel this far around it

KNOWN_SHARE = 0.5

MAX_VIEWS = 100
"""Maximum number of keyframes consulted per point: a camera that stays over one place has
thousands. Their pairs, at most 255 each, are counted in 16 bits."""

AIR_SLACK_M = 1.0  # air that a surface of the whole image hides is looked at so far behind it

GOLDEN = 0.5 * (5.0**0.5 - 1.0)
T = TypeVar("T")


def spread(views: Sequence[T]) -> list[T]:
    """The same views in an order whose every beginning is spread evenly over the whole. By the
    golden ratio: Weyl's sequence of low discrepancy."""
    turns = (np.arange(len(views)) * GOLDEN) % 1.0
    return [views[i] for i in np.argsort(turns, kind="stable").argsort(kind="stable")]


def seen_through(cloud: PointCloud, views: Iterable[DepthMap], window_px: int = WINDOW_PX) -> Bool:
    """(N,) points that more stereo pairs see through than see.

    A keyframe counts with the number of pairs that agree at its pixel. Points that no
    keyframe sees at all are kept. Who sees through one sees surface behind it at every known pixel
    within ``window_px``. The first MAX_VIEWS keyframes with a point's place in the
    image decide; where there may be more of them, give the views as :func:`spread` orders them.
    """
    tiles = Tiles(cloud.xyz_m)
    sigma = np.ascontiguousarray(cloud.sigma_m[tiles.order], np.float32)
    seers, asked = np.zeros(len(sigma), np.int16), np.zeros(len(sigma), np.uint8)
    largest_m = float(sigma.max(initial=0.0))
    for depth in views:
        slack_m = AGREES_SIGMAS * (largest_m + float(np.nanmax(depth.sigma_m, initial=0.0)))
        pairs = np.ascontiguousarray(depth.views, np.uint8)
        reached = tiles.in_view(depth, slack_m)
        tiles.look(_vote, depth, reached, sigma, pairs, window_px, seers, asked)
    out: Bool = np.zeros(len(cloud), np.bool_)
    out[tiles.order] = seers < 0
    return out


def air_above(
    places_m: F64, heights_m: Sequence[float], views: Iterable[DepthMap]
) -> tuple[Bool, U8]:
    """(N, H) whether a keyframe sees through the air so far above each place, and (N, H) how many
    keyframes see a surface in front of it or at it, counted up to 255 and until one sees through.

    A camera that looks sideways sees ground below a crown or an eave; where nothing above
    the ground was seen to be empty, the ground need not be the highest surface there. Places
    are (N, 3) in the world of the depth maps.
    """
    tiles = Tiles(places_m)
    up = np.asarray(heights_m, np.float64)
    is_open = np.zeros((len(places_m), len(up)), np.bool_)
    behind = np.zeros((len(places_m), len(up)), np.uint8)
    around = float(up.min(initial=0.0)), float(up.max(initial=0.0))
    for depth in views:
        reached = tiles.in_view(depth, AIR_SLACK_M, around)
        tiles.look(_look_above, depth, reached, up, is_open, behind)
    out: tuple[Bool, U8] = np.zeros_like(is_open), np.zeros_like(behind)
    out[0][tiles.order], out[1][tiles.order] = is_open, behind
    return out


@njit(cache=True, nogil=True)
def pixel_of(K: F64, T: F64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The pixel (u, v) of a place and its depth; (-1, -1) nearer than 0.1 m or behind. ``T`` is
    T_camera_world, at least its first three rows."""
    cz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if cz <= 0.1:
        return -1.0, -1.0, cz
    cx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    cy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    return K[0, 0] * cx / cz + K[0, 2], K[1, 1] * cy / cz + K[1, 2], cz


@njit(cache=True, nogil=True)
def _look_above(
    begin: int, end: int, tiles: I64, first: I64, xyz: F32, is_decided: Bool, depth: F32,
    depth_sigma: F32, K: F64, T: F64, up_m: F64, is_open: Bool, behind: U8,
) -> None:  # fmt: skip
    """Take what a keyframe sees of the air ``up_m[j]`` above the places of ``tiles[begin:end]``
    into column j of ``is_open`` and ``behind``."""
    h, w = depth.shape
    for tile in tiles[begin:end]:
        left = 0
        for p in range(first[tile], first[tile + 1]):
            for j in range(up_m.shape[0]):
                if is_open[p, j]:
                    continue
                left += 1
                x, y, z = float(xyz[p, 0]), float(xyz[p, 1]), float(xyz[p, 2]) + up_m[j]
                at, down, cz = pixel_of(K, T, x, y, z)
                u, v = int(np.floor(at + 0.5)), int(np.floor(down + 0.5))
                if not (0 <= u < w and 0 <= v < h):
                    continue
                if depth[v, u] - cz > AGREES_SIGMAS * float(depth_sigma[v, u]):
                    is_open[p, j] = True
                    left -= 1
                elif depth[v, u] > 0.0 and behind[p, j] < 255:
                    behind[p, j] += np.uint8(1)
        is_decided[tile] = left == 0


@njit(cache=True, nogil=True)
def _vote(
    begin: int, end: int, tiles: I64, first: I64, xyz: F32, is_decided: Bool, depth: F32,
    depth_sigma: F32, K: F64, T: F64, sigma: F32, views: U8, window: int, seers: I16, asked: U8,
) -> None:  # fmt: skip
    """Add one keyframe's votes on the points of ``tiles[begin:end]`` to ``seers``. A vote is the
    pairs that see less the pairs that see through; ``T`` is T_camera_world."""
    h, w = depth.shape
    for tile in tiles[begin:end]:
        left = 0
        for p in range(first[tile], first[tile + 1]):
            if asked[p] == MAX_VIEWS:
                continue
            left += 1
            x, y, z = float(xyz[p, 0]), float(xyz[p, 1]), float(xyz[p, 2])
            at, down, cz = pixel_of(K, T, x, y, z)
            u, v = int(np.floor(at + 0.5)), int(np.floor(down + 0.5))
            if not (window <= u < w - window and window <= v < h - window):
                continue
            asked[p] += 1
            seers[p] += _judgement(u, v, cz, float(sigma[p]), depth, depth_sigma, views, window)
        is_decided[tile] = left == 0


@njit(cache=True, nogil=True)
def _judgement(
    u: int, v: int, cz: float, sigma: float, depth: F32, depth_sigma: F32, views: U8, window: int
) -> int:
    """The pairs that see a point at pixel (u, v) and depth ``cz``; negative: see through it."""
    here = depth[v, u]
    if abs(here - cz) <= AGREES_SIGMAS * (sigma + float(depth_sigma[v, u])):
        return max(int(views[v, u]), 1)
    known = 0
    most = 1
    agrees = False
    behind = 0
    for dv in range(-window, window + 1):
        for du in range(-window, window + 1):
            d = depth[v + dv, u + du]
            if not d > 0.0:
                continue
            s = sigma + float(depth_sigma[v + dv, u + du])
            known += 1
            if d - cz > BEHIND_SIGMAS * s:
                behind += 1
            if abs(du) <= 1 and abs(dv) <= 1:
                agrees = agrees or abs(d - cz) <= AGREES_SIGMAS * s
                most = max(most, int(views[v + dv, u + du]))
    if agrees:
        return most
    if known >= KNOWN_SHARE * (2 * window + 1) ** 2 and behind == known:
        return -most
    return 0
