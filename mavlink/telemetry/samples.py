"""Telemetry samples, one per message, and the vehicle state that they give at one time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import numpy.typing as npt

from mavlink.telemetry.quaternion import Quaternion

RECEIVER_SIGMA_H_M, RECEIVER_SIGMA_V_M = 2.1, 3.5
"""1 sigma per axis of a receiver that reports no accuracy: a circular error of 2.5 m, from the data
sheets of u-blox M8 receivers, is 2.1 m per axis; heights are about 1.7 times worse."""


class GimbalFrame(Enum):
    """Reference frame of a gimbal's quaternion."""

    EARTH = "earth"  # NED
    VEHICLE = "vehicle"  # horizon in roll and pitch, the vehicle's heading in yaw
    BODY = "body"  # the vehicle's own axes
    SERVO = "servo"  # pan, roll and tilt of servos on the body, sent as yaw, roll and pitch


@dataclass(frozen=True, slots=True)
class Sample:
    """Base of all samples. ``boot_ms`` is the sender's boot clock, None when it sends none."""

    boot_ms: float | None


@dataclass(frozen=True, slots=True)
class AttitudeSample(Sample):
    """Attitude of the body."""

    q_ned_body: Quaternion


@dataclass(frozen=True, slots=True)
class PositionSample(Sample):
    """The estimator's position."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float | None
    relative_alt_m: float | None  # above home
    v_ned_m_s: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True)
class AccuracySample(Sample):
    """The GNSS receiver's own estimate of its accuracy, 1 sigma, and its own altitude."""

    has_fix: bool
    sigma_h_m: float
    sigma_v_m: float
    alt_amsl_m: float | None = None


@dataclass(frozen=True, slots=True)
class RangeSample(Sample):
    """Distance of a rangefinder that looks along the body's z axis."""

    distance_m: float


@dataclass(frozen=True, slots=True)
class TerrainSample(Sample):
    """Height above the ground from a terrain model or an altimeter fused by the autopilot."""

    agl_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class GimbalSample(Sample):
    """Attitude of a gimbal's head as declared by its sender."""

    q: Quaternion
    frame: GimbalFrame
    component: int
    rank: int  # 0 GIMBAL_DEVICE_ATTITUDE_STATUS, 1 MOUNT_ORIENTATION, 2 MOUNT_STATUS


OF_AUTOPILOT = (AttitudeSample, PositionSample, AccuracySample)
"""Accepted from the autopilot only: a gimbal or camera that sends it describes itself."""


F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ReceiverAltitude:
    """One fix of the GNSS receiver and the autopilot's altitude at the same time."""

    time_ns: int
    above_m: float  # the receiver's altitude minus the autopilot's


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
    alt_agl_m: float | None = None  # above the ground below; ``sources`` names its origin
    v_ned_m_s: F64 | None = None  # (3,)
    sigma_h_m: float | None = None  # of the horizontal position, per axis
    sigma_v_m: float | None = None  # of alt_amsl_m
    sigma_agl_m: float | None = None
    sigma_attitude_rad: float | None = None  # roll and pitch of the body
    sigma_yaw_rad: float | None = None
    sigma_gimbal_rad: float | None = None  # roll and pitch of the gimbal head
    receiver: ReceiverAltitude | None = None  # of the fix nearest in time
    age_ms: Mapping[str, float] = field(default_factory=dict)  # source to ms from its next sample
    sources: tuple[str, ...] = ()  # of attitude, gimbal, gnss, rangefinder, terrain, relative
