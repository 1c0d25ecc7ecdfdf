"""Where the camera is: Harris + ZSSD tracks, EPnP against landmarks, a window refined.

Section 2.3 of the paper: corners of two earlier views (the left and right image of the
virtual stereo camera) are found again in the new frame, each view gives a pose by EPnP
(Eq. 6-7) and the two are averaged. Between the frames that become keyframes, landmarks are
triangulated and the last keyframes are adjusted together (:mod:`recon.tracking.keyframe_window`).

The odometry works in a frame of its own that starts at the first telemetry pose; scale,
heading and position are corrected afterwards by :mod:`recon.posegraph.alignment`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from recon import se3
from recon.rolling_shutter import NEAR_S, FrameRows, RowTrack
from recon.tracking import matching, pnp, prediction, two_view
from recon.tracking.frame import NO_IMAGE, UNKNOWN, Frame, Landmarks, Tracking
from recon.tracking.keyframe_window import (
    AdjustedWindow,
    adjust_window,
    median_depth,
    triangulate,
)
from recon.tracking.localisation import (
    DISAGREES,
    LOOSE_PX,
    LOW_RATE_GAP_S,
    MIN_BASE_TO_HEIGHT,
    MIN_TRACKS,
    SEARCH_SHARE,
    Localiser,
    Located,
    TwoViewPose,
)
from recon.tracking.prediction import ConstantVelocity
from recon.tracking.readout_search import ReadoutSearch
from recon.types import F64, I64, Bool, Camera, PosePrior

MAX_TURN_RAD, MIN_OVERLAP = 0.25, 0.45
"""A frame that turned so much since the last keyframe, or shows a smaller share of its corners,
becomes one: what came into view has no landmarks yet. So much is a fifth of a usual view."""

FIRST_STEP, FIRST_TURN_RAD = 0.7, 0.12
"""Of the usual step: the baseline of a segment's first two keyframes, as no frame before the second
has a pose. Their motion may turn by so much otherwise than telemetry: attitudes are off by some
degrees, and a false motion between two views by more."""

WINDOW = 8
"""Keyframes adjusted together. Of those further back, 0.8 of the height and more, a wide image
shows nothing any more."""

LOST_AFTER = 8  # frames in a row without a pose before a new segment: a third of a second of video

OVERDUE = 1.3
"""A blurred frame becomes a keyframe when the last is this many steps away: partners may be 2.2
steps apart, and a sharp frame is likely to come sooner."""

MAX_GAP_S, SOUGHT_GAP_S, ROLLING_GAP_S = 0.17, 0.09, 0.05
"""A frame this long after the last is followed: with a global shutter, while a readout is sought,
and with a rolling shutter, whose rows need neighbours closer by."""


EARLY = 4
"""Frames after a segment's first that show how its rows moved: a curve of the second degree needs
two, and noise more."""


class Odometry:
    """Follows one camera without distortion; feed it every frame in order."""

    def __init__(
        self,
        camera: Camera,
        lens: Camera | None = None,
        seeks_readout: bool = False,
        base_to_height: float = 0.1,
        on_adjusted: Callable[[AdjustedWindow], None] | None = None,
    ) -> None:
        """``camera`` has no distortion and the size of the frames to come.

        ``lens`` is the camera with its distortion and shutter; None: a global shutter.
        ``seeks_readout``: its readout is a start, to be found by the images.
        ``base_to_height`` is the motion between keyframes over the distance to the ground; raises
        ValueError where no two frames so close can be triangulated. ``on_adjusted`` gets every
        window that shares no keyframe with the one before.
        """
        if not MIN_BASE_TO_HEIGHT <= base_to_height <= 1.0:
            raise ValueError(f"base_to_height is {base_to_height}, not {MIN_BASE_TO_HEIGHT} to 1")
        self.camera = camera
        self.K = camera.K
        self._base_to_height = base_to_height
        self.keyframes: list[Frame] = []  # of the current segment
        self.segment = -1
        self._lost = self._refused = 0  # frames in a row without a pose; by telemetry's turn
        self._missed_frame: Frame | None = None  # the last still, where it is lost
        self._model = ConstantVelocity(0, np.eye(4), UNKNOWN)  # of the newest segment
        self._row_track = RowTrack(lens or camera, seeks_readout)
        clock = self._row_track.clock
        self.readout = ReadoutSearch(clock, self.K) if seeks_readout and clock else None
        self._on_adjusted, self._given_seq = on_adjusted, -1
        self._rows_awaited: Frame | None = None  # its rows' motion will be known better
        self._early: list[tuple[FrameRows, F64, Bool]] = []  # frames, the first one's corners there
        self._localiser = Localiser(camera, self._row_track)
        self._frame_ns = self._gap_ns = 0  # time of the last frame, and since the one before
        self._depth = float("nan")  # median of the last keyframe's landmarks

    # ---- one frame -------------------------------------------------------------------

    def can_skip(self, time_ns: int, prior: PosePrior, frames_per_step: float) -> bool:
        """True for a frame that :meth:`track` need not see: the camera has hardly moved since.
        ``frames_per_step`` is how many frames at least are followed from keyframe to keyframe."""
        if not self._is_metric or self._lost:
            return False
        moved, turned, gap_s = self._model.shift(time_ns, prior, self._depth)
        max_gap_s = SOUGHT_GAP_S if self._row_track.is_rolling else MAX_GAP_S
        max_gap_s = ROLLING_GAP_S if self._row_track.is_known else max_gap_s
        step = max(moved / self._base_to_height, turned / MAX_TURN_RAD)
        return gap_s < max_gap_s and step * frames_per_step < 1.0

    def needs_turn(self, time_ns: int) -> bool:
        """True where the prior of a frame should hold the camera's angular velocity."""
        return self._row_track.needs_telemetry(time_ns)

    def track(self, frame: Frame) -> list[Frame]:
        """The new frame with its pose, or why there is none; before it the last still, lost until
        now, where both together start a segment."""
        time_ns, prior = frame.time_ns, frame.prior
        expected = self._expected(time_ns, prior)
        new = replace(frame, row_motion=self._row_track.expect(time_ns, prior, expected))
        self._gap_ns, self._frame_ns = time_ns - self._frame_ns, time_ns
        if not self.keyframes:
            return [self._start(new)]
        if not self._is_metric:
            return self._second_view(new)
        found = self._located(new)
        if found == DISAGREES:
            self._refused += 1
            found = found if self._heeds_turn else self._located(new)
        if not isinstance(found, str):
            return [self._accept(new, found)]
        pair = self._localiser.by_two_views(new, self.keyframes) if self._low_frame_rate else None
        return self._missed(new, found) if pair is None else [self._accept_two_views(new, pair)]

    def _located(self, new: Frame) -> Located | str:
        return self._localiser.locate(
            new, self.keyframes, self._model, self._low_frame_rate,
            lost=self._lost > 0, heeds_turn=self._heeds_turn,
        )  # fmt: skip

    @property
    def _heeds_turn(self) -> bool:
        """False once telemetry's turn contradicts the images steadily: it is not the camera's."""
        return self._refused < LOST_AFTER

    def _expected(self, time_ns: int, prior: PosePrior) -> F64:
        """(4, 4) T_camera_odom of a new frame, as far as it can be foreseen."""
        if self.segment >= 0:
            return se3.inverse(self._model.ahead(time_ns, prior)[0])
        R = prior.R_world_camera
        return np.eye(4) if R is None else se3.compose(R.T, np.zeros(3))

    @property
    def _is_metric(self) -> bool:
        """True where the current segment has landmarks: from its second keyframe on."""
        return len(self.keyframes) > 1

    @property
    def _low_frame_rate(self) -> bool:
        """Too long since the frame before for a motion model to hold."""
        return self._gap_ns > 1e9 * LOW_RATE_GAP_S

    def _found(self, new: Frame, state: Tracking, T_odom_camera: F64, tracks: int = 0) -> Frame:
        """The frame with its pose (4, 4), from now on relative to the newest keyframe."""
        key = self.keyframes[-1]
        return replace(
            new, state=state, segment=self.segment, tracks=tracks, reference=key,
            T_keyframe_camera=se3.inverse(key.T_odom_camera) @ T_odom_camera,
        )  # fmt: skip

    def _unplaced(self, new: Frame, state: Tracking, reason: str, tracks: int = 0) -> Frame:
        return replace(new, state=state, segment=self.segment, tracks=tracks, reason=reason)

    def _missed(self, new: Frame, reason: str) -> list[Frame]:
        """Count a frame without a pose; after too many, or two stills, begin a new segment."""
        self._lost += 1
        if self._low_frame_rate and self._missed_frame is not None and self._lost >= 2:
            first, self._missed_frame = self._missed_frame, None
            started = self._start(first)
            if started.state is Tracking.STARTED:
                (second,) = self._second_view(new)
                late = replace(started, state=Tracking.KEYFRAME, reason=first.reason)
                return [late, second] if second.state is Tracking.KEYFRAME else [second]
        elif not self._low_frame_rate and self._lost >= LOST_AFTER:
            self._start(new)
        lost = self._unplaced(new, Tracking.LOST, reason)
        self._missed_frame = lost if self._low_frame_rate else None
        return [lost]

    def _start(self, new: Frame) -> Frame:
        uv = self._corners(new)
        if len(uv) < 2 * MIN_TRACKS:
            return self._unplaced(new, Tracking.LOST, "too little texture")
        self.segment += 1
        self._lost = self._refused = 0
        self._localiser.begin()
        self._row_track.begin()
        self._rows_awaited, self._early = None, []
        R, t = new.prior.R_world_camera, new.prior.position_m
        T_odom_camera = se3.compose(
            np.diag([1.0, -1, -1]) if R is None else R, np.zeros(3) if t is None else t
        )
        T_camera_odom = se3.inverse(T_odom_camera)
        unknown = np.full(len(uv), -1, np.int64)
        self.keyframes = [self._keyframe(new, T_camera_odom, uv, unknown, Landmarks())]
        self._row_track.add(new.row_motion, T_camera_odom)
        self._model = ConstantVelocity(new.time_ns, T_odom_camera, new.prior)
        return self._found(new, Tracking.STARTED, T_odom_camera)

    def _keyframe(
        self, new: Frame, T_camera_odom: F64, uv: F64, landmark: I64, table: Landmarks
    ) -> Frame:
        """The frame as a keyframe with corners ``uv`` (N, 2)."""
        return replace(
            new, image=NO_IMAGE, gray=NO_IMAGE, mask=None, segment=self.segment,
            T_camera_odom=T_camera_odom, uv=uv, landmark=landmark, landmarks=table,
        )  # fmt: skip

    def _corners(self, new: Frame) -> F64:
        found = matching.harris_grid(new.small, mask=new.mask)
        return found[:, :2].astype(np.float64)

    # ---- the second view --------------------------------------------------------------

    def _second_view(self, new: Frame) -> list[Frame]:
        """Wait until the camera has moved enough, then make the first landmarks."""
        first = self.keyframes[0]
        R_b_a = prediction.relative_rotation(first.prior, new.prior)
        uv, ok = self._localiser.match_first(new, first, R_b_a, self._low_frame_rate)
        R_b_a = R_b_a if self._heeds_turn else None
        if self._low_frame_rate and ok.sum() < 2 * MIN_TRACKS:
            uv, ok = self._localiser.with_features(new, first, uv, ok) or (uv, ok)
        if ok.sum() < 2 * MIN_TRACKS:
            return self._missed(new, "too few matches with the first frame")
        self._lost = 0
        least = FIRST_STEP * self._base_to_height
        moved = prediction.base_to_height(first.uv[ok], uv[ok], self.K, R_b_a)
        # A camera that circles a place keeps it in the middle: it moves, but the image does not.
        off = 0.0 if R_b_a is not None else prediction.beyond_turn(first.uv[ok], uv[ok], self.K)
        view = None
        if moved >= least or self.K[0, 0] * off > 2.0 * two_view.MAX_ERROR_PX:
            inverse_depth = 1.0 / new.prior.agl_m if new.prior.agl_m else 0.0
            view = self._localiser.motion_since(
                first, new, uv, ok, inverse_depth, R_b_a, FIRST_TURN_RAD,
                may_be_wrong=self._low_frame_rate,
            )  # fmt: skip
        if moved < least and (view is None or view.parallax_rad < least):
            if self._row_track.is_known and len(self._early) < EARLY:
                self._early.append((new.row_motion, uv, ok))
            return [self._unplaced(new, Tracking.WAITING, "too little motion", int(ok.sum()))]
        if view is None or view.parallax_rad < MIN_BASE_TO_HEIGHT:
            self._refused += R_b_a is not None
            return self._missed(new, "no certain motion between two frames")
        matched = np.flatnonzero(ok)
        ok[matched[~view.inliers]] = False
        scale = prediction.metric_scale(view, first.prior, new.prior, first.T_odom_camera)
        points = se3.transform(first.T_odom_camera, view.points[view.inliers] * scale)
        first.landmark[matched[view.inliers]] = first.landmarks.add(points)
        self._place_early(first)
        second = se3.compose(view.T_b_a[:3, :3], view.T_b_a[:3, 3] * scale)
        return [self._accept_two_views(new, (first, second @ first.T_camera_odom, uv, ok))]

    def _place_early(self, first: Frame) -> None:
        """Poses of the frames after the first; they say how its rows moved."""
        for row_motion, uv, ok in self._early:
            rows = np.flatnonzero(ok & first.landmarks.known(first.landmark[: len(ok)]))
            points = first.landmarks[first.landmark[rows]]
            depth = se3.transform(first.T_camera_odom, points)[:, 2]
            at = row_motion.at_middle(self.K, uv[rows], 1.0 / depth)
            found = pnp.solve(points, at, self.K, first.T_camera_odom)
            if found is not None:
                self._row_track.add(row_motion, found.T_camera_points)
        self._early = []

    # ---- keyframes ---------------------------------------------------------------------

    def _accept(self, new: Frame, found: Located) -> Frame:
        """Keep the pose; make the frame a keyframe when it has moved enough. A blurred one waits a
        while longer, as a sharp one is better."""
        key = found.key
        T_camera_odom = found.pose.T_camera_points
        moved = T_camera_odom @ key.T_odom_camera
        depth = self._depth if key is self.keyframes[-1] else median_depth(key)
        base = float(np.linalg.norm(moved[:3, 3])) / max(depth, 1e-6)
        tracks = int(found.ok.sum())
        turned = float(np.linalg.norm(se3.so3_log(moved[:3, :3])))
        T_odom_camera = se3.inverse(T_camera_odom)
        new = replace(new, image_rad_s=self._image_rad_s(T_odom_camera, depth))
        self._model.update(new.time_ns, T_odom_camera, new.prior)
        self._lost, self._refused = 0, 0 if self._heeds_turn else self._refused
        due = self._base_to_height * (OVERDUE if new.is_blurred else 1.0)
        if base < due and found.share > MIN_OVERLAP and turned < MAX_TURN_RAD:
            self._row_track.add(new.row_motion, T_camera_odom)
            self._readjust()
            return self._found(new, Tracking.TRACKED, T_odom_camera, tracks)
        share = 0.5 * SEARCH_SHARE
        whole = self._localiser.pose_from(key, new, T_camera_odom, share, MIN_TRACKS)
        found = found if isinstance(whole, str) else whole
        seen = [found]
        if self._low_frame_rate:  # little overlap: every keyframe that sees the same ground counts
            seen += self._localiser.others(new, self.keyframes, found)
        corners = [(other.key, other.uv, other.ok) for other in seen]
        placed = self._add_keyframe(new, found.pose.T_camera_points, corners)
        self._model.correct(self.keyframes[-1].T_odom_camera)
        return placed

    def _image_rad_s(self, T_odom_camera: F64, depth: float) -> F64 | None:
        """(2,) motion of the image's middle since the frame before; None for stills, which are far
        apart."""
        gap_s = 1e-9 * self._gap_ns
        if not (0.0 < gap_s < NEAR_S and np.isfinite(depth)):
            return None
        return np.asarray(self._model.across(T_odom_camera, depth) / gap_s)

    def _accept_two_views(self, new: Frame, found: TwoViewPose) -> Frame:
        """Make a keyframe of a frame that two views alone place."""
        self._lost = 0
        key, T_camera_odom, uv, ok = found
        placed = self._add_keyframe(new, T_camera_odom, [(key, uv, ok)])
        self._model.update(new.time_ns, self.keyframes[-1].T_odom_camera, new.prior)
        return placed

    def _add_keyframe(
        self,
        new: Frame,
        T_camera_odom: F64,
        seen: list[tuple[Frame, F64, Bool]],
    ) -> Frame:
        """Append a keyframe: tracked corners, new landmarks, fresh corners; adjust the window.

        ``seen`` are keyframes with where (N, 2) their corners were found and which (N,) were,
        the one that gave the pose first. Of the others only corners with landmarks count.
        """
        least = 0.5 * MIN_BASE_TO_HEIGHT
        self._row_track.add(new.row_motion, T_camera_odom)
        kept, landmark = np.zeros((0, 2)), np.zeros(0, np.int64)
        for key, uv, ok in seen:
            triangulate(key, T_camera_odom, new.row_motion, uv, ok, self.K, least, LOOSE_PX)
            if key is not seen[0][0]:
                ok = ok & (key.landmark >= 0) & ~np.isin(key.landmark, landmark)
            kept = np.vstack([kept, uv[ok]])
            landmark = np.concatenate([landmark, key.landmark[ok]])
        fresh = prediction.fresh_corners(
            self._corners(new), kept, self.camera.size_px, matching.DEFAULT.grid
        )
        uv = np.vstack([kept, fresh])
        landmark = np.concatenate([landmark, np.full(len(fresh), -1, np.int64)])
        key_new = self._keyframe(new, T_camera_odom, uv, landmark, seen[0][0].landmarks)
        self.keyframes.append(key_new)
        self._rows_awaited = key_new if new.row_motion.rows is not None else None
        window = self.keyframes[-WINDOW - 2 :]
        adjusted = adjust_window(window, self.K)
        is_next = len(window) > WINDOW and window[0].seq > self._given_seq
        if is_next and self._on_adjusted is not None:
            self._given_seq = new.seq
            self._on_adjusted(adjusted)
        self._depth = median_depth(key_new)
        self._forget()
        return self._found(new, Tracking.KEYFRAME, key_new.T_odom_camera, int(seen[0][2].sum()))

    def _readjust(self) -> None:
        """Adjust the window again once frames after its last keyframe say how its rows moved, and
        look for the readout, until it is known that there is none."""
        if self._rows_awaited is not None and self._rows_awaited.row_motion.is_settled:
            adjust_window(self.keyframes, self.K)
            self._rows_awaited = None
            search = self.readout if self._row_track.is_rolling else None
            if search is not None and search.update(self.keyframes):
                adjust_window(self.keyframes, self.K)
            if search is not None and search.is_none:
                self._row_track.stop()

    def _forget(self) -> None:
        """Drop images and corners that left the window, and landmarks out of sight."""
        window = self.keyframes[-WINDOW - 2 :]
        for old in self.keyframes[: -len(window)]:
            old.pyramid, old.features = (), {}
            old.uv, old.landmark = np.zeros((0, 2)), np.zeros(0, np.int64)
        self.keyframes = window
        seen = np.concatenate([k.landmark for k in window])
        if (seen >= 0).any():
            window[0].landmarks.forget_before(int(seen[seen >= 0].min()))
