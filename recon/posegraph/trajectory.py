"""The keyframes' poses: chained from vision and ICP, placed in the world by the pose graph.

A scan may break into segments (tracking was lost and started again elsewhere). Each segment has a
chain of its own; the graph (:mod:`recon.posegraph.pose_graph`) holds them all in one frame.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recon import se3
from recon.posegraph.interpolated import (
    KEYFRAME,
    Spans,
    interpolated,
    moved_m,
    whole,
)
from recon.posegraph.ledger import Ledger, Rows
from recon.posegraph.pose_graph import PoseGraph
from recon.poses import sigma_m
from recon.types import F64, Pose, PosePrior

REPOSE_M, REPOSE_SIGMAS = 0.05, 0.1
"""In flight a corrected pose is published that moves the keyframe or its ground by more than this,
and by more than this share of its sigma."""

AT_ONCE = 200
"""Interpolated keyframes examined with one correction in flight, about; the rest follows with the
next."""


SIGMA_SHARE = 0.01
"""A sigma that differs by more is published again at the end."""


class Trajectory:
    """Keyframe poses of one scan, segment by segment.

    The graph may drop keyframes that it has no room for; they move with the nodes next to
    them (:mod:`recon.posegraph.interpolated`), and little of each is kept, in a ledger.
    """

    def __init__(self, graph: PoseGraph | None = None) -> None:
        """``graph`` places the keyframes; a :class:`PoseGraph` when left out."""
        self.graph = PoseGraph() if graph is None else graph
        self._ledger = Ledger(KEYFRAME)
        self._published: dict[int, Pose] = {}  # nodes as they were last published, in order
        self._checked = -1  # version of the graph that they were compared with
        self._seqs = array("q")  # numbers of all keyframes, as in the ledger
        self._nodes: list[int] = []  # their numbers, in order
        self._generation = 0  # of the graph
        self._pending: deque[int] = deque()  # nodes after which others may have moved

    def add(
        self,
        seq: int,
        segment: int,
        T_map_camera: F64,
        prior: PosePrior,
        height: tuple[float, float] | None,
        time_ns: int,
        covariance: F64,
    ) -> None:
        """Append a keyframe to its segment.

        ``height`` comes from :func:`recon.posegraph.anchors.height_above`, in odometry units, and
        ``covariance`` is of the step from the keyframe before, as in
        :meth:`recon.posegraph.pose_graph.PoseGraph.add_keyframe`.
        """
        self.graph.add_keyframe(seq, time_ns, segment, T_map_camera, covariance, prior, height)
        row = np.zeros(1, KEYFRAME)
        row["seq"], row["segment"], row["odom"] = seq, segment, T_map_camera[:3]
        row["height"] = height[0] if height is not None and height[0] else 1.0
        self._seqs.append(seq)
        self._nodes.append(seq)
        self._ledger.append(row)
        self._follow()

    def __contains__(self, seq: int) -> bool:
        row = bisect_left(self._seqs, seq)
        return row < len(self._seqs) and self._seqs[row] == seq

    def map_pose(self, seq: int) -> F64:
        """(4, 4) T_map_camera of a keyframe in its segment's chain."""
        if seq in self.graph:
            return self.graph.node(seq).T_odom_camera
        return np.asarray(whole(self._read(self._row(seq))["odom"])[0])

    def pose(self, seq: int) -> Pose:
        """The keyframe in the world, as known now. Raises KeyError for an unknown keyframe."""
        if seq not in self.graph:
            row, ends = self._row(seq), self._neighbours(seq)
            at = np.array([row]), np.array([0])
            T, scales = interpolated(self._read(row), *at, self._spans([ends]))
            return replace(self.pose(ends[0]), T_world_camera=T[0], scale=float(scales[0]))
        pose = self.graph.pose(seq)
        frame = self.graph.segments[self.graph.node(seq).segment].similarity
        T, covariance = pose.T_world_camera, pose.covariance
        if frame is None:  # its scale and heading are not known
            covariance = covariance + se3.about(-T[:3, 3], np.eye(6))
        elif frame.sigma_fixes is not None and frame.sigma_counted is not None:
            own = np.diag(se3.about(T[:3, 3], covariance))[3:]
            bent = np.maximum(own - frame.sigma_counted**2, 0.0)
            # The mean error of the fixes bends nothing, and the graph cannot know it.
            factor = np.r_[1.0, 1.0, 1.0, np.sqrt((bent + frame.sigma_fixes**2) / own)]
            covariance = se3.about(T[:3, 3], covariance) * np.outer(factor, factor)
            covariance = se3.about(-T[:3, 3], covariance)
        if frame is not None and frame.lean is not None:  # nothing in the graph shows it
            covariance = covariance + frame.lean
        return replace(pose, covariance=covariance)

    def places(self, seqs: Sequence[int]) -> F64:
        """(N, 4, 4) T_world_camera of keyframes."""
        nodes, graph = self.graph.poses(), self.graph
        found = [
            nodes[graph.node(seq).key] if seq in graph else self.pose(seq).T_world_camera
            for seq in seqs
        ]
        return np.array(found).reshape(-1, 4, 4)

    def scale(self, seq: int) -> float:
        """Metres per unit of the odometry at a keyframe."""
        return self.graph.scale(seq) if seq in self.graph else self.pose(seq).scale

    def step_between(self, a: int, b: int) -> F64:
        """(4, 4) T_a_b in metres by what the graph holds now."""
        return np.asarray(se3.inverse(self.pose(a).T_world_camera) @ self.pose(b).T_world_camera)

    def add_loop(self, a: int, b: int, T_a_b: F64, covariance: F64, growth: float = 1.0) -> bool:
        """As :meth:`recon.posegraph.pose_graph.PoseGraph.add_loop`; ``a`` need not be a node, and
        then the loop is moved to the node before it; False where that is of another
        segment."""
        if a not in self.graph:
            before, after = self._neighbours(a)
            node, rows = self.graph.node(after), self._row(after) - self._row(before)
            if node.segment != self.graph.node(before).segment:
                return False  # no node carries it
            T = self.step_between(before, a)
            units = np.array([1.0] * 3 + [self.graph.scale(before)] * 3)
            step = node.covariance * np.outer(units, units) * (rows / node.weight)
            A = se3.adjoint(T)
            a, T_a_b, covariance = before, T @ T_a_b, step + A @ covariance @ A.T
        return self.graph.add_loop(a, b, T_a_b, covariance, growth)

    # ---- publishing ----------------------------------------------------------------------------

    def moved(self, final: bool = False) -> dict[int, Pose]:
        """Keyframes, by number, whose world pose has changed since it was published by more than a
        threshold.

        In flight a change must exceed REPOSE_M and a tenth of the pose's own sigma, or
        each fix of a poor receiver would move the whole scan; those carried by nodes that moved
        follow gradually, :data:`AT_ONCE` at a time. At the end (``final``) the graph is solved
        again and every change is published, so that the result does not depend on when corrections
        were asked for.
        """
        if final:
            self.graph.solve()
        nodes = self._moved_nodes(final)
        if final:
            self._pending = deque(self._nodes[:-1])
        return nodes | self._moved_interpolated(final)

    def _moved_nodes(self, final: bool) -> dict[int, Pose]:
        if not self._published or (self._checked == self.graph.version and not final):
            return {}
        self._checked = self.graph.version
        before, seqs = list(self._published.values()), list(self._published)
        rows = self._ledger.pick(np.searchsorted(self._seqs, seqs))
        keys = np.searchsorted(self._nodes, seqs)
        T, scales = self.graph.poses()[keys], self.graph.scales()[keys]
        change, claimed = moved_m(rows, T, scales), rows["sigma_m"]
        if final:
            now = [self.pose(seq) for seq in seqs]
            sigma = np.array([sigma_m(pose) for pose in now])
            stale = (change > 1e-6) | (np.abs(sigma - claimed) > SIGMA_SHARE * claimed)
            return {seqs[i]: now[i] for i in np.flatnonzero(stale)}
        moved = np.flatnonzero(change > np.maximum(REPOSE_M, REPOSE_SIGMAS * claimed))
        self._owe([seqs[i] for i in moved])
        # In flight with the sigmas published before: newer readings have only made them smaller.
        return {
            seqs[i]: replace(
                before[i], T_world_camera=T[i], scale=float(scales[i]),
                sources=self.graph.sources(seqs[i]),
            )
            for i in moved
        }  # fmt: skip

    def _owe(self, seqs: Sequence[int]) -> None:
        """Look at the keyframes on both sides of these nodes soon."""
        pending = set(self._pending)
        for seq in seqs:
            i = bisect_left(self._nodes, seq)
            for k in (i - 1, i):
                if 0 <= k < len(self._nodes) - 1 and self._nodes[k] not in pending:
                    pending.add(self._nodes[k])
                    self._pending.append(self._nodes[k])

    def _moved_interpolated(self, final: bool) -> dict[int, Pose]:
        out: dict[int, Pose] = {}
        while self._pending:
            spans: list[tuple[int, int]] = []
            count = 0
            while self._pending and count < AT_ONCE:
                before = self._pending.popleft()
                after = self._nodes[bisect_left(self._nodes, before) + 1]
                held = self._row(after) - self._row(before) - 1
                spans += [(before, after)] if held else []
                count += held
            out |= self._moved_within(spans, final) if spans else {}
            if not final:
                break
        return out

    def _moved_within(self, spans: list[tuple[int, int]], final: bool) -> dict[int, Pose]:
        """Published keyframes between these pairs of nodes that have moved."""
        numbers = [np.arange(self._row(a) + 1, self._row(b)) for a, b in spans]
        span = np.repeat(np.arange(len(spans)), [len(held) for held in numbers])
        rows = np.concatenate([self._ledger.read(held[0], held[-1] + 1) for held in numbers])
        number = np.concatenate(numbers)
        published = rows["is_published"]
        rows, number, span = rows[published], number[published], span[published]
        T, scales = interpolated(rows, number, span, self._spans(spans))
        known = [
            self.pose(before) if final else self._published.get(before) or self.pose(before)
            for before, _ in spans
        ]
        sigma = np.array([sigma_m(one) for one in known])[span]
        least = np.maximum(REPOSE_M, REPOSE_SIGMAS * sigma)
        far = moved_m(rows, T, scales) > (1e-6 if final else least)
        return {
            int(rows["seq"][i]): replace(
                known[span[i]], T_world_camera=T[i], scale=float(scales[i])
            )
            for i in np.flatnonzero(far)
        }

    def publish(self, seq: int, pose: Pose) -> None:
        """Remember that this pose of the keyframe was published."""
        row = self._row(seq)
        rows = self._read(row)
        if seq in self.graph:
            self._published[seq] = pose
            rows["sigma_m"] = sigma_m(pose)
        rows["is_published"] = True
        rows["pose"], rows["scale"] = pose.T_world_camera[:3], pose.scale
        self._ledger.amend(row, rows)

    # ---- keyframes that are not nodes -----------------------------------------------------------

    def _follow(self) -> None:
        """Drop cached data of marginalised keyframes."""
        if self.graph.generation == self._generation:
            return
        self._generation = self.graph.generation
        self._nodes = list(self.graph.seqs)
        self._published = {seq: p for seq, p in self._published.items() if seq in self.graph}
        self._pending = deque(seq for seq in self._pending if seq in self.graph)

    def _neighbours(self, seq: int) -> tuple[int, int]:
        """The nodes before and after a keyframe that is none."""
        i = bisect_left(self._nodes, seq)
        if not 0 < i < len(self._nodes):
            raise KeyError(seq)
        return self._nodes[i - 1], self._nodes[i]

    def _row(self, seq: int) -> int:
        """Place of a keyframe in the ledger. Raises KeyError for an unknown one."""
        if seq not in self:
            raise KeyError(seq)
        return bisect_left(self._seqs, seq)

    def _read(self, row: int) -> Rows:
        return self._ledger.read(row, row + 1)

    def _spans(self, ends: list[tuple[int, int]]) -> Spans:
        """The spans between these pairs of nodes, as known now."""
        nodes = [[self.graph.node(seq) for seq in pair] for pair in ends]
        return Spans(
            np.array([[self._row(seq) for seq in pair] for pair in ends]),
            np.array([[node.T_odom_camera for node in pair] for pair in nodes]),
            np.array([[self.graph.place(seq) for seq in pair] for pair in ends]),
            np.array([[self.graph.scale(seq) for seq in pair] for pair in ends]),
            np.array([a.segment == b.segment for a, b in nodes]),
        )
