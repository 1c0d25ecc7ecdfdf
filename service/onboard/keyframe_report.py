"""A keyframe as the operator's ground station shows it."""

from __future__ import annotations

import numpy as np

from mavlink.component.camera import KeyframeReport
from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA
from recon.se3 import quaternion_from_rotation
from recon.types import F64
from service.georeference import LocalFrame


def keyframe_report(
    time_unix_ns: int, T_world_camera: F64, frame: LocalFrame | None, agl_m: float | None
) -> KeyframeReport:
    """Its place on the globe and the attitude of its head; no place without a georeference."""
    R_ned_head = R_ENU_NED.T @ T_world_camera[:3, :3] @ R_GIMBAL_CAMERA.T
    w, x, y, z = (float(v) for v in quaternion_from_rotation(np.asarray(R_ned_head)))
    lat = lon = alt = None
    if frame is not None:
        lat, lon, alt = (float(v) for v in frame.to_geodetic(T_world_camera[None, :3, 3])[0])
    return KeyframeReport(time_unix_ns // 1000, lat, lon, alt, agl_m, (w, x, y, z))
