"""Which frames become views of the virtual stereo camera, and which of them pair up.

Three ways: the odometry's keyframes, spaced by base-to-height; a frame every so far along the
track; or every so many frames, as the paper does (two of every ten).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from recon import se3
from recon.calibration.adjusted_track import AnyTrack
from recon.camera_model import Undistorter
from recon.image_quality import ExposureTimeWatch
from recon.posegraph.pose_priors import FixAverage
from recon.rolling_shutter import depth_share
from recon.row_errors import turn_shares
from recon.stereo.posed_image import PosedImage
from recon.tracking.frame import NO_IMAGE, TWO_ONLY, Frame, Tracking
from recon.tracking.keyframe_window import landmark_points, median_depth, step_covariance
from recon.tracking.prediction import inverse_depth_plane
from recon.types import F32, F64, U8

KEPT = 6  # views remembered as partners; those further back see the ground from too far aside
MIN_FRAMES_PER_STEP = 6.0  # a keyframe may be late by one part in so many

NEAREST_PARTNER, FARTHEST_PARTNER = 0.6, 2.2
PARTNER_SPAN = FARTHEST_PARTNER - NEAREST_PARTNER
"""Steps away that partners between the views are, and over how many they spread on one side: the
first and the last view have no other."""

AHEAD, KNOWN_KEPT, KNOWN_PARTNERS = 4, 12, 2
"""Views to come that a view of a known track waits for, views remembered there, and partners for
each of ``compute.pairs``: such a track has no drift over wide baselines."""

WIDEST = 0.45  # base to height of such partners, at most
HELD = 5  # views that wait, at most, for the first estimate of an unstated readout: all are kept
KNOWN_ROWS = np.zeros((1, 1), np.float32)  # no uncertain motion of rows adds to the sigma of depth

FIRST_SHARE = 0.3
"""Of a usual step: the first frame that far from a view is the partner of its first depth. Those
nearer see the ground from too much the same place."""

LAST_VIEW_SHARE = 0.1
"""A segment's last frame becomes a view when it is this share of a usual step further on."""


@dataclass(frozen=True, slots=True, eq=False)
class StereoView:
    """A view with everything that its reconstruction needs, poses as they are known now."""

    frame: Frame  # without its images
    image: PosedImage  # in colour
    partners: tuple[PosedImage, ...]
    points: F64  # (N, 3) landmarks in the view's camera
    covariance: F64  # (6, 6) of vision's motion from the view before, left, in the view's camera
    earlier: Mapping[int, F64]  # number to pose (4, 4) of the segment's last few views
    # (n, m), all over the image: sigma of depth over depth by readout and turns that are not sure
    rows_share: F32 = field(default_factory=KNOWN_ROWS.copy)
    is_first_depth: bool = False  # it comes again, with all its partners

    @property
    def seq(self) -> int:
        return self.frame.seq

    @property
    def segment(self) -> int:
        return self.frame.segment

    @property
    def bgr(self) -> U8:
        assert self.image.bgr is not None
        return self.image.bgr


class ViewSelection:
    """Selects views from tracked frames and remembers the last few as partners."""

    def __init__(
        self, spacing: tuple[float, int] = (0.0, 0), partners: int = 4, all_known: bool = False
    ) -> None:
        """Views are so many metres apart, or frames; by base to height where both are 0. Then at
        most ``partners`` of the last :data:`KEPT` views pair up with one of them.

        ``all_known``: the poses are final, and views wait for those on their far side.

        With more partners than the neighbouring views can be, tracked frames between them
        become partners too.
        """
        self.spacing = spacing  # set at once: a frame may come at any time
        self.max_partners = partners
        self.takes_next = False  # the next frame with a pose, whatever the baseline asks for
        self._all_known = all_known
        self._kept = deque[Frame](maxlen=KNOWN_KEPT if all_known else KEPT)
        self._between = deque[Frame](maxlen=8 * partners if partners > KEPT - 2 else 0)
        self._recent = deque[Frame](maxlen=6)  # a quarter of a step apart
        # A last view, and its partner.
        self._extra: tuple[Frame, list[Frame]] | None = None
        self._views_of: Counter[int] = Counter()  # views by segment, kept or not

    @property
    def _is_auto(self) -> bool:
        return not any(self.spacing)

    @property
    def frames_per_step(self) -> float:
        """Frames between two keyframes that are needed: as many as pair up, or all of them."""
        if not self._is_auto or self.takes_next:
            return np.inf
        return max(MIN_FRAMES_PER_STEP, self.max_partners / PARTNER_SPAN)

    @property
    def min_base_to_height(self) -> float:
        """The shortest baseline that stereo should accept: an operator's choice is kept."""
        return 0.03 if self._is_auto else 0.002

    def offer(self, frame: Frame) -> bool:
        """True when the frame is to be a view."""
        frame = replace(frame, image=NO_IMAGE)
        if self.takes_next or self._wants(frame):
            self.takes_next = False
            self._keep(frame)
            return True
        if self._between.maxlen:
            self._between.append(frame)
        elif self._moved_on(frame):
            self._recent.append(frame)
        return False

    def end_segment(self, frame: Frame | None) -> bool:
        """True when the last frame of a segment must be a view: it shows more than the last one.
        ``frame`` is that frame unless it is a view already. The newest ground is not in the view
        before; a frame between the two becomes its partner.
        """
        step = self._step(self._kept[-1].segment) if self._kept else None
        if step is None:
            return False
        least = LAST_VIEW_SHARE * step
        is_view = (
            frame is not None and not frame.is_blurred and _apart(frame, self._kept[-1]) >= least
        )
        if frame is not None and is_view:
            self._keep(replace(frame, image=NO_IMAGE))
        last = self._kept[-1]
        near = [v for v in self._recent if v.segment == last.segment and not v.is_blurred]
        near = [v for v in near if 0.5 * step <= _apart(v, last) < 0.9 * step]
        near.sort(key=lambda v: abs(_apart(v, last) - 0.65 * step))
        self._extra = (last, near[:1])
        return is_view

    def shows_first(self, frame: Frame, view: Frame) -> bool:
        """True when the frame can be the only partner of the newest view."""
        step = self._step(view.segment)
        if step is None or frame.segment != view.segment or not self.confirmed(view):
            return False
        is_sharp = not (frame.is_blurred or view.is_blurred)
        return is_sharp and _apart(frame, view) >= FIRST_SHARE * step

    def _step(self, segment: int) -> float | None:
        """Distance between the last two views; None unless they are automatic and of it."""
        same = [v for v in self._kept if v.segment == segment]
        return _apart(same[-1], same[-2]) if self._is_auto and len(same) >= 2 else None

    def _moved_on(self, frame: Frame) -> bool:
        """True a quarter of a step after the last frame that was remembered."""
        step = self._step(frame.segment)
        if step is None:
            return False
        last = max([self._kept[-1], *self._recent], key=lambda v: v.seq)
        return last.segment == frame.segment and _apart(frame, last) > 0.25 * step

    def _keep(self, view: Frame) -> None:
        self._kept.append(view)
        self._views_of[view.segment] += 1

    def _wants(self, frame: Frame) -> bool:
        if frame.state is Tracking.STARTED or not self._kept:
            return frame.state in (Tracking.STARTED, Tracking.KEYFRAME)
        last, (metres, frames) = self._kept[-1], self.spacing
        if not (metres or frames) or last.segment != frame.segment:
            return frame.state is Tracking.KEYFRAME
        if frames:
            return frame.seq - last.seq >= frames
        return _apart(frame, last) >= metres

    def ready(self, view: Frame) -> bool:
        """True when the view has two neighbours to pair with, or its segment is over."""
        if not self._kept or self._kept[-1].seq == view.seq:
            return False
        if self._kept[-1].segment != view.segment:
            return True
        if self._kept[-1].row_motion.is_awaited:
            return False
        if not self._is_auto:
            return True
        if self._all_known:
            return sum(v.seq > view.seq for v in self._kept) >= AHEAD
        return self.confirmed(view)

    def confirmed(self, view: Frame) -> bool:
        """False for a segment of two views: no other view can contradict a single pair.

        Clouds in the sky or a false first motion would otherwise become surface. A baseline
        that the operator fixed pairs each view once and is not checked.
        """
        return not self._is_auto or self._views_of[view.segment] >= 3

    def partners(self, view: Frame) -> list[Frame]:
        """The views to pair it with, the best first.

        Automatic: those nearest to the wanted base-to-height, from both sides; a fixed
        baseline: the neighbour after it, or before it at the end of a segment.
        """
        others = [
            v for v in [*self._kept, *self._between]
            if v.segment == view.segment and not v.is_blurred and v.seq != view.seq
        ]  # fmt: skip
        if not self._is_auto:
            others.sort(key=lambda v: (v.seq < view.seq, abs(v.seq - view.seq)))
            return others[:1]
        others.sort(key=lambda v: _apart(v, view))
        if self._all_known:
            # Of all baselines that stereo can bridge; the nearest where there are none.
            widest = WIDEST * median_depth(view.reference_keyframe)
            good = [v for v in others if _apart(v, view) <= widest]
            return _evenly(good, KNOWN_PARTNERS * self.max_partners) or others[: self.max_partners]
        if not self._between:
            extra = self._extra[1] if self._extra and self._extra[0].seq == view.seq else []
            return [*extra, *others[: self.max_partners]]
        # Between half and twice the keyframes' spacing, evenly spread.
        spacing = next((_apart(v, view) for v in others if v in self._kept), 0.0)
        near, far = NEAREST_PARTNER * spacing, FARTHEST_PARTNER * spacing
        return _evenly([v for v in others if near <= _apart(v, view) <= far], self.max_partners)


def _evenly(views: list[Frame], count: int) -> list[Frame]:
    """At most ``count`` of the views, evenly spread over their order."""
    picked = np.unique(np.linspace(0, len(views) - 1, count).round().astype(int))
    return [views[i] for i in picked] if views else []


def _apart(a: Frame, b: Frame) -> float:
    return float(np.linalg.norm(a.T_odom_camera[:3, 3] - b.T_odom_camera[:3, 3]))


class VirtualStereoCamera:
    """The virtual stereo camera: takes every frame, gives each view once its partners have come."""

    def __init__(
        self,
        selection: ViewSelection,
        odometry: AnyTrack,
        undistorter: Undistorter,
        refused: Counter[str],
    ) -> None:
        """``undistorter`` takes out the distortion of views in colour."""
        self.selection, self._undistorter = selection, undistorter
        self._odometry, self._K, self._refused = odometry, undistorter.camera.K, refused
        self._segment = odometry.segment
        self._fixes = FixAverage()
        self._waiting = deque[Frame]()
        self._given: deque[Frame] = deque(maxlen=8)
        self._first = -1  # number of the newest view that was given with its first partner
        self._latest: Frame | None = None  # the last tracked frame, unless it is a view
        self.exposure_time = ExposureTimeWatch()
        self._frame_ns = self._image_ns = 0  # of the last frame, and of the last image

    def pass_over(self, time_ns: int) -> None:
        """The next image is not tracked."""
        self._image_ns = time_ns

    def take(self, tracked: Frame) -> bool:
        """Whether the next frame becomes a view."""
        self._watch_exposure_time(tracked)
        if tracked.segment != self._segment:
            self.end_segment()
            self._segment = tracked.segment
        if not tracked.is_placed:
            return False
        frame = replace(tracked, pyramid=(), features={}, mask=None)
        is_view = self.selection.offer(frame)
        self._fixes.take(frame.T_odom_camera, frame.prior)
        if is_view:
            self._wait(frame)
        self._latest = None if is_view else frame
        return is_view

    def _watch_exposure_time(self, tracked: Frame) -> None:
        gap_s, image_gap_s = (
            1e-9 * (tracked.time_ns - before) for before in (self._frame_ns, self._image_ns)
        )
        self._frame_ns = self._image_ns = tracked.time_ns
        if tracked.state is Tracking.KEYFRAME and tracked.image_rad_s is not None:
            px_s = self._odometry.K[0, 0] * tracked.image_rad_s
            self.exposure_time.add(tracked.small, px_s, gap_s, image_gap_s)

    def end_segment(self) -> None:
        """Make a view of a segment's last frame: only it shows what the camera saw last."""
        if self.selection.end_segment(self._latest) and self._latest is not None:
            self._wait(self._latest)
        self._fixes.forget()
        self._latest = None

    def _wait(self, view: Frame) -> None:
        """Keep a view until its partners are there; all fixes since the last one are its own."""
        self._waiting.append(replace(view, prior=self._fixes.given()))

    def ready(self, everything: bool = False) -> Iterator[StereoView]:
        """The views whose partners are there, in order."""
        while self._waiting and (everything or self._is_ready(self._waiting[0])):
            view = self._waiting.popleft()
            if not self.selection.confirmed(view):
                self._refused[TWO_ONLY] += 1
            elif view.is_blurred:
                self._refused["blurred"] += 1
            else:
                found = self._stereo_view(view, self.selection.partners(view))
                self._given.append(found.frame)
                yield found

    def first(self) -> StereoView | None:
        """The newest view with the first frame that shows its depth as the only partner; once."""
        if not self._waiting or self._latest is None:
            return None
        view, partner = self._waiting[-1], self._latest
        if view.seq == self._first or not self.selection.shows_first(partner, view):
            return None
        self._first = view.seq
        return replace(self._stereo_view(view, [partner]), is_first_depth=True)

    def _is_ready(self, view: Frame) -> bool:
        """True when its partners are there, and the images could show the readout."""
        search, newest = self._odometry.readout, self._waiting[-1].row_motion
        shows = search is not None and search.is_open and newest.is_measured
        return self.selection.ready(view) and not (shows and len(self._waiting) < HELD)

    def _stereo_view(self, view: Frame, partners: list[Frame]) -> StereoView:
        """The view with its image, which is without distortion from now on."""
        assert view.T_keyframe_camera is not None
        points = landmark_points(view.reference_keyframe)
        points = se3.transform(se3.inverse(view.T_keyframe_camera), points)
        in_odom = se3.transform(view.T_odom_camera, points)
        # Of the motion since the view given before.
        since = self._given[-1].reference_keyframe.seq if self._given else -1
        keys = [k for k in self._odometry.keyframes if since < k.seq <= view.reference_keyframe.seq]
        return StereoView(
            view.without_images(),
            replace(self._posed(view, in_odom), bgr=self._undistorter.image(view.image)),
            tuple(self._posed(partner, in_odom) for partner in partners),
            points,
            step_covariance(keys or [view.reference_keyframe], se3.inverse(view.T_odom_camera)),
            {a.seq: a.T_odom_camera for a in self._given if a.segment == view.segment},
            self._rows_share(view, partners, points),
        )

    def _rows_share(self, view: Frame, partners: list[Frame], points: F64) -> F32:
        """(n, m) sigma of depth over depth by what is not known of readout and turns. ``points``
        (N, 3) of the view's camera are the ground."""
        rows = view.row_motion.rows
        pairs = [
            (partner.row_motion.rows, se3.inverse(partner.T_odom_camera) @ view.T_odom_camera)
            for partner in partners
            if partner.row_motion.rows is not None
        ]
        seen = points[points[:, 2] > 0]
        if rows is None or not pairs or not len(seen):
            return KNOWN_ROWS
        search, of_readout = self._odometry.readout, 0.0
        if search is not None and search.doubt_s:
            shares = [depth_share(rows, other, T, seen, search.doubt_s) for other, T in pairs]
            of_readout = float(np.median(shares))
        of_turns = turn_shares(rows, pairs, seen, self._K, view.gray.shape[::-1])
        return np.asarray(np.hypot(of_readout, of_turns), np.float32)

    def _posed(self, view: Frame, points: F64) -> PosedImage:
        """The view in gray with its pose; ``points`` (N, 3) of the odometry are the ground."""
        posed = PosedImage(
            None, view.gray, self._K, view.T_odom_camera, self._undistorter.valid,
            blur_px=self._blur_px(view), seq=view.seq,
        )  # fmt: skip
        rows = view.row_motion.rows
        if rows is None or not rows.clock.readout_s:
            return posed
        ground = se3.transform(se3.inverse(view.T_odom_camera), points)
        scene = inverse_depth_plane(ground[ground[:, 2] > 0])
        return replace(posed, rows=rows.now(), scene=scene)

    def _blur_px(self, view: Frame) -> F64 | None:
        """(2,) px by which the middle of the image moved during the exposure; None where images are
        sharp or its motion is not known."""
        exposure_s = self.exposure_time.shown_s
        if not exposure_s or view.image_rad_s is None:
            return None
        return np.asarray(self._K[0, 0] * exposure_s * view.image_rad_s)
