"""Where a frame was taken: a keyframe's corners found again in it, and EPnP on their landmarks.

Section 2.3 of the paper: the two views of the virtual stereo camera give the pose of the new frame
(Eq. 6-7). DEVIATION: the paper averages a pose by each; here the landmarks of both, each searched
once, give one, which is the average weighted by each landmark's information.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from recon import se3
from recon.rolling_shutter import FrameRows, RowTrack
from recon.tracking import matching, pnp, prediction, robust_geometry, two_view
from recon.tracking.frame import Frame
from recon.tracking.keyframe_window import median_depth
from recon.tracking.prediction import ConstantVelocity
from recon.tracking.sift_features import (
    FEATURE_SHARES,
    FINE_MOST,
    FINE_WIDTH_PX,
    MOST,
    WIDTH_PX,
    FeatureMatches,
    Features,
    features,
    match_features,
)
from recon.types import F64, I64, Bool, Camera, PosePrior

MIN_BASE_TO_HEIGHT = 0.03
"""Motion over the distance to the ground, under which two frames are not triangulated: with a focal
length of 500 px, half a pixel would be 3 % of the distance."""

SEARCH_SHARE, WIDE_SEARCH_SHARE = 0.03, 0.09
"""ZSSD search radii around a good and a poor prediction, as shares of the image's width: 2 and 6
degrees of a wide view, as attitudes err by and as a camera turns from frame to frame."""

MIN_TRACKS, MIN_TRACK_SHARE = 40, 0.25
"""Inliers under which a frame is lost, and matches as a share of the corners that should be
visible."""

TRACKED_LANDMARKS = 450
"""Of both keyframes, for a frame's pose; new keyframes match all their corners. The sigma of a pose
falls with their root only, and their time grows as they do."""

MAX_TILT_ERROR_RAD = 0.35
"""Vision against attitude, 20 degrees: since the keyframe before no gimbal or compass in order errs
by more, so it is a false solution."""

DISAGREES = "vision and attitude disagree"  # why a frame has no pose

LOOSE_PX = 6.0  # gate of a second try: a rolling shutter bends images that much
LOW_RATE_GAP_S = 0.7  # frames further apart are stills: no motion model holds
RECALLED = 4  # newest keyframes compared by features: at 75 % overlap no more share the ground
CLEAR_SHARE = 0.6  # share of the corners searched: if so many are found, no other start is tried


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A frame's pose and a keyframe's corners found in it."""

    key: Frame
    pose: pnp.PnpResult  # camera from odometry
    uv: F64  # (N, 2) of the keyframe's corners
    ok: Bool  # (N,) found, and not contradicted by the pose
    share: float  # of the keyframe's corners that are found, by those searched
    found_share: float  # of the corners searched

    @property
    def explained(self) -> int:
        """Landmarks that the pose explains; corners without one do not test it."""
        return int(np.count_nonzero(self.pose.inliers))


TwoViewPose = tuple[Frame, F64, F64, Bool]
"""A frame's pose by what it and one keyframe see, whose depths give the scale: that keyframe,
T_camera_odom (4, 4), where (N, 2) its corners are found, and which (N,) are."""


Start = tuple[Frame, F64, float, bool]
"""Where the camera may be: a keyframe, T_camera_odom (4, 4), the radius about it, as a share of the
width, in which to search for the keyframe's corners, and whether features leave no doubt about the
heading."""


class Localiser:
    """Poses of frames of one camera without distortion."""

    def __init__(self, camera: Camera, row_track: RowTrack) -> None:
        self.camera, self._row_track = camera, row_track
        self._near_px = [share * camera.size_px[0] for share in FEATURE_SHARES]
        self._drift = np.eye(3)  # from the pixels of a segment's first frame to the last one's

    def locate(
        self,
        new: Frame,
        keyframes: Sequence[Frame],
        motion: ConstantVelocity,
        low_frame_rate: bool,
        lost: bool,
        heeds_turn: bool = True,
    ) -> Located | str:
        """The frame against a recent keyframe, averaged with the one before; or why not.

        Args:
            motion: where the camera was last and how it moved.
            low_frame_rate: too long since the frame before for that motion to hold.
            lost: the frame before has no pose.
            heeds_turn: a pose that turns otherwise than telemetry is false.
        """
        reason, best = "no match", None
        most = None if low_frame_rate else TRACKED_LANDMARKS
        for key, T_camera_odom, share, by_features in self.starts(new, keyframes, motion, lost):
            left = keyframes[-2] if len(keyframes) > 1 and key is keyframes[-1] else None
            found = self.pose_from(key, new, T_camera_odom, share, MIN_TRACKS, most, left)
            if isinstance(found, str):
                reason = found
                continue
            T_new = found.pose.T_camera_points
            if heeds_turn and not self._agrees(T_new, new.prior, key, by_features):
                reason = DISAGREES
                continue
            if best is None or found.explained > best.explained:
                best = found
            if not low_frame_rate or found.found_share > CLEAR_SHARE:
                break
        return reason if best is None else best

    def others(self, new: Frame, keyframes: Sequence[Frame], found: Located) -> list[Located]:
        """The frame against the other recent keyframes that see the same ground."""
        share, least = 0.5 * SEARCH_SHARE, MIN_TRACKS // 3
        T = found.pose.T_camera_points
        rest = [key for key in keyframes[-RECALLED:] if key is not found.key]
        located = [self.pose_from(key, new, T, share, least) for key in rest]
        return [other for other in located if not isinstance(other, str)]

    def by_two_views(self, new: Frame, keyframes: Sequence[Frame]) -> TwoViewPose | None:
        """The frame by two views alone: little of what it shares with a keyframe has landmarks.

        The scale is that of the keyframe's landmarks, or where none is shared of the ground
        that they lie on.
        """
        for key, shared in self._shared(new, keyframes, low_frame_rate=True):
            guess = shared.predict(key.uv)
            for radius_px in self._near_px:
                uv, ok = self._find(key, new, *guess, radius_px)
                found = self._two_views(new, key, uv, ok)
                if found is not None:
                    return found
            corners = key.uv, key.landmark
            tied = self.with_features(new, key, uv, ok)
            found = None if tied is None else self._two_views(new, key, *tied)
            if found is not None:
                return found
            key.uv, key.landmark = corners
        return None

    def with_features(self, new: Frame, key: Frame, uv: F64, ok: Bool) -> tuple[F64, Bool] | None:
        """Where (N, 2) a keyframe's corners are found, and which (N,), once the features that both
        images share are among them; None where they share none.

        Treetops have few corners that look alike from two places. Features follow the corners that
        are there, each place once however often it is found.
        """
        shared = match_finely(key, new)
        if shared is None:
            return None
        row_of = {tuple(place): row for row, place in enumerate(key.uv.tolist())}
        rows = np.array([row_of.get(tuple(place), -1) for place in shared.uv_a.tolist()])
        fresh, uv, ok = rows < 0, uv.copy(), ok.copy()
        uv[rows[~fresh]], ok[rows[~fresh]] = shared.uv_b[~fresh], True
        count = int(np.count_nonzero(fresh))
        key.uv = np.vstack([key.uv, shared.uv_a[fresh]])
        key.landmark = np.concatenate([key.landmark, np.full(count, -1, np.int64)])
        return np.vstack([uv, shared.uv_b[fresh]]), np.concatenate([ok, np.ones(count, np.bool_)])

    def _two_views(self, new: Frame, key: Frame, uv: F64, ok: Bool) -> TwoViewPose | None:
        """The pose by the keyframe's corners found at ``uv`` (N, 2) where ``ok`` (N,)."""
        if ok.sum() < 2 * MIN_TRACKS:
            return None
        turn = prediction.relative_rotation(key.prior, new.prior)
        inverse_depth = float(np.nan_to_num(1.0 / median_depth(key)))
        seen = self.motion_since(
            key, new, uv, ok, inverse_depth, turn, MAX_TILT_ERROR_RAD, may_be_wrong=True
        )
        if seen is None or seen.parallax_rad < MIN_BASE_TO_HEIGHT:
            return None
        rows = np.flatnonzero(ok)[seen.inliers]
        depth = prediction.landmark_depths(key, self.camera.K, rows)
        if depth is None:
            return None
        ratio = np.log(depth / seen.points[seen.inliers, 2])
        ratio = ratio[np.isfinite(ratio)]
        scale = float(np.exp(np.median(ratio)))
        step = se3.compose(seen.T_b_a[:3, :3], scale * seen.T_b_a[:3, 3])
        good = np.zeros(len(ok), np.bool_)
        good[rows] = True
        return key, step @ key.T_camera_odom, uv, good

    def motion_since(
        self, key: Frame, new: Frame, uv: F64, ok: Bool, inverse_depth: float,
        R_b_a: F64 | None, max_turn_rad: float, may_be_wrong: bool,
    ) -> two_view.TwoView | None:  # fmt: skip
        """The motion since a keyframe, whose corners are at ``uv`` (N, 2) where ``ok`` (N,).

        It turns by no more than ``max_turn_rad`` otherwise than telemetry (3, 3) says, unless that
        ``may_be_wrong``, as tags often are. Rows were read at an ``inverse_depth`` of level ground.
        """
        K, up = self.camera.K, key.T_camera_odom[:3, 2]
        far = np.full(int(ok.sum()), inverse_depth)
        uv_a = key.row_motion.at_middle(K, key.uv[ok], far)
        uv_b = new.row_motion.at_middle(K, uv[ok], far)
        if R_b_a is not None:
            view = two_view.solve(uv_a, uv_b, K, R_b_a, max_turn_rad, up)
            if view is not None or not may_be_wrong:
                return view
        return two_view.solve(uv_a, uv_b, K, None, np.pi, up)

    def starts(
        self,
        new: Frame,
        keyframes: Sequence[Frame],
        motion: ConstantVelocity,
        lost: bool,
    ) -> Iterator[Start]:
        """Where the camera may be, most trusted first."""
        key = keyframes[-1]
        T_odom_camera, turn, gap_s = motion.ahead(new.time_ns, new.prior)
        is_stale = gap_s > LOW_RATE_GAP_S  # the last pose, of whatever frame since was lost
        by_motion = se3.inverse(T_odom_camera)
        if not is_stale or turn is not None:
            share = WIDE_SEARCH_SHARE if is_stale else SEARCH_SHARE
            yield key, by_motion, share, False
        if is_stale or lost:
            yield from self._by_features(new, keyframes, is_stale)
        if not is_stale or turn is None:
            yield key, by_motion, WIDE_SEARCH_SHARE, False
        if not (is_stale or lost):
            yield from self._by_features(new, keyframes, is_stale)

    def _by_features(
        self, new: Frame, keyframes: Sequence[Frame], low_frame_rate: bool
    ) -> Iterator[Start]:
        """Poses by features that the frame shares with recent keyframes, the most first."""
        for key, shared in self._shared(new, keyframes, low_frame_rate):
            T_camera_odom = self._pose_by(key, shared)
            if T_camera_odom is not None:
                for share in FEATURE_SHARES:
                    yield key, T_camera_odom, share, True

    def _shared(
        self, new: Frame, keyframes: Sequence[Frame], low_frame_rate: bool
    ) -> list[tuple[Frame, FeatureMatches]]:
        """Recent keyframes that share features with the frame, the most first."""
        found = []
        for key in keyframes[-RECALLED:]:
            shared = match_images(key, new, low_frame_rate)
            if shared is not None:
                found.append((key, shared))
        return sorted(found, key=lambda item: -len(item[1]))

    def _pose_by(self, key: Frame, shared: FeatureMatches) -> F64 | None:
        """T_camera_odom by the keyframe's landmarks, carried to where ``shared`` says."""
        known = np.flatnonzero(key.landmarks.known(key.landmark))
        there = shared.carry(key.uv[known])
        inside = np.all((there > 0) & (there < self.camera.size_px), axis=1)
        if inside.sum() < 12:
            return None
        points = key.landmarks[key.landmark[known[inside]]]
        return robust_geometry.pose_from_points(
            points, there[inside], self.camera.K, cv2.SOLVEPNP_SQPNP
        )

    def pose_from(
        self,
        key: Frame,
        new: Frame,
        T_camera_odom: F64,
        share: float,
        least: int,
        most: int | None = None,
        left: Frame | None = None,
    ) -> Located | str:
        """Pose of the frame by a keyframe's landmarks, or why there is none.

        ``least`` matches it takes; with ``most`` only about so many landmarks are searched and
        no corner that has none, spread over the image, a third of them in the image of ``left``.
        """
        radius_px = share * self.camera.size_px[0]
        amount = most if most is None or left is None else most * 2 // 3
        uv, ok, searched, in_view = self.search(key, new, T_camera_odom, radius_px, amount)
        if np.count_nonzero(searched) < least:
            return "no known landmark is in view"
        known = key.landmarks.known(key.landmark)
        rows = np.flatnonzero(ok & known)
        points, pixels = key.landmarks[key.landmark[rows]], uv[rows]
        expected = np.count_nonzero(searched & known)
        if most is not None and left is not None:
            taken = key.landmark[searched]
            more = self.search(left, new, T_camera_odom, radius_px, most // 3, taken)
            also = np.flatnonzero(more[1])  # all that are searched have a landmark
            points = np.vstack([points, left.landmarks[left.landmark[also]]])
            pixels = np.vstack([pixels, more[0][also]])
            expected += np.count_nonzero(more[2])
        if len(points) < max(least, MIN_TRACK_SHARE * expected):
            return "too few matches"
        fewest = max(least, len(points) // 2)
        solved = self._solve(points, pixels, T_camera_odom, fewest, new.row_motion)
        if solved is None:
            return "no pose fits the matches"
        ok[rows[~solved.inliers[: rows.size]]] = False
        found_share = float(ok[searched].mean())
        return Located(key, solved, uv, ok, in_view * found_share, found_share)

    def search(
        self,
        key: Frame,
        new: Frame,
        T_camera_odom: F64,
        radius_px: float,
        most: int | None,
        taken: I64 | None = None,
    ) -> tuple[F64, Bool, Bool, float]:
        """Where (N, 2) the keyframe's corners are in the frame, which (N,) are found, which (N,)
        were searched, and the share of them that should be visible.

        With ``most`` only about so many are searched, all with a landmark; none of those ``taken``
        (M,) elsewhere.
        """
        uv, warp, visible = prediction.on_landmarks(
            key, self.camera.K, self.camera.size_px, T_camera_odom
        )
        in_view, config = float(visible.mean()), matching.DEFAULT
        if taken is not None:
            visible &= ~np.isin(key.landmark, taken)
        if most is not None:
            rows = np.flatnonzero(visible & key.landmarks.known(key.landmark))
            visible[:] = False
            visible[rows[:: max(1, len(rows) // most)]] = True
            config = replace(config, max_return_px=np.inf)  # the pose refutes what is wrong
        index = np.flatnonzero(visible)
        # While a readout is sought, what it does to each row must show.
        is_led = most is not None and self._row_track.is_known >= self._row_track.is_rolling
        find = matching.match_led if is_led else matching.match
        found = find(
            key.pyramid, key.uv[index].astype(np.float32), new.pyramid,
            uv[index].astype(np.float32), radius_px, warp[index].astype(np.float32), config,
        )  # fmt: skip
        ok = np.zeros(len(key.uv), np.bool_)
        ok[index], uv[index] = found.ok, found.uv_px
        return uv, ok, visible, in_view

    def _solve(
        self, points: F64, uv: F64, start: F64, least: int, row_motion: FrameRows
    ) -> pnp.PnpResult | None:
        """EPnP with a tight gate, else with a loose one; None with fewer than ``least``. The pose
        says how the rows moved, so it is solved again with that motion."""
        for gate_px in (pnp.THRESHOLD_PX, LOOSE_PX):
            solved = self._solve_rows(points, uv, start, gate_px, row_motion)
            if solved is not None and row_motion.rows is not None:
                self._row_track.place(row_motion, solved.T_camera_points)
                again = self._solve_rows(points, uv, solved.T_camera_points, gate_px, row_motion)
                solved = again or solved
            if solved is not None and solved.inliers.sum() >= least:
                return solved
        return None

    def _solve_rows(
        self, points: F64, uv: F64, start: F64, gate_px: float, row_motion: FrameRows
    ) -> pnp.PnpResult | None:
        """EPnP on pixels (N, 2) as they would be at the middle row's time."""
        depth = se3.transform(start, points)[:, 2]
        middle = row_motion.at_middle(self.camera.K, uv, 1.0 / np.maximum(depth, 1e-6))
        return pnp.solve(points, middle, self.camera.K, start, gate_px)

    def _agrees(self, T_camera_odom: F64, prior: PosePrior, key: Frame, tilt_only: bool) -> bool:
        """False when vision turned otherwise than telemetry since the keyframe. ``tilt_only`` where
        vision is sure of the heading: tags and compasses are often wrong."""
        turn = prediction.relative_rotation(key.prior, prior)
        if turn is None:
            return True
        seen = T_camera_odom[:3, :3] @ key.T_odom_camera[:3, :3]
        if not tilt_only:
            off = float(np.linalg.norm(se3.so3_log(seen @ turn.T)))
        else:
            assert key.prior.R_world_camera is not None and prior.R_world_camera is not None
            cosine = (seen @ key.prior.R_world_camera[2]) @ prior.R_world_camera[2]
            off = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return off < MAX_TILT_ERROR_RAD

    # ---- a segment's first frame ---------------------------------------------------------------

    def begin(self) -> None:
        self._drift = np.eye(3)

    def match_first(
        self, new: Frame, first: Frame, R_b_a: F64 | None,
        low_frame_rate: bool,
    ) -> tuple[F64, Bool]:  # fmt: skip
        """(N, 2) pixels and (N,) success of the first frame's corners in a new frame, by what is
        likely: as in the frame before, by telemetry, by the features that both images share.

        ``R_b_a`` (3, 3) is the turn by telemetry; ``low_frame_rate`` images are far apart in time.
        """
        uv, ok = first.uv, np.zeros(len(first.uv), np.bool_)
        for there, warp, radius_px in self._guesses(new, first, R_b_a, low_frame_rate):
            found = self._find(first, new, there, warp, radius_px)
            if found[1].sum() > ok.sum():
                uv, ok = found
            if ok.sum() > 0.5 * len(first.uv):
                A = robust_geometry.affine(first.uv[ok], uv[ok], 8.0)
                self._drift = np.eye(3) if A is None else np.vstack([A, [0.0, 0.0, 1.0]])
                break
        return uv, ok

    def _guesses(
        self, new: Frame, first: Frame, R_b_a: F64 | None,
        low_frame_rate: bool,
    ) -> Iterator[tuple[F64, F64, float]]:  # fmt: skip
        """Where the corners went, with warps and radius in px, best first."""
        wide_px = WIDE_SEARCH_SHARE * self.camera.size_px[0]
        if not low_frame_rate:
            yield *robust_geometry.by_homography(self._drift, first.uv), wide_px
        if R_b_a is not None:
            H = self._by_telemetry(new, first, R_b_a)
            yield *robust_geometry.by_homography(H, first.uv), wide_px
        shared = match_images(first, new, low_frame_rate)
        if shared is not None:
            guess = shared.predict(first.uv)
            for radius_px in self._near_px:
                yield *guess, radius_px

    def _by_telemetry(self, new: Frame, first: Frame, R_b_a: F64) -> F64:
        """(3, 3) homography of level ground by attitude, and by position and height if known."""
        a, b = first.prior, new.prior
        height, t = b.agl_m or 0.0, np.zeros(3)
        if b.position_m is not None and a.position_m is not None and height > 0:
            assert a.R_world_camera is not None
            t = R_b_a @ a.R_world_camera.T @ (a.position_m - b.position_m) / height
        n, K = first.T_camera_odom[:3, 2], self.camera.K  # up, seen from the camera
        return np.asarray(K @ (R_b_a - np.outer(t, n)) @ np.linalg.inv(K))

    def _find(
        self, key: Frame, new: Frame, uv: F64, warp: F64, radius_px: float
    ) -> tuple[F64, Bool]:
        """Where (N, 2) a keyframe's corners are in a frame, about ``uv``, and which are found."""
        found = matching.match(
            key.pyramid, key.uv.astype(np.float32), new.pyramid, uv.astype(np.float32),
            radius_px, warp.astype(np.float32),
        )  # fmt: skip
        return found.uv_px.astype(np.float64), found.ok


def match_images(a: Frame, b: Frame, low_frame_rate: bool) -> FeatureMatches | None:
    """The features that two frames share, or None. Stills are compared in finer detail where they
    need it: they are few and far apart."""
    shared = match_features(*(_features(image, WIDTH_PX, MOST) for image in (a, b)))
    return match_finely(a, b) if shared is None and low_frame_rate else shared


def match_finely(a: Frame, b: Frame) -> FeatureMatches | None:
    return match_features(*(_features(image, FINE_WIDTH_PX, FINE_MOST) for image in (a, b)))


def _features(frame: Frame, width_px: int, most: int) -> Features:
    """Those of a frame, which keeps them."""
    if width_px not in frame.features:
        frame.features[width_px] = features(frame.small, width_px, most)
    return frame.features[width_px]
