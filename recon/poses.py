"""Figures of a pose in the world, and poses carried on from it."""

from __future__ import annotations

from dataclasses import replace

from recon import se3
from recon.types import F64, Pose


def sigma_m(pose: Pose) -> float:
    """Sigma of the place, in all three directions together."""
    return se3.sigma_at(pose.T_world_camera[:3, 3], pose.covariance)


def carried(pose: Pose, T_keyframe_camera: F64) -> Pose:
    """A frame in the world by its pose (4, 4) relative to a keyframe, in units of the odometry."""
    moved = T_keyframe_camera.copy()
    moved[:3, 3] *= pose.scale
    return replace(pose, T_world_camera=pose.T_world_camera @ moved)
