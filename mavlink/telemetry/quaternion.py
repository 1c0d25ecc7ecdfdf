"""Quaternions as plain tuples ``(w, x, y, z)``, scalar first, Hamilton product.

``q_a_b`` takes b-coordinates to a-coordinates, so neighbours must match:
``multiply(q_ned_body, q_body_gimbal)``. Euler angles are intrinsic yaw, pitch, roll (Z-Y-X).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation b followed by a (``q_a_c`` of ``q_a_b`` and ``q_b_c``)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse rotation of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def normalised(q: Sequence[float]) -> Quaternion | None:
    """The unit quaternion along ``q``; None when it is not finite or far from unit length."""
    if len(q) != 4:
        return None
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if not math.isfinite(length) or abs(length - 1.0) > 0.1:
        return None
    return (q[0] / length, q[1] / length, q[2] / length, q[3] / length)


def from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """``q_parent_child`` of yaw, then pitch, then roll."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def from_degrees(*rpy_deg: float | None) -> Quaternion | None:
    """:func:`from_rpy` of roll, pitch and yaw in degrees; None where one is not known."""
    roll, pitch, yaw = (math.nan if angle is None else math.radians(angle) for angle in rpy_deg)
    return from_rpy(roll, pitch, yaw) if math.isfinite(roll + pitch + yaw) else None


def to_rpy(q: Quaternion) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in rad; at pitch +-90 degrees roll is zero and yaw holds the rotation."""
    w, x, y, z = q
    sin_pitch = max(-1.0, min(1.0, 2.0 * (w * y - z * x)))
    pitch = math.asin(sin_pitch)
    if abs(sin_pitch) > 1.0 - 1e-9:
        return 0.0, pitch, 2.0 * math.atan2(z, w) if abs(w) + abs(z) > 1e-6 else 0.0
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def down_component(q_ned_body: Quaternion) -> float:
    """Cosine between the body's z axis and straight down: 1 when level."""
    _, x, y, _ = q_ned_body
    return 1.0 - 2.0 * (x * x + y * y)


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Angle in rad of the rotation from a to b, 0 to pi."""
    return math.hypot(*rotation_vector(multiply(conjugate(a), b)))


def slerp(a: Quaternion, b: Quaternion, fraction: float) -> Quaternion:
    """The rotation ``fraction`` of the way from a (0) to b (1) on the shorter arc. Fractions
    slightly outside 0 to 1 extrapolate the rotation."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    if dot < 0.0:
        b = (-b[0], -b[1], -b[2], -b[3])
        dot = -dot
    if dot > 1.0 - 1e-9:
        ka, kb = 1.0 - fraction, fraction
    else:
        theta = math.acos(min(1.0, dot))
        scale = math.sin(theta)
        ka = math.sin((1.0 - fraction) * theta) / scale
        kb = math.sin(fraction * theta) / scale
    w, x, y, z = (ka * p + kb * q for p, q in zip(a, b, strict=True))
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return (w / length, x / length, y / length, z / length)


def curve(
    a: Quaternion, b: Quaternion, rates_a: Vector, rates_b: Vector, gap_s: float, fraction: float
) -> Quaternion:
    """The rotation ``fraction`` of the way from a to b, which are ``gap_s`` apart.

    A cubic Hermite curve of the rotation vector from a. Rates are rad/s about the axes of the
    body; at b they are taken to derivatives of that vector, to second order.
    """
    turn = rotation_vector(multiply(conjugate(a), b))
    across = cross(turn, rates_b)
    twice = cross(turn, across)
    x, y, z = (
        hermite(
            turn[k],
            gap_s * rates_a[k],
            gap_s * (rates_b[k] + across[k] / 2 + twice[k] / 12),
            fraction,
        )
        for k in range(3)
    )
    angle = math.sqrt(x * x + y * y + z * z)
    scale = 0.5 if angle < 1e-6 else math.sin(angle / 2) / angle
    return multiply(a, (math.cos(angle / 2), scale * x, scale * y, scale * z))


def hermite(step: float, begin: float, end: float, fraction: float) -> float:
    """The way at ``fraction`` of a cubic over ``step`` with these derivatives at its ends."""
    u = fraction
    return u * (1 - u) ** 2 * begin + u * u * (3 - 2 * u) * step + u * u * (u - 1) * end


def rotation_vector(q: Quaternion) -> Vector:
    """Axis times angle, rad, of the shorter way."""
    w, x, y, z = q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    length = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if length < 1e-9 else 2.0 * math.atan2(length, w) / length
    return (scale * x, scale * y, scale * z)


def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
