"""Reports to the autopilot and the ground station: odometry, keyframes and the field of view."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mavlink.component.camera import KeyframeReport
from mavlink.component.control import CameraView
from mavlink.component.status import BodyOdometry
from mavlink.telemetry.samples import VehicleState
from recon import se3
from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA, gimbal_from_camera
from recon.pipeline.mapper import FramePosed
from recon.types import F64, Camera, PosePrior
from service.cameras.rig import Rig, body_from_head, stated_roll_deg
from service.config import CameraConfig, FusionConfig, ScanConfig
from service.georeference import LocalFrame

LONGEST_STEP_S = 0.5  # between two poses that give a velocity
JUMP_M = 0.5  # off the way that the velocity before would have led
BEST_TRACKS = 200
MIN_DOWN = 0.05  # of the optical axis: closer to the horizon it meets no ground that is known


class OdometryReport:
    """Turns poses of frames into odometry and hands it on.

    Position and attitude are those of the body; the offset from body to camera is neglected. With a
    gimbal, telemetry gives the head's attitude on the body. The reset counter grows when tracking
    starts again and when a correction moves the estimate.
    """

    def __init__(self, camera: CameraConfig, send: Callable[[BodyOdometry, int], object]) -> None:
        """``send(odometry, time_ns)`` takes the result, at the frame's exposure."""
        self._send = send
        self._R_body_head = body_from_head(camera)
        self._R_head_camera = gimbal_from_camera(stated_roll_deg(camera))
        self._fixed = camera.mount == "fixed"
        self._last: tuple[int, int, F64] | None = None  # time, segment, position
        self._velocity: F64 | None = None  # NED, m/s
        self.resets = 0

    def send(self, posed: FramePosed, state: VehicleState | None) -> None:
        """Hand on the pose of one frame; nothing for a frame without one by vision."""
        pose, frame = posed.pose, posed.frame
        if pose is None or not frame.is_placed:
            return
        position: F64 = np.asarray(R_ENU_NED.T @ pose.T_world_camera[:3, 3])
        R_ned_camera = R_ENU_NED.T @ pose.T_world_camera[:3, :3]
        R_ned_body: F64 = np.asarray(R_ned_camera @ self._camera_from_body(frame.prior, state))
        velocity = self._move(frame.time_ns, frame.segment, position)
        w, x, y, z = (float(v) for v in se3.quaternion_from_rotation(R_ned_body))
        a, b, c = (float(v) for v in R_ned_body.T @ velocity)
        north, east, down = (float(v) for v in position)
        quality = round(100.0 * min(1.0, frame.tracks / BEST_TRACKS))
        odometry = BodyOdometry(
            (north, east, down),
            (w, x, y, z),
            (a, b, c),
            _covariance(se3.about(pose.T_world_camera[:3, 3], pose.covariance)),
            self.resets,
            max(1, quality),
        )
        self._send(odometry, frame.time_ns)

    def _camera_from_body(self, prior: PosePrior, state: VehicleState | None) -> F64:
        """R_camera_body (3, 3) by telemetry or by the fixed mount."""
        R_body_head = self._R_body_head
        if state is not None and state.q_ned_body_wxyz is not None:
            R_ned_body = se3.rotation_from_quaternion(state.q_ned_body_wxyz)
            if prior.R_world_camera is not None and not prior.is_view_assumed:
                # It knows of a roll of the images that was found on the way.
                return np.asarray(prior.R_world_camera.T @ R_ENU_NED @ R_ned_body)
            if state.q_ned_gimbal_wxyz is not None and not self._fixed:
                R_body_head = R_ned_body.T @ se3.rotation_from_quaternion(state.q_ned_gimbal_wxyz)
        return np.asarray((R_body_head @ self._R_head_camera).T)

    def _move(self, time_ns: int, segment: int, position: F64) -> F64:
        """The velocity by the last step; one more reset where that was none of the vehicle's."""
        last, self._last = self._last, (time_ns, segment, position)
        unknown: F64 = np.full(3, np.nan)
        if last is None:
            return unknown
        step_s = (time_ns - last[0]) * 1e-9
        if segment != last[1] or not 0.0 < step_s < LONGEST_STEP_S:
            self.resets += segment != last[1]
            self._velocity = None
            return unknown
        velocity: F64 = np.asarray((position - last[2]) / step_s)
        known = self._velocity
        if known is not None and float(np.linalg.norm(velocity - known)) * step_s > JUMP_M:
            self.resets += 1
            return known
        self._velocity = velocity
        return velocity


def _covariance(covariance: F64) -> list[list[float]]:
    """(6, 6) x y z roll pitch yaw in NED of one with the rotation first in ENU."""
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = R_ENU_NED.T
    rows: list[list[float]] = (turn @ covariance @ turn.T).tolist()
    return rows


def keyframe_report(
    time_unix_ns: int,
    R_world_camera: F64 | None,
    position_m: F64 | None,
    frame: LocalFrame | None,
    agl_m: float | None,
    file: str = "",
) -> KeyframeReport:
    """Its geographic position and the attitude of its head; no place without a georeference."""
    head = None if R_world_camera is None else _head(R_world_camera)
    lat = lon = alt = None
    if position_m is not None and frame is not None:
        lat, lon, alt = frame.place(position_m)
    return KeyframeReport(time_unix_ns // 1000, lat, lon, alt, agl_m, head, file=file)


def camera_view(config: CameraConfig, camera: Camera, state: VehicleState | None) -> CameraView:
    """The view by telemetry, on level ground."""
    rig = Rig(config, ScanConfig(), FusionConfig())
    prior = rig.prior(state, None)
    (W, H), K = camera.size_px, camera.K
    hfov, vfov = (
        2.0 * math.degrees(math.atan2(n, 2.0 * f)) for n, f in ((W, K[0, 0]), (H, K[1, 1]))
    )
    R = None if prior.is_view_assumed else prior.R_world_camera
    view = CameraView(None, None, None if R is None else _head(R), hfov, vfov)
    frame, position = rig.local_frame, prior.position_m
    if frame is None or position is None or state is None or state.alt_amsl_m is None:
        return view
    view = replace(view, camera=frame.place(position))
    if R is None or prior.is_agl_assumed or prior.agl_m is None or R[2, 2] > -MIN_DOWN:
        return view
    middle = position - R[:, 2] * (prior.agl_m / R[2, 2])
    return replace(view, ground=frame.place(middle))


def _head(R_world_camera: F64) -> tuple[float, float, float, float]:
    """The attitude of the camera's head in NED, wxyz."""
    R_ned_head = np.asarray(R_ENU_NED.T @ R_world_camera @ R_GIMBAL_CAMERA.T)
    w, x, y, z = (float(v) for v in se3.quaternion_from_rotation(R_ned_head))
    return w, x, y, z
