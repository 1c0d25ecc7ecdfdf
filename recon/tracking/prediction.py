"""Where the camera and a keyframe's corners should be in a new frame, and how two frames differ."""

from __future__ import annotations

import cv2
import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.tracking import robust_geometry, two_view
from recon.tracking.frame import Frame
from recon.types import F64, I64, Bool, PosePrior

MIN_MEASURED = 12  # landmarks that give a scale


def inverse_depth_plane(P: F64) -> F64:
    """(3,) q with ``1 / z = q . ray`` for the plane through camera points (N, 3)."""
    if len(P) < 3:
        return np.array([0.0, 0.0, 1.0 / max(float(np.median(P[:, 2])) if len(P) else 1.0, 1e-6)])
    inverse = 1.0 / P[:, 2]
    at, weight = P * inverse[:, None], np.ones(len(P))
    for _ in range(5):
        weighted = at * weight[:, None]
        q = np.linalg.solve(weighted.T @ at + 1e-9 * np.eye(3), weighted.T @ inverse)
        weight = robust_geometry.cauchy_weights(np.abs(at @ q - inverse))
    return np.asarray(q)


def on_landmarks(
    key: Frame, K: F64, size_px: tuple[int, int], T_camera_odom: F64
) -> tuple[F64, F64, Bool]:
    """Where (N, 2) the keyframe's corners fall for a start pose, the warps (N, 2, 2) of offsets
    there, and which (N,) are visible. Corners without a landmark are taken to lie on the plane
    through the landmarks."""
    T_new_key = T_camera_odom @ key.T_odom_camera
    known, P_key = key.known_points()
    plane = inverse_depth_plane(P_key)
    H = K @ (T_new_key[:3, :3] + np.outer(T_new_key[:3, 3], plane)) @ np.linalg.inv(K)
    uv = cv2.perspectiveTransform(key.uv[:, None], H)[:, 0].astype(np.float64)
    warp = robust_geometry.local_affine(H, key.uv, uv)
    P_new = se3.transform(T_new_key, P_key)
    uv[known] = P_new[:, :2] / P_new[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    W, Hh = size_px
    visible = np.all((uv > 8) & (uv < [W - 8, Hh - 8]), axis=1) & np.isfinite(uv[:, 0])
    return uv, warp, visible


def landmark_depths(key: Frame, K: F64, rows: I64) -> F64 | None:
    """(N,) depths in its camera of the keyframe's corners ``rows`` (N,), NaN without a landmark.

    With too few landmarks among them all depths are those of the plane through the others;
    None where that does not reach.
    """
    known, P = key.known_points()
    z = np.full(len(key.uv), np.nan)
    z[known] = P[:, 2]
    if np.isfinite(z[rows]).sum() >= MIN_MEASURED:
        return np.asarray(z[rows])
    if len(P) < MIN_MEASURED:
        return None
    inverse = rays(K, key.uv[rows]) @ inverse_depth_plane(P)
    return np.asarray(1.0 / inverse) if np.all(inverse > 0) else None


def relative_rotation(a: PosePrior, b: PosePrior) -> F64 | None:
    """R_b_a from two attitudes; None when one is missing or only assumed from the mount."""
    if a.R_world_camera is None or b.R_world_camera is None:
        return None
    if max(a.sigma_yaw_rad, b.sigma_yaw_rad) > 1.0:
        return None
    return np.asarray(b.R_world_camera.T @ a.R_world_camera)


NEAR_QUANTILE = 0.85
"""Quantile of the matches' motion: a camera that looks at the horizon sees mostly distant
points."""


def base_to_height(uv_a: F64, uv_b: F64, K: F64, R_b_a: F64 | None) -> float:
    """Motion of the nearer matches in focal lengths, with the turn taken out when known.

    Without an attitude the turn about the optical axis and the mean shift that a tilt would
    give cannot be distinguished from motion; the shift is then counted as motion.
    """
    a, b = rays(K, uv_a), rays(K, uv_b)
    if R_b_a is not None:
        a = a @ R_b_a.T
        a = a / a[:, 2:]
        return float(np.quantile(np.linalg.norm(b - a, axis=1), NEAR_QUANTILE))
    A = robust_geometry.affine(
        np.ascontiguousarray(a[:, :2]), np.ascontiguousarray(b[:, :2]), 0.01, is_similarity=True
    )
    return float(np.linalg.norm(A[:, 2])) if A is not None else 0.0


def beyond_turn(uv_a: F64, uv_b: F64, K: F64) -> float:
    """Median angle in rad that the best turn of the camera leaves between matches (N, 2)."""
    a, b = (ray / np.linalg.norm(ray, axis=1)[:, None] for ray in (rays(K, uv_a), rays(K, uv_b)))
    weight = np.ones(len(a))
    for _ in range(5):
        R_b_a = se3.nearest_rotation((b * weight[:, None]).T @ a)
        off = np.linalg.norm(b - a @ R_b_a.T, axis=1)
        weight = robust_geometry.cauchy_weights(off)
    return float(np.median(off))


def metric_scale(
    view: two_view.TwoView, first: PosePrior, second: PosePrior, T_odom_a: F64
) -> float:
    """Metres per baseline: from the height above ground, else from the distance flown."""
    if first.agl_m is not None and first.agl_m > 0:
        up_a = T_odom_a[:3, :3].T[:, 2]
        height = -float(np.median(view.points[view.inliers] @ up_a))
        if height > 0:
            return first.agl_m / height
    if first.position_m is not None and second.position_m is not None:
        flown = float(np.linalg.norm(second.position_m - first.position_m))
        if flown > 0:
            return flown
    return 1.0


def fresh_corners(corners: F64, kept: F64, size_px: tuple[int, int], grid: int) -> F64:
    """(N, 2) of the ``corners`` in cells of the ``grid`` that no kept track occupies."""
    taken = np.zeros((grid, grid), np.bool_)
    cell = (kept / size_px * grid).astype(np.int64).clip(0, grid - 1)
    taken[cell[:, 1], cell[:, 0]] = True
    cell = (corners / size_px * grid).astype(np.int64).clip(0, grid - 1)
    return np.asarray(corners[~taken[cell[:, 1], cell[:, 0]]])


STEADY_S = 0.3  # velocities of frames closer than this are averaged with those before


class ConstantVelocity:
    """Constant-velocity motion model; the turn is telemetry's. In units of the odometry."""

    def __init__(self, time_ns: int, T_odom_camera: F64, prior: PosePrior) -> None:
        """At rest there, with the pose prior of that moment."""
        self._last = (time_ns, T_odom_camera, prior)
        self._velocity = np.zeros(3)
        self._turn_rad_s = 0.0

    def update(self, time_ns: int, T_odom_camera: F64, prior: PosePrior) -> None:
        last_ns, T_last, _ = self._last
        if time_ns > last_ns:
            dt = (time_ns - last_ns) * 1e-9
            velocity = (T_odom_camera[:3, 3] - T_last[:3, 3]) / dt
            keep = 0.5 if dt < STEADY_S and np.any(self._velocity) else 0.0
            self._velocity = keep * self._velocity + (1 - keep) * velocity
            self._turn_rad_s = _angle(T_last[:3, :3].T @ T_odom_camera[:3, :3]) / dt
        self._last = (time_ns, T_odom_camera, prior)

    def correct(self, T_odom_camera: F64) -> None:
        """The last frame's pose was adjusted; the velocity stays."""
        time_ns, _, prior = self._last
        self._last = (time_ns, T_odom_camera, prior)

    def shift(self, time_ns: int, prior: PosePrior, depth: float) -> tuple[float, float, float]:
        """How far (rad) the ground at ``depth`` moves in the image from the last frame until then,
        by motion and by the turn that telemetry shows, and the seconds. A turn that it does not
        show continues at its last rate, and counts as motion."""
        _, turn, gap_s = self.ahead(time_ns, prior)
        moved = float(np.linalg.norm(self._velocity)) * gap_s / depth
        if turn is None:
            return moved + self._turn_rad_s * gap_s, 0.0, gap_s
        return moved, _angle(turn), gap_s

    def across(self, T_odom_camera: F64, depth: float) -> F64:
        """(2,) rad by which the ground at ``depth`` on the optical axis has moved in the image
        since the last frame."""
        on_axis = np.array([[0.0, 0.0, depth]])
        x, y, z = se3.transform(se3.inverse(T_odom_camera) @ self._last[1], on_axis)[0]
        return np.asarray(np.array([x, y]) / max(z, 1e-6))

    def ahead(self, time_ns: int, prior: PosePrior) -> tuple[F64, F64 | None, float]:
        """T_odom_camera (4, 4) expected then, the turn R_new_last of telemetry, and seconds."""
        last_ns, T_last, last_prior = self._last
        dt = (time_ns - last_ns) * 1e-9
        R = T_last[:3, :3]
        turn = relative_rotation(last_prior, prior)
        if turn is not None:
            R = R @ turn.T
        return se3.compose(R, T_last[:3, 3] + self._velocity * dt), turn, dt


def _angle(R: F64) -> float:
    return float(np.linalg.norm(se3.so3_log(R)))
