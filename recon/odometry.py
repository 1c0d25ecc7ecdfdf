"""Where the camera is: Harris + ZSSD tracks, EPnP against landmarks, a window refined.

Section 2.3 of the paper: corners of two earlier views (the left and right image of the
virtual stereo camera) are found again in the new frame, each view gives a pose by EPnP
(Eq. 6-7) and the two are averaged. Between the frames that become keyframes, landmarks are
triangulated and the last keyframes are adjusted together (:mod:`recon.keyframe_window`).

The odometry works in a frame of its own that starts at the first telemetry pose; scale,
heading and position are corrected afterwards by :mod:`recon.alignment`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from recon import matching, pnp, prediction, se3, two_view
from recon.first_views import FirstViews
from recon.keyframe_window import (
    Incoming,
    OdometryKeyframe,
    adjust_window,
    landmarks,
    triangulate,
)
from recon.landmarks import I64, Landmarks
from recon.matcher import HostMatcher, Matcher
from recon.types import F64, U8, Bool, Camera, PosePrior

OVERDUE = 1.3
"""A blurred frame becomes a keyframe when the last is this many steps away."""


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Parameters of the odometry; angles are in rad, shares are of the image width."""

    base_to_height: float = 0.1  # motion between keyframes over the distance to the ground
    least_base_to_height: float = 0.03  # under it two frames are not triangulated
    window: int = 8  # keyframes adjusted together
    search_share: float = 0.03  # ZSSD search radius around a good prediction
    wide_search_share: float = 0.09  # and around a poor one
    min_tracks: int = 40  # fewer inliers: lost
    min_track_share: float = 0.25  # of the corners that should be visible
    tracked_landmarks: int = 300  # enough for a pose; keyframes match all their corners
    max_tilt_error_rad: float = 0.35  # vision against attitude: more is a false solution
    loose_px: float = 6.0  # gate of a second try: a rolling shutter bends pictures that much
    lost_after: int = 8  # frames in a row without a pose before a new segment starts
    least_shift_confidence: float = 1.4  # of the global shift between two pictures
    still_gap_s: float = 0.7  # frames further apart are stills: no motion model holds
    matching: matching.MatchingConfig = field(default_factory=matching.MatchingConfig)
    pnp: pnp.PnpConfig = field(default_factory=pnp.PnpConfig)

    def __post_init__(self) -> None:
        if not 0.0 < self.least_base_to_height <= self.base_to_height < 1.0:
            raise ValueError("0 < least_base_to_height <= base_to_height < 1 must hold")
        if self.window < 3:
            raise ValueError(f"window must hold 3 keyframes or more, got {self.window}")


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """What one frame gave."""

    state: str  # "started", "waiting", "tracked", "keyframe" or "lost"
    segment: int
    T_odom_camera: F64 | None = None  # (4, 4)
    covariance: F64 | None = None  # (6, 6) left perturbation of the camera-from-odom pose
    tracks: int = 0
    base_to_height: float = 0.0  # against the last keyframe
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class _Located:
    """A frame's pose and the keyframe's corners found in it."""

    pose: pnp.PnpResult  # camera from odometry
    uv: F64  # (N, 2) of the keyframe's corners
    ok: Bool  # (N,) found, and not contradicted by the pose
    share: float  # of the keyframe's corners that are found, by those searched


class Odometry:
    """Follows one camera without distortion; feed it every frame in order."""

    def __init__(
        self,
        camera: Camera,
        config: OdometryConfig | None = None,
        matcher: Matcher | None = None,
    ) -> None:
        """``camera`` has no distortion and the size of the frames to come.

        ``matcher`` finds and follows corners; None: the processor does.
        """
        self._matcher = matcher or HostMatcher()
        self.camera = camera
        self.K = camera.K
        self.config = config or OdometryConfig()
        self.keyframes: list[OdometryKeyframe] = []  # of the current segment
        self.segment = -1
        self._metric = False  # the current segment has landmarks
        self._lost = 0
        self._last: tuple[int, F64, PosePrior] | None = None  # time, T_odom_camera, prior
        self._velocity = np.zeros(3)
        self._first_views = FirstViews(
            camera,
            self.config.matching,
            self.config.wide_search_share * camera.size_px[0],
            self.config.least_shift_confidence,
            self._matcher,
        )
        self._frame_ns = self._gap_ns = 0  # time of the last frame, and since the one before

    # ---- one frame -------------------------------------------------------------------

    def track(
        self,
        grey: U8,
        seq: int,
        time_ns: int,
        prior: PosePrior,
        mask: U8 | None = None,
        blurred: bool = False,
    ) -> Tracked:
        """Pose of a new frame, or why there is none.

        Args:
            grey: (H, W) undistorted picture.
            prior: telemetry's word on this frame; parts may be missing.
            mask: (H, W) non-zero where the picture is valid.
            blurred: a later frame makes a better keyframe, if it comes soon.
        """
        pyramid = self._matcher.pyramid(grey, self.config.matching.search_levels)
        new = Incoming(grey, pyramid, seq, time_ns, prior, mask, blurred)
        self._gap_ns, self._frame_ns = time_ns - self._frame_ns, time_ns
        if not self.keyframes:
            return self._start(new)
        if not self._metric:
            return self._second_view(new)
        found = self._locate(new)
        if isinstance(found, str):
            return self._missed(new, found)
        return self._accept(new, found)

    def _missed(
        self,
        new: Incoming,
        reason: str,
    ) -> Tracked:
        """Count a frame without a pose; after too many, or at a still, begin a new segment."""
        self._lost += 1
        still = self._gap_ns > 1e9 * self.config.still_gap_s
        if self._lost >= (2 if still else self.config.lost_after):
            self._start(new)
        return Tracked("lost", self.segment, reason=reason)

    def _start(
        self,
        new: Incoming,
    ) -> Tracked:
        """Begin a segment at this frame."""
        uv = self._corners(new)
        if len(uv) < 2 * self.config.min_tracks:
            return Tracked("lost", self.segment, reason="too little texture")
        self.segment += 1
        self._metric, self._lost = False, 0
        self._velocity = np.zeros(3)
        self._first_views.begin()
        R = (
            new.prior.R_world_camera
            if new.prior.R_world_camera is not None
            else np.diag([1.0, -1, -1])
        )
        t = new.prior.position_m if new.prior.position_m is not None else np.zeros(3)
        T_odom_camera = se3.compose(R, t)
        self.keyframes = [
            OdometryKeyframe(
                new.seq,
                new.time_ns,
                self.segment,
                se3.inverse(T_odom_camera),
                np.zeros((6, 6)),
                new.prior,
                new.pyramid,
                uv,
                np.full(len(uv), -1, np.int64),
                Landmarks(),
            )
        ]
        self._last = (new.time_ns, T_odom_camera, new.prior)
        return Tracked("started", self.segment, T_odom_camera, np.zeros((6, 6)))

    def _corners(self, new: Incoming) -> F64:
        """(N, 2) Harris corners of the frame, Eq. 4-5."""
        found = self._matcher.corners(new.pyramid, self.config.matching, new.mask)
        return found.uv_px.astype(np.float64)

    # ---- the second view --------------------------------------------------------------

    def _second_view(
        self,
        new: Incoming,
    ) -> Tracked:
        """Wait until the camera has moved enough, then make the first landmarks."""
        first = self.keyframes[0]
        R_b_a = prediction.relative_rotation(first.prior, new.prior)
        still = self._gap_ns > 1e9 * self.config.still_gap_s
        uv, ok = self._first_views.match(new, first, R_b_a, still)
        if ok.sum() < 2 * self.config.min_tracks:
            return self._missed(new, "too few matches with the first frame")
        self._lost = 0
        if (
            prediction.base_to_height(first.uv[ok], uv[ok], self.K, R_b_a)
            < 0.7 * self.config.base_to_height
        ):
            return Tracked(
                "waiting", self.segment, tracks=int(ok.sum()), reason="too little motion"
            )
        up_a = first.T_camera_odom[:3, 2]
        turn = 0.12 if R_b_a is not None else np.pi
        view = two_view.solve(first.uv[ok], uv[ok], self.K, R_b_a, turn, up_a)
        if view is None or view.parallax_rad < self.config.least_base_to_height:
            return self._missed(new, "no certain motion between two frames")
        matched = np.flatnonzero(ok)
        ok[matched[~view.inliers]] = False
        scale = self._first_landmarks(view, matched[view.inliers], new.prior)
        second = se3.compose(view.T_b_a[:3, :3], view.T_b_a[:3, 3] * scale)
        T_camera_odom = second @ first.T_camera_odom
        self._metric = True
        self._add_keyframe(new, T_camera_odom, uv, ok)
        self._update_motion(new.time_ns, self.keyframes[-1].T_odom_camera, new.prior)
        return Tracked(
            "keyframe",
            self.segment,
            self.keyframes[-1].T_odom_camera,
            self.keyframes[-1].covariance,
            int(ok.sum()),
            view.parallax_rad,
        )

    def _first_landmarks(self, view: two_view.TwoView, rows: I64, prior: PosePrior) -> float:
        """Enter the two-view points into the table; return metres per unit of the baseline."""
        first = self.keyframes[0]
        T_odom_a = first.T_odom_camera
        scale = prediction.metric_scale(view, first.prior, prior, T_odom_a)
        points = se3.transform(T_odom_a, view.points[view.inliers] * scale)
        first.landmark[rows] = first.map.add(points)
        return scale

    def _locate(self, new: Incoming) -> _Located | str:
        """The frame against the last keyframe, averaged with the one before; or why not."""
        right = self.keyframes[-1]
        reason = "no match"
        still = self._gap_ns > 1e9 * self.config.still_gap_s
        least = self.config.min_tracks
        most = None if still else self.config.tracked_landmarks
        for T_camera_odom, share in self._predicted_poses(new, right):
            found = self._pose_from(right, new.pyramid, T_camera_odom, share, least, most)
            if isinstance(found, str):
                reason = found
                continue
            T = found.pose.T_camera_points
            if not self._agrees(T, new.prior, right):
                reason = "vision and attitude disagree"
                continue
            return self._with_left(new, found)
        return reason

    def _with_left(self, new: Incoming, found: _Located) -> _Located:
        """The pose averaged with the one that the keyframe before gives, as the paper does."""
        if len(self.keyframes) < 2:
            return found
        T, share = found.pose.T_camera_points, 0.5 * self.config.search_share
        least, most = self.config.min_tracks // 3, self.config.tracked_landmarks // 2
        left = self._pose_from(self.keyframes[-2], new.pyramid, T, share, least, most)
        if isinstance(left, str):
            return found
        return replace(found, pose=_averaged(left.pose, found.pose))

    def _predicted_poses(self, new: Incoming, key: OdometryKeyframe) -> list[tuple[F64, float]]:
        """Start poses T_camera_odom with their search radius share, most trusted first."""
        assert self._last is not None
        last_ns, T_last, last_prior = self._last
        dt = (new.time_ns - last_ns) * 1e-9
        R = T_last[:3, :3]
        turn = prediction.relative_rotation(last_prior, new.prior)
        if turn is not None:
            R = R @ turn.T
        t = T_last[:3, 3] + self._velocity * dt
        still = dt > self.config.still_gap_s
        share = self.config.wide_search_share if still else self.config.search_share
        by_motion = (se3.inverse(se3.compose(R, t)), share)
        by_picture: list[tuple[F64, float]] = []
        if still or self._lost > 0:
            by_picture = self._pose_by_picture(new.grey, key, turn, R)
        if still and turn is None:
            return [*by_picture, by_motion]
        wide = (by_motion[0], self.config.wide_search_share)
        return [by_motion, *by_picture] if still else [by_motion, *by_picture, wide]

    def _pose_by_picture(
        self, grey: U8, key: OdometryKeyframe, turn: F64 | None, R_odom_camera: F64
    ) -> list[tuple[F64, float]]:
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
        ok, rvec, tvec = cv2.solvePnP(
            points[inside], there[inside], self.K, np.zeros(5), flags=cv2.SOLVEPNP_SQPNP
        )
        if not ok:
            return []
        R = se3.so3_exp(np.asarray(rvec, np.float64).ravel())
        return [(se3.compose(R, np.asarray(tvec, np.float64).ravel()), 0.07)]

    def _pose_from(
        self,
        key: OdometryKeyframe,
        pyramid: matching.Pyramid,
        T_camera_odom: F64,
        share: float,
        least: int,
        most: int | None = None,
    ) -> _Located | str:
        """EPnP pose of the frame from one keyframe's landmarks, or why there is none.

        ``least`` matches it takes; with ``most`` only about so many landmarks are searched and
        no corner that has none, spread over the picture.
        """
        radius_px = share * self.camera.size_px[0]
        guess, visible = prediction.on_landmarks(
            key, self.K, self.camera.size_px, T_camera_odom, radius_px
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
        found = self._matcher.match(
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
        return _Located(solved, uv, ok, in_view * float(ok[index].mean()))

    def _solve(self, points: F64, uv: F64, start: F64, least: int) -> pnp.PnpResult | None:
        """EPnP with a tight gate, else with a loose one; None with fewer than ``least``."""
        for gate_px in (self.config.pnp.threshold_px, self.config.loose_px):
            config = replace(self.config.pnp, threshold_px=gate_px)
            solved = pnp.solve(points, uv, self.K, config, start)
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

    # ---- keyframes ---------------------------------------------------------------------

    def _accept(
        self,
        new: Incoming,
        found: _Located,
    ) -> Tracked:
        """Keep the pose; make the frame a keyframe when it has moved enough."""
        key = self.keyframes[-1]
        T_camera_odom, covariance = found.pose.T_camera_points, found.pose.covariance
        moved = T_camera_odom @ key.T_odom_camera
        depth = self.median_depth(key)
        base = float(np.linalg.norm(moved[:3, 3])) / max(depth, 1e-6)
        tracks = int(found.ok.sum())
        turned = float(np.linalg.norm(se3.so3_log(moved[:3, :3])))
        T_odom_camera = se3.inverse(T_camera_odom)
        self._update_motion(new.time_ns, T_odom_camera, new.prior)
        self._lost = 0
        due = self.config.base_to_height * (OVERDUE if new.blurred else 1.0)
        if base < due and found.share > 0.45 and turned < 0.25:
            return Tracked("tracked", self.segment, T_odom_camera, covariance, tracks, base)
        share = 0.5 * self.config.search_share
        whole = self._pose_from(key, new.pyramid, T_camera_odom, share, self.config.min_tracks)
        found = found if isinstance(whole, str) else whole
        self._add_keyframe(new, found.pose.T_camera_points, found.uv, found.ok)
        last, tracks = self.keyframes[-1], int(found.ok.sum())
        self._last = (new.time_ns, last.T_odom_camera, new.prior)
        return Tracked("keyframe", self.segment, last.T_odom_camera, last.covariance, tracks, base)

    def _update_motion(self, time_ns: int, T_odom_camera: F64, prior: PosePrior) -> None:
        if self._last is not None and time_ns > self._last[0]:
            dt = (time_ns - self._last[0]) * 1e-9
            velocity = (T_odom_camera[:3, 3] - self._last[1][:3, 3]) / dt
            keep = 0.5 if dt < 0.3 and np.any(self._velocity) else 0.0
            self._velocity = keep * self._velocity + (1 - keep) * velocity
        self._last = (time_ns, T_odom_camera, prior)

    def _add_keyframe(
        self,
        new: Incoming,
        T_camera_odom: F64,
        uv: F64,
        ok: Bool,
    ) -> None:
        """Append a keyframe: tracked corners, new landmarks, fresh corners; adjust the window."""
        key = self.keyframes[-1]
        least = 0.5 * self.config.least_base_to_height
        triangulate(key, T_camera_odom, uv, ok, self.K, least, self.config.loose_px)
        kept = np.flatnonzero(ok)
        fresh = prediction.fresh_corners(
            self._corners(new), uv[kept], self.camera.size_px, self.config.matching.grid
        )
        key_new = OdometryKeyframe(
            new.seq,
            new.time_ns,
            self.segment,
            T_camera_odom,
            np.zeros((6, 6)),
            new.prior,
            new.pyramid,
            np.vstack([uv[kept], fresh]),
            np.concatenate([key.landmark[kept], np.full(len(fresh), -1, np.int64)]),
            key.map,
        )
        self.keyframes.append(key_new)
        adjust_window(self.keyframes[-self.config.window - 2 :], self.K)
        self._forget()

    def _forget(self) -> None:
        """Let go of what left the window: pictures, corners, and landmarks nobody sees."""
        window = self.keyframes[-self.config.window - 2 :]
        for old in self.keyframes[: -len(window)]:
            old.pyramid = matching.Pyramid(())
            old.uv, old.landmark = np.zeros((0, 2)), np.zeros(0, np.int64)
        self.keyframes = window
        seen = np.concatenate([k.landmark for k in window])
        if (seen >= 0).any():
            window[0].map.forget_before(int(seen[seen >= 0].min()))

    def median_depth(self, key: OdometryKeyframe) -> float:
        """Median depth of the keyframe's landmarks, in odometry units; NaN without any."""
        _, depth = landmarks(key)
        return float(np.median(depth)) if depth.size else float("nan")


def _averaged(left: pnp.PnpResult, right: pnp.PnpResult) -> pnp.PnpResult:
    """The right view's pose averaged with the left's, both of one frame in one map."""
    mean = pnp.average_left_right(left, right, np.eye(4))
    return replace(right, T_camera_points=mean.T_camera_points, covariance=mean.covariance)
