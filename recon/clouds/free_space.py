"""What views see through: points that stereo invented, and places that are open to the sky.

A keyframe that sees surface well behind a point, all around the pixel where the point would
be, says that the point's place is empty. One that sees surface at the point confirms it
(Merrell et al. 2007, doi:10.1109/ICCV.2007.4408984).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
from numba import njit

from recon.types import F32, F64, U8, Bool, DepthMap, PointCloud

I32 = npt.NDArray[np.int32]

AGREES_SIGMAS = 2.5
BEHIND_SIGMAS = 4.0
WINDOW_PX = 2
"""Surface must be behind the point at every known pixel this far around it."""

KNOWN_SHARE = 0.5


def seen_through(cloud: PointCloud, views: Iterable[DepthMap]) -> Bool:
    """(N,) points that more stereo pairs see through than see.

    A keyframe counts with the number of pairs that agree at its pixel. Points that no
    keyframe sees at all are kept.
    """
    through = np.zeros(len(cloud), np.int32)
    confirmed = np.zeros(len(cloud), np.int32)
    order = np.argsort(cloud.xyz_m[:, 0], kind="stable")
    xyz = np.ascontiguousarray(cloud.xyz_m[order], np.float32)
    sigma = np.ascontiguousarray(cloud.sigma_m[order], np.float32)
    for depth in views:
        first, last = np.searchsorted(xyz[:, 0], _reach_east(depth))
        if last > first:
            _vote(
                xyz[first:last],
                sigma[first:last],
                np.ascontiguousarray(depth.depth_m, np.float32),
                np.ascontiguousarray(depth.sigma_m, np.float32),
                np.ascontiguousarray(depth.views, np.uint8),
                np.ascontiguousarray(depth.K, np.float64),
                np.linalg.inv(depth.T_world_camera),
                through[first:last],
                confirmed[first:last],
            )
    out: Bool = np.zeros(len(cloud), np.bool_)
    out[order] = through > confirmed
    return out


def open_above(places_m: F64, heights_m: Sequence[float], views: Iterable[DepthMap]) -> Bool:
    """(N,) places above which each of the heights has been seen to be empty by some keyframe.

    A camera that looks sideways sees ground below a crown or an eave; where nothing above
    the ground was seen to be empty, the ground need not be the highest surface there. Places
    are (N, 3) in the world of the depth maps. Raises ValueError for more than 8 heights.
    """
    if not 0 < len(heights_m) <= 8:
        raise ValueError(f"give 1 to 8 heights, not {len(heights_m)}")
    order = np.argsort(places_m[:, 0], kind="stable")
    xyz = np.ascontiguousarray(places_m[order], np.float32)
    up = np.asarray(heights_m, np.float64)
    seen = np.zeros(len(xyz), np.uint8)
    for depth in views:
        first, last = np.searchsorted(xyz[:, 0], _reach_east(depth))
        if last > first:
            _look_above(
                xyz[first:last],
                up,
                np.ascontiguousarray(depth.depth_m, np.float32),
                np.ascontiguousarray(depth.sigma_m, np.float32),
                np.ascontiguousarray(depth.K, np.float64),
                np.linalg.inv(depth.T_world_camera),
                seen[first:last],
            )
    out: Bool = np.zeros(len(xyz), np.bool_)
    out[order] = seen == (1 << len(up)) - 1
    return out


@njit(cache=True, nogil=True)
def _pixel(x: float, y: float, z: float, K: F64, T: F64) -> tuple[int, int, float]:
    """The pixel (u, v) of a place in the world and its depth; (-1, -1) behind the camera."""
    cz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if cz <= 0.1:
        return -1, -1, cz
    cx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    cy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    u = int(np.floor(K[0, 0] * cx / cz + K[0, 2] + 0.5))
    v = int(np.floor(K[1, 1] * cy / cz + K[1, 2] + 0.5))
    return u, v, cz


@njit(cache=True, nogil=True)
def _look_above(
    xyz: F32, up_m: F64, depth: F32, depth_sigma: F32, K: F64, T: F64, seen: U8
) -> None:
    """Set bit j of ``seen`` where a keyframe sees through the place ``up_m[j]`` higher."""
    h, w = depth.shape
    for p in range(xyz.shape[0]):
        for j in range(up_m.shape[0]):
            if seen[p] & (1 << j):
                continue
            x, y, z = float(xyz[p, 0]), float(xyz[p, 1]), float(xyz[p, 2]) + up_m[j]
            u, v, cz = _pixel(x, y, z, K, T)
            if not (0 <= u < w and 0 <= v < h):
                continue
            if depth[v, u] - cz > AGREES_SIGMAS * float(depth_sigma[v, u]):
                seen[p] |= np.uint8(1 << j)


def _reach_east(depth: DepthMap) -> tuple[float, float]:
    """The least and greatest x in the world of what the depth map holds, and of its camera."""
    h, w = depth.depth_m.shape
    known = np.isfinite(depth.depth_m)
    eye = float(depth.T_world_camera[0, 3])
    if not known.any():
        return eye, eye
    far = float(depth.depth_m[known].max())
    u, v = np.array([0, w - 1, 0, w - 1.0]), np.array([0, 0, h - 1, h - 1.0])
    a, b = (u - depth.K[0, 2]) / depth.K[0, 0], (v - depth.K[1, 2]) / depth.K[1, 1]
    x = far * (depth.T_world_camera[0, :3] @ np.stack([a, b, np.ones(4)])) + eye
    return min(eye, float(x.min())), max(eye, float(x.max()))


@njit(cache=True, nogil=True)
def _vote(
    xyz: F32,
    sigma: F32,
    depth: F32,
    depth_sigma: F32,
    views: U8,
    K: F64,
    T: F64,
    through: I32,
    confirmed: I32,
) -> None:
    """Add one keyframe's votes; ``T`` is T_camera_world."""
    h, w = depth.shape
    least = KNOWN_SHARE * (2 * WINDOW_PX + 1) ** 2
    for p in range(xyz.shape[0]):
        x, y, z = float(xyz[p, 0]), float(xyz[p, 1]), float(xyz[p, 2])
        u, v, cz = _pixel(x, y, z, K, T)
        if not (WINDOW_PX <= u < w - WINDOW_PX and WINDOW_PX <= v < h - WINDOW_PX):
            continue
        here = depth[v, u]
        if abs(here - cz) <= AGREES_SIGMAS * (float(sigma[p]) + float(depth_sigma[v, u])):
            confirmed[p] += max(views[v, u], 1)
            continue
        known = 0
        behind = 0
        agrees = False
        most = 0
        for dv in range(-WINDOW_PX, WINDOW_PX + 1):
            for du in range(-WINDOW_PX, WINDOW_PX + 1):
                d = depth[v + dv, u + du]
                if not d > 0.0:
                    continue
                s = float(sigma[p]) + float(depth_sigma[v + dv, u + du])
                known += 1
                if d - cz > BEHIND_SIGMAS * s:
                    behind += 1
                near = abs(du) <= 1 and abs(dv) <= 1
                if near and abs(d - cz) <= AGREES_SIGMAS * s:
                    agrees = True
                if near and views[v + dv, u + du] > most:
                    most = views[v + dv, u + du]
        if agrees:
            confirmed[p] += max(most, 1)
        elif known >= least and behind == known:
            through[p] += max(most, 1)
