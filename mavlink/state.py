"""What telemetry says of the vehicle at one instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ReceiverAltitude:
    """One fix of the GNSS receiver beside the autopilot's altitude at the same instant."""

    time_ns: int
    above_m: float  # the receiver's altitude less the autopilot's


@dataclass(frozen=True, slots=True, eq=False)
class VehicleState:
    """Attitude, gimbal attitude, position and height at ``time_ns``; a missing part is None.

    Sigmas are 1 sigma and cover the time between samples; they are None with their part.
    """

    time_ns: int  # the history's clock: companion monotonic live, unix in a replay
    q_ned_body_wxyz: F64 | None = None  # (4,) FRD body to NED
    q_ned_gimbal_wxyz: F64 | None = None  # (4,) FRD gimbal head to NED
    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_amsl_m: float | None = None
    alt_agl_m: float | None = None  # above the ground below; see ``sources`` for how it is known
    v_ned_m_s: F64 | None = None  # (3,)
    sigma_h_m: float | None = None  # of the horizontal position, per axis
    sigma_v_m: float | None = None  # of alt_amsl_m
    sigma_agl_m: float | None = None
    sigma_attitude_rad: float | None = None  # roll and pitch of the body
    sigma_yaw_rad: float | None = None
    sigma_gimbal_rad: float | None = None  # roll and pitch of the gimbal head
    receiver: ReceiverAltitude | None = None  # of the fix nearest in time
    age_ms: Mapping[str, float] = field(default_factory=dict)  # source to ms from its next sample
    sources: tuple[
        str, ...
    ] = ()  # of attitude, gimbal, mount, gnss, rangefinder, terrain, relative
