"""Frames of reference.

=========  ======================  ======  =====================================================
name       axes                    units   where
=========  ======================  ======  =====================================================
world      x east, y north, z up   m       ENU tangent plane at the scan's origin (scan.json)
ned        x north, y east, z down m       same origin; MAVLink attitude refers to it
body       x forward, y right,     m       the vehicle (FRD)
           z down
gimbal     x along the optical     m       the stabilised head (FRD); level and forward at rest
           axis, y right, z down
camera     x right, y down,        m       the optical frame; pixels are u right, v down
           z forward
=========  ======================  ======  =====================================================

All are right-handed. ``T_a_b`` (4x4) and ``R_a_b`` (3x3) take b-coordinates to
a-coordinates, so neighbours must match: ``T_world_body @ T_body_camera``. Quaternions named
``q_..._wxyz`` have the scalar first (MAVLink); TUM files have it last.
"""

from __future__ import annotations

import numpy as np

from recon.types import F64

R_ENU_NED: F64 = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""NED to ENU (its own inverse)."""

R_GIMBAL_CAMERA: F64 = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Optical axes to the gimbal's FRD axes: z forward becomes x, x right becomes y."""


def gimbal_from_camera(image_roll_deg: float) -> F64:
    """R_gimbal_camera (3, 3) where images are turned clockwise by so much: at 90 degrees what is up
    for the head is to the right in them."""
    c, s = np.cos(np.radians(image_roll_deg)), np.sin(np.radians(image_roll_deg))
    return np.asarray(R_GIMBAL_CAMERA @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))


def rotation_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> F64:
    """R_parent_child of intrinsic yaw, pitch, roll (Z-Y-X), as MAVLink's ATTITUDE means it."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(R: F64) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in rad of R_parent_child, the inverse of :func:`rotation_from_rpy`. At
    pitch = +-90 degrees roll is set to zero and yaw carries the whole turn."""
    sp = float(np.clip(-R[2, 0], -1.0, 1.0))
    pitch = float(np.arcsin(sp))
    if abs(sp) > 1.0 - 1e-9:
        return 0.0, pitch, float(np.arctan2(-R[0, 1], R[1, 1]))
    return (float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0])))
