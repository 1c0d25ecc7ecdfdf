"""The map: where its keyframes are, and frames by them, and which surface is known by them."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from recon import se3
from recon.backends import Backend
from recon.mapping.disagreement import Disagreement
from recon.mapping.registration import IcpConfig, agreed_motion
from recon.mapping.voxel_map import VoxelMap
from recon.pipeline.stages import Timing
from recon.pipeline.views import StereoView
from recon.posegraph.ground import MAX_LEVELLED_SHARE, height_above, height_below, levelled
from recon.posegraph.loop_closure import LoopSearch
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.pose_priors import dead_reckoned
from recon.posegraph.records import Node
from recon.posegraph.trajectory import Trajectory, carried
from recon.stereo.reprojection import known_where
from recon.tracking.frame import Frame, Tracking
from recon.types import F32, F64, Bool, DepthMap, Keyframe, Pose, PosePrior, Verdict

FARTHEST_M = 1e6  # maximum distance from the scan's origin


class KeyframeMap:
    """Places keyframes in the world. It belongs to who reconstructs, until all is done.

    The keyframes of a segment are a *chain*: the odometry's steps from one to the next, each
    refined by ICP. It has the odometry's frame and unit, and the graph takes its poses.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        loops: LoopSearch | None,
        backend: Backend,
        rejected: Counter[str],
        timing: Timing,
    ) -> None:
        self.trajectory, self._loops = trajectory, loops
        self._backend, self._icp = backend, IcpConfig()
        self._levelled = 0  # keyframes whose ground is taken as level
        self._rejected, self._timing = rejected, timing
        self._newest = -1  # number of the last keyframe
        self._depth: DepthMap | None = None  # its depth
        self.verdicts: Counter[Verdict] = Counter()  # of ICP

    @property
    def graph(self) -> PoseGraph:
        return self.trajectory.graph

    @property
    def is_levelled(self) -> bool:
        """True when what is level follows from the ground: too many views are off the mount."""
        return self._levelled > MAX_LEVELLED_SHARE * self.graph.entered

    @property
    def held(self) -> dict[str, int]:
        """Views that are remembered for loops, and keyframes in the graph."""
        views = 0 if self._loops is None else len(self._loops)
        return {"loop_views": views, "graph_keyframes": len(self.graph)}

    def add(self, view: StereoView, depth: DepthMap | None) -> Pose:
        """Append a view, by vision and by ICP of its depth onto that of the keyframe before, and
        look for loops; its pose."""
        T_odom, (step, covariance) = view.image.T_odom_camera, self._step(view, depth)
        T_chain = T_odom if step is None else self.trajectory.odom_pose(self._newest) @ step
        up = T_odom[2, :3]
        height, slant = height_below(depth, up) if depth is not None else None, 0.0
        if height is None:
            height, slant = height_above(view.points, up) or (None, 0.0)
        prior = levelled(view.frame.prior, view.points)
        self._newest, self._depth = view.seq, depth
        self._levelled += prior is not view.frame.prior
        time_ns = view.frame.time_ns
        self.trajectory.add(
            Node(view.seq, time_ns, view.segment, T_chain, covariance, prior, height, slant)
        )
        if depth is not None and self._loops is not None:
            with self._timing("loops"):
                self._loops.add(view.seq, view.segment, view.image.gray, view.image.K, depth)
        return self.trajectory.pose(view.seq)

    def publish(self, seq: int, pose: Pose) -> bool:
        """Note a keyframe's pose as published; False for one impossibly far away, which is not."""
        if not np.abs(pose.T_world_camera[:3, 3]).max() < FARTHEST_M:
            self._rejected["placed impossibly far away"] += 1
            return False
        self.trajectory.publish(seq, pose)
        return True

    def _step(self, view: StereoView, depth: DepthMap | None) -> tuple[F64 | None, F64]:
        """The step (4, 4) from the keyframe before, None where its chain begins, and its covariance
        (6, 6): vision's and ICP's, weighted by covariance; vision's alone where ICP contradicts it.
        ICP makes it no surer: vision's motion of the same images gave the depth that it aligns.

        Lengths are in units of the odometry, the covariance of a left perturbation in the frame of
        the camera before; without a step, of the pose itself.
        """
        covariance = view.covariance + np.diag([1e-4**2] * 3 + [0.005**2] * 3)
        T_before = view.earlier.get(self._newest)
        if T_before is None:
            return None, covariance
        step = se3.inverse(T_before) @ view.image.T_odom_camera
        covariance = se3.left_covariance(step, covariance)
        if depth is None or self._depth is None:
            return step, covariance
        with self._timing("icp"):
            found = self._backend.register(depth, self._depth, step, self._icp)
        self.verdicts[found.verdict] += 1
        agreed = agreed_motion(step, covariance, found)
        return step if agreed is None else agreed[0], covariance

    def predicted(self, view: StereoView) -> tuple[F64, Pose] | None:
        """A view that is not added yet: T_odom_camera (4, 4) in its segment's chain, and its pose
        in the world. None without a keyframe before it that has a place there."""
        T_before = view.earlier.get(self._newest)
        if T_before is None or self.graph.segments[view.segment].similarity is None:
            return None
        step = se3.inverse(T_before) @ view.image.T_odom_camera
        T_chain = self.trajectory.odom_pose(self._newest) @ step
        return T_chain, carried(self.trajectory.pose(self._newest), step)

    def add_surface(self, view: StereoView, keyframe: Keyframe) -> None:
        points = int(np.count_nonzero(keyframe.fresh & np.isfinite(keyframe.depth.depth_m)))
        self.graph.segments[view.segment].add_surface(view.seq, points, view.frame.prior)

    def apart(self) -> list[tuple[int, int]]:
        """First and last keyframe of each segment that nothing ties to the rest of the scan."""
        return self.graph.segments.apart(self.graph.loops)

    def false(self) -> list[tuple[int, int]]:
        """First and last keyframe of each step or segment in which vision is wrong, and its depth,
        too."""
        segments = [(one.surface[0], one.surface[-1]) for one in self.graph.segments.false()]
        return [*self.graph.refuted.items(), *segments]


class SurfaceMap:
    """Compares each view with the surface known before, and remembers it. :meth:`clear` may be
    called from another thread."""

    def __init__(
        self,
        placed: Callable[[Sequence[int]], F64],
        resolution_m: float = 0.0,
        new_map: Callable[[float], VoxelMap] = VoxelMap,
    ) -> None:
        """``placed`` as :meth:`recon.posegraph.trajectory.Trajectory.similarities`; ``new_map``
        makes the empty map of a scan."""
        self._resolution_m, self._new_map = resolution_m, new_map
        self.known: VoxelMap | None = None
        self._disagreement, self._segment = Disagreement(placed), -1

    def __call__(
        self, seq: int, segment: int, depth: DepthMap, rows_share: F32, T_odom_camera: F64
    ) -> tuple[DepthMap, Bool]:
        """(The depth in the odometry without what earlier views see through, (h, w) surface that is
        new or better). Its sigma holds disagreement of views and an unknown readout, not what all
        points share.

        ``rows_share`` (n, m), all over the image, is the sigma of depth over depth by the rows'
        motion.
        """
        if segment != self._segment:
            self._disagreement.forget()
            self._segment = segment
        in_odom = self._in_odom(depth, rows_share, T_odom_camera)
        factor = np.float32(self._disagreement.take(seq, in_odom))
        in_odom = replace(in_odom, sigma_m=in_odom.sigma_m * factor)
        in_odom = known_where(in_odom, ~self._disagreement.refuted(seq, in_odom))
        known = self.known
        if known is None:
            ground_m = float(np.nanmedian(depth.depth_m)) / depth.K[0, 0]
            known = self._new_map(max(2.0 * ground_m, self._resolution_m, 1e-3))
            self.known = known
        fresh = known.fresh(in_odom)
        known.insert(in_odom, fresh)
        return in_odom, fresh

    def peek(self, depth: DepthMap, rows_share: F32, T_odom_camera: F64) -> tuple[DepthMap, Bool]:
        """As :meth:`__call__`, of a depth that is not remembered and shows no disagreement."""
        in_odom = self._in_odom(depth, rows_share, T_odom_camera)
        known = self.known  # another thread may clear it meanwhile
        fresh = np.isfinite(depth.depth_m) if known is None else known.fresh(in_odom)
        return in_odom, fresh

    def _in_odom(self, depth: DepthMap, rows_share: F32, T_odom_camera: F64) -> DepthMap:
        """The depth at its place, its sigma widened by what its rows limit."""
        share = cv2.resize(rows_share, depth.depth_m.shape[::-1])
        sigma_m = np.hypot(depth.sigma_m, share * depth.depth_m)
        return replace(depth, sigma_m=sigma_m, T_world_camera=T_odom_camera)

    def clear(self) -> None:
        known, self.known = self.known, None
        if known is not None:
            known.close()


class FramePoses:
    """Places frames by the pose of the newest view, so that they never wait for the graph; by the
    graph itself after :meth:`finish`."""

    def __init__(self, keyframes: KeyframeMap, is_settled: Callable[[Frame], bool]) -> None:
        """``is_settled`` marks frames whose reference keyframe is no longer adjusted."""
        self._map, self._is_settled = keyframes, is_settled
        self._views: list[Frame] = []  # reconstructed, in order
        self._settled = 0  # the first so many no longer change
        # By segment, of its last frame with a fix: place in the odometry, fix, sigma, sources.
        self._fallbacks: dict[int, tuple[F64, F64, F64, tuple[str, ...]]] = {}
        self._seen: tuple[PosePrior, Pose] | None = None  # the last frame placed by vision
        self._newest: Pose | None = None  # of a view; None again once all is done

    def add_view(self, view: Frame, pose: Pose) -> None:
        """Let a view that is in the graph, at a pose, carry frames from now on."""
        self._views.append(view)
        self._newest = pose

    def settle(self) -> None:
        """Release the keyframes that no longer change."""
        for i in range(self._settled, len(self._views)):
            if not self._is_settled(self._views[i]):
                return
            self._views[i] = self._views[i].settled()
            self._settled += 1

    def finish(self) -> None:
        """Place frames by the whole graph from now on, all of them again in the order of time."""
        self._newest = self._seen = None
        self._fallbacks.clear()

    def place(self, frame: Frame) -> Pose | None:
        """A new frame in the world, by vision or else by telemetry; None where neither tells."""
        if not frame.is_placed:
            return self._by_telemetry(frame.prior) if frame.state is Tracking.LOST else None
        pose = self._by_vision(frame, self._fallback(frame))
        self._seen = frame.prior, pose
        return pose

    def _fallback(self, frame: Frame) -> Pose:
        """A frame that no keyframe carries: turned as the odometry has it, at its fix, or as far
        from the last one as the odometry has it. Heading and scale of the odometry are not known:
        the sigma grows by the way."""
        at_m, prior = frame.T_odom_camera[:3, 3], frame.prior
        fix, sigma = prior.position_m, prior.sigma_position_m
        if fix is not None and sigma is not None:
            self._fallbacks[frame.segment] = at_m, fix, sigma, ("gnss",)
        start = at_m, at_m, np.ones(3), ("vision",)
        from_m, place_m, sigma_m, sources = self._fallbacks.setdefault(frame.segment, start)
        way_m = at_m - from_m
        sigma_m = np.hypot(sigma_m, np.linalg.norm(way_m))
        T = se3.compose(frame.T_odom_camera[:3, :3], place_m + way_m)
        covariance = se3.about(-T[:3, 3], np.diag(np.r_[np.ones(3), np.square(sigma_m)]))
        return Pose(T, covariance, sources, is_aligned=False)

    def _by_vision(self, frame: Frame, fallback: Pose) -> Pose:
        """A frame carried by the view at or before it where it can. A segment too short to be
        aligned has no scale and no heading: its frames stay at their fixes."""
        view = self._view_of(frame)
        if view is None:
            return fallback
        # In flight no other view than the newest carries a new frame.
        known = self._newest or self._map.trajectory.pose(view.seq)
        if "gnss" in self._fallbacks[frame.segment][3] and not known.is_aligned:
            return fallback
        pose = carried(known, se3.inverse(view.T_odom_camera) @ frame.T_odom_camera)
        after = self._map.graph.refuted.get(view.seq) if self._newest is None else None
        return pose if after is None else self._doubted(pose, view.seq, after)

    def _view_of(self, frame: Frame) -> Frame | None:
        """The view at or before a frame, or its segment's first; None without any."""
        after = bisect_right(self._views, frame.seq, key=lambda view: view.seq)
        for view in self._views[max(after - 1, 0) : after + 1]:
            if view.segment == frame.segment:
                return view
        return None

    def _doubted(self, pose: Pose, before: int, after: int) -> Pose:
        """A frame between two keyframes where vision is wrong: as unsure as its step is long."""
        step_m = self._map.trajectory.step_between(before, after)[:3, 3]
        spread = np.diag(np.r_[np.ones(3), np.full(3, float(step_m @ step_m))])
        about = se3.about(-pose.T_world_camera[:3, 3], spread)
        return replace(pose, covariance=pose.covariance + about)

    def _by_telemetry(self, prior: PosePrior) -> Pose | None:
        """A lost frame where telemetry alone says the camera is; None without attitude, heading
        or position.

        Telemetry's error when vision was lost is subtracted, so that the track continues.
        """
        R, position, sigma = prior.R_world_camera, prior.position_m, prior.sigma_position_m
        if R is None or position is None or sigma is None or prior.sigma_yaw_rad > 1.0:
            return None
        T = se3.compose(R, position)
        if self._seen is not None:
            before, seen = self._seen
            if seen.is_aligned:
                T = dead_reckoned(before, prior, seen.T_world_camera, None, 0.0)
        tilt, yaw = prior.sigma_tilt_rad, prior.sigma_yaw_rad
        covariance = se3.about(-T[:3, 3], np.diag(np.square([tilt, tilt, yaw, *sigma])))
        return Pose(T, covariance, ("attitude", "gnss", "dead reckoning"))
