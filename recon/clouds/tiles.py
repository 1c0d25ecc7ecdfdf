"""Places sorted into tiles of the ground, and which of the tiles a depth map can see.

A long scan has millions of points and a thousand keyframes, of which each sees a few tiles.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from recon.types import F32, F64, Bool, DepthMap

I64 = npt.NDArray[np.int64]
U32 = npt.NDArray[np.uint32]

PLACES = 2048
"""In a tile, about."""

SAMPLED = 100_000
"""Places that tell how large a tile is."""

HALF = 1 << 15
"""Rows and columns of tiles to either side; what lies farther off shares the last."""


class Tiles:
    """``xyz_m`` (N, 3) float32 are the places in the order of their tiles, ``order`` (N,) where
    they were; tile ``t`` holds those from ``first[t]`` to ``first[t + 1]``. Who has no more to
    ask about a tile sets ``is_decided[t]``.
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

    def in_view(self, depth: DepthMap, slack_m: float = 0.0, up_m: float = 0.0) -> I64:
        """(M,) undecided tiles that may hold a place in the picture, no more than ``slack_m``
        behind the farthest surface in it; or one that is raised by up to ``up_m``.
        """
        planes = _planes(depth, slack_m)
        if planes is None:
            return np.zeros(0, np.int64)
        up = np.array([0.0, 0.0, 0.5 * up_m])
        middle, half = self._middle + up, self._half + up
        reach = middle @ planes[:, :3].T + half @ np.abs(planes[:, :3]).T + planes[:, 3]
        return np.flatnonzero((reach >= 0.0).all(axis=1) & ~self.is_decided)


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
    """(6, 4) planes about what the depth map holds, positive inside; None without any depth."""
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
