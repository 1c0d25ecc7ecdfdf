"""Keyframes that are not nodes of the pose graph: carried by the nodes on both sides of them.

A keyframe continues from the node before it by vision. The misclosure of vision at the next node is
spread evenly over the keyframes between, as a screw motion. Both nodes belong to the keyframe's
segment, whose first and last keyframes are nodes. Where no node of its segment is left it stays as
it was published last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.posegraph.ledger import Rows
from recon.types import F64, I64, Bool

KEYFRAME = np.dtype(
    [
        ("seq", np.int64),
        ("segment", np.int32),
        ("is_published", np.bool_),
        ("odom", np.float64, (3, 4)),  # T_odom_camera in the segment's chain
        ("height", np.float64),  # above the ground that it sees, in odometry units
        ("pose", np.float64, (3, 4)),  # T_world_camera as last published
        ("sigma_m", np.float64),  # of the place, as last published as a node
        ("scale", np.float64),  # metres per odometry unit as last published
    ]
)
"""A row of the ledger: the data of one keyframe."""


@dataclass(frozen=True, slots=True, eq=False)
class Spans:
    """Spans between two neighbouring nodes in which keyframes are interpolated."""

    rows: I64  # (G, 2) of the nodes in the ledger
    T_odom_camera: F64  # (G, 2, 4, 4)
    T_world_camera: F64  # (G, 2, 4, 4)
    scale: F64  # (G, 2) metres per unit of the odometry
    is_seen: Bool  # (G,) both nodes are of one segment


def interpolated(rows: Rows, number: I64, span: I64, spans: Spans) -> tuple[F64, F64]:
    """(N, 4, 4) poses and (N,) scales of the ledger's rows ``number`` (N,), each in its span."""
    inverse = np.linalg.inv(spans.T_odom_camera[:, 0])
    scale, T = spans.scale[:, 0], spans.T_world_camera[:, 0]
    motions = inverse[span] @ whole(rows["odom"])
    motions[:, :3, 3] *= scale[span, None]
    last = inverse @ spans.T_odom_camera[:, 1]
    last[:, :3, 3] *= scale[:, None]
    miss = spans.T_world_camera[:, 1] @ np.linalg.inv(T @ last)
    twists = np.array([se3.log(one) for one in miss])
    share = (number - spans.rows[span, 0]) / np.diff(spans.rows, axis=1)[span, 0]
    poses = screws(twists[span], share) @ T[span] @ motions
    scales = scale[span] * (spans.scale[:, 1] / scale)[span] ** share
    is_left = ~spans.is_seen[span]
    if is_left.any():
        poses[is_left], scales[is_left] = left(
            rows[is_left], T[span][is_left], scale[span][is_left]
        )
    return poses, scales


def screws(twists: F64, shares: F64) -> F64:
    """(N, 4, 4) motions by shares (N,) of twists (N, 6)."""
    angle = np.maximum(np.linalg.norm(twists[:, :3], axis=1, keepdims=True), 1e-12)
    axis, turned = se3.hat(twists[:, :3] / angle), shares[:, None] * angle
    across = np.einsum("nij,nj->ni", axis, twists[:, 3:])
    along = np.einsum("nij,nj->ni", axis, across)
    sine, rest = np.sin(turned), 2.0 * np.sin(0.5 * turned) ** 2
    out = np.tile(np.eye(4), (len(shares), 1, 1))
    out[:, :3, :3] += sine[..., None] * axis + rest[..., None] * (axis @ axis)
    out[:, :3, 3] = shares[:, None] * twists[:, 3:] + rest / angle * across
    out[:, :3, 3] += (turned - sine) / angle * along
    return out


def left(rows: Rows, T_before: F64, scale_before: F64) -> tuple[F64, F64]:
    """(N, 4, 4) poses and (N,) scales of the ledger's rows that no node carries: as published,
    and in the place of the node before them, (N, 4, 4) and (N,), if they never were."""
    published = rows["is_published"]
    poses = np.where(published[:, None, None], whole(rows["pose"]), T_before)
    return poses, np.where(published, rows["scale"], scale_before)


def whole(parts: F64) -> F64:
    """(N, 4, 4) motions of their upper three rows (N, 3, 4)."""
    out = np.tile(np.eye(4), (len(parts), 1, 1))
    out[:, :3] = parts
    return out


def moved_m(rows: Rows, T: F64, scales: F64) -> F64:
    """(N,) metres by which keyframes as published, or their ground, are off where they are now."""
    old, reach = rows["pose"], scales * rows["height"]
    shift = np.linalg.norm(T[:, :3, 3] - old[:, :, 3], axis=1)
    # Of a rotation by an angle a, the Frobenius norm of its difference is sqrt(8) sin(a/2).
    apart = np.linalg.norm(T[:, :3, :3] - old[:, :, :3], axis=(1, 2))
    turn = 2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0)) * reach
    growth = np.abs(scales / rows["scale"] - 1.0) * reach
    return np.asarray(shift + turn + growth)
