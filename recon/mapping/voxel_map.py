"""Known surface: voxels in a hash.

A voxel is named by its three indices, packed into one 64-bit key. Keys live in an open
addressing table with linear probing that points into dense arrays, so memory grows with the
area flown and not with its bounding box (Niessner et al. 2013, doi:10.1145/2508363.2508374,
without the blocks).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from recon import se3
from recon.camera_model import project, rays
from recon.parallel import parallel_for
from recon.table import Rows
from recon.types import F32, F64, I32, I64, Bool, DepthMap

EMPTY = np.int64(-1)
TILE_BITS = 7  # pages hold square columns of 2**7 voxels on a side
SAMPLED_ROWS = 24  # of a depth map, where some of its surface stands for all
_OFFSET = 1 << 20
LARGEST_INDEX = _OFFSET - 1
"""Voxel indices reach this far from the origin on each axis; points beyond are left out."""


BETTER_RATIO = 1.5  # surface is better when its sigma, times this, is still below the held one

REACH_SIGMA, LARGEST_REACH = 2.0, 6
"""Held surface within so many sigma along the pixel's ray is the same surface, so many voxels away
at most."""

LARGEST_VOXELS = 8_000_000
"""Above this the half seen longest ago is dropped (and would be sent again)."""


@njit(cache=True, nogil=True, inline="always")
def voxel_key(x: float, y: float, z: float, inverse: float) -> int:
    """The packed key of the voxel at (x, y, z) m, or EMPTY when it is out of range."""
    i, j, k = np.floor(x * inverse), np.floor(y * inverse), np.floor(z * inverse)
    if not (abs(i) < LARGEST_INDEX and abs(j) < LARGEST_INDEX and abs(k) < LARGEST_INDEX):
        return -1  # also NaN and infinity
    return ((int(i) + _OFFSET) << 42) | ((int(j) + _OFFSET) << 21) | (int(k) + _OFFSET)


@njit(cache=True, nogil=True, inline="always")
def find_slot(keys: I64, key: int) -> int:
    """Where ``key`` is in the table, or the empty slot where it would go."""
    mask = keys.shape[0] - 1
    h = key * -7046029254386353131  # 2**64 / golden ratio, odd
    h ^= (h >> 32) & 0xFFFFFFFF
    s = h & mask
    while keys[s] != -1 and keys[s] != key:
        s = (s + 1) & mask
    return int(s)


@njit(cache=True, nogil=True)
def rehash(old: I64, ids: I32, size: int) -> tuple[I64, I32]:
    """A table of ``size`` slots (a power of two) with the same keys."""
    keys = np.full(size, -1, np.int64)
    out = np.zeros(size, np.int32)
    for s in range(old.shape[0]):
        if old[s] != -1:
            t = find_slot(keys, old[s])
            keys[t] = old[s]
            out[t] = ids[s]
    return keys, out


VOXEL = np.dtype([("sigma_m", np.float32), ("seen", np.int32)])
"""What is held of a voxel: its sigma, and the turn of the last keyframe that saw it."""

PAGED = np.dtype([("key", np.int64), *VOXEL.descr])  # a voxel outside a map, as it is paged


def tile_of(keys: I64) -> I64:
    """(N,) number of the square column of TILE x TILE voxels that each key (N,) lies in."""
    i, j = keys >> 42, (keys >> 21) & ((1 << 21) - 1)
    return np.asarray(((i >> TILE_BITS) << 21) | (j >> TILE_BITS))


def sampled(depth: DepthMap) -> tuple[tuple[I64, I64], F64]:
    """Rows and columns of known pixels on a coarse grid of ``depth``, and the (N, 3) places that
    they show, m, world."""
    step = max(1, depth.depth_m.shape[0] // SAMPLED_ROWS)
    v, u = np.nonzero(np.isfinite(depth.depth_m[::step, ::step]))
    v, u = step * v, step * u
    z = depth.depth_m[v, u, None].astype(np.float64)
    uv = np.column_stack([u, v]).astype(np.float64)
    return (v, u), se3.transform(depth.T_world_camera, rays(depth.K, uv) * z)


def shared(depth: DepthMap, points_m: F32) -> tuple[I64, tuple[I64, I64], F64]:
    """Which of (N, 3) world points lie in the image of ``depth`` where that is known, the row and
    column of each, and its own depth there."""
    h, w = depth.depth_m.shape
    here = se3.transform(se3.inverse(depth.T_world_camera), points_m.astype(np.float64))
    which = np.flatnonzero(here[:, 2] > 1e-3)
    uv = np.rint(project(depth.K, here[which]))
    inside = (uv[:, 0] >= 0) & (uv[:, 1] >= 0) & (uv[:, 0] < w) & (uv[:, 1] < h)
    u, v = uv[inside].astype(np.int64).T
    which = which[inside]
    known = np.isfinite(depth.depth_m[v, u])
    return which[known], (v[known], u[known]), here[which[known], 2]


def tiles_under(depth: DepthMap, voxel_m: float, margin_m: float) -> I64:
    """(T,) tiles that the surface of ``depth`` lies in, and those ``margin_m`` around it."""
    _, points = sampled(depth)
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = points[:, :2].min(axis=0) - margin_m, points[:, :2].max(axis=0) + margin_m
    reach = LARGEST_INDEX - 1
    first = (np.floor(low / voxel_m).clip(-reach, reach).astype(np.int64) + _OFFSET) >> TILE_BITS
    last = (np.floor(high / voxel_m).clip(-reach, reach).astype(np.int64) + _OFFSET) >> TILE_BITS
    x, y = np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1))
    return np.asarray(((x << 21) | y).ravel())


class VoxelMap:
    """Remembers the best sigma of the surface in each voxel.

    One thread at a time. Answers are about surface along the camera's rays: noise that lifts
    a known roof into the next voxel does not make it new.
    """

    def __init__(self, voxel_m: float, largest_voxels: int = LARGEST_VOXELS) -> None:
        """``voxel_m`` of about twice the ground sample distance keeps the gaps between the pixels
        of two keyframes from looking like new surface."""
        self.voxel_m, self._largest_voxels = voxel_m, largest_voxels
        self._turn = 0
        self._count: int = 0
        self._clear()

    def __len__(self) -> int:
        return self._count

    def close(self) -> None:
        """Release what is held outside of memory; here nothing is."""

    @property
    def nbytes(self) -> int:
        return self._keys.nbytes + self._ids.nbytes + self._voxels.nbytes

    def fresh(self, depth: DepthMap) -> Bool:
        """(h, w) pixels whose surface is new, or clearly better than what is held."""
        out = np.zeros(depth.depth_m.shape, np.bool_)
        parallel_for(
            _fresh, len(out), self._keys, self._ids, self._voxels, *_arrays(depth),
            1.0 / self.voxel_m, out,
        )  # fmt: skip
        return out

    def insert(self, depth: DepthMap, mask: Bool | None = None) -> int:
        """Remember the surface of ``depth``, where ``mask`` if given; how many voxels are new."""
        mask_ = np.ones(depth.depth_m.shape, np.bool_) if mask is None else mask
        self._turn += 1
        if self._count > self._largest_voxels:
            self._forget_half()
        self._make_room(int(np.count_nonzero(mask_)))
        before = self._count
        self._count = int(
            _insert(
                self._keys, self._ids, self._voxels, self._count, self._turn, *_arrays(depth),
                mask_, 1.0 / self.voxel_m,
            )
        )  # fmt: skip
        return self._count - before

    def _clear(self) -> None:
        slots = 1 << 16
        self._keys: I64 = np.full(slots, EMPTY, np.int64)
        self._ids: I32 = np.zeros(slots, np.int32)
        self._voxels: Rows = np.zeros(slots // 2, VOXEL)
        self._count = 0

    def _make_room(self, more: int) -> None:
        """Room for ``more`` voxels at a load of one half."""
        need = self._count + more
        slots = len(self._keys)
        while slots < 2 * need:
            slots *= 2
        if slots == len(self._keys):
            return
        self._keys, self._ids = rehash(self._keys, self._ids, slots)
        self._voxels = np.resize(self._voxels, slots // 2)

    def take(self, tiles: I64) -> Rows:
        """Remove all voxels of some tiles (:func:`tile_of`) and return them, rows of PAGED."""
        held = self._held()
        gone = np.isin(tile_of(held["key"]), tiles)
        self._refill(held[~gone])
        return held[gone]

    def put(self, voxels: Rows) -> None:
        """Add voxels taken before; where one is held already the smaller sigma stays."""
        self._make_room(len(voxels))
        self._count = int(_put(self._keys, self._ids, self._voxels, self._count, voxels))

    def oldest_tiles(self) -> tuple[I64, I64]:
        """(T,) tiles that hold voxels, those seen longest ago first, and (T,) how many."""
        held = self._held()
        tiles, index, counts = np.unique(
            tile_of(held["key"]), return_inverse=True, return_counts=True
        )
        newest = np.zeros(len(tiles), np.int32)
        np.maximum.at(newest, index, held["seen"])
        order = np.argsort(newest, kind="stable")
        return np.asarray(tiles[order]), np.asarray(counts[order], np.int64)

    def _forget_half(self) -> None:
        held = self._held()
        self._refill(held[held["seen"] > int(np.median(held["seen"]))])

    def _held(self) -> Rows:
        at = np.flatnonzero(self._keys != EMPTY)
        out = np.empty(len(at), PAGED)
        out["key"], out[["sigma_m", "seen"]] = self._keys[at], self._voxels[self._ids[at]]
        return out

    def _refill(self, voxels: Rows) -> None:
        self._clear()
        self._make_room(2 * len(voxels))
        self.put(voxels)


def _arrays(depth: DepthMap) -> tuple[F32, F32, F64, F64]:
    """Depth, sigma, K and pose with the layout that the kernels are compiled for."""
    return (
        np.ascontiguousarray(depth.depth_m, np.float32),
        np.ascontiguousarray(depth.sigma_m, np.float32),
        np.ascontiguousarray(depth.K, np.float64),
        np.ascontiguousarray(depth.T_world_camera, np.float64),
    )


@njit(cache=True, nogil=True)
def _put(keys: I64, ids: I32, held: Rows, count: int, new: Rows) -> int:
    """See VoxelMap.put; the new number of voxels."""
    for n in range(new.shape[0]):
        t = find_slot(keys, new[n].key)
        if keys[t] == -1:
            keys[t] = new[n].key
            ids[t] = count
            held[count].sigma_m, held[count].seen = new[n].sigma_m, new[n].seen
            count += 1
            continue
        known = held[ids[t]]
        known.sigma_m = min(known.sigma_m, new[n].sigma_m)
        known.seen = max(known.seen, new[n].seen)
    return count


@njit(cache=True, nogil=True, fastmath=False)
def _fresh(
    begin: int, end: int, keys: I64, ids: I32, held: Rows, depth: F32, sigma: F32, K: F64, T: F64,
    inverse: float, out: Bool,
) -> None:  # fmt: skip
    """See VoxelMap.fresh; the ray is sampled every voxel, nearest samples first."""
    w = depth.shape[1]
    for v in range(begin, end):
        b = (v - K[1, 2]) / K[1, 1]
        for u in range(w):
            z, s = depth[v, u], sigma[v, u]
            if not (z > 0.0 and s > 0.0):
                continue
            a = (u - K[0, 2]) / K[0, 0]
            # The ray per metre of depth; samples are one voxel apart along it.
            dx = T[0, 0] * a + T[0, 1] * b + T[0, 2]
            dy = T[1, 0] * a + T[1, 1] * b + T[1, 2]
            dz = T[2, 0] * a + T[2, 1] * b + T[2, 2]
            step = 1.0 / (inverse * np.sqrt(dx * dx + dy * dy + dz * dz))
            # Held surface may be as uncertain as this one: sqrt(2) of its sigma.
            reach = max(min(int(np.ceil(REACH_SIGMA * 1.4142 * s / step)), LARGEST_REACH), 1)
            known = False
            for n in range(2 * reach + 1):
                offset = (n + 1) // 2 if n % 2 else -(n // 2)
                r = z + offset * step
                key = voxel_key(T[0, 3] + r * dx, T[1, 3] + r * dy, T[2, 3] + r * dz, inverse)
                if key == -1:
                    known = True
                    break
                t = find_slot(keys, key)
                if keys[t] == key and held[ids[t]].sigma_m <= s * BETTER_RATIO:
                    known = True
                    break
            out[v, u] = not known


@njit(cache=True, nogil=True)
def _insert(
    keys: I64, ids: I32, held: Rows, count: int, turn: int, depth: F32, sigma: F32, K: F64, T: F64,
    mask: Bool, inverse: float,
) -> int:  # fmt: skip
    """See VoxelMap.insert; the new number of voxels."""
    h, w = depth.shape
    for v in range(h):
        b = (v - K[1, 2]) / K[1, 1]
        for u in range(w):
            z, s = depth[v, u], sigma[v, u]
            if not (z > 0.0 and s > 0.0 and mask[v, u]):
                continue
            a = (u - K[0, 2]) / K[0, 0]
            key = voxel_key(
                T[0, 3] + z * (T[0, 0] * a + T[0, 1] * b + T[0, 2]),
                T[1, 3] + z * (T[1, 0] * a + T[1, 1] * b + T[1, 2]),
                T[2, 3] + z * (T[2, 0] * a + T[2, 1] * b + T[2, 2]),
                inverse,
            )
            if key == -1:
                continue
            t = find_slot(keys, key)
            if keys[t] == -1:
                keys[t] = key
                ids[t] = count
                held[count].sigma_m = s
                count += 1
            known = held[ids[t]]
            known.sigma_m = min(known.sigma_m, s)
            known.seen = turn
    return count


def ground_sample_m(depth: DepthMap) -> float | None:
    """Metres of surface per pixel: median depth over focal length; None without any depth."""
    known = depth.depth_m[np.isfinite(depth.depth_m)]
    return float(np.median(known) / depth.K[0, 0]) if known.size else None
