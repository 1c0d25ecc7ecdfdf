"""Figure 1 of the paper: images and telemetry in, posed depth images out.

:meth:`Pipeline.step` is the upper row of the figure, up to the virtual stereo camera;
:meth:`Pipeline.reconstruct` is the lower row, from a stereo view to a keyframe. Every box is one
line with its equation. The stages are built from the configuration by
:func:`service.flight.stages.build_stages`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from threading import Event

from recon.posegraph.trajectory import Placed
from recon.tracking.odometry import Tracked, Tracking
from recon.types import Frame, Keyframe, PosePrior
from service.config import ComputeConfig, ScanConfig
from service.flight.anchorage import Anchorage
from service.flight.stages import Stages
from service.flight.viewpoints import StereoCandidate, UndistortedFrame
from service.stream.records import Repose


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """Results of one frame."""

    tracked: Tracked
    placed: Placed | None = None  # the frame in the world; by telemetry alone when vision fails
    is_view: bool = False  # the frame takes part in stereo and may become a keyframe
    anchor: Anchorage | None = None  # gives the frame's place again, as it is known later
    keyframes: tuple[Keyframe, ...] = ()  # finished depth images, oldest first
    moved: tuple[Repose, ...] = ()  # keyframes published before whose pose is better now
    late: Step | None = None  # the frame before, which was lost until this one came


class Pipeline:
    """One scan: feed :meth:`step` every frame in order, then call :meth:`finish`."""

    def __init__(self, stages: Stages) -> None:
        self.stages = stages
        self._background = stages.in_background(self.reconstruct)
        self._lost: UndistortedFrame | None = None  # the last frame, where it has no pose

    # ---- the figure --------------------------------------------------------------------

    def skip(self, time_ns: int, prior: PosePrior) -> Step | None:
        """The step of a frame that need not be seen; None for one that :meth:`step` must take."""
        track = self.stages.track  # frames are followed as fast as the image moves
        if not track.can_skip(time_ns, prior):
            return None
        return Step(Tracked(Tracking.SKIPPED, track.segment))

    def step(self, frame: Frame) -> Step:
        """One frame: where the camera is, and which views have their partners by now.

        Raises ValueError when the image is not of the camera model's size.
        """
        s = self.stages
        image = s.undistort(frame)  # section 2.1
        tracked = s.track(image)  # Harris and ZSSD (Eq. 4-5), EPnP (Eq. 6-7)
        late = self._late(image, tracked)
        anchor, is_view = s.views.take(image, tracked)  # virtual stereo camera, section 2.3
        if anchor is None:
            return Step(tracked, s.chain.by_telemetry(image, tracked))
        for view in s.views.ready():
            self._background.offer(view)  # to be reconstructed
        keyframes = self._finished()
        moved = s.chain.corrections() if keyframes else ()
        placed = s.chain.follow(image, anchor)
        return Step(tracked, placed, is_view, anchor, keyframes, moved, late)

    def _late(self, image: UndistortedFrame, tracked: Tracked) -> Step | None:
        """The step of the frame before, which begins the segment of this one."""
        before, self._lost = self._lost, image if tracked.state is Tracking.LOST else None
        if before is None or tracked.before is None:
            return None
        anchor, is_view = self.stages.views.take(before, tracked.before)
        assert anchor is not None
        placed = self.stages.chain.follow(before, anchor)
        return Step(tracked.before, placed, is_view, anchor)

    def reconstruct(self, view: StereoCandidate) -> Keyframe | None:
        """One view: its depth from all its partners, its pose, and its new surface."""
        s, depth = self.stages, None
        grid = s.rectify.grid(view)
        depths = s.carry(view, grid)  # by images that are matched already
        pairs = s.rectify(view, depths)  # virtual stereo pairs, section 2.1
        if pairs:
            depth = s.stereo.whole_path(pairs.values(), grid)  # Eq. 1-3 at once, where a device can
        if depth is None and (pairs or depths):
            for partner, pair in pairs.items():
                disparity = s.stereo.match(pair)  # belief propagation, Eq. 1
                disparity = s.stereo.upsample(disparity, pair)  # joint bilateral, Eq. 2
                depths[partner] = s.stereo.reproject(disparity, pair, grid)  # Eq. 3
            s.carry.keep(view.seq, depths)
            depth = s.stereo.fuse([*depths.values()], grid)
        bgr = s.rectify.colours(view, grid)
        depth = s.plausible(view, depth, bgr)  # nothing that cannot be
        s.rectify.learn(depth)  # how far the relief of the next pairs may reach
        motion = s.register(view, depth)  # ICP onto the keyframe before
        placed = s.chain.add(view, motion, depth)  # pose graph
        if depth is None or placed is None:
            return None
        sigma_m, fresh = s.map(view, depth, s.chain.map_pose(view.seq))  # map: what is new
        return s.keyframe(view, depth, bgr, sigma_m, fresh, placed)

    def drain(self) -> Step:
        """The views still waiting for partners, up to one whose work failed."""
        s = self.stages
        s.views.end_stretch()
        for view in s.views.ready(everything=True):
            self._background.offer(view)
        keyframes = self._finished(everything=True)
        tracked = Tracked(Tracking.LOST, s.track.segment, reason="end of the recording")
        return Step(tracked, keyframes=keyframes)

    def finish(self) -> Step:
        """The remaining results, and the last corrections. Raises what work raised."""
        try:
            step = self.drain()
        finally:
            self._background.close()
        self.stages.map.clear()
        return replace(step, moved=self.stages.chain.corrections(final=True))

    def _finished(self, everything: bool = False) -> tuple[Keyframe, ...]:
        """Keyframes that are done, in order."""
        done = self._background.finished(everything)
        for view, keyframe in done:
            self.stages.chain.reconstructed(view, keyframe)
        self.stages.chain.settle()
        return tuple(keyframe for _, keyframe in done if keyframe is not None)

    def end_by(self, stop: Event, patience_s: float) -> None:
        """Drop unfinished reconstructions, at most ``patience_s`` after ``stop`` is set."""
        self._background.end_by(stop, patience_s)

    # ---- in flight ---------------------------------------------------------------------

    def set_baseline(self, config: ScanConfig) -> None:
        """Apply a new ``scan.baseline`` from the next frame on."""
        views = self.stages.views.selection
        views.set_baseline(config)
        self.stages.rectify.set_min_base_to_height(views.min_base_to_height)

    def set_effort(self, compute: ComputeConfig) -> None:
        """Apply new ``pairs``, ``stereo_width`` and ``upsample`` from the next view on."""
        self.stages.views.selection.set_partners(compute.pairs)
        self.stages.rectify.set_effort(compute)

    def take_next(self) -> None:
        """Make the next frame with a pose a view, whatever the baseline asks for."""
        self.stages.views.selection.take_next()

    def reset_map(self) -> None:
        """Reset the map: all surface counts as unseen."""
        self.stages.map.clear()

    # ---- figures -----------------------------------------------------------------------

    @property
    def segments(self) -> int:
        """Number of segments so far."""
        return self.stages.track.segment + 1

    @property
    def pairs(self) -> int:
        """Stereo pairs so far."""
        return self.stages.rectify.pairs

    @property
    def dropped(self) -> int:
        """Views that were not reconstructed because newer ones arrived faster."""
        return self._background.dropped

    @property
    def busy_s(self) -> float:
        """Seconds for which one view has been under reconstruction; 0 when none is."""
        return self._background.busy_s

    @property
    def held(self) -> dict[str, int]:
        """Memory that this scan takes: the map's voxels, its tiles on disk, views for loops,
        and keyframes in the pose graph."""
        return self.stages.map.held | self.stages.chain.held

    def refusals(self) -> Counter[str]:
        """Frames, views and pairs not used, by reason."""
        return self.stages.refused + self.stages.rejected + self.stages.track.waiting
