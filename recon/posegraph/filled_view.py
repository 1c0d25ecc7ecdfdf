"""A keyframe's view filled with the surface that its neighbours measured.

A kept keyframe holds only what was new when it was flown. To be compared with another one it needs
all that it saw, brought over by the track between the keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from recon import se3
from recon.camera_model import project, rays
from recon.types import F32, F64, I64, Bool, DepthMap, Keyframe

MIN_NEIGHBOURS = 5
"""Number of a pixel's eight neighbours that must be known for it to be filled."""


def filled(own: Keyframe, others: Sequence[Keyframe]) -> Keyframe:
    """``own`` with the nearest surface of ``others`` as its camera sees it, in depth and colour.

    Every depth's ``T_world_camera`` counts. What ``own`` measured itself stays; holes of single
    pixels are closed, and unmeasured ones are black.
    """
    at = own.depth
    h, w = at.depth_m.shape
    known = np.isfinite(at.depth_m)
    wanted = cv2.dilate(np.asarray(~known, np.uint8), np.ones((3, 3))) > 0  # holes and their edges
    T_own_world = se3.inverse(at.T_world_camera)
    layers = np.full((h, w, 5), np.nan, np.float32)  # depth, sigma, colour
    rows = [
        _rows(one, T_own_world @ one.depth.T_world_camera, at.K, wanted)
        for one in others
        if wanted.any()
    ]
    if rows:
        v, u, depth_m, values = (np.concatenate(part) for part in zip(*rows, strict=True))
        order = np.argsort(-depth_m, kind="stable")  # the nearest is written last
        layers[v[order], u[order]] = values[order]
        layers = _closed(layers)
    layers[known, 0], layers[known, 1] = at.depth_m[known], at.sigma_m[known]
    layers[known, 2:] = own.bgr[known]
    views = np.where(np.isfinite(layers[..., 0]), np.maximum(at.views, 2), 0).astype(np.uint8)
    depth = DepthMap(layers[..., 0].copy(), layers[..., 1].copy(), views, at.K, at.T_world_camera)
    bgr = np.nan_to_num(layers[..., 2:], nan=0.0).astype(np.uint8)
    return replace(own, depth=depth, bgr=np.ascontiguousarray(bgr))


def _rows(one: Keyframe, T: F64, K: F64, wanted: Bool) -> tuple[I64, I64, F64, F32]:
    """(N,) rows and columns of points after ``T`` (4, 4), of those ``wanted`` (h, w), with (N,)
    depths and (N, 5) depth, sigma and colour."""
    points, sigma = points_of(one.depth, T)
    uv = np.rint(project(K, points))
    inside = np.asarray(((uv >= 0) & (uv < wanted.shape[::-1])).all(axis=1))
    u, v = uv[inside].astype(np.int64).T
    inside[inside] = seen = wanted[v, u]
    depth_m, colour = points[inside, 2], one.bgr[np.isfinite(one.depth.depth_m)][inside]
    values = np.column_stack([depth_m, sigma[inside], colour])
    return v[seen], u[seen], depth_m, values.astype(np.float32)


def points_of(depth: DepthMap, T: F64) -> tuple[F64, F64]:
    """(N, 3) points of a depth map, taken on by ``T`` (4, 4) from its camera, and (N,) sigmas."""
    v, u = np.nonzero(np.isfinite(depth.depth_m))
    z = depth.depth_m[v, u].astype(np.float64)
    points = rays(depth.K, np.column_stack([u, v]).astype(np.float64)) * z[:, None]
    return se3.transform(T, points), depth.sigma_m[v, u].astype(np.float64)


def _closed(layers: F32) -> F32:
    """The layers (h, w, C) with single unknown pixels set to the median of their neighbours."""
    padded = np.pad(layers, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    v, u = np.nonzero(np.isnan(layers[..., 0]))
    around = np.array(
        [padded[v + dv, u + du] for dv in range(3) for du in range(3) if (dv, du) != (1, 1)]
    )
    enough = np.count_nonzero(np.isfinite(around[..., 0]), axis=0) >= MIN_NEIGHBOURS
    out: F32 = layers.copy()
    if enough.any():
        out[v[enough], u[enough]] = np.nanmedian(around[:, enough], axis=0)
    return out
