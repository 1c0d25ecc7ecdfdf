"""The keyframes' poses: chained from vision and ICP, placed in the world by the pose graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Loop, Node
from recon.posegraph.thinning import moved_loop
from recon.table import Rows, Table
from recon.types import F64, I64, Bool, Pose

REPOSE_M, REPOSE_SIGMAS = 0.05, 0.1
"""In flight a corrected pose is published that moves the keyframe or its ground by more than this,
and by more than this share of its sigma."""

AT_ONCE = 600
"""Corrections published at once in flight, at most: to build them takes some ms, in which tracking
may wait. The rest follows with the next keyframe."""

SIGMA_SHARE = 0.01  # a sigma that differs by more is published again at the end
SETTLED_M = 1e-6  # at the end, what moved by more is published: rounding errors are smaller

KEYFRAME = np.dtype(
    [
        ("seq", np.int64),
        ("segment", np.int32),
        ("is_published", np.bool_),
        ("T_odom_camera", np.float64, (4, 4)),  # in the segment's chain
        ("height", np.float64),  # above the ground that it sees, in odometry units
        ("T_world_camera", np.float64, (4, 4)),  # as last published, as all below
        ("covariance", np.float64, (6, 6)),
        ("sigma_m", np.float64),  # of the place
        ("scale", np.float64),  # metres per odometry unit
    ]
)
"""A row of the table: one keyframe."""


def sigma_m(pose: Pose) -> float:
    """Sigma of the place, in all three directions together."""
    return se3.sigma_at(pose.T_world_camera[:3, 3], pose.covariance)


def carried(pose: Pose, T_keyframe_camera: F64) -> Pose:
    """A frame in the world by its pose (4, 4) relative to a keyframe, in units of the odometry."""
    moved = T_keyframe_camera.copy()
    moved[:3, 3] *= pose.scale
    return replace(pose, T_world_camera=pose.T_world_camera @ moved)


class Trajectory:
    """Keyframe poses of one scan, and what was published of each.

    A keyframe for which the graph has no room is no node of it any more. It is carried by the
    nodes of its segment on both sides; where the graph dropped its whole segment, it stays as
    published.
    """

    def __init__(self, graph: PoseGraph | None = None) -> None:
        """``graph`` places the keyframes; a :class:`PoseGraph` when left out."""
        self.graph = PoseGraph() if graph is None else graph
        self._table = Table(KEYFRAME)  # of all keyframes, in order
        self._row = dict[int, int]()  # place of each in the table, by number
        self._nodes = np.zeros(0, np.int64)  # rows of those that are nodes, in order
        self._generation = 0  # of the graph
        self._checked = -1  # version of the graph that all published poses follow

    def add(self, node: Node) -> None:
        """As :meth:`recon.posegraph.pose_graph.PoseGraph.add_keyframe`."""
        self.graph.add_keyframe(node)
        row = np.zeros(1, KEYFRAME)
        row["seq"], row["segment"], row["height"] = node.seq, node.segment, node.height or 1.0
        row["T_odom_camera"] = node.T_odom_camera
        self._row[node.seq] = len(self._table)
        self._table.append(row)
        if self.graph.generation == self._generation:
            self._nodes = np.append(self._nodes, len(self._table) - 1)
        else:
            self._generation = self.graph.generation
            self._nodes = np.searchsorted(self._table.rows["seq"], self.graph.seqs)

    def __contains__(self, seq: int) -> bool:
        return seq in self._row

    def odom_pose(self, seq: int) -> F64:
        """(4, 4) T_odom_camera of a keyframe in its segment's chain."""
        return np.array(self._table.rows["T_odom_camera"][self._row[seq]])

    # ---- poses ---------------------------------------------------------------------------------

    def pose(self, seq: int) -> Pose:
        """The keyframe in the world, as known now. Raises KeyError for an unknown keyframe."""
        if seq not in self.graph:
            row = np.array([self._row[seq]])
            T, scales = self._placed(row)
            node = self.pose(int(self._table.rows["seq"][self._node_before(row)[0]]))
            return replace(node, T_world_camera=T[0], scale=float(scales[0]))
        pose = self.graph.pose(seq)
        similarity = self.graph.segments[self.graph.node(seq).segment].similarity
        T, covariance = pose.T_world_camera, pose.covariance
        if similarity is None:  # its scale and heading are not known
            covariance = covariance + se3.about(-T[:3, 3], np.eye(6))
        elif similarity.sigma_fixes is not None and similarity.sigma_counted is not None:
            own = np.diag(se3.about(T[:3, 3], covariance))[3:]
            bent = np.maximum(own - similarity.sigma_counted**2, 0.0)
            # The mean error of the fixes bends nothing, and the graph cannot know it.
            factor = np.r_[1.0, 1.0, 1.0, np.sqrt((bent + similarity.sigma_fixes**2) / own)]
            covariance = se3.about(T[:3, 3], covariance) * np.outer(factor, factor)
            covariance = se3.about(-T[:3, 3], covariance)
        if similarity is not None and similarity.lean is not None:  # nothing in the graph shows it
            covariance = covariance + similarity.lean
        return replace(pose, covariance=covariance, is_aligned=similarity is not None)

    def places(self, seqs: Sequence[int]) -> F64:
        return self._placed(np.searchsorted(self._table.rows["seq"], seqs))[0]

    def similarities(self, seqs: Sequence[int]) -> F64:
        """(N, 4, 4) from the cameras of keyframes, in units of the odometry, to the world in m."""
        T, scales = self._placed(np.searchsorted(self._table.rows["seq"], seqs))
        T[:, :3, :3] *= scales[:, None, None]
        return T

    def scale(self, seq: int) -> float:
        """Metres per unit of the odometry at a keyframe."""
        return self.graph.scale(seq) if seq in self.graph else self.pose(seq).scale

    def step_between(self, a: int, b: int) -> F64:
        """(4, 4) T_a_b in metres by what the graph holds now."""
        return np.asarray(se3.inverse(self.pose(a).T_world_camera) @ self.pose(b).T_world_camera)

    def _node_before(self, at: I64) -> I64:
        """(N,) rows of the nodes at or before the rows ``at`` (N,)."""
        return self._nodes[np.searchsorted(self._nodes, at, side="right") - 1]

    def _is_dropped(self, at: I64) -> Bool:
        """(N,) True for keyframes in rows ``at`` (N,) of whose segment the graph has no node."""
        segments = self._table.rows["segment"]
        return np.asarray(segments[self._node_before(at)] != segments[at])

    def _placed(self, at: I64) -> tuple[F64, F64]:
        """(N, 4, 4) poses and (N,) scales of the keyframes in the rows ``at`` (N,)."""
        before = np.searchsorted(self._nodes, at, side="right") - 1
        T_nodes, scales_nodes = self.graph.poses(), self.graph.scales()
        T, scales = T_nodes[before], scales_nodes[before]
        is_dropped = self._is_dropped(at)
        i = np.flatnonzero((self._nodes[before] != at) & ~is_dropped)
        if len(i):
            T[i], scales[i] = self._interpolated(at[i], before[i], T_nodes, scales_nodes)
        i = np.flatnonzero(is_dropped & self._table.rows["is_published"][at])
        published = self._table.rows[at[i]]
        T[i], scales[i] = published["T_world_camera"], published["scale"]
        return T, scales

    def _interpolated(self, at: I64, before: I64, T_nodes: F64, scales: F64) -> tuple[F64, F64]:
        """(N, 4, 4) poses and (N,) scales of the keyframes in rows ``at`` (N,), between the nodes
        ``before`` (N,) and those after them, which have ``T_nodes`` (M, 4, 4), ``scales`` (M,).

        Vision carries a keyframe from both nodes, and the nearer one weighs more. From the node
        before alone, as ORB-SLAM has it, the whole misclosure would lie in one step: over 2,000
        simulated keyframes with 300 nodes, steps err by 42 mm and 197 mm at most, interpolated by
        37 mm and 130 mm; places err the same.
        """
        odom = self._table.rows["T_odom_camera"]
        T_nodes_odom = se3.each_inverse(odom[self._nodes])

        def carried(node: I64) -> F64:
            motion = T_nodes_odom[node] @ odom[at]
            motion[:, :3, 3] *= scales[node, None]
            return np.asarray(T_nodes[node] @ motion)

        after = before + 1
        share = (at - self._nodes[before]) / (self._nodes[after] - self._nodes[before])
        T, other = carried(before), carried(after)
        turn = se3.each_so3_log(T[:, :3, :3].transpose(0, 2, 1) @ other[:, :3, :3])
        T[:, :3, :3] = T[:, :3, :3] @ se3.each_so3_exp(share[:, None] * turn)
        T[:, :3, 3] += share[:, None] * (other - T)[:, :3, 3]
        return T, scales[before] * (scales[after] / scales[before]) ** share

    def add_loop(self, loop: Loop) -> bool:
        """As :meth:`recon.posegraph.pose_graph.PoseGraph.add_loop`; its first end need not be a
        node, and then the loop is moved to the node before it, with vision's covariance on the way
        there; False where that node is of another segment."""
        if (a := loop.a) not in self.graph:
            row = self._row[a]
            if self._is_dropped(np.array([row]))[0]:
                return False  # no node carries it
            i = int(np.searchsorted(self._nodes, row))
            before, after = self.graph.seqs[i - 1], self.graph.node(self.graph.seqs[i])
            share = (row - self._nodes[i - 1]) / after.weight
            step = share * se3.in_units(after.covariance, self.graph.scale(before))
            way = Loop(before, a, self.step_between(before, a), step)
            loop = moved_loop(loop, {a: way})
        return self.graph.add_loop(loop)

    # ---- publishing ----------------------------------------------------------------------------

    def publish(self, seq: int, pose: Pose) -> None:
        row = self._table.rows[self._row[seq]]
        row["is_published"], row["sigma_m"], row["scale"] = True, sigma_m(pose), pose.scale
        row["T_world_camera"], row["covariance"] = pose.T_world_camera, pose.covariance

    def moved(self, final: bool = False) -> dict[int, Pose]:
        """Keyframes, by number, whose world pose has changed since it was published by more than a
        threshold; their new poses count as published.

        In flight a change must exceed REPOSE_M and a tenth of the pose's own sigma, or
        each fix of a poor receiver would move the whole scan; of more than :data:`AT_ONCE`, those
        come first that moved farthest. At the end (``final``) the graph is solved again and every
        change is published, so that the result does not depend on when corrections were asked for.
        """
        if final:
            self.graph.solve()
        elif self._checked == self.graph.version:
            return {}
        found = self._moved(final)
        for seq, pose in found.items():
            self.publish(seq, pose)
        return found

    def _moved(self, final: bool) -> dict[int, Pose]:
        at = np.flatnonzero(self._table.rows["is_published"])
        if not len(at):
            return {}
        rows, (T, scales) = self._table.rows[at], self._placed(at)
        nodes = self._table.rows["seq"][self._node_before(at)]
        change = moved_m(rows, T, scales)
        if final:
            known = {int(seq): self.pose(int(seq)) for seq in np.unique(nodes)}
            now = [
                replace(known[seq], T_world_camera=T[i], scale=float(scales[i]))
                for i, seq in enumerate(nodes.tolist())
            ]
            off = np.abs(np.array([sigma_m(pose) for pose in now]) - rows["sigma_m"])
            is_stale = (off > SIGMA_SHARE * rows["sigma_m"]) & ~self._is_dropped(at)
            far = np.flatnonzero((change > SETTLED_M) | is_stale)
            return {int(rows["seq"][i]): now[i] for i in far}
        far = np.flatnonzero(change > np.maximum(REPOSE_M, REPOSE_SIGMAS * rows["sigma_m"]))
        if len(far) <= AT_ONCE:
            self._checked = self.graph.version
        far = np.sort(far[np.argsort(-change[far])[:AT_ONCE]])
        # With the covariances published before: newer readings have only made them smaller.
        return {
            int(rows["seq"][i]): Pose(
                T[i], rows["covariance"][i], self.graph.sources(int(nodes[i])), float(scales[i])
            )
            for i in far
        }


def moved_m(rows: Rows, T: F64, scales: F64) -> F64:
    """(N,) metres by which keyframes as published, or their ground, are off where they are now."""
    old, reach = rows["T_world_camera"], scales * rows["height"]
    shift = np.linalg.norm(T[:, :3, 3] - old[:, :3, 3], axis=1)
    # Of a rotation by an angle a, the Frobenius norm of its difference is sqrt(8) sin(a/2).
    apart = np.linalg.norm(T[:, :3, :3] - old[:, :3, :3], axis=(1, 2))
    turn = 2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0)) * reach
    growth = np.abs(scales / rows["scale"] - 1.0) * reach
    return np.asarray(shift + turn + growth)
