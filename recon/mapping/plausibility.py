"""The part of a depth image that its camera can have seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recon.types import F64, Bool, DepthMap, PosePrior

TILT_SIGMAS = 2.0


def plausible(depth: DepthMap, prior: PosePrior) -> DepthMap | None:
    """``depth`` without surface that only one pair sees above the horizon; None with nothing left.

    Below the horizon a ray ends at the ground. Above it there may be nothing but sky, so a
    surface there takes two pairs that agree.
    """
    if prior.R_world_camera is not None:
        sky = _above_horizon(depth, prior.R_world_camera[2], TILT_SIGMAS * prior.sigma_tilt_rad)
        sky &= depth.views == 1
        if sky.any():
            nothing = np.float32(np.nan)
            depth = replace(
                depth,
                depth_m=np.where(sky, nothing, depth.depth_m),
                sigma_m=np.where(sky, nothing, depth.sigma_m),
                views=np.where(sky, np.uint8(0), depth.views),
            )
    return depth if np.isfinite(depth.depth_m).any() else None


def _above_horizon(depth: DepthMap, up: F64, margin_rad: float) -> Bool:
    """(h, w) pixels whose ray rises by more than the margin; ``up`` (3,) in the camera's frame."""
    h, w = depth.depth_m.shape
    K = depth.K
    x, y = (np.arange(w) - K[0, 2]) / K[0, 0], (np.arange(h)[:, None] - K[1, 2]) / K[1, 1]
    rise = up[0] * x + up[1] * y + up[2]
    return np.asarray(rise > np.sin(margin_rad) * np.sqrt(1.0 + x**2 + y**2))
