"""Quaternions of gimbals into attitudes of the head in NED.

By its flags, GIMBAL_DEVICE_ATTITUDE_STATUS declares the reference of its quaternion (MAVLink gimbal
protocol v2): bit 64 earth, bit 32 the vehicle's heading, neither: earth when yaw is locked
(16), otherwise the vehicle's heading. Some senders declare it wrongly: ArduPilot's servo mounts
send servo angles with flags 44, which declare the horizon. Therefore the configuration,
:func:`steadiest_frame` (by telemetry alone) and :mod:`.frame_watch` (by the images) can override
the flags.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mavlink.telemetry.quaternion import (
    Quaternion,
    from_rpy,
    multiply,
    to_rpy,
    yaw_of,
)
from mavlink.telemetry.samples import GimbalFrame

YAW_LOCK = 16
YAW_IN_VEHICLE_FRAME = 32
YAW_IN_EARTH_FRAME = 64

STRAIGHT_RAD = math.radians(0.05)
TILT_LAG = 30
TILTED_RAD = math.radians(1.0)

YAW_FRAMES = ("auto", "vehicle", "earth", "body", "servo")


@dataclass(frozen=True, slots=True)
class GimbalConfig:
    """Options for reading gimbal messages."""

    yaw_frame: str = "auto"  # auto: as the flags declare, unless telemetry refutes them

    def __post_init__(self) -> None:
        if self.yaw_frame not in YAW_FRAMES:
            raise ValueError(
                f"gimbal yaw_frame is {self.yaw_frame!r}; use one of {', '.join(YAW_FRAMES)}"
            )


def frame_of_flags(flags: int) -> GimbalFrame:
    """The quaternion's reference, by the flags of GIMBAL_DEVICE_ATTITUDE_STATUS."""
    if flags & YAW_IN_EARTH_FRAME:
        return GimbalFrame.EARTH
    if flags & YAW_IN_VEHICLE_FRAME:
        return GimbalFrame.VEHICLE
    return GimbalFrame.EARTH if flags & YAW_LOCK else GimbalFrame.VEHICLE


def to_earth(q: Quaternion, frame: GimbalFrame, q_ned_body: Quaternion) -> Quaternion:
    """``q_ned_gimbal`` of a quaternion in any frame and the body's attitude at that time."""
    if frame is GimbalFrame.EARTH:
        return q
    if frame is GimbalFrame.BODY:
        return multiply(q_ned_body, q)
    if frame is GimbalFrame.SERVO:
        return multiply(q_ned_body, _of_servos(q))
    return multiply(from_rpy(0.0, 0.0, yaw_of(q_ned_body)), q)


def _of_servos(q: Quaternion) -> Quaternion:
    """``q_body_gimbal`` of servo angles that were sent as if they were yaw, pitch, roll.

    The servo order differs: pan on the body, roll on the pan, tilt on the roll. A tilt beyond
    straight down becomes one before it, with the other angles rotated by 180 degrees. Straight
    down, roll and yaw are indistinguishable, and the rotation is taken as roll, because few servo
    mounts can pan.
    """
    roll, pitch, yaw = to_rpy(q)
    if abs(pitch) > math.pi / 2 - STRAIGHT_RAD:
        turn = roll - yaw if pitch > 0.0 else roll + yaw
        return multiply(from_rpy(turn, 0.0, 0.0), _tilt(pitch))
    if abs(roll) > math.pi / 2:
        roll -= math.copysign(math.pi, roll)
        yaw -= math.copysign(math.pi, yaw)
        pitch = math.copysign(math.pi, pitch) - pitch
    return multiply(from_rpy(roll, 0.0, yaw), _tilt(pitch))


def _tilt(pitch_rad: float) -> Quaternion:
    return from_rpy(0.0, pitch_rad, 0.0)


def steadiest_frame(
    q_sent: Sequence[Quaternion], q_ned_body: Sequence[Quaternion], lag: int = TILT_LAG
) -> GimbalFrame | None:
    """BODY or SERVO when a head that declares the horizon moves like such a mount.

    A mount that holds the horizon has a steady tilt while the body's tilt changes. When instead the
    sent tilt changes against the body's, so that only its composition with the body's attitude is
    steady, its angles are relative to the body. Compares pairs of samples, ``lag`` apart, between
    which the body tilted by a degree; None when the declaration holds, or with too few pairs.
    """
    pairs = [
        (i, i + lag)
        for i in range(len(q_sent) - lag)
        if math.dist(_down(q_ned_body[i]), _down(q_ned_body[i + lag])) > TILTED_RAD
    ]
    if len(pairs) < 20:
        return None
    scores: dict[GimbalFrame, float] = {}
    for frame in (GimbalFrame.VEHICLE, GimbalFrame.BODY, GimbalFrame.SERVO):
        heads = [to_earth(q, frame, body) for q, body in zip(q_sent, q_ned_body, strict=True)]
        scores[frame] = _change(heads, pairs)
    best = min(scores, key=lambda frame: scores[frame])
    return best if scores[best] < 0.5 * scores[GimbalFrame.VEHICLE] else None


def _change(heads: Sequence[Quaternion], pairs: Sequence[tuple[int, int]]) -> float:
    """Median change of tilt in rad over pairs; jumps of the target drop out."""
    steps = sorted(math.dist(_down(heads[i]), _down(heads[j])) for i, j in pairs)
    return steps[len(steps) // 2]


def _down(q: Quaternion) -> tuple[float, float, float]:
    """The down direction in the head's axes; independent of heading."""
    w, x, y, z = q
    return (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
