"""Quaternions of gimbals into attitudes of the head in NED.

By its flags, GIMBAL_DEVICE_ATTITUDE_STATUS declares the reference of its quaternion (MAVLink gimbal
protocol v2): bit 64 earth, bit 32 the vehicle's heading, neither: earth when yaw is locked
(16), otherwise the vehicle's heading. Some senders declare it wrongly: ArduPilot's servo mounts
send servo angles with flags 44, which declare the horizon. Therefore the configuration,
:func:`steadiest_frame` (by telemetry alone) and :func:`frame_by_images` can override the flags.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mavlink.telemetry.quaternion import (
    Quaternion,
    angle_between,
    conjugate,
    from_rpy,
    multiply,
    to_rpy,
)
from mavlink.telemetry.samples import GimbalFrame

YAW_LOCK = 16
YAW_IN_VEHICLE_FRAME = 32
YAW_IN_EARTH_FRAME = 64

STRAIGHT_RAD = math.radians(0.05)
TILT_LAG = 30
TILTED_RAD = math.radians(1.0)

YAW_FRAMES = ("auto", "vehicle", "earth", "body", "servo")


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
    return multiply(from_rpy(0.0, 0.0, to_rpy(q_ned_body)[2]), q)


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


SAME_RAD = math.radians(0.3)
CLEAR_RAD = math.radians(0.05)
MIN_TURNS = 20


@dataclass(frozen=True, slots=True)
class FrameVerdict:
    """The frame that agrees with the images."""

    frame: GimbalFrame
    decided: bool  # the rotations distinguish the frames
    refuted: tuple[GimbalFrame, ...] = ()  # frames that disagree clearly more


Ends = tuple[Quaternion, Quaternion]
"""Two rotations: at the first and at the second of two images, or as sent and the body's."""

Turn = tuple[int, int, Quaternion]
"""Times in ns of two images, and ``q_head(first)_head(second)`` as seen, in the head's axes."""


def frame_by_images(
    turns: Sequence[Turn],
    claimed_at: Callable[[int], Ends | None],
    latency_ms: float = 0.0,
) -> FrameVerdict | None:
    """The frame of a gimbal's quaternions that agrees with the turns of its head as seen.

    ``claimed_at(time_ns)`` gives the gimbal's quaternion as sent, and ``q_ned_body``. None with
    fewer than twenty turns. ``decided`` requires the best frame to disagree less than half as much
    as every other frame with a different meaning.
    """
    shift = round(latency_ms * 1e6)
    claims = [(claimed_at(a - shift), claimed_at(b - shift), seen) for a, b, seen in turns]
    known = [(a, b, seen) for a, b, seen in claims if a is not None and b is not None]
    if len(known) < MIN_TURNS:
        return None
    heads: dict[GimbalFrame, list[Ends]] = {
        frame: [(to_earth(a[0], frame, a[1]), to_earth(b[0], frame, b[1])) for a, b, _ in known]
        for frame in GimbalFrame
    }
    rms = {frame: _disagreement(heads[frame], [seen for *_, seen in known]) for frame in heads}
    best = min(rms, key=lambda frame: rms[frame])
    # A frame that always gives the same attitudes is not a rival.
    rivals = [f for f in GimbalFrame if _largest_angle(heads[f], heads[best]) > SAME_RAD]
    refuted = tuple(
        f for f in rivals if rms[f] > 2.0 * rms[best] and rms[f] - rms[best] > CLEAR_RAD
    )
    return FrameVerdict(best, bool(rivals) and refuted == tuple(rivals), refuted)


MIN_STEADY_TURNS = 8
STEADY_SHARE, SWAYS_RAD, STRAIGHT_ON_RAD = 0.5, math.radians(1.5), math.radians(4.0)
"""A camera tilts by less than this share of what its vehicle tilts by, which tilts by this rms, in
turns in which the vehicle keeps its heading so well, which the camera may follow."""


def is_stabilised(
    turns: Sequence[Turn], body_at: Callable[[int], Quaternion | None], latency_ms: float = 0.0
) -> bool:
    """True where the images surely hold still while the vehicle tilts: its attitude is not theirs.

    Sums are compared, not turn by turn, as the latency may be wrong.
    """
    shift = round(latency_ms * 1e6)
    tilted = seen = count = 0.0
    for first_ns, second_ns, turn in turns:
        a, b = body_at(first_ns - shift), body_at(second_ns - shift)
        if a is None or b is None:
            continue
        w, x, y, z = multiply(b, conjugate(a))  # in NED
        if 2.0 * abs(z) < STRAIGHT_ON_RAD * abs(w):
            tilted += 4.0 * (x * x + y * y)
            seen += angle_between(turn, (1.0, 0.0, 0.0, 0.0)) ** 2 - 4.0 * z * z
            count += 1.0
    is_known = count >= MIN_STEADY_TURNS and tilted > SWAYS_RAD**2 * count
    return is_known and seen < STEADY_SHARE**2 * tilted


def _disagreement(heads: Sequence[Ends], steps: Sequence[Quaternion]) -> float:
    """Root mean square angle in rad between the steps of the heads and those seen."""
    squares = [
        angle_between(multiply(conjugate(a), b), seen) ** 2
        for (a, b), seen in zip(heads, steps, strict=True)
    ]
    return math.sqrt(sum(squares) / len(squares))


def _largest_angle(a: Sequence[Ends], b: Sequence[Ends]) -> float:
    return max(
        angle_between(p, q) for pair in zip(a, b, strict=True) for p, q in zip(*pair, strict=True)
    )
