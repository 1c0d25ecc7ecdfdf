"""Figure 1 of the paper: images and telemetry in, posed depth images out.

:meth:`Mapper.track` is the upper row of the figure, up to the virtual stereo camera;
:meth:`Mapper.reconstruct` is the lower row, from a stereo view to a keyframe. Every box is one
line with its equation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np

from recon.backends import Backend
from recon.backends.cpu import CpuBackend
from recon.calibration.adjusted_track import AdjustedTrack
from recon.calibration.focal_watch import FocalWatch
from recon.mapping.cloud_fusion import cloud_of, fuse
from recon.mapping.gain_compensation import GainCompensation
from recon.mapping.voxel_map import VoxelMap, ground_sample_m
from recon.pipeline.keyframe_map import FramePoses, KeyframeMap, SurfaceMap
from recon.pipeline.stages import (
    DenseStereo,
    Timing,
    Undistort,
    check_image,
    keyframe_of,
    untimed,
    without_false_surface,
)
from recon.pipeline.views import StereoView, ViewSelection, VirtualStereoCamera
from recon.posegraph.loop_closure import LoopSearch
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.pose_priors import check_prior
from recon.posegraph.trajectory import Trajectory
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.posed_image import VirtualStereoConfig
from recon.tracking.frame import CONTRADICTED, NO_IMAGE, Frame, Tracking
from recon.tracking.odometry import Odometry
from recon.types import U8, Array, Camera, DepthMap, Keyframe, PointCloud, Pose, PosePrior


@dataclass(frozen=True, slots=True)
class MapperConfig:
    # A view each so many metres along the track, or frames; by base to height where both are 0.
    spacing: tuple[float, int] = (0.0, 0)
    pairs: int = 4  # partners of a view, at most
    base_to_height: float = 0.1  # motion between the odometry's keyframes over the distance
    seeks_readout: bool = False  # the shutter's readout is a start, to be found by the images
    guide_width_px: int = 1280  # of the images that guide the upsampling
    stereo_width_px: int = 320
    upsample: bool = True
    labels: int = 16  # of disparity, at least
    iterations: int = 5  # of belief propagation per level
    loops: bool = True
    loop_views: int = 400  # keyframes kept for loop detection
    graph_keyframes: int = 400  # nodes of the pose graph; above that, keyframes are interpolated
    resolution_m: float = 0.0  # of the map, at least; 0: as fine as the images
    keeps_debug: bool = False  # the images of each view's stages
    first_depths: bool = False  # of views whose partners have not come, while no work waits


@dataclass(frozen=True, slots=True, eq=False)
class FramePosed:
    """A frame went through tracking. One that was lost comes again where the next one places it."""

    frame: Frame  # without its images; gives its pose in the odometry again, as known later
    pose: Pose | None = None  # in the world; by telemetry alone when vision fails
    is_view: bool = False  # the frame takes part in stereo and may become a keyframe


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeReady:
    """A view has become a keyframe, with the depth of all its partners.

    ``is_first_depth``: only what one partner shows, to look at now. The same view comes again with
    its whole depth, unless it is refused. ``stages``: the images of its stages, by name, where they
    are kept.
    """

    keyframe: Keyframe
    is_first_depth: bool = False
    stages: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class PosesChanged:
    """Better poses of keyframes that came before, by number."""

    poses: Mapping[int, Pose]


Event = FramePosed | KeyframeReady | PosesChanged

Reconstructed = tuple[Pose | None, tuple[Event, ...]]
"""The pose of a view that is in the graph now, None of one that comes again after its first depth;
and what there is to tell."""

Reconstruct = Callable[[StereoView], Callable[[], Reconstructed]]
"""Work on a view: what it returns is the rest of it, which may go on while work on the next view
begins, on another thread. Both are in the order of the views."""

COARSER, FIRST_BASE_TO_HEIGHT = 2, 0.02  # a first depth's images are smaller, its baseline shorter


class Worker(Protocol):
    """Does the work of :meth:`Mapper.reconstruct`, view by view."""

    def offer(self, item: StereoView) -> None: ...

    def finished(self, everything: bool = False) -> list[tuple[StereoView, Reconstructed]]: ...

    @property
    def is_free(self) -> bool: ...

    def close(self) -> None: ...


class InTurn:
    """Reconstructs each view before the next frame is looked at."""

    def __init__(self, work: Reconstruct) -> None:
        self._work, self._done = work, list[tuple[StereoView, Reconstructed]]()

    def offer(self, item: StereoView) -> None:
        self._done.append((item, self._work(item)()))

    def finished(self, everything: bool = False) -> list[tuple[StereoView, Reconstructed]]:
        done, self._done = self._done, []
        return done

    is_free = True

    def close(self) -> None:
        """Nothing is left to do."""


class Mapper:
    """One scan: :meth:`add` every frame in the order of time, then call :meth:`finish`.

    It has no thread, clock or file of its own. ``worker`` may run :meth:`reconstruct` on another
    thread, of which the stages that make depth are then part, and what that returns on a third,
    with ``keyframes`` and ``surface``.
    """

    def __init__(
        self,
        camera: Camera,
        config: MapperConfig | None = None,
        backend: Backend | None = None,
        known: AdjustedTrack | None = None,
        new_map: Callable[[float], VoxelMap] = VoxelMap,
        worker: Callable[[Reconstruct], Worker] = InTurn,
        timing: Timing = untimed,
        keeps_cloud: bool = True,
    ) -> None:
        """Raises ValueError for an unusable camera model.

        A ``known`` track takes the odometry's place; ``new_map`` makes the map of known surface;
        ``timing`` measures the stages; ``keeps_cloud`` holds all keyframes for :meth:`cloud`.
        """
        self.config = config = config or MapperConfig()
        backend = backend or CpuBackend()
        self.refused = Counter[str]()  # frames and views, by reason; written while tracking
        self.rejected = Counter[str]()  # pairs and keyframes; written while reconstructing
        self.debug: dict[str, Array] | None = {} if config.keeps_debug else None
        self._timing = timing
        self._size_px, self._last = camera.size_px, (-1, -(1 << 63))  # number and time of a frame
        self.undistort = Undistort(camera, config.guide_width_px, timing)
        self.focal = FocalWatch(self.undistort.tracking_camera.K)
        self.odometry = known or Odometry(
            self.undistort.tracking_camera,
            camera,
            config.seeks_readout,
            config.base_to_height,
            self.focal.add,
        )
        selection = ViewSelection(config.spacing, config.pairs, all_known=known is not None)
        self._waiting = Counter[str]()  # frames since a segment's first one, by reason
        self.views = VirtualStereoCamera(
            selection, self.odometry, self.undistort.undistorter, self.refused
        )
        stereo = VirtualStereoConfig(
            min_base_to_height=selection.min_base_to_height, width_px=config.stereo_width_px,
            guided=config.upsample, labels=config.labels,
        )  # fmt: skip
        matching = BeliefPropagationConfig(iterations=config.iterations)
        self.stereo = DenseStereo(backend, stereo, matching, self.rejected, self.debug, timing)
        self._first_stereo: DenseStereo | None = None
        if config.first_depths:
            first = replace(stereo, min_base_to_height=FIRST_BASE_TO_HEIGHT, guided=False,
                            width_px=stereo.width_px // COARSER)  # fmt: skip
            self._first_stereo = DenseStereo(backend, first, matching, Counter(), None, untimed)
        trajectory = Trajectory(PoseGraph(config.graph_keyframes))
        loops = LoopSearch(trajectory, max_views=config.loop_views) if config.loops else None
        self.keyframe_map = KeyframeMap(trajectory, loops, backend, self.rejected, timing)
        self.surface = SurfaceMap(trajectory.similarities, config.resolution_m, new_map)
        self.gains = GainCompensation()
        self.frame_poses = FramePoses(self.keyframe_map, self.is_settled)
        self._kept: dict[int, Keyframe] | None = {} if keeps_cloud else None
        self._ready = set[int]()  # numbers of all keyframes that are given out
        self._worker = worker(self.reconstruct)

    # ---- the figure --------------------------------------------------------------------

    def add(self, frame: Frame) -> tuple[Event, ...]:
        """One frame of a recording; those that hardly moved are not looked at.

        Raises ValueError for an image that is not (H, W, 3) uint8 of the camera model's size, a
        number or time that is not after the last frame's, or a prior that cannot be.
        """
        check_image(frame.image, self._size_px)
        check_prior(frame.prior)
        if not isinstance(frame.time_ns, int | np.integer):
            raise ValueError(
                f"frame {frame.seq}: time_ns {frame.time_ns!r} is no whole number of ns"
            )
        seq, time_ns = self._last
        if frame.seq <= seq or frame.time_ns <= time_ns:
            raise ValueError(
                f"frame {frame.seq} at {frame.time_ns} ns is not after frame {seq} at {time_ns} ns"
            )
        self._last = frame.seq, int(frame.time_ns)
        return self.skip(frame.seq, frame.time_ns, frame.prior) or self.track(frame)

    def skip(self, seq: int, time_ns: int, prior: PosePrior) -> tuple[Event, ...]:
        """A frame that need not be seen: what is done by now, and the frame's event; nothing for
        one that :meth:`track` must take."""
        frames_per_step = self.views.selection.frames_per_step
        if not self.odometry.can_skip(time_ns, prior, frames_per_step):
            return ()  # frames are followed as fast as images move
        self.views.pass_over(time_ns)
        skipped = Frame(NO_IMAGE, time_ns, seq, prior, segment=self.odometry.segment)
        return (*self._finished(), FramePosed(skipped))

    def track(self, frame: Frame) -> tuple[Event, ...]:
        """One frame: where the camera is, and which views have their partners by now. Raises
        ValueError when the image is not of the camera model's size."""
        undistorted = self.undistort(frame)  # section 2.1
        *late, tracked = self.locate(undistorted)  # Harris and ZSSD (Eq. 4-5), EPnP (Eq. 6-7)
        placed = [self._posed(still, self.views.take(still)) for still in late]
        is_view = self.views.take(tracked)  # virtual stereo, 2.3
        if tracked.is_placed:
            for view in self.views.ready():
                self._worker.offer(view)  # to be reconstructed
            if self._first_stereo is not None and self._worker.is_free:
                first = self.views.first()
                if first is not None:
                    self._worker.offer(first)
        done = tuple(self._finished())  # while vision is lost, too
        return (*placed, *done, self._posed(tracked, is_view))

    def _posed(self, frame: Frame, is_view: bool) -> FramePosed:
        return FramePosed(frame.without_images(), self.frame_poses.place(frame), is_view)

    def locate(self, frame: Frame) -> list[Frame]:
        """The frame with its pose by the odometry, or why there is none; before it the last one,
        where that was lost until now."""
        with self._timing("track"):
            *late, tracked = self.odometry.track(frame)
        self.refused -= Counter(still.reason for still in late)  # as they were counted when lost
        if tracked.state is Tracking.WAITING:
            self._waiting[tracked.reason] += 1
        elif not tracked.is_placed:
            self.refused[tracked.reason] += 1
        else:
            if tracked.state is Tracking.STARTED:  # the segment before never began
                self.refused.update(self._waiting)
            self._waiting.clear()
        return [*late, tracked]

    def is_settled(self, frame: Frame) -> bool:
        """True when the odometry no longer adjusts the frame's reference keyframe."""
        key, window = frame.reference, self.odometry.keyframes
        if key is None or key.segment != self.odometry.segment or not window:
            return True
        return key.seq < window[0].seq

    def reconstruct(self, view: StereoView) -> Callable[[], Reconstructed]:
        """One view: its depth from all its partners. What is returned finds its pose and its new
        surface."""
        if view.is_first_depth:
            return self._first_depth(view)
        if self.debug is not None:
            self.debug.clear()
        depth, bgr = self.stereo(view)  # virtual stereo pairs, section 2.1; Eq. 1 to 3
        seen = None if depth is None else without_false_surface(view, depth, bgr)
        self.stereo.learn(seen)  # how far the relief of the next pairs may reach
        return partial(self._place, view, seen, bgr, is_matched=depth is not None)

    def _place(
        self, view: StereoView, depth: DepthMap | None, bgr: U8, is_matched: bool
    ) -> Reconstructed:
        """The pose of a view, and its new surface."""
        segment = self.keyframe_map.graph.segments[view.segment]
        if is_matched and not segment.judge(depth is not None):
            self.rejected[
                CONTRADICTED if depth is None else f"{CONTRADICTED} in earlier views"
            ] += 1
            depth = None
        pose = self.keyframe_map.add(view, depth)  # ICP onto the keyframe before, pose graph
        if depth is None:
            return pose, ()
        is_plausible = self.keyframe_map.publish(view.seq, pose)
        changed = PosesChanged(self.keyframe_map.trajectory.moved())
        if not is_plausible:
            return pose, (changed,)
        with self._timing("map"):  # what is new
            T_odom = self.keyframe_map.trajectory.odom_pose(view.seq)
            depth, fresh = self.surface(view.seq, view.segment, depth, view.rows_share, T_odom)
            bgr = self.gains(view.segment, depth, bgr)  # as bright as the map
        keyframe = keyframe_of(view, depth, bgr, fresh, pose)
        if self.debug is not None:
            metric = keyframe.depth
            self.debug |= {"depth_m": metric.depth_m, "sigma_m": metric.sigma_m, "bgr": bgr}
        self.keyframe_map.add_surface(view, keyframe)
        return pose, (KeyframeReady(keyframe, stages=dict(self.debug or {})), changed)

    def _first_depth(self, view: StereoView) -> Callable[[], Reconstructed]:
        """The new surface that the view's only partner shows, ahead of its whole depth, of which it
        changes nothing; none where it shows none.

        New ground is in no earlier image, so that the partner is a later frame.
        """
        assert self._first_stereo is not None
        with self._timing("first depth"):
            depth, bgr = self._first_stereo(view)
            if depth is not None:
                depth = without_false_surface(view, depth, bgr)
            self._first_stereo.learn(depth)
        return partial(self._place_first, view, depth, bgr)

    def _place_first(self, view: StereoView, depth: DepthMap | None, bgr: U8) -> Reconstructed:
        predicted = self.keyframe_map.predicted(view)
        if predicted is None or depth is None:
            return None, ()
        if self.keyframe_map.graph.segments[view.segment].agreement < 0:
            return None, ()
        T_odom, pose = predicted
        depth, fresh = self.surface.peek(depth, view.rows_share, T_odom)
        first = keyframe_of(view, depth, self.gains.level(bgr), fresh, pose)
        return None, (KeyframeReady(first, is_first_depth=True),)

    def drain(self) -> tuple[Event, ...]:
        """The views still waiting for partners, up to one whose work failed."""
        self.views.end_segment()
        for view in self.views.ready(everything=True):
            self._worker.offer(view)
        return tuple(self._finished(everything=True))

    def finish(self) -> tuple[Event, ...]:
        """The remaining results, and the last corrections. Raises what work raised."""
        try:
            events = self.drain()
        finally:
            self._worker.close()
            self.reset_map()
        self.frame_poses.finish()
        return (*events, *self._changed(self.keyframe_map.trajectory.moved(final=True)))

    def _finished(self, everything: bool = False) -> Iterator[Event]:
        for view, (pose, events) in self._worker.finished(everything):
            if pose is not None:
                self.frame_poses.add_view(view.frame, pose)
            for event in events:
                if isinstance(event, PosesChanged):
                    yield from self._changed(event.poses)
                    continue
                if isinstance(event, KeyframeReady) and not event.is_first_depth:
                    self._ready.add(view.seq)
                    if self._kept is not None:
                        self._kept[view.seq] = event.keyframe
                yield event
        self.frame_poses.settle()

    def _changed(self, poses: Mapping[int, Pose]) -> Iterator[PosesChanged]:
        # A view whose work was broken off is in the graph, and no keyframe.
        poses = {seq: pose for seq, pose in poses.items() if seq in self._ready}
        if not poses:
            return
        if self._kept is not None:
            self._kept |= {seq: moved(self._kept[seq], pose) for seq, pose in poses.items()}
        yield PosesChanged(poses)

    # ---- in flight ---------------------------------------------------------------------

    def set_spacing(self, spacing: tuple[float, int]) -> None:
        """Space views otherwise from the next frame on, as :class:`MapperConfig` says."""
        self.views.selection.spacing = spacing
        self.stereo.change(min_base_to_height=self.views.selection.min_base_to_height)

    def set_effort(self, pairs: int, stereo_width_px: int, upsample: bool) -> None:
        """Apply these from the next view on."""
        self.views.selection.max_partners = pairs
        self.stereo.change(width_px=stereo_width_px, guided=upsample)
        if self._first_stereo is not None:
            self._first_stereo.change(width_px=stereo_width_px // COARSER)

    def take_next(self) -> None:
        """Make the next frame with a pose a view, whatever the baseline asks for."""
        self.views.selection.takes_next = True

    def reset_map(self) -> None:
        """Reset the map: all surface counts as unseen."""
        self.surface.clear()

    # ---- results -----------------------------------------------------------------------

    def cloud(self, voxel_m: float | None = None) -> PointCloud:
        """All keyframes fused, in voxels as fine as the images unless ``voxel_m`` is given. Raises
        ValueError for a mapper that does not keep its cloud."""
        if self._kept is None:
            raise ValueError("this mapper was made with keeps_cloud=False")
        out = [*self.keyframe_map.apart(), *self.keyframe_map.false()]
        kept = [k for seq, k in self._kept.items() if not any(a <= seq <= b for a, b in out)]
        sizes = [size for k in kept if (size := ground_sample_m(k.depth)) is not None]
        fine = voxel_m or min(sizes, default=1.0)
        return fuse((cloud_of(k.depth, k.bgr, k.fresh, k.time_ns) for k in kept), fine)

    @property
    def segments(self) -> int:
        return self.odometry.segment + 1

    @property
    def pairs(self) -> int:
        return self.stereo.pairs

    def refusals(self) -> Counter[str]:
        return self.refused + self.rejected + self._waiting


def moved(keyframe: Keyframe, pose: Pose) -> Keyframe:
    """The keyframe at another pose, its depth by the scale there."""
    depth = keyframe.depth.scaled(pose.scale / keyframe.pose.scale, pose.T_world_camera)
    return replace(keyframe, depth=depth, pose=pose)
