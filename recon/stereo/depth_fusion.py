"""Several stereo pairs of one keyframe fused into one depth map with honest sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange

from recon.stereo.reprojection import PairDepth
from recon.types import F64, DepthMap


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """Parameters of the fusion of stereo pairs."""

    agree_sigmas: float = 2.5  # pairs agree within that many combined sigmas
    single_view_sigma: float = 1.5  # factor on the sigma of a point that one pair saw alone
    most_sigma_share: float = 0.04  # of the depth; a worse reading says nothing
    least_sigma_share: float = 0.0005  # of the depth; no pair is better than this


def fuse(pairs: Sequence[PairDepth], K: F64, T_world_camera: F64, config: FusionConfig) -> DepthMap:
    """One depth map of all pairs: at each pixel the largest group that agrees, averaged.

    The mean is over inverse depth (whose error is nearly Gaussian) with weights 1/sigma^2;
    the sigma is the larger of the propagated one and the spread inside the group. ``views``
    counts the group. Raises ValueError without any pair.
    """
    if not pairs:
        raise ValueError("no stereo pair to fuse")
    depth = np.stack([p.depth_m for p in pairs])
    sigma = np.stack([p.sigma_m for p in pairs])
    shape = depth.shape[1:]
    out = DepthMap(
        np.empty(shape, np.float32), np.empty(shape, np.float32), np.zeros(shape, np.uint8), K,
        T_world_camera,
    )  # fmt: skip
    _fuse(
        depth, sigma, config.agree_sigmas, config.single_view_sigma, config.most_sigma_share,
        config.least_sigma_share, out.depth_m, out.sigma_m, out.views,
    )  # fmt: skip
    return out


@njit(cache=True, nogil=True)
def _largest_group(
    inverse: Any, sigma: Any, count: int, agree_sigmas: float
) -> int:  # pragma: no cover - compiled
    """The reading that most others agree with; ties go to the smaller sigma."""
    best, most = 0, -1
    square = agree_sigmas * agree_sigmas
    for i in range(count):
        support = 0
        for j in range(count):
            apart = inverse[i] - inverse[j]
            support += apart * apart <= square * (sigma[i] * sigma[i] + sigma[j] * sigma[j])
        if support > most or (support == most and sigma[i] < sigma[best]):
            best, most = i, support
    return best


@njit(cache=True, nogil=True, parallel=True)
def _fuse(
    depth: Any,
    sigma: Any,
    agree_sigmas: float,
    single_view: float,
    most_share: float,
    least_share: float,
    out_depth: Any,
    out_sigma: Any,
    out_views: Any,
) -> None:  # pragma: no cover - compiled
    P, height, width = depth.shape
    for v in prange(height):
        w = np.empty(P)
        s = np.empty(P)
        for u in range(width):
            out_depth[v, u] = np.nan
            out_sigma[v, u] = np.nan
            count = 0
            for p in range(P):
                z, e = float(depth[p, v, u]), float(sigma[p, v, u])
                if z > 0 and e < most_share * z:
                    w[count] = 1.0 / z
                    s[count] = e / (z * z)
                    count += 1
            if count == 0:
                continue
            centre = _largest_group(w, s, count, agree_sigmas)
            total = mean = 0.0
            views = 0
            for p in range(count):
                limit = agree_sigmas * np.sqrt(s[p] ** 2 + s[centre] ** 2)
                if abs(w[p] - w[centre]) <= limit:
                    weight = 1.0 / s[p] ** 2
                    total += weight
                    mean += weight * w[p]
                    views += 1
            mean /= total
            spread = 0.0
            for p in range(count):
                limit = agree_sigmas * np.sqrt(s[p] ** 2 + s[centre] ** 2)
                if abs(w[p] - w[centre]) <= limit:
                    spread += (w[p] - mean) ** 2 / s[p] ** 2
            variance = 1.0 / total + spread / total / max(views - 1, 1)
            z = 1.0 / mean
            e = np.sqrt(variance) * z * z * (single_view if views == 1 else 1.0)
            out_depth[v, u] = z
            out_sigma[v, u] = max(e, least_share * z)
            out_views[v, u] = views
