"""Our own estimate of the motion, for the autopilot: ODOMETRY (331). Off unless asked for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mavlink.quaternion import Quaternion
from mavlink.wire import dialect

LOCAL_FRD = 20  # MAV_FRAME_LOCAL_FRD: an origin of our own; ArduPilot and PX4 both take it
BODY_FRD = 12  # MAV_FRAME_BODY_FRD
VISION = 2  # MAV_ESTIMATOR_TYPE_VISION
CELLS = 21  # upper triangle of 6 x 6


@dataclass(frozen=True, slots=True)
class Odometry:
    """Pose and velocity of the body; unknown parts of the covariances are NaN."""

    position_ned_m: tuple[float, float, float]
    q_ned_body: Quaternion
    velocity_frd_m_s: tuple[float, float, float]
    pose_covariance: Sequence[Sequence[float]]  # (6, 6) x y z roll pitch yaw
    reset_counter: int  # grows when the estimate jumps, as after a loop was closed
    quality_percent: int  # 0 to 100; 0 and less is unusable


def odometry_message(odometry: Odometry, boot_time_us: int) -> Any:
    """The ODOMETRY at a time of the autopilot's boot clock.

    ValueError when the covariance is not 6 x 6.
    """
    rows = odometry.pose_covariance
    if len(rows) != 6 or any(len(row) != 6 for row in rows):
        raise ValueError(f"pose_covariance must be 6 x 6, got {len(rows)} rows")
    upper = [float(rows[i][j]) for i in range(6) for j in range(i, 6)]
    nan = math.nan
    return dialect.MAVLink_odometry_message(
        max(0, boot_time_us),
        LOCAL_FRD,
        BODY_FRD,
        *odometry.position_ned_m,
        list(odometry.q_ned_body),
        *odometry.velocity_frd_m_s,
        nan,
        nan,
        nan,
        upper,
        [nan] * CELLS,
        odometry.reset_counter & 0xFF,
        VISION,
        max(-1, min(100, odometry.quality_percent)),
    )
