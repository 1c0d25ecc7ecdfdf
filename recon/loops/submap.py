"""A keyframe's view filled with the surface that its neighbours measured.

A kept keyframe holds only what was new when it was flown. For a loop the whole of what it saw
is wanted: the neighbours' points, brought over by the track between them, which is sure over
so short a way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recon import se3
from recon.camera_model import project, rays
from recon.types import F32, F64, DepthMap, Keyframe

LEAST_NEIGHBOURS = 5
"""Of a pixel's eight, that must be known for it to be filled."""


def filled(own: Keyframe, others: Sequence[Keyframe]) -> Keyframe:
    """``own`` with the nearest surface of ``others`` as its camera sees it, in depth and colour.

    Every depth's ``T_world_camera`` counts. What ``own`` measured itself stays; holes of single
    pixels are closed, and what nobody measured is black.
    """
    at = own.depth
    h, w = at.depth_m.shape
    T_own_world = se3.inverse(at.T_world_camera)
    layers = np.full((h, w, 5), np.nan, np.float32)  # depth, sigma, colour
    rows = [_rows(one, T_own_world @ one.depth.T_world_camera) for one in others]
    if rows:
        points, values = (np.concatenate(part) for part in zip(*rows, strict=True))
        uv = np.rint(project(at.K, points))
        inside = (uv >= 0).all(axis=1) & (uv <= [w - 1, h - 1]).all(axis=1)
        points, values, uv = points[inside], values[inside], uv[inside].astype(np.int64)
        order = np.argsort(-points[:, 2])  # the nearest is written last
        layers[uv[order, 1], uv[order, 0]] = values[order]
        layers[..., 0][uv[order, 1], uv[order, 0]] = points[order, 2]
        layers = _closed(layers)
    known = np.isfinite(at.depth_m)
    layers[known, 0], layers[known, 1] = at.depth_m[known], at.sigma_m[known]
    layers[known, 2:] = own.bgr[known]
    views = np.where(np.isfinite(layers[..., 0]), np.maximum(at.views, 2), 0).astype(np.uint8)
    depth = DepthMap(layers[..., 0].copy(), layers[..., 1].copy(), views, at.K, at.T_world_camera)
    bgr = np.nan_to_num(layers[..., 2:], nan=0.0).astype(np.uint8)
    return replace(own, depth=depth, bgr=np.ascontiguousarray(bgr))


def _rows(one: Keyframe, T: F64) -> tuple[F64, F32]:
    """(N, 3) points after ``T`` (4, 4) and (N, 5) their depth, sigma and colour."""
    v, u = np.nonzero(np.isfinite(one.depth.depth_m))
    points, sigma = points_of(one.depth, T)
    return points, np.column_stack([points[:, 2], sigma, one.bgr[v, u]]).astype(np.float32)


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
    enough = np.count_nonzero(np.isfinite(around[..., 0]), axis=0) >= LEAST_NEIGHBOURS
    out: F32 = layers.copy()
    if enough.any():
        out[v[enough], u[enough]] = np.nanmedian(around[:, enough], axis=0)
    return out
