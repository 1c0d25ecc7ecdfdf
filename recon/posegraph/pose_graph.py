"""One consistent trajectory: vision, attitude, altitude, GNSS and loops in one pose graph.

A pose per keyframe, in the world and in metres. Vision gives the motion between keyframes; a
segment's frame is brought to the world by one similarity from all its telemetry
(:mod:`recon.posegraph.alignment`), because a frame with a wrong heading or scale would be sheared
by single readings. About that similarity the graph bends the track as far as the readings, each
with its own bias, and the loops outweigh vision.
"""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import replace

import numpy as np

from recon import parallel, se3
from recon.posegraph.factors import HUBER_SIGMAS, MotionFactors, ReadingFactors
from recon.posegraph.loop_verification import LoopVerification, is_explained
from recon.posegraph.pose_priors import is_frozen, sound
from recon.posegraph.records import LOOP_WINDOW, Loop, Node, PoseGraphConfig, loops_agree
from recon.posegraph.segments import Segments
from recon.posegraph.sensor_offsets import Constants
from recon.posegraph.smoother import (
    MANY_STEPS,
    NO_SCALE,
    STEPS,
    Smoother,
    left_covariance,
    reversed_motion,
)
from recon.posegraph.thinning import GONE_SHARE, thin
from recon.types import F64, Pose, PosePrior

__all__ = ["PoseGraph", "PoseGraphConfig"]

log = logging.getLogger(__name__)

SOURCES = ("vision", "attitude", "altitude", "gnss", "loop", "dead reckoning")

FRAME_DRIFT = 0.003
"""Share of the path flown by which a track may leave the frame of its segment."""

SIGMA_LOOP_SCALE = 0.002
"""Of the ratio of the depths at a loop's ends."""


class PoseGraph:
    """Keyframe poses in the world, corrected as evidence comes in.

    ``segments`` holds each segment's similarity to the world, ``loops`` those offered. Poses,
    motions and covariances use this package's conventions (left perturbations).
    """

    def __init__(self, config: PoseGraphConfig | None = None) -> None:
        self.config = config or PoseGraphConfig()
        self._kept_counts: Counter[str] = Counter()  # of what happens once, whatever is rebuilt
        self._nodes: dict[int, Node] = {}  # by keyframe number, in order of time
        self._thin_at = self.config.max_nodes
        self.entered = 0  # keyframes, whether they are nodes or not
        self.generation = 0  # how often nodes were thinned out
        self.segments = Segments(self.config)
        self.loops = LoopVerification()
        self._built = 0
        self._start()

    # ---- what goes in --------------------------------------------------------------------------

    def add_keyframe(
        self,
        seq: int,
        time_ns: int,
        segment: int,
        T_odom_camera: F64,
        covariance: F64,
        prior: PosePrior,
        height: tuple[float, float] | None = None,
    ) -> Pose:
        """Add a keyframe; returns its pose by all evidence.

        Of more than ``max_nodes`` some older ones stop being nodes: their motions are those of
        the neighbouring nodes (:mod:`recon.posegraph.thinning`), and the graph is rebuilt.

        Args:
            seq: number of the keyframe; greater than those before.
            segment: keyframes tracked without interruption; each has an odometry frame of its own.
            T_odom_camera: (4, 4) in the segment's frame.
            covariance: (6, 6) of the motion since the last keyframe, a left perturbation in
                the last camera's frame, in units of the odometry.
            prior: telemetry at this moment; parts may be missing.
            height: above ground as :func:`recon.posegraph.ground_heights.height_above` gives it.
        """
        above, lean = height if height is not None else (None, 0.0)
        node = Node(
            seq, len(self._nodes), time_ns, segment, np.array(T_odom_camera, np.float64),
            np.array(covariance, np.float64), self._fresh(sound(prior)), above, lean,
        )  # fmt: skip
        last = self._newest() if self._nodes else None
        self.entered += 1
        self._nodes[node.seq] = node
        is_refitted = self.segments.refit(self.segments.add(node), self._smoother.pose)
        if len(self) >= self._thin_at:
            self._thin()
        elif is_refitted:
            self.rebuild()
        else:
            self._insert(node, last)
            self._solve()
        return self.pose(seq)

    def add_loop(self, a: int, b: int, T_a_b: F64, covariance: F64, growth: float = 1.0) -> bool:
        """True when the loop bent the graph; False while it waits for another that agrees.

        ``T_a_b`` (4, 4) in metres between the cameras of keyframes ``a`` and ``b``, with a
        ``covariance`` (6, 6) as a left perturbation in a's frame; ``growth`` is what b's depths
        must be multiplied by to fit a's. A single loop is not accepted: a repeated texture
        gives perfect matches at the wrong place. A second one nearby must close the same circle.
        """
        if a > b:
            a, b, growth = b, a, 1.0 / growth
            T_a_b, covariance = reversed_motion(T_a_b, covariance)
        scale = self.scale(a)
        ratio = growth * self.scale(b) / scale
        loop = Loop(a, b, T_a_b, covariance, ratio).scaled(1.0 / scale)
        if not self._is_possible(loop):
            self.loops.counts["loop impossible"] += 1
            return False
        fresh = self.loops.offer(loop, self._agree)
        if not fresh:
            return False
        if self._tie(loop):
            self.rebuild()
            return True
        for item in fresh:
            self._add_loop_factor(item)
        self._solve(now=True, steps=MANY_STEPS)
        return True

    def solve(self) -> None:
        """Fit every segment's frame to all its telemetry again, and rebuild the graph."""
        for segment in self.segments:
            segment.forget()
            self.segments.refit(segment, self._smoother.pose)
            loops = [one for one in self.loops.taken if self._enters(one, segment.number)]
            if loops and not segment.is_tied:
                self.rebuild()  # so that the segments before are where they belong
                for loop in loops:
                    if self._tie(loop):
                        break
        self.rebuild()

    # ---- what comes out ------------------------------------------------------------------------

    @property
    def counts(self) -> Counter[str]:
        """Readings and loops left out, by reason."""
        return self._kept_counts + self.loops.counts + self._left_out

    @property
    def seqs(self) -> list[int]:
        """Numbers of the nodes, in order."""
        return list(self._nodes)

    @property
    def refuted(self) -> dict[int, int]:
        """Steps of vision that attitude and positions contradict: the node after by that before."""
        return self._motions.refuted

    def metric_loops(self) -> list[Loop]:
        return [loop.scaled(self.scale(loop.a)) for loop in self.loops.taken]

    def largest_growth(self) -> float:
        """Log of the largest segment's scale by all factors over its scale by its own readings."""
        segment = self.segments.largest()
        if segment is None:
            return 0.0
        keys = [node.key for node in segment.nodes]
        return float(np.median(self._smoother.logs()[self._motions.scale_of][keys]))

    def constants(self) -> Constants:
        """Constant errors of the sensors, as known for the newest segment."""
        return self.segments[self._newest().segment].constants if self._nodes else Constants()

    def node(self, seq: int) -> Node:
        """The record of keyframe ``seq``. Raises KeyError for an unknown one."""
        return self._nodes[seq]

    def __contains__(self, seq: int) -> bool:
        return seq in self._nodes

    def __len__(self) -> int:
        return len(self._nodes)

    def pose(self, seq: int) -> Pose:
        """The pose of keyframe ``seq`` with its covariance and sources."""
        node = self._nodes[seq]
        T, covariance = self._smoother.state(node.key)
        return Pose(T, covariance, self.sources(seq), self.scale(seq))

    def scale(self, seq: int) -> float:
        """Metres per unit of the odometry at keyframe ``seq``."""
        node = self._nodes[seq]
        log = self._smoother.logs()[self._motions.scale_of[node.key]]
        return self.segments[node.segment].frame.scale * float(np.exp(log))

    @property
    def version(self) -> int:
        """A number that changes whenever published poses may have changed."""
        return self._built * 1_000_000 + self._smoother.updates

    def poses(self) -> F64:
        """(N, 4, 4) T_world_camera in the order of the keyframes."""
        return self._smoother.poses()

    def sources(self, seq: int) -> tuple[str, ...]:
        """Names of the sources that keyframe ``seq`` rests on."""
        used = self._sources[self._nodes[seq].key]
        return tuple(name for name in SOURCES if name in used)

    def scales(self) -> F64:
        """(N,) metres per unit of the odometry, in the order of the keyframes."""
        frames = [np.full(len(s.nodes), s.frame.scale) for s in self.segments]
        logs = self._smoother.logs()[self._motions.scale_of]
        return np.asarray(np.concatenate(frames) * np.exp(logs))

    def residuals(self) -> dict[str, F64]:
        """Whitened residuals by kind of factor: "vision", "attitude", "position", "altitude",
        "height", "loop", "loop scale", "link", "scale", "prior" and "prior place"; (n, dimension)
        each."""
        self._solve(now=True)
        return self._smoother.residuals()

    # ---- building ------------------------------------------------------------------------------

    def _start(self) -> None:
        self._built += 1
        self._smoother = Smoother()
        self.segments.restart()
        self._left_out: Counter[str] = Counter()
        times = [n.time_ns for n in self._nodes.values()]
        span_s = (times[-1] - times[0]) * 1e-9 if times else 0.0
        self._readings = ReadingFactors(
            self.config, self._smoother, self._left_out, len(times), span_s,
            self.segments.altitude_offset(),
        )  # fmt: skip
        self._motions = MotionFactors(self.config, self._smoother, self.segments, self._left_out)
        self._sources: list[set[str]] = []
        self._prior = PosePrior()  # of the newest node, without biases
        self._path: list[float] = []  # m flown up to each keyframe

    def rebuild(self) -> None:
        """Rebuild the graph from all readings and the segments' present frames."""
        self._start()
        last: Node | None = None
        for node in self._nodes.values():
            parallel.release_gil()  # each takes about a millisecond
            self._insert(node, last)
            last = node
        for loop in self.loops.taken:
            self._add_loop_factor(loop)
        self._solve(now=True, steps=MANY_STEPS)

    def _solve(self, now: bool = False, steps: int = STEPS) -> None:
        """Solve the waiting factors when due; without a solution, poses stay as vision predicts
        them."""
        try:
            self._smoother.update(now, steps)
        except RuntimeError as error:
            log.error("the pose graph has no solution: %s", error)
            self._kept_counts["solved badly"] += 1

    def _thin(self) -> None:
        """Interpolate some of the older keyframes between their neighbours, and rebuild."""
        poses = dict(zip(self._nodes, self._smoother.poses(), strict=False))  # but the newest
        nodes, marginalised, dropped = thin(list(self._nodes.values()), self._refused(), poses)
        self._kept_counts["keyframe dropped"] += len(dropped)
        self._nodes = {node.seq: node for node in nodes}
        self.segments.thin(nodes)
        self.loops.thin(marginalised, dropped, len(nodes))
        self._thin_at = max(self.config.max_nodes, int(len(nodes) * (1.0 + GONE_SHARE)))
        self.generation += 1
        self.rebuild()

    def _refused(self) -> set[int]:
        """Nodes whose fix was left out when the graph was built last."""
        return {
            node.seq
            for node, used in zip(self._nodes.values(), self._sources, strict=False)
            if node.prior.sigma_position_m is not None
            and "gnss" not in used
            and self.segments[node.segment].rests_on_fixes
        }

    def _insert(self, node: Node, last: Node | None) -> None:
        segment = self.segments[node.segment]
        frame = segment.similarity
        before, self._prior = self._prior, segment.without_biases(node)
        self._sources.append({"vision"})
        self._motions.scale_of.append(0)
        self._path.append(self._path[-1] if self._path else 0.0)
        if last is None:
            T, spread = self._motions.first(node)
        else:
            T_last, spread_last = self._smoother.state(last.key)
            priors = before, self._prior
            motion, covariance, is_seen = self._motions.add(node, last, T_last, priors)
            self._sources[-1] = {"vision" if is_seen else "dead reckoning"}
            T = se3.project_to_so3(T_last @ motion)
            self._path[-1] += float(np.linalg.norm(motion[:3, 3]))
            spread = spread_last + left_covariance(T_last, covariance)
        self._smoother.append_pose(T, spread)
        drift_m = None if frame is None else FRAME_DRIFT * self._path[node.key]
        node = replace(node, prior=self._prior)
        used = self._readings.add(node, T, spread, drift_m, segment.noise)
        if frame is not None and self._readings.height(
            node, self._motions.scale_key(node), frame.scale
        ):
            used.add("altitude")
        self._sources[node.key] |= used

    def _fresh(self, prior: PosePrior) -> PosePrior:
        """The prior without its position when the receiver repeats its last one."""
        if not self._nodes or not is_frozen(prior, self._newest().prior):
            return prior
        self._kept_counts["position at rest" if prior.is_at_rest else "position frozen"] += 1
        return replace(prior, sigma_position_m=None)

    # ---- loops ---------------------------------------------------------------------------------

    def _enters(self, loop: Loop, segment: int) -> bool:
        """True when the loop leads from an earlier segment into this one."""
        return self._nodes[loop.b].segment == segment != self._nodes[loop.a].segment

    def _is_possible(self, loop: Loop) -> bool:
        """False when a loop within a segment is off by more than vision can drift."""
        a, b = self._nodes[loop.a], self._nodes[loop.b]
        if a.segment != b.segment:
            return True
        T = se3.inverse(self._smoother.pose(a.key)) @ self._smoother.pose(b.key)
        path_m = self._path[b.key] - self._path[a.key]
        return is_explained(loop.scaled(self.scale(loop.a)), T, path_m)

    def _agree(self, one: Loop, other: Loop) -> bool:
        """True when two loops, joined by the track between their ends, close on themselves."""
        pairs = list(zip(one.ends, other.ends, strict=True))
        if one.ends == other.ends or not all(self._are_near(*pair) for pair in pairs):
            return False
        (a, a_other), (b, b_other) = (
            [self._smoother.pose(self._nodes[seq].key) for seq in pair] for pair in pairs
        )
        T_a_a, T_b_b = se3.inverse(a) @ a_other, se3.inverse(b_other) @ b
        T_b_b[:3, 3] *= one.ratio * self.scale(one.a) / self.scale(one.b)
        one, other = one.scaled(self.scale(one.a)), other.scaled(self.scale(other.a))
        return loops_agree(one, other, T_a_a, T_b_b)

    def _are_near(self, seq: int, other: int) -> bool:
        one, two = self._nodes[seq], self._nodes[other]
        return one.segment == two.segment and abs(one.key - two.key) <= LOOP_WINDOW

    def _tie(self, loop: Loop) -> bool:
        """True when a loop between segments now places the later one, which no fix does."""
        a, b = self._nodes[loop.a], self._nodes[loop.b]
        if not self._enters(loop, b.segment) or self.segments[b.segment].is_tied:
            return False
        scale = self.scale(loop.a)
        T = self._smoother.pose(a.key) @ loop.scaled(scale).T_a_b
        R = T[:3, :3] @ b.T_odom_camera[:3, :3].T
        scale *= loop.ratio
        self.segments.tie(b.segment, scale, R, T[:3, 3] - scale * R @ b.T_odom_camera[:3, 3])
        return True

    def _add_loop_factor(self, loop: Loop) -> None:
        a, b = self._nodes[loop.a], self._nodes[loop.b]
        metric = loop.scaled(self.segments[a.segment].frame.scale)
        self._sources[b.key].add("loop")
        self._motions.add_loop(a, b, metric.T_a_b, metric.covariance)
        self._add_loop_scale(loop, a.key, b.key)

    def _add_loop_scale(self, loop: Loop, a: int, b: int) -> None:
        """The ratio of the depths at both ends, where each has a scale of its own."""
        keys = self._motions.scale_of[a], self._motions.scale_of[b]
        if keys[0] == keys[1] or NO_SCALE in keys:
            return
        frames = [self.segments[self._nodes[seq].segment].frame.scale for seq in loop.ends]
        log = float(np.log(loop.ratio * frames[0] / frames[1]))
        self._smoother.add_scale("loop scale", keys, log, SIGMA_LOOP_SCALE, HUBER_SIGMAS)

    def _newest(self) -> Node:
        return next(reversed(self._nodes.values()))
