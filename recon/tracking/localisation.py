"""Where a frame was taken: a keyframe's corners found again in it, and EPnP on their landmarks.

Section 2.3 of the paper: each of the two views of the virtual stereo camera gives a pose of the
new frame (Eq. 6-7), and the two are averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from recon import se3
from recon.tracking import matching, pnp, prediction, robust_geometry
from recon.tracking.keyframe_window import Incoming, OdometryKeyframe
from recon.tracking.matcher import Matcher
from recon.tracking.motion import Motion
from recon.tracking.odometry_config import OdometryConfig
from recon.types import F64, U8, Bool, Camera, PosePrior


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A frame's pose and the keyframe's corners found in it."""

    pose: pnp.PnpResult  # camera from odometry
    uv: F64  # (N, 2) of the keyframe's corners
    ok: Bool  # (N,) found, and not contradicted by the pose
    share: float  # of the keyframe's corners that are found, by those searched


class Localiser:
    """Poses of frames of one camera without distortion."""

    def __init__(self, camera: Camera, config: OdometryConfig, matcher: Matcher) -> None:
        """``matcher`` finds the corners again."""
        self.camera, self.config, self.matcher = camera, config, matcher

    def locate(
        self, new: Incoming, keyframes: Sequence[OdometryKeyframe], motion: Motion,
        still: bool, lost: bool,
    ) -> Located | str:  # fmt: skip
        """The frame against the last keyframe, averaged with the one before; or why not.

        Args:
            motion: where the camera was last and how it moved.
            still: too long since the frame before for that motion to hold.
            lost: the frame before has no pose.
        """
        right = keyframes[-1]
        reason = "no match"
        least = self.config.min_tracks
        most = None if still else self.config.tracked_landmarks
        for T_camera_odom, share in self._predicted_poses(new, right, motion, lost):
            found = self.pose_from(right, new.pyramid, T_camera_odom, share, least, most)
            if isinstance(found, str):
                reason = found
                continue
            T = found.pose.T_camera_points
            if not self._agrees(T, new.prior, right):
                reason = "vision and attitude disagree"
                continue
            return self._with_left(new, keyframes, found)
        return reason

    def _with_left(
        self, new: Incoming, keyframes: Sequence[OdometryKeyframe], found: Located
    ) -> Located:
        """The pose averaged with the one that the keyframe before gives, as the paper does."""
        if len(keyframes) < 2:
            return found
        T, share = found.pose.T_camera_points, 0.5 * self.config.search_share
        least, most = self.config.min_tracks // 3, self.config.tracked_landmarks // 2
        left = self.pose_from(keyframes[-2], new.pyramid, T, share, least, most)
        if isinstance(left, str):
            return found
        return replace(found, pose=_averaged(left.pose, found.pose))

    def _predicted_poses(
        self, new: Incoming, key: OdometryKeyframe, motion: Motion, lost: bool
    ) -> list[tuple[F64, float]]:
        """Start poses T_camera_odom with their search radius share, most trusted first."""
        T_odom_camera, turn, gap_s = motion.ahead(new.time_ns, new.prior)
        still = gap_s > self.config.still_gap_s
        share = self.config.wide_search_share if still else self.config.search_share
        by_motion = (se3.inverse(T_odom_camera), share)
        by_picture: list[tuple[F64, float]] = []
        if still or lost:
            by_picture = self._pose_by_picture(new.grey, key)
        if still and turn is None:
            return [*by_picture, by_motion]
        wide = (by_motion[0], self.config.wide_search_share)
        return [by_motion, *by_picture] if still else [by_motion, *by_picture, wide]

    def _pose_by_picture(self, grey: U8, key: OdometryKeyframe) -> list[tuple[F64, float]]:
        """A start pose from the global shift between the keyframe's picture and this one."""
        shift = matching.global_shift(key.pyramid.levels[0], grey)
        if shift is None or shift.confidence < self.config.least_shift_confidence:
            return []
        known = np.flatnonzero(key.map.known(key.landmark))
        points = key.map[key.landmark[known]]
        there = shift.apply(key.uv[known])
        W, H = self.camera.size_px
        inside = np.all((there > 0) & (there < [W, H]), axis=1)
        if inside.sum() < 12:
            return []
        T = robust_geometry.pose_from_points(
            points[inside], there[inside], self.camera.K, cv2.SOLVEPNP_SQPNP
        )
        return [] if T is None else [(T, 0.07)]

    def pose_from(
        self,
        key: OdometryKeyframe,
        pyramid: matching.Pyramid,
        T_camera_odom: F64,
        share: float,
        least: int,
        most: int | None = None,
    ) -> Located | str:
        """EPnP pose of the frame from one keyframe's landmarks, or why there is none.

        ``least`` matches it takes; with ``most`` only about so many landmarks are searched and
        no corner that has none, spread over the picture.
        """
        radius_px = share * self.camera.size_px[0]
        guess, visible = prediction.on_landmarks(
            key, self.camera.K, self.camera.size_px, T_camera_odom, radius_px
        )
        mapped = key.map.known(key.landmark)
        in_view = float(visible.mean())
        if most is not None:
            rows = np.flatnonzero(visible & mapped)
            visible[:] = False
            visible[rows[:: max(1, len(rows) // most)]] = True
        index = np.flatnonzero(visible)
        if index.size < least:
            return "the view left the map"
        found = self.matcher.match(
            key.pyramid,
            key.uv[index].astype(np.float32),
            pyramid,
            guess.uv[index].astype(np.float32),
            guess.radius_px,
            guess.warp[index].astype(np.float32),
            self.config.matching,
        )
        ok = np.zeros(len(key.uv), np.bool_)
        ok[index] = found.ok
        uv = guess.uv.copy()
        uv[index] = found.uv_px
        known = np.flatnonzero(ok & mapped)
        expected = int((visible & mapped).sum())
        if known.size < max(least, self.config.min_track_share * expected):
            return "too few matches"
        points = key.map[key.landmark[known]]
        solved = self._solve(points, uv[known], T_camera_odom, max(least, int(0.5 * known.size)))
        if solved is None:
            return "no pose fits the matches"
        ok[known[~solved.inliers]] = False
        return Located(solved, uv, ok, in_view * float(ok[index].mean()))

    def _solve(self, points: F64, uv: F64, start: F64, least: int) -> pnp.PnpResult | None:
        """EPnP with a tight gate, else with a loose one; None with fewer than ``least``."""
        for gate_px in (self.config.pnp.threshold_px, self.config.loose_px):
            config = replace(self.config.pnp, threshold_px=gate_px)
            solved = pnp.solve(points, uv, self.camera.K, config, start)
            if solved is not None and solved.inliers.sum() >= least:
                return solved
        return None

    def _agrees(self, T_camera_odom: F64, prior: PosePrior, key: OdometryKeyframe) -> bool:
        """False when vision turned otherwise than telemetry since the keyframe."""
        turn = prediction.relative_rotation(key.prior, prior)
        if turn is None:
            return True
        seen = T_camera_odom[:3, :3] @ key.T_odom_camera[:3, :3]
        return float(np.linalg.norm(se3.so3_log(seen @ turn.T))) < self.config.max_tilt_error_rad


def _averaged(left: pnp.PnpResult, right: pnp.PnpResult) -> pnp.PnpResult:
    """The right view's pose averaged with the left's, both of one frame in one map."""
    mean = pnp.average_left_right(left, right, np.eye(4))
    return replace(right, T_camera_points=mean.T_camera_points, covariance=mean.covariance)
