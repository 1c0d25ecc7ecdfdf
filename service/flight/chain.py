"""The chain of keyframes: the pose graph, loops, and the frames that keyframes carry."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from recon import se3
from recon.posegraph.anchors import height_above, height_below
from recon.posegraph.between_keyframes import carried
from recon.posegraph.level_ground import MAX_LEVELLED_SHARE, levelled
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.segment_frames import SegmentFrames
from recon.posegraph.trajectory import Placed, Trajectory
from recon.tracking.odometry import Tracked, Tracking
from recon.types import F64, DepthMap, Keyframe, PosePrior
from service.flight.anchorage import Anchorage, Carriers, Key
from service.flight.loops import LoopSearch
from service.flight.reports import GraphWatch
from service.flight.viewpoints import StereoCandidate, UndistortedFrame
from service.progress import Stopwatch
from service.stream.records import Repose

FARTHEST_M = 1e6
"""Maximum distance from the scan's origin."""

HEADING_KNOWN_RAD = 1.0

HEIGHT_KNOWN_M, HEIGHTS_AGREE_M = 20.0, 5.0
"""Sigma of a fix's height below which it lays two stretches of one flight on each other, and of one
stretch's height against the other's."""

SCALE_KNOWN = 0.2
"""Sigma of a stretch's scale, by its fixes, below which they lay it on another: depths of unknown
length are no surface beside others."""


class KeyframeStep(NamedTuple):
    """The step of the camera from the keyframe before, in units of the odometry."""

    T_before_camera: F64 | None  # (4, 4); None where the chain begins again
    covariance: F64  # (6, 6) left perturbation; of the pose itself where the chain begins


class Uncarried(NamedTuple):
    """Where a frame is as long as no keyframe carries it."""

    place_m: F64  # (3,) in the world
    sigma_m: F64  # (3,)
    sources: tuple[str, ...] = ("vision",)


class News(NamedTuple):
    """The graph's answer once a view is in it."""

    placed: Placed  # the view in the world
    is_aligned: bool  # its segment has a frame in the world
    reposes: tuple[Repose, ...]  # keyframes published before whose pose is better now
    doubts: list[str]  # what the operator must know of the telemetry


class Chain:
    """Places keyframes in the world, and frames by them.

    :meth:`add` and :meth:`map_pose` belong to the thread that reconstructs, which alone knows the
    trajectory until all is done; the rest belongs to the thread that tracks, which goes by the
    :class:`News` of the newest view and so never waits for the graph.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        loops: LoopSearch | None,
        is_settled: Callable[[Key], bool],
        rejected: Counter[str],
        stopwatch: Stopwatch,
    ) -> None:
        """``is_settled`` marks keyframes that the odometry no longer adjusts."""
        self.trajectory, self.watch = trajectory, GraphWatch(trajectory.graph)
        self._loops = loops
        self.views = self.levelled = 0  # keyframes, and those whose ground is taken as level
        self._carriers, self._is_settled = Carriers(), is_settled
        self._known: dict[int, tuple[F64, Uncarried]] = {}  # by segment, its last frame with a fix
        self._rejected, self._stopwatch = rejected, stopwatch
        self._pieces = Pieces()
        self._T_map = np.eye(4)  # of the last keyframe
        self._seen: tuple[PosePrior, Placed, int] | None = None  # the last frame placed by vision
        self._news: dict[int, News] = {}  # by view, from thread to thread
        self._newest: Placed | None = None  # view of the chain; None again once all is done
        self._aligned = -1  # the newest segment that has a frame in the world
        self._reposes: list[Repose] = []
        self._doubts: list[str] = []

    @property
    def graph(self) -> PoseGraph:
        """That places the keyframes."""
        return self.trajectory.graph

    @property
    def is_levelled(self) -> bool:
        """True when what is level follows from the ground: too many views are off the mount."""
        return self.levelled > MAX_LEVELLED_SHARE * self.views

    @property
    def held(self) -> dict[str, int]:
        """Views that are remembered for loops, and keyframes in the graph."""
        views = 0 if self._loops is None else len(self._loops)
        return {"loop_views": views, "graph_keyframes": len(self.graph)}

    # ---- keyframes ---------------------------------------------------------------------

    def add(
        self, view: StereoCandidate, motion: KeyframeStep, depth: DepthMap | None
    ) -> Placed | None:
        """Append a view and look for loops; None without depth, or at an impossible distance."""
        T_odom, step = view.view.T_odom_camera, motion.T_before_camera
        self._T_map = T_odom if step is None else self._T_map @ step
        up = T_odom[2, :3]
        below = height_below(depth, up) if depth is not None else None
        height = (below, 0.0) if below is not None else height_above(view.points, up)
        prior = levelled(view.prior, view.points)
        self.views += 1
        self.levelled += prior is not view.prior
        self.trajectory.add(
            view.seq, view.segment, self._T_map, prior, height, view.time_ns, motion.covariance,
        )  # fmt: skip
        if depth is not None and self._loops is not None:
            with self._stopwatch("loops"):
                self._loops.look(view.seq, view.segment, view.view.gray, view.view.K, depth)
        placed = self.trajectory.place(view.seq)
        is_near = bool(np.abs(placed.T_world_camera[:3, 3]).max() < FARTHEST_M)
        if depth is not None and is_near:
            self.trajectory.publish(placed)
        elif depth is not None:
            self._rejected["placed impossibly far away"] += 1
        self._news[view.seq] = News(
            placed, self.graph.segments.known(view.segment) is not None,
            self._moved() if depth is not None else (), self.watch.look(),
        )  # fmt: skip
        return placed if depth is not None and is_near else None

    def _moved(self, final: bool = False) -> tuple[Repose, ...]:
        """Corrections of keyframes published before, which count as published from now on."""
        moved = [
            (placed, *self.trajectory.publish(placed)) for placed in self.trajectory.moved(final)
        ]
        return tuple(
            Repose(placed.seq, revision, placed.T_world_camera, growth, placed.covariance)
            for placed, revision, growth in moved
        )

    def map_pose(self, seq: int) -> F64:
        """(4, 4) T_map_camera of a keyframe in its segment's chain."""
        return self.trajectory.map_pose(seq)

    def reconstructed(self, view: StereoCandidate, keyframe: Keyframe | None) -> None:
        """Let a view of the chain carry frames from now on."""
        self._carriers.add(view.anchor)
        news = self._news.pop(view.seq)
        self._newest = news.placed
        self._aligned = view.segment if news.is_aligned else self._aligned
        self._reposes += news.reposes
        self._doubts += news.doubts
        if keyframe is not None:
            points = int(np.count_nonzero(keyframe.fresh & np.isfinite(keyframe.depth.depth_m)))
            self._pieces.add(keyframe.seq, view.segment, points, view.prior)

    def settle(self) -> None:
        """Drop the data of keyframes that the odometry no longer adjusts."""
        self._carriers.settle(self._is_settled)

    def corrections(self, final: bool = False) -> tuple[Repose, ...]:
        """Keyframes published before whose pose is better now; call with ``final`` once all is
        reconstructed, to solve the graph once more."""
        out, self._reposes = tuple(self._reposes), []
        if final:
            self._newest = None
            out += self._moved(final)
        return out

    def new_doubts(self) -> list[str]:
        """Warnings about the telemetry, each once."""
        out, self._doubts = self._doubts, []
        return out

    def apart(self) -> list[tuple[int, int]]:
        """First and last keyframe of each stretch that nothing ties to the rest of the scan."""
        return self._pieces.apart(self.graph)

    def refuted(self) -> list[tuple[int, int]]:
        """Keyframes between which vision is wrong, so that their depth is, too."""
        return list(self.graph.refuted.items())

    # ---- frames ------------------------------------------------------------------------

    def follow(self, image: UndistortedFrame, anchor: Anchorage) -> Placed:
        """A tracked frame in the world."""
        placed = self.place(anchor, self._uncarried(image.prior, anchor))
        self._seen = image.prior, placed, anchor.key.segment
        return placed

    def _uncarried(self, prior: PosePrior, anchor: Anchorage) -> Uncarried:
        """A frame at its fix, or as far from the last one as the odometry has it.

        Heading and scale of the odometry are not known: the sigma grows by the way.
        """
        at_m, fix, sigma = anchor.T_odom_camera[:3, 3], prior.position_m, prior.sigma_position_m
        if fix is not None and sigma is not None:
            self._known[anchor.key.segment] = at_m, Uncarried(fix, sigma, ("gnss",))
        start = at_m, Uncarried(at_m, np.ones(3))
        from_m, known = self._known.setdefault(anchor.key.segment, start)
        way_m = at_m - from_m
        sigma_m = np.hypot(known.sigma_m, np.linalg.norm(way_m))
        return Uncarried(known.place_m + way_m, sigma_m, known.sources)

    def _has_fix(self, segment: int) -> bool:
        return segment in self._known and "gnss" in self._known[segment][1].sources

    def _is_aligned(self, segment: int) -> bool:
        """True when the segment has a frame in the world; in flight, of the newest one."""
        if self._newest is not None:
            return segment == self._aligned
        return self.graph.segments.known(segment) is not None

    def place(self, anchor: Anchorage, uncarried: Uncarried) -> Placed:
        """A frame in the world, carried by the chain's keyframe at or before it where it can.

        A segment too short to be aligned has no scale and no heading: its frames stay at their
        fixes.
        """
        T_odom_camera, segment = anchor.T_odom_camera, anchor.key.segment
        carrier = self._carriers.of(anchor)
        if carrier is None or (self._has_fix(segment) and not self._is_aligned(segment)):
            place_m, sigma_m, sources = uncarried
            T = se3.compose(T_odom_camera[:3, :3], place_m)
            covariance = se3.about(-place_m, np.diag(np.r_[np.ones(3), np.square(sigma_m)]))
            return Placed(anchor.key.seq, T, 1.0, covariance, sources)
        # In flight no other view than the newest carries a new frame.
        known = self._newest or self.trajectory.place(carrier.seq)
        moved = se3.inverse(carrier.T_odom_camera) @ T_odom_camera
        placed = known.carry(moved)
        after = self.graph.refuted.get(carrier.seq) if self._newest is None else None
        return placed if after is None else self._doubted(placed, carrier.seq, after)

    def _doubted(self, placed: Placed, before: int, after: int) -> Placed:
        """A frame between two keyframes where vision is wrong: as unsure as its step is long."""
        step_m = self.trajectory.step_between(before, after)[:3, 3]
        spread = np.diag(np.r_[np.ones(3), np.full(3, float(step_m @ step_m))])
        about = se3.about(-placed.T_world_camera[:3, 3], spread)
        return replace(placed, covariance=placed.covariance + about)

    def by_telemetry(self, image: UndistortedFrame, tracked: Tracked) -> Placed | None:
        """A lost frame where telemetry alone says the camera is; None without attitude, heading
        or position.

        Telemetry's error when vision was lost is subtracted, so that the track continues.
        """
        prior = image.prior
        R, position, sigma = prior.R_world_camera, prior.position_m, prior.sigma_position_m
        if tracked.state is not Tracking.LOST or R is None or position is None or sigma is None:
            return None
        if prior.sigma_yaw_rad > 1.0:
            return None
        T = se3.compose(R, position)
        if self._seen is not None:
            before, seen, segment = self._seen
            if segment == self._aligned:
                T = carried(before, prior, seen.T_world_camera, None, 0.0)
        tilt, yaw = prior.sigma_tilt_rad, prior.sigma_yaw_rad
        covariance = se3.about(-T[:3, 3], np.diag(np.square([tilt, tilt, yaw, *sigma])))
        return Placed(image.seq, T, 1.0, covariance, ("attitude", "gnss", "dead reckoning"))


class Pieces:
    """The segments of one scan with their keyframes, and which telemetry places in the world."""

    def __init__(self) -> None:
        self._stretches: list[list[int]] = []  # each segment with its first and last keyframe
        self._points: Counter[int] = Counter()  # by segment
        self._placed: set[int] = set()  # by a fix and a heading of their own

    def add(self, seq: int, segment: int, points: int, prior: PosePrior) -> None:
        """Take the next keyframe with surface."""
        if not self._stretches or self._stretches[-1][0] != segment:
            self._stretches.append([segment, seq, seq])
        self._stretches[-1][2] = seq
        self._points[segment] += points
        sigma = prior.sigma_position_m
        is_known = sigma is not None and sigma[2] < HEIGHT_KNOWN_M
        if is_known and prior.sigma_yaw_rad < HEADING_KNOWN_RAD:
            self._placed.add(segment)

    def apart(self, graph: PoseGraph) -> list[tuple[int, int]]:
        """First and last keyframe of the segments that nothing ties to the scan's main piece.

        The main piece is the one that fixes place; without fixes, that with most points.
        """
        piece, frames = {segment: segment for segment, _, _ in self._stretches}, graph.segments
        looped: set[int | None] = set()
        for loop in graph.loops.taken:
            a, b = (self._segment_of(seq) for seq in loop.ends)
            if a is not None and b is not None:
                _join(piece, a, b)
                looped |= {a, b}
        heights = {s: sigma for s in piece if (sigma := _sigma_height_m(frames, s)) is not None}
        unsure = {s for s, sigma in heights.items() if sigma > HEIGHT_KNOWN_M}
        of_any_size = {s for s in heights if not _is_scaled(frames, s)}
        loose = {s for s in unsure if not _agrees(frames, s)} | of_any_size
        placed = self._placed - of_any_size
        fixed = [s for s in piece if s in placed or s in heights.keys() - loose]
        for segment in fixed[1:]:
            _join(piece, fixed[0], segment)
        if fixed:
            main = piece[fixed[0]]
        else:
            sizes: Counter[int] = Counter()
            for segment, points in self._points.items():
                sizes[piece[segment]] += points
            main = sizes.most_common(1)[0][0] if sizes else -1
        return [
            (first, last)
            for segment, first, last in self._stretches
            # A long flight forgets loops, and not which segments they tied.
            if piece[segment] != main
            and (segment in looped or segment in loose or not frames.is_tied(segment))
        ]

    def _segment_of(self, seq: int) -> int | None:
        at = bisect_right(self._stretches, seq, key=lambda one: one[1]) - 1
        return self._stretches[at][0] if at >= 0 else None


def _sigma_height_m(frames: SegmentFrames, segment: int) -> float | None:
    """Sigma of the height at which fixes place a segment; None where they do not."""
    found = frames.known(segment)
    if found is None or "gnss" not in found.sources:
        return None
    return float(np.sqrt(found.covariance[5, 5]))


def _agrees(frames: SegmentFrames, segment: int) -> bool:
    """True when the height is known against the largest segment's: what all fixes of a flight err
    by lays none on another."""
    sigma_m = frames.sigma_height_m(segment)
    return sigma_m is not None and sigma_m < HEIGHTS_AGREE_M


def _is_scaled(frames: SegmentFrames, segment: int) -> bool:
    """True for segments of a known scale, and for the largest, which the others are laid on."""
    found = frames.known(segment)
    assert found is not None
    return found is frames.largest() or found.sigma_scale < SCALE_KNOWN


def _join(piece: dict[int, int], a: int, b: int) -> None:
    """Make one piece of those that segments ``a`` and ``b`` are in."""
    old, new = piece[b], piece[a]
    for segment, name in piece.items():
        if name == old:
            piece[segment] = new
