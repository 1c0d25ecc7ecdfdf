"""Depth and points from disparity (paper section 2.2, Eq. 3)."""

from __future__ import annotations

import numpy as np

from recon.types import F32, F64, DepthMap, DisparityMap, StereoPair

LABEL_SIGMA_PX = 0.25
"""Sigma of a label of full confidence, in pixels of the grid that was matched."""

MIN_CONFIDENCE = 0.05
"""Below it a label is not trusted at all."""


def depth_from_disparity(disparity: DisparityMap, pair: StereoPair) -> tuple[F32, F32]:
    """Depth along the rectified left camera's z and its sigma, two (H, W) float32 in metres.

    ``disparity`` holds labels of ``pair``, on the pair's own grid (h, w) or upsampled to any
    (H, W); labels are always in pixels of (h, w). With Eq. 3, ``z = f B / d`` where
    ``d = plane . (u, v, 1) + slope * label``; sigma is ``z / d`` times the label's sigma,
    which grows as confidence falls. NaN where the label is unknown, its confidence below
    ``MIN_CONFIDENCE`` or the point at or beyond infinity. Raises ValueError for bad shapes.
    """
    if disparity.px.ndim != 2 or disparity.px.shape != disparity.confidence.shape:
        raise ValueError(f"bad disparity {disparity.px.shape}, {disparity.confidence.shape}")
    height, width = disparity.px.shape
    h, w = pair.left.shape
    u = ((np.arange(width) + 0.5) * (w / width) - 0.5)[None, :]
    v = ((np.arange(height) + 0.5) * (h / height) - 0.5)[:, None]
    plane = pair.plane
    d = (plane[0] * u + plane[1] * v + plane[2]) + pair.slope * disparity.px
    usable = (disparity.confidence >= MIN_CONFIDENCE) & (d > 1e-3)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(usable, pair.K[0, 0] * pair.baseline_m / d, np.nan)
        label_sigma = LABEL_SIGMA_PX / np.sqrt(np.maximum(disparity.confidence, MIN_CONFIDENCE))
        sigma = depth / d * abs(pair.slope) * label_sigma
    return depth.astype(np.float32), sigma.astype(np.float32)


def scale_intrinsics(K: F64, size: tuple[int, int], new_size: tuple[int, int]) -> F64:
    """K of the same view at another (W, H); pixel centres are at integers."""
    sx, sy = new_size[0] / size[0], new_size[1] / size[1]
    scaled = np.array(K, np.float64)
    scaled[0] *= sx
    scaled[1] *= sy
    scaled[0, 2] += 0.5 * sx - 0.5
    scaled[1, 2] += 0.5 * sy - 0.5
    return scaled


def points_from_depth(depth: DepthMap) -> F32:
    """(h, w, 3) float32 points in the camera's frame, metres; NaN where depth is (Eq. 3)."""
    height, width = depth.depth_m.shape
    K = depth.K
    y = (np.arange(height)[:, None] - K[1, 2]) / K[1, 1]
    x = (np.arange(width)[None, :] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    z = depth.depth_m
    return np.stack([x * z, y * z, z], axis=-1).astype(np.float32)
