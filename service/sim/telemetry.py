"""The flight's MAVLink messages, as a tlog."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mavlink.wire.dialect import dialect
from mavlink.wire.messages import OutgoingMessage, Packer
from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA, rotation_from_rpy
from recon.se3 import quaternion_from_rotation, so3_exp
from recon.types import F64
from service.georeference import LocalFrame
from service.sim.flight import LEAD_S, Sensors, check_ranges

BOOT_BEFORE_VIDEO_S = 100.0
GIMBAL_COMPONENT = 154
ROLL_LOCK, PITCH_LOCK, YAW_IN_VEHICLE_FRAME, YAW_IN_EARTH_FRAME = 4, 8, 32, 64
RANGE_TO_GROUND = Callable[[F64, F64], F64]
"""(N,) metres along rays from (N, 3) places in (N, 3) directions of length one."""

Timed = tuple[Any, int, float]
"""A message, the component that sends it, and when, in seconds since the first frame."""


@dataclass(frozen=True, slots=True)
class TelemetryOptions:
    gimbal_frame: str = "earth"  # or "vehicle": the frame of the gimbal's yaw
    rangefinder: bool = True
    gap_s: tuple[float, float] | None = None  # nothing is sent between these times
    lead_s: float = 0.0  # how long before the first frame the log begins
    boresight_deg: tuple[float, float] = (0.0, 0.0)  # the camera looks right and up of it
    accuracy: bool = True  # GPS_RAW_INT carries h_acc and v_acc
    home_above_m: float = 0.0  # the take-off point above the ground at the world's origin

    def __post_init__(self) -> None:
        check_ranges(
            *(("boresight", angle, " deg", -45, 45) for angle in self.boresight_deg),
            ("log lead", self.lead_s, " s", 0, LEAD_S),
            ("home above the site", self.home_above_m, " m", -1000, 1000),
        )
        if self.gimbal_frame not in ("earth", "vehicle"):
            raise ValueError(f"gimbal frame {self.gimbal_frame!r} is not 'earth' or 'vehicle'")


def _boot_ms(t: F64) -> npt.NDArray[np.int64]:
    return np.asarray(np.round((t + BOOT_BEFORE_VIDEO_S) * 1e3), np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class FlightMessages:
    """The messages of a flight kind by kind, each kind in the order of time."""

    sensors: Sensors
    origin: LocalFrame
    epoch_unix_s: float
    ground_range: RANGE_TO_GROUND
    options: TelemetryOptions

    def write_tlog(self, path: Path) -> int:
        """Write MAVLink 2 packets as a tlog, big-endian unix microseconds before each; how many."""
        kinds = [
            self.housekeeping(), self.attitude(), self.gimbal(), self.position(),
            self.satellites(), *([self.range()] if self.options.rangefinder else []),
        ]  # fmt: skip
        gap = self.options.gap_s
        packer, count = Packer(0), 0
        with path.open("wb") as out:
            for message, component, t in heapq.merge(*kinds, key=lambda item: item[2]):
                # a video piped without its time is taken to begin with the log
                if t < -self.options.lead_s or (gap and gap[0] <= t < gap[1]):
                    continue
                data = packer.pack(1, OutgoingMessage(component, message), 0)
                if data is not None:
                    out.write(struct.pack(">Q", round((self.epoch_unix_s + t) * 1e6)) + data)
                    count += 1
        return count

    def _times(self, hz: float) -> F64:
        """From before the first frame until after the last."""
        duration_s = self.sensors.flight.plan.duration_s
        return np.asarray(np.arange(-LEAD_S, duration_s + LEAD_S, 1.0 / hz), np.float64)

    def housekeeping(self) -> Iterator[Timed]:
        """HEARTBEAT (armed, in a mission), SYSTEM_TIME and HOME_POSITION, once a second."""
        lat, lon = round(self.origin.lat_deg * 1e7), round(self.origin.lon_deg * 1e7)
        level = [1.0, 0.0, 0.0, 0.0]
        for t in self._times(1.0):
            heartbeat = dialect.MAVLink_heartbeat_message
            yield heartbeat(2, 3, 128 | 16 | 8 | 1, 3, 4, 3), 1, float(t)
            yield heartbeat(26, 8, 0, 0, 4, 3), GIMBAL_COMPONENT, float(t)
            unix_us, boot_ms = round((self.epoch_unix_s + t) * 1e6), int(_boot_ms(np.array([t]))[0])
            yield dialect.MAVLink_system_time_message(unix_us, boot_ms), 1, float(t) + 0.001
            alt = round((self.origin.alt_amsl_m + self.options.home_above_m) * 1e3)
            home = dialect.MAVLink_home_position_message
            yield home(lat, lon, alt, 0, 0, 0, level, 0, 0, 0), 1, float(t) + 0.002

    def attitude(self) -> Iterator[Timed]:
        """ATTITUDE at 50 Hz."""
        t = self._times(50.0)
        rpy = self.sensors.vehicle_rpy(t)
        rates = _body_rates(self.sensors.flight.vehicle_rpy(t), t)
        for k, boot in enumerate(_boot_ms(t)):
            yaw = float((rpy[k, 2] + np.pi) % (2 * np.pi) - np.pi)
            attitude = dialect.MAVLink_attitude_message
            yield attitude(int(boot), rpy[k, 0], rpy[k, 1], yaw, *rates[k]), 1, float(t[k])

    def gimbal(self) -> Iterator[Timed]:
        """GIMBAL_DEVICE_ATTITUDE_STATUS at 20 Hz, from the gimbal's own component."""
        t = self._times(20.0) + 0.003
        right, up = np.radians(self.options.boresight_deg)
        off = R_GIMBAL_CAMERA @ so3_exp(-np.array([up, right, 0.0])) @ R_GIMBAL_CAMERA.T
        R = self.sensors.R_ned_gimbal(t) @ off
        flags = ROLL_LOCK | PITCH_LOCK | YAW_IN_EARTH_FRAME
        if self.options.gimbal_frame == "vehicle":
            flags = ROLL_LOCK | PITCH_LOCK | YAW_IN_VEHICLE_FRAME
            for k, yaw in enumerate(self.sensors.vehicle_rpy(t)[:, 2]):
                R[k] = rotation_from_rpy(0.0, 0.0, float(-yaw)) @ R[k]
        for k, boot in enumerate(_boot_ms(t)):
            q = [float(v) for v in quaternion_from_rotation(R[k])]
            nan = float("nan")
            message = dialect.MAVLink_gimbal_device_attitude_status_message(
                0, 0, int(boot), flags, q, nan, nan, nan, 0, nan, nan, 0
            )
            yield message, GIMBAL_COMPONENT, float(t[k])

    def position(self) -> Iterator[Timed]:
        t = self._times(10.0) + 0.001
        at = self.sensors.estimate(t)
        geodetic = self.origin.to_geodetic(at)
        v = self.sensors.flight.velocity(t) + 0.05 * self.sensors.rng.normal(size=(len(t), 3))
        yaw = np.degrees(self.sensors.vehicle_rpy(t)[:, 2]) % 360.0
        for k, boot in enumerate(_boot_ms(t)):
            lat, lon = round(geodetic[k, 0] * 1e7), round(geodetic[k, 1] * 1e7)
            ned = round(v[k, 1] * 100), round(v[k, 0] * 100), round(-v[k, 2] * 100)
            yield dialect.MAVLink_global_position_int_message(
                int(boot), lat, lon, round(geodetic[k, 2] * 1e3),
                round((at[k, 2] - self.options.home_above_m) * 1e3), *ned,
                round(float(yaw[k]) * 100) % 36000,
            ), 1, float(t[k])  # fmt: skip

    def satellites(self) -> Iterator[Timed]:
        t = self._times(5.0) + 0.004
        geodetic = self.origin.to_geodetic(self.sensors.gps(t))
        v, noise = self.sensors.flight.velocity(t), self.sensors.noise
        h_acc = round(1e3 * max(0.02, np.hypot(noise.gps_m, noise.gps_white_m)))
        h_acc *= self.options.accuracy  # 0: unknown
        for k, boot in enumerate(_boot_ms(t)):
            course = round(float(np.degrees(np.arctan2(v[k, 0], v[k, 1]))) * 100) % 36000
            speed = round(float(np.hypot(v[k, 0], v[k, 1])) * 100)
            yield dialect.MAVLink_gps_raw_int_message(
                int(boot) * 1000, 3, round(geodetic[k, 0] * 1e7), round(geodetic[k, 1] * 1e7),
                round(geodetic[k, 2] * 1e3), 80, 120, speed, course, 14, 0, h_acc,
                round(1.5 * h_acc), 300, 0,
            ), 1, float(t[k])  # fmt: skip

    def range(self) -> Iterator[Timed]:
        """DISTANCE_SENSOR along the body's z axis at 10 Hz, up to 120 m."""
        t = self._times(10.0) + 0.002
        rpy = self.sensors.flight.vehicle_rpy(t)
        down = np.array([R_ENU_NED @ rotation_from_rpy(*map(float, row))[:, 2] for row in rpy])
        ways = self.ground_range(self.sensors.flight.position(t), down)
        ways = ways + self.sensors.noise.range_m * self.sensors.rng.normal(size=len(t))
        for k, boot in enumerate(_boot_ms(t)):
            if 0.1 < ways[k] < 120.0:
                cm = round(float(ways[k]) * 100)
                distance = dialect.MAVLink_distance_sensor_message
                yield distance(int(boot), 10, 12000, cm, 0, 1, 25, 0), 1, float(t[k])


def _body_rates(rpy: F64, t: F64) -> F64:
    """(T, 3) rad/s about the body's axes, as gyroscopes measure them."""
    roll, pitch, _ = rpy.T
    d_roll, d_pitch, d_yaw = np.gradient(rpy, t, axis=0).T
    right, down = np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)
    return np.column_stack(
        [
            d_roll - np.sin(pitch) * d_yaw,
            np.cos(roll) * d_pitch + right * d_yaw,
            -np.sin(roll) * d_pitch + down * d_yaw,
        ]
    )
