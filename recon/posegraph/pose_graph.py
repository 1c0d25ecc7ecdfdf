"""One consistent trajectory: vision, attitude, altitude, GNSS and loops in one pose graph.

A pose per keyframe, in the world and in metres; docs/pose-graph.md has the derivation.
"""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import replace

import numpy as np

from recon import parallel, se3
from recon.posegraph.factors import GraphFactors
from recon.posegraph.pose_priors import is_frozen, sound
from recon.posegraph.records import LOOP_WINDOW, Loop, Node, loops_agree
from recon.posegraph.segments import Segments
from recon.posegraph.sensor_offsets import Constants
from recon.posegraph.smoother import MANY_STEPS, STEPS
from recon.posegraph.thinning import GONE_SHARE, moved_loops, thin
from recon.types import F64, Pose, PosePrior

log = logging.getLogger(__name__)

SOURCES = ("vision", "attitude", "altitude", "gnss", "loop", "dead reckoning")

DRIFT, SLACK_M, MAX_TURN_RAD = 0.05, 2.0, 0.5
"""A loop off by more than this share of the path between its ends and so many metres, or by such a
turn, is impossible: vision drifts by less."""

MAX_PENDING = 50  # loops that wait for one that agrees; older ones are forgotten


class PoseGraph:
    """Keyframe poses in the world, corrected as evidence comes in.

    ``segments`` holds each segment's similarity to the world, ``loops`` those that the map rests
    on, ``pending`` those for which none that agrees was found yet. Poses, motions and covariances
    use this package's conventions (left perturbations).
    """

    def __init__(self, max_nodes: int = 100_000) -> None:
        """Of more than ``max_nodes`` keyframes some are interpolated."""
        self.max_nodes = max_nodes
        self._kept_counts: Counter[str] = Counter()  # of what happens once, whatever is rebuilt
        self._nodes: dict[int, Node] = {}  # by keyframe number, in order of time
        self._thin_at = max_nodes
        self.entered = 0  # keyframes, whether they are nodes or not
        self.generation = 0  # how often nodes were thinned out
        self.segments = Segments()
        self.loops: list[Loop] = []
        self.pending: list[Loop] = []
        self._built = 0
        self._start()

    # ---- what goes in --------------------------------------------------------------------------

    def add_keyframe(self, node: Node) -> Pose:
        """Add a keyframe, newer than those before; returns its pose by all evidence.

        Of more than ``max_nodes`` some older ones stop being nodes: their motions are those of
        the neighbouring nodes (:mod:`recon.posegraph.thinning`), and the graph is rebuilt.
        """
        node = replace(node, key=len(self._nodes), prior=self._fresh(sound(node.prior)))
        last = self._newest() if self._nodes else None
        self.entered += 1
        self._nodes[node.seq] = node
        is_refitted = self.segments.refit(self.segments.add(node))
        if len(self) >= self._thin_at:
            self._thin()
        elif is_refitted:
            self.rebuild()
        else:
            self._factors.add(node, last)
            self._solve()
        return self.pose(node.seq)

    def add_loop(self, loop: Loop) -> bool:
        """True when the loop, in metres, bent the graph; False while it waits for another that
        agrees.

        A single loop is not accepted: a repeated texture gives perfect matches at the wrong place.
        A second one nearby must close the same circle.
        """
        scale = self.scale(loop.a)
        ratio = loop.ratio * self.scale(loop.b) / scale
        loop = replace(loop, ratio=ratio).scaled(1.0 / scale)
        if not self._is_possible(loop):
            self._kept_counts["loop impossible"] += 1
            return False
        support = [other for other in self.pending + self.loops if self._agree(loop, other)]
        if not support:
            self.pending = [*self.pending, loop][-MAX_PENDING:]
            self._kept_counts["loop waits"] += 1
            return False
        fresh = [loop, *(other for other in support if other in self.pending)]
        self.pending = [other for other in self.pending if other not in support]
        self.loops += fresh
        if self._tie(loop):
            self.rebuild()
            return True
        for item in fresh:
            self._add_loop_factor(item)
        self._solve(now=True, steps=MANY_STEPS)
        return True

    def solve(self) -> None:
        """Fit every segment's similarity to all its telemetry again, and rebuild the graph."""
        for segment in self.segments:
            segment.forget()
            self.segments.refit(segment)
            loops = [one for one in self.loops if self._enters(one, segment.number)]
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
        return self._kept_counts + self._factors.left_out

    @property
    def seqs(self) -> list[int]:
        """Numbers of the nodes, in order."""
        return list(self._nodes)

    @property
    def refuted(self) -> dict[int, int]:
        """Steps of vision that attitude and positions contradict: the node after by that before."""
        return self._factors.refuted

    def largest_growth(self) -> float:
        """Log of the largest segment's scale by all factors over its scale by its own readings."""
        segment = self.segments.largest()
        if segment is None:
            return 0.0
        keys = [node.key for node in segment.nodes]
        return float(np.median(self._smoother.logs()[self._factors.scale_of][keys]))

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
        node = self._nodes[seq]
        log = self._smoother.logs()[self._factors.scale_of[node.key]]
        return self.segments[node.segment].to_world.scale * float(np.exp(log))

    @property
    def version(self) -> int:
        """A number that changes whenever published poses may have changed."""
        return self._built * 1_000_000 + self._smoother.updates

    def poses(self) -> F64:
        """(N, 4, 4) T_world_camera in the order of the keyframes."""
        return self._smoother.poses()

    def sources(self, seq: int) -> tuple[str, ...]:
        used = self._factors.sources[self._nodes[seq].key]
        return tuple(name for name in SOURCES if name in used)

    def scales(self) -> F64:
        """(N,) metres per unit of the odometry, in the order of the keyframes."""
        frames = [np.full(len(s.nodes), s.to_world.scale) for s in self.segments]
        logs = self._smoother.logs()[self._factors.scale_of]
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
        self._factors = GraphFactors(self.segments, self._nodes.values())
        self._smoother = self._factors.smoother

    def rebuild(self) -> None:
        """Rebuild the graph from all readings and the segments' present frames."""
        self._start()
        last: Node | None = None
        for node in self._nodes.values():
            parallel.release_gil()  # each takes about a millisecond
            self._factors.add(node, last)
            last = node
        for loop in self.loops:
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
        self.loops, self.pending = (
            moved_loops(loops, marginalised, dropped, len(nodes))
            for loops in (self.loops, self.pending)
        )
        self._thin_at = max(self.max_nodes, int(len(nodes) * (1.0 + GONE_SHARE)))
        self.generation += 1
        self.rebuild()

    def _refused(self) -> set[int]:
        """Nodes whose fix was left out when the graph was built last."""
        return {
            node.seq
            for node, used in zip(self._nodes.values(), self._factors.sources, strict=False)
            if node.prior.sigma_position_m is not None
            and "gnss" not in used
            and self.segments[node.segment].rests_on_fixes
        }

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
        apart = se3.log(se3.inverse(loop.scaled(self.scale(loop.a)).T_a_b) @ self._step(a, b))
        turned, moved = float(np.linalg.norm(apart[:3])), float(np.linalg.norm(apart[3:]))
        path_m = self._factors.path_m[b.key] - self._factors.path_m[a.key]
        return moved < SLACK_M + DRIFT * path_m and turned < MAX_TURN_RAD

    def _agree(self, one: Loop, other: Loop) -> bool:
        """True when two loops, joined by the track between their ends, close on themselves."""
        (a, b), (a_other, b_other) = ([self._nodes[seq] for seq in o.ends] for o in (one, other))
        for near, far in ((a, a_other), (b, b_other)):
            if near.segment != far.segment or abs(near.key - far.key) > LOOP_WINDOW:
                return False
        if one.ends == other.ends:
            return False
        T_a_a, T_b_b = self._step(a, a_other), self._step(b_other, b)
        T_b_b[:3, 3] *= one.ratio * self.scale(one.a) / self.scale(one.b)
        one, other = one.scaled(self.scale(one.a)), other.scaled(self.scale(other.a))
        return loops_agree(one, other, T_a_a, T_b_b)

    def _step(self, a: Node, b: Node) -> F64:
        """(4, 4) T_a_b in metres, as solved last."""
        return np.asarray(se3.inverse(self._smoother.pose(a.key)) @ self._smoother.pose(b.key))

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
        self._factors.add_loop(loop, self._nodes[loop.a], self._nodes[loop.b])

    def _newest(self) -> Node:
        return next(reversed(self._nodes.values()))
