"""MAVLink messages into samples: one function per message, a table of their names."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mavlink.telemetry.gimbal import frame_of_flags
from mavlink.telemetry.quaternion import Vector, from_degrees, from_rpy, normalised
from mavlink.telemetry.samples import (
    RECEIVER_SIGMA_H_M,
    RECEIVER_SIGMA_V_M,
    AccuracySample,
    AttitudeSample,
    GimbalFrame,
    GimbalSample,
    PositionSample,
    RangeSample,
    Sample,
    TerrainSample,
)

Message = Any  # a message object of a pymavlink dialect

DOWNWARD = 25  # MAV_SENSOR_ROTATION_PITCH_270
HDOP_TO_M = 1.5  # range error of one sigma per unit of HDOP
UNKNOWN_U16 = 65535
UNKNOWN_I32 = -(1 << 31)  # by our own mavlink.wire.lines
MAX_SIGMA_M = 1e5  # a receiver that says more says nothing
UNIX_USEC = 10**15  # a time_usec beyond this is unix time, not time since boot
TERRAIN_MODEL_SIGMA_M = 5.0
CLEARANCE_SIGMA_M = 1.0
MAX_RATE_RAD_S = 35.0  # the range of usual gyroscopes, 2000 degrees/s


def decode(message: Message) -> Sample | None:
    """The sample in a message; None when it has none or its values are implausible."""
    reader = READERS.get(message.get_type())
    return None if reader is None else reader(message)


def _attitude(m: Message) -> Sample | None:
    if not _finite(m.roll, m.pitch, m.yaw):
        return None
    return AttitudeSample(m.time_boot_ms, from_rpy(m.roll, m.pitch, m.yaw), _rates(m))


def _attitude_quaternion(m: Message) -> Sample | None:
    q = normalised((m.q1, m.q2, m.q3, m.q4))
    return None if q is None else AttitudeSample(m.time_boot_ms, q, _rates(m))


def _rates(m: Message) -> Vector | None:
    """Rates of the body by its gyroscopes; None where the sender fills in zeros."""
    rates = (m.rollspeed, m.pitchspeed, m.yawspeed)
    is_plausible = _finite(*rates) and max(map(abs, rates)) <= MAX_RATE_RAD_S
    return rates if is_plausible and any(rates) else None


def _global_position(m: Message) -> Sample | None:
    lat, lon = m.lat * 1e-7, m.lon * 1e-7
    if not plausible_place(lat, lon):
        return None
    velocity = (m.vx * 0.01, m.vy * 0.01, m.vz * 0.01)
    alt_m, above_home_m = (
        None if mm == UNKNOWN_I32 else mm * 1e-3 for mm in (m.alt, m.relative_alt)
    )
    return PositionSample(m.time_boot_ms, lat, lon, alt_m, above_home_m, velocity)


def _gps_raw(m: Message) -> Sample | None:
    fix = m.fix_type >= 3
    sigma_h = m.h_acc * 1e-3 if m.h_acc else _from_dop(m.eph, RECEIVER_SIGMA_H_M)
    sigma_v = m.v_acc * 1e-3 if m.v_acc else _from_dop(m.epv, RECEIVER_SIGMA_V_M)
    alt_m, place = m.alt * 1e-3 if fix else None, None
    lat, lon, course = m.lat * 1e-7, m.lon * 1e-7, math.radians(m.cog * 0.01)
    if fix and plausible_place(lat, lon):
        speed = math.nan if UNKNOWN_U16 in (m.vel, m.cog) else m.vel * 0.01
        velocity = (speed * math.cos(course), speed * math.sin(course), math.nan)
        place = PositionSample(None, lat, lon, alt_m, None, velocity)
    return AccuracySample(None, fix, sigma_h, sigma_v, alt_m, m.h_acc > 0, place)


def _from_dop(dop_cent: int, unknown_m: float) -> float:
    """Metres, 1 sigma, from a dilution of precision in hundredths; ``unknown_m`` without one."""
    return unknown_m if dop_cent in (UNKNOWN_U16, 0) else dop_cent * 0.01 * HDOP_TO_M


def receiver_accuracy(
    has_fix: bool,
    sigma_h_m: float = math.nan,
    sigma_v_m: float = math.nan,
    alt_amsl_m: float | None = None,
) -> AccuracySample:
    """The accuracy that a log states; that of usual receivers where it states none that can be."""
    is_stated = 0.0 < sigma_h_m < MAX_SIGMA_M
    return AccuracySample(
        None, has_fix,
        sigma_h_m if is_stated else RECEIVER_SIGMA_H_M,
        sigma_v_m if 0.0 < sigma_v_m < MAX_SIGMA_M else RECEIVER_SIGMA_V_M,
        alt_amsl_m, is_claimed=is_stated,
    )  # fmt: skip


def _distance_sensor(m: Message) -> Sample | None:
    if m.orientation != DOWNWARD or m.signal_quality == 1:
        return None
    if not m.min_distance <= m.current_distance < m.max_distance:
        return None
    return RangeSample(m.time_boot_ms, m.current_distance * 0.01)


def _rangefinder(m: Message) -> Sample | None:
    if not math.isfinite(m.distance) or m.distance <= 0.0:
        return None
    return RangeSample(None, m.distance)


def _terrain_report(m: Message) -> Sample | None:
    # Without a loaded grid ArduPilot answers with zeros and spacing 0.
    if m.spacing == 0 or not _finite(m.current_height):
        return None
    return TerrainSample(None, m.current_height, TERRAIN_MODEL_SIGMA_M)


def _altitude(m: Message) -> Sample | None:
    # PX4 sends NaN when it does not know the clearance; other senders -1000.
    if not math.isfinite(m.bottom_clearance) or m.bottom_clearance <= 0.0:
        return None
    boot_ms = m.time_usec * 1e-3 if m.time_usec < UNIX_USEC else None
    return TerrainSample(boot_ms, m.bottom_clearance, CLEARANCE_SIGMA_M)


def _device_status(m: Any) -> GimbalSample | None:
    q = normalised(m.q)
    if q is None:
        return None
    return GimbalSample(m.time_boot_ms, q, frame_of_flags(m.flags), m.get_srcComponent(), 0)


def _mount_orientation(m: Any) -> GimbalSample | None:
    """The sample in a MOUNT_ORIENTATION (265): degrees, earth yaw when it sends one."""
    absolute = float(getattr(m, "yaw_absolute", math.nan))
    # Senders of the short form leave the extension zero, whatever the heading.
    earth = math.isfinite(absolute) and absolute != 0.0
    q = from_degrees(m.roll, m.pitch, absolute if earth else m.yaw)
    frame = GimbalFrame.EARTH if earth else GimbalFrame.VEHICLE
    return None if q is None else GimbalSample(m.time_boot_ms, q, frame, m.get_srcComponent(), 1)


def _mount_status(m: Any) -> GimbalSample | None:
    """The sample in an old MOUNT_STATUS (158): hundredths of a degree, vehicle's heading."""
    roll, pitch, yaw = (math.radians(a * 0.01) for a in (m.pointing_b, m.pointing_a, m.pointing_c))
    q = from_rpy(roll, pitch, yaw)
    return GimbalSample(None, q, GimbalFrame.VEHICLE, m.get_srcComponent(), 2)


def _finite(*values: float) -> bool:
    return all(math.isfinite(value) for value in values)


def plausible_place(lat_deg: float, lon_deg: float) -> bool:
    """True for a place on Earth; autopilots send 0, 0 before they have a position."""
    if not _finite(lat_deg, lon_deg) or abs(lat_deg) > 90.0 or abs(lon_deg) > 180.0:
        return False
    return lat_deg != 0.0 or lon_deg != 0.0


READERS: dict[str, Callable[[Message], Sample | None]] = {
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "GLOBAL_POSITION_INT": _global_position,
    "GPS_RAW_INT": _gps_raw,
    "DISTANCE_SENSOR": _distance_sensor,
    "RANGEFINDER": _rangefinder,
    "TERRAIN_REPORT": _terrain_report,
    "ALTITUDE": _altitude,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": _device_status,
    "MOUNT_ORIENTATION": _mount_orientation,
    "MOUNT_STATUS": _mount_status,
}
"""Message name to reader. A new message is one function and one line."""
