"""A flight that turns: its telemetry, and its frames as the check of telemetry takes them."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.quaternion import Quaternion
from mavlink.telemetry.samples import AttitudeSample, GimbalFrame, GimbalSample
from recon.frames import gimbal_from_camera
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.types import F64
from service.flight.telemetry_check import TelemetryCheck

S = 1_000_000_000
LATE_S = 0.07

Turns = list[tuple[int, Quaternion]]


def seen(state: Tracking, T_odom_camera: F64 | None = None, segment: int = 0) -> Frame:
    return Frame(NO_IMAGE, 0, 0, state=state, segment=segment, T_keyframe_camera=T_odom_camera)


def body(t: float, strength: float = 1.0) -> Rotation:
    roll = strength * 0.1 * math.sin(2.9 * t)
    pitch = strength * 0.08 * math.sin(1.7 * t + 0.5)
    return Rotation.from_euler("ZYX", [strength * 0.8 * math.sin(0.3 * t), pitch, roll])


def quaternion_of(R: Rotation) -> Quaternion:
    x, y, z, w = map(float, R.as_quat())
    return (w, x, y, z)


def history_of(
    gimbal: str, strength: float, yaw_frame: str = "auto",
    kind: type[VehicleHistory] = VehicleHistory,
) -> VehicleHistory:  # fmt: skip
    """Telemetry of a camera fixed at 60 degrees below the nose.

    The gimbal is "none", "honest" (earth), or "wrong": body-relative, but claims the earth.
    """
    history = kind(HistoryConfig(yaw_frame=yaw_frame))
    mount = Rotation.from_euler("Y", -math.pi / 3)
    for k in range(45 * 25):
        t = k / 25
        history.add(AttitudeSample(None, quaternion_of(body(t, strength))), k * S // 25)
        if gimbal == "honest":
            q = quaternion_of(body(t, strength) * mount)
            history.add(GimbalSample(None, q, GimbalFrame.EARTH, 154, 0), k * S // 25)
        elif gimbal == "wrong":
            claimed = GimbalSample(None, quaternion_of(mount), GimbalFrame.EARTH, 154, 0)
            history.add(claimed, k * S // 25)
    return history


def fly(
    check: TelemetryCheck,
    strength: float = 1.0,
    noise_rad: float = 5e-4,
    gap: bool = False,
    hz: float = 15.0,
    rate: float = 0.0,
    image_roll_deg: float = 0.0,
) -> list[int]:
    """Forty seconds of frames whose stamps are 70 ms late, and ever later by ``rate``; the times of
    exposure. The images are turned clockwise by ``image_roll_deg``."""
    rng = np.random.default_rng(2)
    mount = Rotation.from_euler("Y", -math.pi / 3)
    R_head_camera = gimbal_from_camera(image_roll_deg)
    exposed = []
    for k in range(round(40 * hz)):
        t = 1.0 + k / hz
        noise = Rotation.from_rotvec(rng.normal(0.0, noise_rad, 3))
        T = np.eye(4)
        T[:3, :3] = (body(t, strength) * mount * noise).as_matrix() @ R_head_camera
        stamp = round((t + LATE_S + rate * t) * S)
        lost = gap and 200 <= k < 205
        exposed.append(check.exposed_ns(stamp))
        segment = int(gap and k >= 205)
        state = Tracking.LOST if lost else Tracking.TRACKED
        check.add(stamp, seen(state, None if lost else T, segment))
    check.finish()
    return exposed
