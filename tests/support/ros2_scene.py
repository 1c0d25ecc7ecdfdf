"""Keyframes over a roof, and ROS 2 messages read by the layout that they declare."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon import se3
from recon.types import F64, DepthMap, Keyframe, Pose

START_NS = 1_700_000_000_123_456_789


K = np.array([[60.0, 0.0, 39.5], [0.0, 61.0, 22.0], [0.0, 0.0, 1.0]])


DOWN = np.diag([1.0, -1.0, -1.0])


SIZE = (45, 80)


def camera_at(east_m: float) -> F64:
    """Looking down with image rows southwards, turned a little."""
    yaw = np.radians(20.0)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return se3.compose(turn @ DOWN, np.array([east_m, 6.0, 50.0]))


def keyframe(seq: int, T: F64) -> Keyframe:
    depth = np.full(SIZE, 50.0, np.float32)
    depth[:5] = np.nan
    depth[20:30, 20:30] = 40.0  # a roof
    views = np.full(SIZE, 4, np.uint8)
    bgr = np.zeros((*SIZE, 3), np.uint8)
    bgr[:] = 30, 90, 200
    known = DepthMap(depth, np.full(SIZE, 0.2, np.float32), views, K, T)
    return Keyframe(seq, 0, known, bgr, Pose(T, np.eye(6)), np.isfinite(depth))


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec * 10**9 + stamp.nanosec)


def matrix(transform: Any) -> F64:
    q, t = transform.rotation, transform.translation
    R = se3.rotation_from_quaternion(np.array([q.w, q.x, q.y, q.z]))
    return se3.compose(R, np.array([t.x, t.y, t.z]))


def in_map(cloud: Any, T: F64) -> tuple[F64, Any]:
    """(N, 3) ENU metres and the raw rows of a cloud, by the layout that it declares."""
    kinds = {2: "u1", 6: "<u4", 7: "<f4"}
    row = np.dtype(
        {
            "names": [f.name for f in cloud.fields],
            "formats": [kinds[f.datatype] for f in cloud.fields],
            "offsets": [f.offset for f in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    rows = np.frombuffer(bytes(cloud.data), row)
    assert len(rows) == cloud.width * cloud.height and cloud.row_step == len(cloud.data)
    xyz = np.column_stack([rows[axis] for axis in "xyz"]).astype(np.float64)
    return np.asarray(xyz @ T[:3, :3].T + T[:3, 3]), rows
