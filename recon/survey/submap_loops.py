"""Loops between keyframes of a finished flight, whose surfaces are known on both sides.

Corners of one are found in the other's image (ZSSD), and their places on both surfaces give
the motion by a robust fit of points to points. That needs fewer matches than a pose from
pixels, so it holds where little of two images is alike: oblique views from opposite sides.
A kept keyframe holds only what was new when it was flown, so its view is first filled with the
surface that its neighbours measured, brought over by the track between them.
Arun et al. 1987, doi:10.1109/TPAMI.1987.4767965, with weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from recon import se3
from recon.camera_model import project, rays
from recon.posegraph.loop_closure import (
    MIN_RAD,
    MIN_SHARE,
    LoopClosure,
    LoopEnd,
    landmarks,
    on_surface,
    warps,
)
from recon.similarity import lever
from recon.tracking import matching
from recon.types import F32, F64, I64, Bool, DepthMap, Keyframe

SEARCH_SHARES = (0.03, 0.1)
"""Search radii, as shares of the image's width, tried in turn: the track is near the truth
already."""

MIN_MATCHES, MIN_INLIER_SHARE, GATE_SIGMAS = 14, 0.6, 3.0
"""Places that both surfaces have, and the share of them that one motion must bring together to so
many sigmas."""

PIXEL_SIGMA = 0.4  # sigma of a match, px
MIN_SPREAD = 0.02  # of the matches across their narrow side, of their distance

MATCHING = matching.MatchingConfig(grid=50, ambiguity=0.9, max_zssd=0.6, max_return_px=0.7)


def verify_surfaces(a: LoopEnd, b: LoopEnd, T_a_b_guess: F64) -> LoopClosure | None:
    """The motion between two keyframes that may see the same place, or None when they do not.

    ``T_a_b_guess`` (4, 4) is the track's estimate. The covariance is of a left perturbation in a's
    camera frame.
    """
    uv, points = landmarks(a, MATCHING)
    if len(uv) < MIN_MATCHES:
        return None
    pyramids = [matching.build_pyramid(v.gray) for v in (a, b)]
    T_b_a = se3.inverse(T_a_b_guess)
    predicted = project(b.K, se3.transform(T_b_a, points))
    bent = warps(a.K, b.K, T_b_a, uv, points)
    for share in SEARCH_SHARES:
        radius = share * b.gray.shape[1]
        found = matching.match(pyramids[0], uv, pyramids[1], predicted, radius, bent, MATCHING)
        closure = _fitted(a, b, points, found, T_a_b_guess)
        if closure is not None:
            return closure
    return None


def _fitted(
    a: LoopEnd, b: LoopEnd, points: F64, found: matching.Matches, guess: F64
) -> LoopClosure | None:
    there, _, known = on_surface(b, found.uv_px.astype(np.float64))
    ok = found.ok & known
    if np.count_nonzero(ok) < MIN_MATCHES:
        return None
    here, there = points[ok], there[ok]
    sigma = _sigma(a, here) + _sigma(b, there)
    T, inside = _rigid(here, there, sigma, guess)
    count = int(np.count_nonzero(inside))
    if count < MIN_MATCHES or count < MIN_INLIER_SHARE * len(here):
        return None
    spread = np.linalg.svd(here[inside] - here[inside].mean(axis=0), compute_uv=False)
    if spread[1] < MIN_SPREAD * float(np.median(here[:, 2])) * np.sqrt(count):
        return None
    size = [np.linalg.norm(p[inside] - p[inside].mean(axis=0)) for p in (here, there)]
    covariance = _covariance(T, here, there, sigma, inside)
    return T, covariance, float(size[0] / size[1])


def _sigma(one: LoopEnd, points: F64) -> F64:
    """(N,) m of a point, by its depth's median sigma and a pixel's width there."""
    own = float(np.nanmedian(one.depth.sigma_m))
    return np.asarray(np.hypot(own, PIXEL_SIGMA * points[:, 2] / one.K[0, 0]))


def _rigid(here: F64, there: F64, sigma: F64, guess: F64) -> tuple[F64, Bool]:
    """(4, 4) motion that takes ``there`` to ``here``, and which pairs (N,) it holds for."""
    T = guess.copy()
    T[:3, 3] += np.median(here - se3.transform(T, there), axis=0)
    inside = np.ones(len(here), bool)
    for _ in range(15):
        off = np.linalg.norm(here - se3.transform(T, there), axis=1) / sigma
        limit = max(GATE_SIGMAS, 2.0 * float(np.median(off)))  # opens while the start is still off
        weight = np.where(off < limit, (1.0 - (off / limit) ** 2) ** 2, 0.0) / sigma**2
        if np.count_nonzero(weight) < 6:
            return T, np.zeros(len(here), bool)
        weight /= weight.sum()
        centre_a, centre_b = weight @ here, weight @ there
        R = se3.nearest_rotation(((here - centre_a) * weight[:, None]).T @ (there - centre_b))
        T = se3.compose(R, centre_a - R @ centre_b)
    inside = np.linalg.norm(here - se3.transform(T, there), axis=1) < GATE_SIGMAS * sigma
    return T, np.asarray(inside)


def _covariance(T: F64, here: F64, there: F64, sigma: F64, inside: Bool) -> F64:
    """(6, 6) of a left perturbation in a's frame, by the scatter that was left."""
    moved = se3.transform(T, there[inside])
    J = lever(moved)[:, :, :6] / sigma[inside, None, None]
    H = np.einsum("nki,nkj->ij", J, J)
    off = (here[inside] - moved) / sigma[inside, None]
    variance = max(float(np.sum(off**2)) / max(3 * len(moved) - 6, 1), 0.3)
    least = MIN_SHARE * float(np.median(sigma))
    floor = np.diag([MIN_RAD**2] * 3 + [least**2] * 3)
    return np.asarray(variance * np.linalg.inv(H) + floor)


MIN_NEIGHBOURS = 5  # number of a pixel's eight neighbours that must be known for it to be filled


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
