"""The flown path and attitudes, exact at any moment, and the drone's sensor readings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from recon import se3
from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA, rotation_from_rpy
from recon.types import F64

PATTERNS = ("nadir", "oblique", "legs", "orbit", "hover")
LEAD_S = 5.0
"""Seconds of flight before the first and after the last frame, and of telemetry after it."""
STEP_S = 0.02
G_M_S2 = 9.81
SWING_HZ = np.array([1.0, 0.9, 0.0])  # frequencies of a swinging head about its roll and pitch axes


def check_ranges(*rows: tuple[str, float, str, float, float]) -> None:
    """ValueError for the first value out of its range: what it is, value, unit, least and most."""
    for what, value, unit, low, high in rows:
        if not low <= value <= high:
            raise ValueError(f"{what} of {value:g}{unit} is not within {low:g} to {high:g}{unit}")


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """Plan of a flight. ``height_m`` counts above the ground at the world's origin."""

    pattern: str = "nadir"
    duration_s: float = 30.0
    height_m: float = 60.0
    speed_m_s: float = 5.0
    heading_deg: float = 35.0  # of the first leg, from north over east
    camera_pitch_deg: float | None = None  # None: what the pattern asks for
    legs: int = 3
    spacing_m: float | None = None  # between legs; None: 0.45 of the height
    wobble_deg: float = 1.0  # of the stabilised camera, 1 sigma per axis
    sway_m: float = 0.15  # of the position about the path, 1 sigma per axis
    climb_m: float = 0.0  # higher at the end than at the start, evenly
    swing_deg: float = 0.0  # amplitude of the head's swing about two axes, at SWING_HZ
    centred: bool = False  # the middle of the path lies above the origin, else its start

    def __post_init__(self) -> None:
        if self.pattern not in PATTERNS:
            raise ValueError(f"pattern {self.pattern!r} is not one of {', '.join(PATTERNS)}")
        check_ranges(
            ("duration", self.duration_s, " s", 0.1, 7200),
            ("height", self.height_m, " m", 2, 1000),
            ("speed", self.speed_m_s, " m/s", 0, 50),
            ("number of legs", self.legs, "", 1, 100),
            ("camera pitch", self.pitch_deg, " deg", -90, 0),
            ("wobble", self.wobble_deg, " deg", 0, 20),
            ("sway", self.sway_m, " m", 0, 5),
            ("height after the climb", self.height_m + self.climb_m, " m", 2, 1000),
            ("swing", self.swing_deg, " deg", 0, 20),
        )
        if self.spacing_m is not None and not 0 < self.spacing_m < 1e4:
            raise ValueError(f"leg spacing of {self.spacing_m:g} m is not positive")

    @property
    def lowest_m(self) -> float:
        return min(self.height_m, self.height_m + self.climb_m)

    @property
    def highest_m(self) -> float:
        return max(self.height_m, self.height_m + self.climb_m)

    @property
    def pitch_deg(self) -> float:
        """Pitch of the camera's axis: -90 straight down, 0 level."""
        if self.camera_pitch_deg is not None:
            return self.camera_pitch_deg
        return {"oblique": -65.0, "orbit": -50.0}.get(self.pattern, -90.0)


@dataclass(frozen=True, slots=True, eq=False)
class Waves:
    """A smooth random signal: a sum of sines, unit variance per channel."""

    hz: F64  # (C, N)
    phase: F64  # (C, N)

    @staticmethod
    def draw(rng: np.random.Generator, channels: int, low_hz: float, high_hz: float) -> Waves:
        """``channels`` independent signals between two frequencies."""
        hz = np.exp(rng.uniform(np.log(low_hz), np.log(high_hz), (channels, 6)))
        return Waves(hz, rng.uniform(0, 2 * np.pi, (channels, 6)))

    def at(self, t_s: F64) -> F64:
        """(T, C) values at (T,) times."""
        angle = 2 * np.pi * t_s[:, None, None] * self.hz + self.phase
        return np.asarray(np.sin(angle).sum(axis=2) / np.sqrt(self.hz.shape[1] / 2))


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """The true motion; times in seconds since the first frame, from -LEAD_S on."""

    plan: FlightPlan
    path: CubicSpline  # t -> (3,) ENU m
    course: CubicSpline  # t -> smooth yaw rad, from north over east
    wobble: Waves  # camera, 3 channels
    shake: Waves  # vehicle, 3 channels

    def position(self, t_s: F64) -> F64:
        """(T, 3) ENU metres."""
        return np.asarray(self.path(t_s))

    def velocity(self, t_s: F64) -> F64:
        """(T, 3) ENU metres per second."""
        return np.asarray(self.path(t_s, 1))

    def vehicle_rpy(self, t_s: F64) -> F64:
        """(T, 3) roll, pitch, yaw in rad of the vehicle (NED, FRD): it leans to accelerate."""
        a, v, yaw = self.path(t_s, 2), self.path(t_s, 1), self.course(t_s)
        s, c = np.sin(yaw), np.cos(yaw)
        forward = a[:, 0] * s + a[:, 1] * c + 0.08 * (v[:, 0] * s + v[:, 1] * c)
        right = a[:, 0] * c - a[:, 1] * s + 0.08 * (v[:, 0] * c - v[:, 1] * s)
        rpy = np.stack([right / G_M_S2, -forward / G_M_S2, yaw], axis=1)
        return np.asarray(rpy + np.radians([1.2, 1.2, 1.0]) * self.shake.at(t_s))

    def R_ned_gimbal(self, t_s: F64) -> F64:
        """(T, 3, 3) attitude of the stabilised head."""
        turn = np.radians(self.plan.wobble_deg) * self.wobble.at(t_s)
        turn += np.radians(self.plan.swing_deg) * np.sin(2 * np.pi * SWING_HZ * t_s[:, None])
        pitch = np.radians(self.plan.pitch_deg)
        return np.array(
            [
                rotation_from_rpy(0.0, pitch, float(yaw)) @ se3.so3_exp(w)
                for yaw, w in zip(self.course(t_s), turn, strict=True)
            ]
        )

    def T_world_camera(self, t_s: F64) -> F64:
        """(T, 4, 4) exact camera poses; camera and vehicle share their origin."""
        R = R_ENU_NED @ self.R_ned_gimbal(t_s) @ R_GIMBAL_CAMERA
        out = np.tile(np.eye(4), (len(t_s), 1, 1))
        out[:, :3, :3], out[:, :3, 3] = R, self.position(t_s)
        return out


def fly(plan: FlightPlan, seed: int) -> Flight:
    """The flight of a plan; the same for the same seed."""
    rng = np.random.default_rng(seed + 1)
    t = np.asarray(np.arange(-LEAD_S - 3.0, plan.duration_s + LEAD_S + 3.0, STEP_S), np.float64)
    heading = np.radians(plan.heading_deg)
    if plan.pattern == "orbit":
        xy, yaw = _orbit(plan, t, heading)
    elif plan.pattern == "hover":
        xy = np.zeros((len(t), 2))
        yaw = heading + np.radians(2.0) * t
    else:
        xy, yaw = _follow(_waypoints(plan, heading), plan.speed_m_s, t, heading)
    sway = plan.sway_m * Waves.draw(rng, 3, 0.05, 0.25).at(t)
    z = plan.height_m + plan.climb_m * np.clip(t / plan.duration_s, 0.0, 1.0)
    z = gaussian_filter1d(z, 0.9 / STEP_S, mode="nearest")
    xyz = np.column_stack([xy, z]) + sway
    wobble, shake = Waves.draw(rng, 3, 0.08, 0.7), Waves.draw(rng, 3, 0.15, 1.2)
    return Flight(plan, CubicSpline(t, xyz), CubicSpline(t, yaw), wobble, shake)


def _waypoints(plan: FlightPlan, heading: float) -> F64:
    """(N, 2) corners of the path; the flight enters and leaves on straight ahead."""
    ahead = np.array([np.sin(heading), np.cos(heading)])
    right = np.array([ahead[1], -ahead[0]])
    spare = (LEAD_S + 5.0) * max(plan.speed_m_s, 0.1)
    legs = {"nadir": 1, "oblique": 2}.get(plan.pattern, plan.legs)
    spacing = plan.spacing_m if plan.spacing_m is not None else 0.45 * plan.height_m
    total = plan.speed_m_s * plan.duration_s
    length = max((total - (legs - 1) * spacing) / legs, 0.1 * total + 0.01)
    points = []
    for k in range(legs):
        ends = (0.0, length) if k % 2 == 0 else (length, 0.0)
        points += [k * spacing * right + s * ahead for s in ends]
    if plan.centred:
        points = list(np.array(points) - np.mean(points, axis=0))
    points[0] = points[0] - spare * ahead
    points[-1] = points[-1] + spare * ahead * (1.0 if legs % 2 else -1.0)
    return np.array(points)


def _follow(corners: F64, speed_m_s: float, t: F64, heading: float) -> tuple[F64, F64]:
    """((T, 2) position, (T,) yaw) along a line of corners, rounded, t = 0 at its true start."""
    steps = np.diff(corners, axis=0)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    at = np.clip(speed_m_s * t + (LEAD_S + 5.0) * max(speed_m_s, 0.1), 0.0, s[-1])
    sharp = np.stack([np.interp(at, s, corners[:, k]) for k in range(2)], axis=1)
    xy = gaussian_filter1d(sharp, 1.0 / STEP_S, axis=0, mode="nearest")
    course = np.arctan2(steps[:, 0], steps[:, 1])
    leg = np.clip(np.searchsorted(s, at, "right") - 1, 0, len(course) - 1)
    yaw = np.unwrap(course)[leg] if speed_m_s > 0 else np.full(len(t), heading)
    return xy, np.asarray(gaussian_filter1d(yaw, 0.9 / STEP_S, mode="nearest"))


def _orbit(plan: FlightPlan, t: F64, heading: float) -> tuple[F64, F64]:
    """((T, 2), (T,)) a circle about the point that the camera looks at, nose to the centre."""
    radius = plan.height_m / np.tan(np.radians(max(-plan.pitch_deg, 10.0)))
    angle = heading + np.pi + plan.speed_m_s * t / max(radius, 1.0)
    xy = radius * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    return xy, angle + np.pi


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """How wrong the drone's sensors are, 1 sigma."""

    gps_m: float = 1.0  # slowly wandering, horizontal, per axis; vertical 1.5 times
    gps_white_m: float = 0.05
    baro_m: float = 0.5  # slowly wandering
    attitude_deg: float = 0.3  # slowly wandering, roll and pitch
    yaw_deg: float = 1.0  # slowly wandering
    attitude_white_deg: float = 0.05
    range_m: float = 0.05

    @staticmethod
    def of(gnss: str, noise: SensorNoise) -> SensorNoise:
        """The noise with a GNSS that errs as ``gnss`` says; ValueError for an unknown word.

        "wander": slowly, as it is; "white": by as much, from fix to fix; "exact": no sensor errs.
        """
        if gnss == "wander":
            return noise
        if gnss == "white":
            return replace(noise, gps_m=0.0, gps_white_m=noise.gps_m)
        if gnss == "exact":
            return SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        raise ValueError(f"GNSS noise {gnss!r} is not 'wander', 'white' or 'exact'")

    def __post_init__(self) -> None:
        check_ranges(*((name, getattr(self, name), "", 0, 1000) for name in self.__slots__))


class Sensors:
    """Noisy measurements of a flight; wandering errors are shared by all sensors they touch."""

    def __init__(self, flight: Flight, noise: SensorNoise, rng: np.random.Generator) -> None:
        self.flight, self.noise, self.rng = flight, noise, rng
        self._t = np.arange(-LEAD_S - 1.0, flight.plan.duration_s + LEAD_S + 1.0, 0.1)
        sigma = [noise.gps_m, noise.gps_m, 1.5 * noise.gps_m, noise.baro_m]
        sigma += list(np.radians([noise.attitude_deg, noise.attitude_deg, noise.yaw_deg]))
        tau_s = np.array([60.0, 60.0, 60.0, 120.0, 25.0, 25.0, 40.0])
        keep = np.exp(-0.1 / tau_s)  # first-order Gauss-Markov
        walk = rng.normal(size=(len(self._t), 7))  # east, north, up, baro, roll, pitch, yaw
        for k in range(1, len(walk)):
            walk[k] = keep * walk[k - 1] + np.sqrt(1 - keep**2) * walk[k]
        self._drift = gaussian_filter1d(walk * sigma, 5.0, axis=0, mode="nearest")

    def _wander(self, t_s: F64, first: int, last: int) -> F64:
        columns = [np.interp(t_s, self._t, self._drift[:, k]) for k in range(first, last)]
        return np.stack(columns, axis=1)

    def gps(self, t_s: F64) -> F64:
        """(T, 3) ENU position of the receiver's own fix."""
        white = self.rng.normal(size=(len(t_s), 3)) * self.noise.gps_white_m * [1, 1, 2]
        return np.asarray(self.flight.position(t_s) + self._wander(t_s, 0, 3) + white)

    def estimate(self, t_s: F64) -> F64:
        """(T, 3) ENU position as the autopilot's filter gives it: GPS plan, baro height."""
        out = self.flight.position(t_s)
        out[:, :2] += self._wander(t_s, 0, 2)
        out[:, 2:] += self._wander(t_s, 3, 4)
        return np.asarray(out + 0.2 * self.noise.gps_white_m * self.rng.normal(size=out.shape))

    def vehicle_rpy(self, t_s: F64) -> F64:
        """(T, 3) roll, pitch, yaw in rad as ATTITUDE gives them."""
        white = np.radians(self.noise.attitude_white_deg) * self.rng.normal(size=(len(t_s), 3))
        return np.asarray(self.flight.vehicle_rpy(t_s) + self._wander(t_s, 4, 7) + white)

    def R_ned_gimbal(self, t_s: F64) -> F64:
        """(T, 3, 3) attitude of the head as the gimbal gives it; it shares the wander."""
        roll, pitch, turn = self._wander(t_s, 4, 7).T
        yaw = self.flight.course(t_s)
        s, c = np.sin(yaw), np.cos(yaw)
        error = np.column_stack([c * roll - s * pitch, s * roll + c * pitch, turn])
        white = np.radians(self.noise.attitude_white_deg) * self.rng.normal(size=error.shape)
        return np.asarray(se3.each_so3_exp(error + white) @ self.flight.R_ned_gimbal(t_s))
