"""Segments of the track, and the similarity from each one's odometry to the world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from recon import se3
from recon.posegraph import alignment
from recon.posegraph.alignment import Scale, Similarity
from recon.posegraph.alignment_readings import ReadingNoise
from recon.posegraph.anchors import GUESSED_SHARE, Anchor, guessed_at
from recon.posegraph.between_keyframes import at_camera
from recon.posegraph.records import Node, PoseGraphConfig
from recon.posegraph.sensor_offsets import Constants, Offsets, constants, offsets
from recon.types import F64, PosePrior

REFIT_GROWTH, SETTLED_GROWTH = 1.3, 1.6
"""A segment's similarity is fitted again when its keyframes have grown by so much: at first,
and once it has settled."""

SETTLED = 100
"""Keyframes after which a segment's frame is taken over only when it has changed notably."""


class SegmentFrames:
    """Keyframes by segment, and each segment's similarity once telemetry or a loop gives it."""

    def __init__(self, config: PoseGraphConfig) -> None:
        self.nodes: dict[int, list[Node]] = {}
        self._least, self._wander_s = config.min_anchors, (config.fix_s, config.attitude_s)
        self._constants: dict[int, Constants] = {}  # that the frame was fitted with
        self._frames: dict[int, Similarity] = {}
        self._offsets: dict[int, Offsets] = {}
        self._seen: Counter[int] = Counter()  # keyframes of each segment, kept or not
        self._fitted: dict[int, int] = {}  # of which the frame was fitted
        self._tied: set[int] = set()  # placed by a loop

    def keep(self, node: Node) -> None:
        """Take a keyframe."""
        self.nodes.setdefault(node.segment, []).append(node)
        self._seen[node.segment] += 1

    def thin(self, nodes: Iterable[Node]) -> None:
        """Keep only these keyframes, and the data of their segments."""
        before, self.nodes = self.nodes, {}
        for node in nodes:
            self.nodes.setdefault(node.segment, []).append(node)
        for segment in before.keys() - self.nodes.keys():
            self.forget(segment)
            self._seen.pop(segment)

    def known(self, segment: int) -> Similarity | None:
        """The segment's similarity; None before telemetry or a loop gives it."""
        return self._frames.get(segment)

    def largest(self) -> Similarity | None:
        segment = self.largest_segment()
        return None if segment is None else self._frames[segment]

    def largest_segment(self) -> int | None:
        """The one with the most keyframes, of those that readings place where some do."""
        size = {s: (bool(f.sources), self._seen[s]) for s, f in self._frames.items()}
        return max(size, key=size.__getitem__, default=None)

    def frame(self, segment: int) -> Similarity:
        """The segment's similarity; until there is one, its own frame turned to the attitude."""
        if segment in self._frames:
            return self._frames[segment]
        first = self.nodes[segment][0]
        R = first.prior.R_world_camera
        turn = np.eye(3) if R is None else R @ first.T_odom_camera[:3, :3].T
        return Similarity(1.0, turn, np.zeros(3), np.eye(7))

    def freed(self, node: Node) -> Node:
        """The node without its sensors' constants, its fix brought to the camera."""
        prior = self.constants(node.segment).applied(node.prior)
        if node.segment in self._offsets:
            prior = self._frames[node.segment].common.applied(prior, node.time_ns * 1e-9)
            prior = self._offsets[node.segment].applied(prior, node.lean)
        prior = self.at_camera(replace(node, prior=prior))
        return node if prior is node.prior else replace(node, prior=prior)

    def at_camera(self, node: Node) -> PosePrior:
        """The node's prior, with its fix brought to where the camera is."""
        frame = self.frame(node.segment)
        return at_camera(node.prior, frame.R @ node.T_odom_camera[:3, :3], frame.scale)

    def constants(self, segment: int) -> Constants:
        """Constant errors of the sensors, as the segment's frame was fitted with."""
        return self._constants.get(segment, Constants())

    def noise(self, segment: int) -> ReadingNoise | None:
        """How the segment's fixes err; None before they were fitted."""
        frame = self._frames.get(segment)
        return None if frame is None else frame.noise

    def _usual_noise(self) -> ReadingNoise | None:
        """That of the fixes of the largest segment which shows it."""
        known = [s for s, f in self._frames.items() if f.noise and f.noise.horizontal]
        largest = max(known, key=self._seen.__getitem__, default=None)
        return None if largest is None else self.noise(largest)

    def sigma_height_m(self, segment: int) -> float | None:
        """Sigma of a segment's height against the largest one of known heights; None without."""
        known = {s: f.heights for s, f in self._frames.items() if f.heights is not None}
        if segment not in known:
            return None
        main = max(known, key=self._seen.__getitem__)
        return 0.0 if segment == main else known[segment].sigma_to(known[main])

    def rests_on_fixes(self, segment: int) -> bool:
        """True when positions place the segment."""
        frame = self._frames.get(segment)
        return frame is not None and "gnss" in frame.sources

    def is_tied(self, segment: int) -> bool:
        """True when a loop places the segment, or fixes that measure its scale."""
        is_scaled = self.frame(segment).sigma_scale < GUESSED_SHARE
        return segment in self._tied or (is_scaled and self.rests_on_fixes(segment))

    def tie(self, segment: int, scale: float, R: F64, t: F64) -> None:
        """Place a segment by a loop, for good."""
        frame = self._frames.get(segment)
        covariance = np.eye(7) if frame is None else frame.covariance
        sources = () if frame is None else frame.sources
        known = (one for one in self._frames.values() if one.sigma_fixes is not None)
        placed = Similarity(scale, R, t, covariance, sources)
        other = next(known, placed)  # one receiver places all that loops join
        self._frames[segment] = replace(
            placed, sigma_fixes=other.sigma_fixes, sigma_counted=other.sigma_counted
        )
        self._tied.add(segment)

    def forget(self, segment: int) -> None:
        """Count the segment as not placed."""
        for known in (self._frames, self._offsets, self._fitted, self._constants):
            known.pop(segment, None)
        self._tied.discard(segment)

    def refit(self, segment: int, pose: Callable[[int], F64]) -> bool:
        """True when the segment's frame was fitted again, which is due as the segment grows.

        ``pose`` gives the present pose of a key in the graph.
        """
        nodes, fitted = self.nodes[segment], self._fitted.get(segment, 0)
        growth = REFIT_GROWTH if fitted < SETTLED else SETTLED_GROWTH
        seen = self._seen[segment]
        if seen < max(self._least, int(growth * fitted)) or segment in self._tied:
            return False
        self._fitted[segment] = seen
        fresh = self._newest_constants()
        anchors = self._anchors(segment, fresh)
        found = alignment.fit(anchors, *self._wander_s, slow_share=fresh.datum.slow_share,
                              usual=self._usual_noise())  # fmt: skip
        if found is None:
            return False
        found = replace(found, bend_rad=_bend_rad(nodes))
        if "gnss" not in found.sources and nodes[0].key > 0:
            found = _kept_in_place(found, nodes[0], pose(nodes[0].key))
        if found.sigma_fixes is not None:
            most = np.array([np.inf, np.inf, fresh.datum.sigma_m])
            found = replace(found, sigma_fixes=np.minimum(found.sigma_fixes, most))
        before = self._frames.get(segment)
        is_settled = seen >= SETTLED and not fresh.differ(self.constants(segment))
        if before is not None and is_settled and not _differ(before, found, nodes):
            return False  # the graph itself follows such small changes
        self._frames[segment], self._constants[segment] = found, fresh
        freed = [replace(a, prior=found.common.applied(a.prior, a.time_s)) for a in anchors]
        self._offsets[segment] = offsets(freed, found)
        return True

    def _newest_constants(self) -> Constants:
        """By all segments: the sensors stay the same."""
        nodes = [n for segment in self.nodes.values() for n in segment]
        span_s = (nodes[-1].time_ns - nodes[0].time_ns) * 1e-9
        stretches = [
            ([n.T_odom_camera for n in segment], [n.prior for n in segment])
            for segment in self.nodes.values()
        ]
        return constants(stretches, span_s, *self._wander_s)

    def altitude_offset(self) -> float | None:
        """Altitude less world z over all placed keyframes; None without any."""
        apart = [
            n.prior.altitude_m - frame.pose(n.T_odom_camera)[2, 3]
            for segment, frame in self._frames.items()
            for n in self.nodes[segment]
            if n.prior.altitude_m is not None
        ]
        return float(np.median(apart)) if apart else None

    def largest_scales(self) -> tuple[Scale | None, Scale | None]:
        """The largest segment's scale by fixes alone and by heights alone."""
        segment = self.largest_segment()
        if segment is None:
            return None, None
        anchors = self._anchors(segment, self.constants(segment))
        return alignment.scales(anchors, self._frames[segment])

    def _anchors(self, segment: int, known: Constants) -> list[Anchor]:
        height_m = self._usual_height_m()
        return [
            Anchor(
                n.T_odom_camera, guessed_at(height_m, known.applied(n.prior)), n.height, n.lean,
                n.time_ns * 1e-9,
            )
            for n in self.nodes[segment]
        ]  # fmt: skip

    def _usual_height_m(self) -> float | None:
        """Height above ground of the largest segment, if its scale is measured."""
        segment = self.largest_segment()
        if segment is None or self._frames[segment].sigma_scale >= GUESSED_SHARE:
            return None
        heights = [n.height for n in self.nodes[segment] if n.height is not None]
        return self._frames[segment].scale * float(np.median(heights)) if heights else None


def _bend_rad(nodes: list[Node]) -> float:
    """Sigma of the turn of a segment's part against its mean, about each axis.

    A random walk of variance v from end to end has v / 6 about its mean.
    """
    return float(np.sqrt(sum(np.trace(n.covariance[:3, :3]) for n in nodes[1:]) / 18.0))


def _differ(before: Similarity, found: Similarity, nodes: list[Node]) -> bool:
    """True when two frames place a segment apart by more than half their sigma."""
    ends = (nodes[0], nodes[len(nodes) // 2], nodes[-1])
    shift = [before.pose(n.T_odom_camera) - found.pose(n.T_odom_camera) for n in ends]
    sigma = float(np.sqrt(np.trace(found.covariance[3:6, 3:6])))
    return max(float(np.linalg.norm(s[:3, 3])) for s in shift) > 0.5 * sigma


def _kept_in_place(found: Similarity, first: Node, T: F64) -> Similarity:
    """A frame without fixes, moved so that its first keyframe stays at ``T``, and turned to the
    heading there when no compass gives one."""
    R = found.R
    if "attitude" not in found.sources:
        turn = T[:3, :3] @ (R @ first.T_odom_camera[:3, :3]).T
        yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        R = se3.so3_exp(np.array([0.0, 0.0, float(yaw)])) @ R
    t = T[:3, 3] - found.scale * R @ first.T_odom_camera[:3, 3]
    return replace(found, R=R, t=t)
