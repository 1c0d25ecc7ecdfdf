"""The camera's mount on the vehicle, and the prior of its pose from telemetry."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mavlink.telemetry.samples import VehicleState
from recon import se3
from recon.frames import (
    R_ENU_NED,
    R_GIMBAL_CAMERA,
    gimbal_from_camera,
    rotation_from_rpy,
    rpy_from_rotation,
)
from recon.posegraph.ground import ASSUMED_TILT_RAD
from recon.types import F64, PosePrior
from service.cameras.source import GeoTag
from service.config import CameraConfig, FusionConfig, ScanConfig
from service.georeference import LocalFrame

ASSUMED_AGL_M = 50.0  # assumed height above ground without any other scale; the scan states it

ABOVE_HOME_SHARE = 0.25
"""Relative sigma of a height above the take-off point, used as a height above ground."""

AT_REST_M_S, ON_GROUND_M = 0.3, 2.0  # below these a vehicle is on the ground
MIN_SIGMA_M, MAX_ALTITUDE_M = 0.005, 1e5  # limits of plausible accuracies and heights in tags

TAG_HEIGHT_M, BAROMETER_M = 50.0, 5.0
"""Sigma of an altitude in a still's tags: of a camera's receiver, and of a drone that also writes
its height above the take-off point."""

VERTICAL_SHARE = 2.5
"""Sigma of a fix's altitude over that of its position, where the latter alone is stated: of
receivers two to three."""

CORRECTED_M = 0.1
"""A receiver that states less has corrections of a base: its height does not wander by itself."""

NO_ALTITUDE_M = 1000.0  # sigma of the height of a position without an altitude

TURN_NS = 20_000_000
"""Before and after an exposure: how telemetry's attitude changes there is the camera's turn."""

RATE_RAD_S, CHANGE_RAD_S2 = 0.02, 1.0
"""Sigma of a turn by telemetry, and how fast it changes between two attitudes."""

NO_YAW_RAD = 3.0  # sigma of an unknown heading


@dataclass(frozen=True, slots=True)
class Fix:
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float | None
    sigma_h_m: float
    sigma_v_m: float
    is_claimed: bool  # by the receiver, or there is no altitude; False: sigmas are typical ones


def turn_sigma_rad_s(gap_s: float, sigma_time_s: float = 0.0) -> float:
    """Sigma of a turn between two attitudes of telemetry ``gap_s`` apart."""
    away_s = math.hypot(gap_s / math.sqrt(12.0), sigma_time_s)
    return math.hypot(RATE_RAD_S, CHANGE_RAD_S2 * away_s)


def body_from_head(camera: CameraConfig) -> F64:
    """R_body_head (3, 3) of a fixed mount."""
    mount_deg = camera.mount_roll_deg, camera.mount_pitch_deg, camera.mount_yaw_deg
    return rotation_from_rpy(*(math.radians(angle) for angle in mount_deg))


def stated_roll_deg(camera: CameraConfig) -> float:
    """The images' roll against gimbal or mount before they show it."""
    return 0.0 if camera.image_roll_deg == "auto" else camera.image_roll_deg


class Rig:
    """Turns vehicle states and image tags into priors on the camera's pose. The scan's origin is
    the first known position; before it there are no positions."""

    def __init__(self, camera: CameraConfig, scan: ScanConfig, fusion: FusionConfig) -> None:
        self._camera, self._scan, self._fusion = camera, scan, fusion
        self.local_frame: LocalFrame | None = None
        self.georeference = "none"
        self.vertical_datum = ""
        self.is_pressure_altitude = False
        self.is_stabilised = False  # the vehicle's attitude is not the camera's
        self._is_altitude_stated = self._is_altitude_known = False
        self._lever_body = np.array(
            [camera.lever_forward_m, camera.lever_right_m, camera.lever_down_m]
        )
        self.turn_images(stated_roll_deg(camera))

    def turn_images(self, image_roll_deg: float) -> None:
        """Take images as turned clockwise by so much against gimbal or mount from now on."""
        self.image_roll_deg = image_roll_deg
        self._R_head_camera = gimbal_from_camera(image_roll_deg)
        self._R_body_camera = body_from_head(self._camera) @ self._R_head_camera

    @property
    def is_altitude_assumed(self) -> bool:
        """True when there are positions, and none states the accuracy of its altitude."""
        return self.georeference != "none" and not self._is_altitude_stated

    @property
    def is_altitude_missing(self) -> bool:
        """True when there are positions, and none has an altitude other than 0."""
        return self.georeference != "none" and not self._is_altitude_known

    def prior(self, state: VehicleState | None, tag: GeoTag | None) -> PosePrior:
        """The prior of one frame from telemetry, otherwise from the image's own tag.

        Without an attitude it is the nominal mount of a level vehicle heading north, with a large
        sigma; without a height the configured or assumed one, likewise.
        """
        R, tilt, yaw = self._rotation(state, tag)
        fix = self._fix(state, tag)
        if fix is not None and fix.alt_amsl_m:  # devices that know none write 0
            self._is_altitude_known = True
            self._is_altitude_stated |= fix.is_claimed
        position, sigma = self._position(fix)
        lever = self._lever(state)
        height = self._agl(state, tag, float(lever[2]))
        agl, sigma_agl, is_measured = height or (ASSUMED_AGL_M, 0.5 * ASSUMED_AGL_M, False)
        position = None if position is None else position + lever
        velocity = altitude = receiver = None
        if state is not None and state.v_ned_m_s is not None and self._fusion.gnss:
            velocity = R_ENU_NED @ state.v_ned_m_s
        # A position includes the altitude.
        if state is not None and position is None and self._fusion.altitude:
            altitude = None if state.alt_amsl_m is None else state.alt_amsl_m + lever[2]
        if state is not None and position is not None:
            receiver = state.receiver
        return PosePrior(
            R, tilt, yaw, position, sigma, agl, sigma_agl, altitude,
            gnss_minus_baro_m=None if receiver is None else receiver.gnss_minus_baro_m,
            gnss_minus_baro_fixes=0 if receiver is None else 1,
            gnss_minus_baro_ns=0 if receiver is None else receiver.time_ns,
            is_at_rest=state is not None and _is_at_rest(state),
            is_agl_measured=is_measured,
            is_agl_assumed=height is None,
            velocity_m_s=velocity,
            is_sigma_claimed=fix is None or fix.is_claimed,
            is_view_assumed=tilt >= ASSUMED_TILT_RAD,
        )  # fmt: skip

    def turn_at(self, state_at: Callable[[int], VehicleState | None], time_ns: int) -> F64 | None:
        """(3,) rad/s of the camera in its own frame; by one side where telemetry begins or ends."""
        for begin, end in ((-TURN_NS, TURN_NS), (0, TURN_NS), (-TURN_NS, 0)):
            turn = self.turn(state_at(time_ns + begin), state_at(time_ns + end))
            if turn is not None:
                return turn
        return None

    def turn(self, before: VehicleState | None, after: VehicleState | None) -> F64 | None:
        """(3,) rad/s of the camera in its own frame between two states; None without attitude."""
        if before is None or after is None or after.time_ns <= before.time_ns:
            return None
        (R_before, tilt_before, _), (R_after, tilt_after, _) = (
            self._rotation(state, None) for state in (before, after)
        )
        if max(tilt_before, tilt_after) >= ASSUMED_TILT_RAD:
            return None
        turned = R_before.T @ R_after
        return se3.so3_log(turned) * (1e9 / (after.time_ns - before.time_ns))

    def _lever(self, state: VehicleState | None) -> F64:
        """(3,) ENU metres from the vehicle's position to the camera; zero without its attitude."""
        if state is None or state.q_ned_body_wxyz is None:
            return np.zeros(3)
        R_ned_body = se3.rotation_from_quaternion(state.q_ned_body_wxyz)
        return np.asarray(R_ENU_NED @ R_ned_body @ self._lever_body)

    def _rotation(self, state: VehicleState | None, tag: GeoTag | None) -> tuple[F64, float, float]:
        if state is not None and self._fusion.attitude:
            gimbal = state.q_ned_gimbal_wxyz
            if gimbal is not None and self._camera.mount != "fixed":
                R = R_ENU_NED @ se3.rotation_from_quaternion(gimbal) @ self._R_head_camera
                return R, state.sigma_gimbal_rad or 0.02, state.sigma_yaw_rad or 0.1
            body = state.q_ned_body_wxyz
            if body is not None and self._camera.mount != "gimbal" and not self.is_stabilised:
                R = R_ENU_NED @ se3.rotation_from_quaternion(body) @ self._R_body_camera
                return R, state.sigma_attitude_rad or 0.02, state.sigma_yaw_rad or 0.1
        if tag is not None and tag.ypr_deg is not None and self._fusion.attitude:
            yaw, pitch, roll = (math.radians(a) for a in tag.ypr_deg)
            R = R_ENU_NED @ rotation_from_rpy(roll, pitch, yaw) @ R_GIMBAL_CAMERA
            return R, math.radians(1.5), math.radians(5.0) if tag.is_yaw_known else NO_YAW_RAD
        return R_ENU_NED @ self._R_body_camera, ASSUMED_TILT_RAD, NO_YAW_RAD

    def _fix(self, state: VehicleState | None, tag: GeoTag | None) -> Fix | None:
        if not self._fusion.gnss:
            return None
        if state is not None and state.lat_deg is not None and state.lon_deg is not None:
            self.georeference = "gnss"
            return Fix(
                state.lat_deg,
                state.lon_deg,
                state.alt_amsl_m,
                state.sigma_h_m or 2.0,
                state.sigma_v_m or 4.0,
                state.is_claimed or state.alt_amsl_m is None,
            )
        if state is not None or tag is None or self.georeference == "gnss":
            return None
        if tag.lat_deg is not None and tag.lon_deg is not None:
            self.georeference = "exif"
            self.vertical_datum = self.vertical_datum or tag.datum
            self.is_pressure_altitude |= tag.is_pressure_altitude
            usual_m = TAG_HEIGHT_M if tag.relative_alt_m is None else BAROMETER_M
            if tag.is_sigma_h_stated:
                usual_m = min(usual_m, VERTICAL_SHARE * tag.sigma_h_m)
            sigma_v = tag.sigma_v_m or usual_m
            is_corrected = tag.is_sigma_h_stated and tag.sigma_h_m < CORRECTED_M
            is_claimed = tag.sigma_v_m is not None or tag.alt_amsl_m is None or is_corrected
            return Fix(
                tag.lat_deg, tag.lon_deg, tag.alt_amsl_m, tag.sigma_h_m, sigma_v, is_claimed
            )  # fmt: skip
        return None

    def _position(self, fix: Fix | None) -> tuple[F64 | None, F64 | None]:
        """(3,) ENU metres from the origin, and their sigmas."""
        if fix is None:
            return None, None
        altitude = fix.alt_amsl_m
        if altitude is not None and not abs(altitude) < MAX_ALTITUDE_M:
            altitude = None
        if self.local_frame is None:
            self.local_frame = LocalFrame(fix.lat_deg, fix.lon_deg, altitude or 0.0)
        height = self.local_frame.alt_amsl_m if altitude is None else altitude
        enu = self.local_frame.to_enu(np.array([[fix.lat_deg, fix.lon_deg, height]]))[0]
        sigma_v_m = fix.sigma_v_m if altitude is not None else NO_ALTITUDE_M
        sigma = np.array([fix.sigma_h_m, fix.sigma_h_m, sigma_v_m])
        return enu, np.maximum(sigma, MIN_SIGMA_M)

    def _agl(
        self, state: VehicleState | None, tag: GeoTag | None, lever_m: float
    ) -> tuple[float, float, bool] | None:
        """Height above ground and its sigma, m, and whether it is measured or given, not above the
        take-off point, which may lie elsewhere. The camera is ``lever_m`` above the vehicle."""
        if self._scan.assumed_agl_m is not None:
            agl = self._scan.assumed_agl_m
            return agl, 0.1 * agl, True
        if state is not None and state.alt_agl_m is not None and state.alt_agl_m > 1.0:
            if self._fusion.altitude:
                agl = state.alt_agl_m
                spread = max(state.sigma_agl_m or 3.0, 0.03 * agl)
                if "relative" not in state.sources:
                    return agl + lever_m, spread, True
                return agl + lever_m, max(spread, ABOVE_HOME_SHARE * agl), False
        elif tag is not None and self._fusion.altitude and (agl := tag.relative_alt_m or 0.0) > 1.0:
            return agl, ABOVE_HOME_SHARE * agl + 2.0, False
        return None


def _is_at_rest(state: VehicleState) -> bool:
    """True where telemetry shows the vehicle standing on the ground."""
    if state.v_ned_m_s is None or state.alt_agl_m is None:
        return False
    speed_m_s = float(np.linalg.norm(state.v_ned_m_s))
    return speed_m_s < AT_REST_M_S and state.alt_agl_m < ON_GROUND_M


def attitude_of(T_world_camera: F64) -> tuple[float, float, float]:
    """(roll, pitch, yaw) rad of the optical head (gimbal axes) in NED: pitch -pi/2 is nadir."""
    return rpy_from_rotation(R_ENU_NED @ T_world_camera[:3, :3] @ R_GIMBAL_CAMERA.T)
