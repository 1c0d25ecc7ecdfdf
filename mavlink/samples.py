"""What one message says of the vehicle, with the two clocks it may carry."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mavlink.quaternion import Quaternion

RECEIVER_SIGMA_H_M, RECEIVER_SIGMA_V_M = 2.1, 3.5
"""1 sigma per axis of a receiver that states no accuracy: a circular error of 2.5 m, as the data
sheets of u-blox M8 receivers give it, is 2.1 m per axis; heights are worse by about 1.7."""


class GimbalFrame(Enum):
    """What a gimbal's quaternion refers to."""

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
    """Attitude of a gimbal's head as its sender claims it."""

    q: Quaternion
    frame: GimbalFrame
    component: int
    rank: int  # 0 GIMBAL_DEVICE_ATTITUDE_STATUS, 1 MOUNT_ORIENTATION, 2 MOUNT_STATUS


OF_AUTOPILOT = (AttitudeSample, PositionSample, AccuracySample)
"""What only the autopilot may say: a gimbal or camera that says it means itself."""
