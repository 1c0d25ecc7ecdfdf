"""What the pictures of keyframes cover on the ground, and what is kept of that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.camera_model import rays
from recon.types import F64, DepthMap

FARTHEST = 3.0
"""Pictures count as seeing the ground out to this many times their median depth."""

PLACE = np.dtype(
    [
        ("seq", np.int64),
        ("seen_s", np.float64),  # from the first keyframe
        ("corners_m", np.float64, (4, 2)),  # as Footprint has them
        ("centre_m", np.float64, (2,)),
        ("camera_m", np.float64, (3,)),
        ("low", np.int64, (2,)),  # first and last of the tiles with surface of it
        ("high", np.int64, (2,)),
    ]
)
"""A row of the ledger: what is kept of a keyframe."""


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """What a keyframe's picture covers on level ground at its median height."""

    corners_m: F64  # (4, 2) east and north, around the picture
    centre_m: F64  # (2,) where the middle of the picture looks
    camera_m: F64  # (3,)


def footprint(depth: DepthMap) -> Footprint | None:
    """Where a keyframe's picture meets level ground; None without any depth."""
    known = np.isfinite(depth.depth_m)
    if not known.any():
        return None
    h, w = depth.depth_m.shape
    T = depth.T_world_camera
    middle_m = float(np.median(depth.depth_m[known]))
    edge = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]])
    spots = np.vstack([edge, [[(w - 1) / 2, (h - 1) / 2]]])
    ways = rays(depth.K, spots) @ T[:3, :3].T
    drop_m = -float(middle_m * ways[4, 2])  # from the camera to the ground in its middle
    with np.errstate(divide="ignore"):
        reach = np.where(ways[:, 2] < 0, -max(drop_m, 0.0) / ways[:, 2], np.inf)
    reach = np.minimum(reach, FARTHEST * middle_m)
    ground = T[:2, 3] + reach[:, None] * ways[:, :2]
    return Footprint(ground[:4], ground[4], T[:3, 3].copy())


def footprint_of(place: np.void) -> Footprint:
    """The footprint in a row of :data:`PLACE`."""
    return Footprint(place["corners_m"], place["centre_m"], place["camera_m"])
