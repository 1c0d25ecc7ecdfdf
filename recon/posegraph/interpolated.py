"""Keyframes that are no nodes of the pose graph: carried by the nodes on both sides of them.

From the node before it a keyframe goes on by vision. What vision then misses the next node by
is spread evenly over the keyframes between, as a screw motion. Both nodes belong to the
keyframe's segment, whose first and last keyframes are nodes. Where no node of its segment is
left it stays as it was published last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.posegraph.ledger import Rows
from recon.types import F64

KEYFRAME = np.dtype(
    [
        ("seq", np.int64),
        ("segment", np.int32),
        ("published", np.int32),  # how often its pose was published
        ("odom", np.float64, (3, 4)),  # T_odom_camera in the segment's chain
        ("height", np.float64),  # above the ground that it sees, in odometry units
        ("pose", np.float64, (3, 4)),  # T_world_camera as last published
        ("scale", np.float64),  # metres per odometry unit as last published
        ("first_scale", np.float64),  # and as published first
    ]
)
"""A row of the ledger: what is kept of every keyframe of a scan."""


@dataclass(frozen=True, slots=True, eq=False)
class Carrier:
    """A node that others hang on."""

    row: int  # in the ledger
    T_odom_camera: F64  # (4, 4)
    T_world_camera: F64  # (4, 4)
    scale: float  # metres per unit of the odometry


def interpolated(rows: Rows, first: int, before: Carrier, after: Carrier) -> tuple[F64, F64]:
    """(N, 4, 4) poses and (N,) scales of the ledger's rows from ``first`` on, between two nodes."""
    inverse = se3.inverse(before.T_odom_camera)
    motions = inverse @ whole(rows["odom"])
    motions[:, :3, 3] *= before.scale
    poses = before.T_world_camera @ motions
    last = inverse @ after.T_odom_camera
    last[:3, 3] *= before.scale
    miss = se3.log(after.T_world_camera @ se3.inverse(before.T_world_camera @ last))
    share = (first - before.row + np.arange(len(rows))) / (after.row - before.row)
    mended = np.array([se3.exp(s * miss) for s in share]).reshape(-1, 4, 4)
    return mended @ poses, before.scale * (after.scale / before.scale) ** share


def left(rows: Rows, before: Carrier) -> tuple[F64, F64]:
    """(N, 4, 4) poses and (N,) scales of the ledger's rows that no node carries: as published,
    and in the place of the node ``before`` them if they never were."""
    told = rows["published"] > 0
    poses = np.where(told[:, None, None], whole(rows["pose"]), before.T_world_camera)
    return poses, np.where(told, rows["scale"], before.scale)


def whole(parts: F64) -> F64:
    """(N, 4, 4) motions of their upper three rows (N, 3, 4)."""
    out = np.tile(np.eye(4), (len(parts), 1, 1))
    out[:, :3] = parts
    return out


def moved_m(rows: Rows, T: F64, scales: F64) -> F64:
    """(N,) metres by which keyframes as published, or their ground, are off where they are now."""
    return change(whole(rows["pose"]), rows["scale"], rows["height"], T, scales)


def change(old: F64, old_scales: F64, heights: F64, T: F64, scales: F64) -> F64:
    """(N,) metres from the poses and scales ``old`` to the new ones, at the camera or its ground.

    ``heights`` are in units of the odometry.
    """
    reach = scales * heights
    shift = np.linalg.norm(T[:, :3, 3] - old[:, :3, 3], axis=1)
    # Of a rotation by an angle a, the Frobenius norm of its difference is sqrt(8) sin(a/2).
    apart = np.linalg.norm(T[:, :3, :3] - old[:, :3, :3], axis=(1, 2))
    turn = 2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0)) * reach
    growth = np.abs(scales / old_scales - 1.0) * reach
    return np.asarray(shift + turn + growth)
