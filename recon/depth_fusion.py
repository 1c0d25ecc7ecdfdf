"""Several stereo pairs of one keyframe fused into one depth map with honest sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from recon.camera_model import scaled_K
from recon.types import F32, F64, U8, Bool, DepthMap, StereoPair


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """Parameters of the fusion of stereo pairs."""

    agree_sigmas: float = 2.5  # pairs agree within that many combined sigmas
    single_view_sigma: float = 1.5  # factor on the sigma of a point that one pair saw alone
    most_sigma_share: float = 0.04  # of the depth; a worse reading says nothing
    least_sigma_share: float = 0.0005  # of the depth; no pair is better than this


@dataclass(frozen=True, slots=True, eq=False)
class PairDepth:
    """What one stereo pair says of the keyframe's depth, on the keyframe's own grid."""

    depth_m: F32  # (h, w), NaN = unknown
    sigma_m: F32  # (h, w)


def onto_keyframe(
    depth_m: F32, sigma_m: F32, pair: StereoPair, K: F64, size_px: tuple[int, int]
) -> PairDepth:
    """Depth of the rectified left view brought to the keyframe's camera.

    The rectified left camera sits where the keyframe's does and is only turned, so every
    keyframe pixel has exactly one pixel there: nearest, which keeps edges sharp.

    Args:
        depth_m, sigma_m: (h', w') of the rectified left view, any multiple of ``pair``'s size.
        K: (3, 3) intrinsics of the keyframe's grid of ``size_px`` (w, h).
    """
    w, h = size_px
    u, v = np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64))
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    there = ray @ pair.R_left_keyframe.T
    z = there[..., 2]
    Kd = scaled_K(
        pair.K, depth_m.shape[1] / pair.left.shape[1], depth_m.shape[0] / pair.left.shape[0]
    )
    safe = np.where(z > 1e-3, z, 1.0)
    map_x = (Kd[0, 0] * there[..., 0] / safe + Kd[0, 2]).astype(np.float32)
    map_y = (Kd[1, 1] * there[..., 1] / safe + Kd[1, 2]).astype(np.float32)
    map_x[z <= 1e-3] = -10.0
    nan = float("nan")
    sampled = [
        cv2.remap(
            a, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=nan
        )
        for a in (depth_m, sigma_m)
    ]
    factor = (1.0 / safe).astype(np.float32)
    return PairDepth(
        np.asarray(sampled[0] * factor, np.float32), np.asarray(sampled[1] * factor, np.float32)
    )


def fuse(pairs: Sequence[PairDepth], K: F64, T_world_camera: F64, config: FusionConfig) -> DepthMap:
    """One depth map of all pairs: at each pixel the largest group that agrees, averaged.

    The mean is over inverse depth (whose error is nearly Gaussian) with weights 1/sigma^2;
    the sigma is the larger of the propagated one and the spread inside the group. ``views``
    counts the group. Raises ValueError without any pair.
    """
    if not pairs:
        raise ValueError("no stereo pair to fuse")
    inverse = np.stack([1.0 / p.depth_m for p in pairs]).astype(np.float64)
    sigma = np.stack([p.sigma_m / p.depth_m**2 for p in pairs]).astype(np.float64)
    with np.errstate(invalid="ignore"):
        known = (inverse > 0) & (sigma < config.most_sigma_share * inverse)
    inverse, sigma = np.where(known, inverse, 0.0), np.where(known, sigma, 1.0)
    members = _largest_group(inverse, sigma, known, config.agree_sigmas)
    weight = np.where(members, 1.0 / sigma**2, 0.0)
    total = weight.sum(axis=0)
    views = members.sum(axis=0).astype(np.uint8)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (weight * inverse).sum(axis=0) / total
        spread = (weight * (inverse - mean) ** 2).sum(axis=0) / total
        s = np.sqrt(1.0 / total + spread / np.maximum(views - 1, 1))
        depth = 1.0 / mean
    s = np.where(views == 1, s * config.single_view_sigma, s)
    depth[views == 0] = np.nan
    sigma_m = np.maximum(s * depth**2, config.least_sigma_share * depth)
    return DepthMap(depth.astype(np.float32), sigma_m.astype(np.float32), views, K, T_world_camera)


def _largest_group(inverse: F64, sigma: F64, known: Bool, agree_sigmas: float) -> Bool:
    """(P, h, w) members of each pixel's best-supported group; ties go to the smaller sigma."""
    P = inverse.shape[0]
    agree = np.zeros((P, *inverse.shape), np.bool_)
    for i in range(P):
        for j in range(P):
            limit = agree_sigmas * np.sqrt(sigma[i] ** 2 + sigma[j] ** 2)
            agree[i, j] = known[i] & known[j] & (np.abs(inverse[i] - inverse[j]) <= limit)
    support = agree.sum(axis=1).astype(np.float64)
    support -= sigma / (sigma.max() + 1e-12) * 0.5
    support[~known] = -1.0
    best = support.argmax(axis=0)
    return np.asarray(np.take_along_axis(agree, best[None, None], axis=0)[0])


def seen_from(depth: DepthMap, other: DepthMap, agree_sigmas: float = 2.5) -> tuple[U8, Bool]:
    """How ``other`` judges ``depth``: (h, w) 1 where it confirms, and (h, w) contradiction.

    A point is contradicted when ``other`` looks through it: it sees a surface clearly
    behind where the point stands.
    """
    h, w = depth.depth_m.shape
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    z = depth.depth_m.astype(np.float64)
    X = np.stack(
        [(u - depth.K[0, 2]) / depth.K[0, 0] * z, (v - depth.K[1, 2]) / depth.K[1, 1] * z, z], -1
    )
    T = np.linalg.inv(other.T_world_camera) @ depth.T_world_camera
    P = X @ T[:3, :3].T + T[:3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        x = np.rint(other.K[0, 0] * P[..., 0] / P[..., 2] + other.K[0, 2])
        y = np.rint(other.K[1, 1] * P[..., 1] / P[..., 2] + other.K[1, 2])
    H, W = other.depth_m.shape
    inside = np.isfinite(x) & (P[..., 2] > 0) & (x >= 0) & (x < W) & (y >= 0) & (y < H)
    xi, yi = np.where(inside, x, 0).astype(np.int64), np.where(inside, y, 0).astype(np.int64)
    z_other, s_other = other.depth_m[yi, xi], other.sigma_m[yi, xi]
    limit = agree_sigmas * np.sqrt(s_other**2 + depth.sigma_m**2)
    with np.errstate(invalid="ignore"):
        difference = z_other - P[..., 2]
        confirmed = inside & (np.abs(difference) <= limit)
        contradicted = inside & (difference > 2 * limit)
    return confirmed.astype(np.uint8), contradicted
