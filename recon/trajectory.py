"""The keyframes' poses: chained from vision and ICP, placed in the world by the pose graph.

A scan may break into segments (the camera lost its way and found it again elsewhere). Each
segment has a chain of its own; the graph (:mod:`recon.pose_graph`) holds them all in one frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.alignment import Similarity
from recon.pose_graph import PoseGraph, PoseGraphConfig
from recon.types import F64, PosePrior


@dataclass(frozen=True, slots=True)
class TrajectoryConfig:
    """When corrected poses are worth telling."""

    repose_m: float = 0.05  # a keyframe that moved or would move its ground by more
    repose_sigmas: float = 0.1  # and by more than this share of the sigma, in flight


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A keyframe in the world."""

    seq: int
    T_world_camera: F64  # (4, 4)
    scale: float  # metres per odometry unit: multiplies depths of the chain
    covariance: F64  # (6, 6) left perturbation in the world
    sources: tuple[str, ...]


class Trajectory:
    """Keyframe poses of one scan, segment by segment."""

    def __init__(
        self, config: TrajectoryConfig | None = None, graph: PoseGraphConfig | None = None
    ) -> None:
        self.config = config or TrajectoryConfig()
        self.graph = PoseGraph(graph)
        self._told: dict[int, Placed] = {}  # as last published

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

        ``height`` comes from :func:`recon.alignment.height_above`, in odometry units, and
        ``covariance`` is of the step from the keyframe before, as in
        :meth:`recon.pose_graph.PoseGraph.add_keyframe`.
        """
        self.graph.add_keyframe(seq, time_ns, segment, T_map_camera, covariance, prior, height)

    def __contains__(self, seq: int) -> bool:
        return seq in self.graph

    def similarity(self, segment: int) -> Similarity | None:
        """The segment's way to the world; None while it stands where telemetry first put it."""
        return self.graph.similarity(segment)

    def map_pose(self, seq: int) -> F64:
        """(4, 4) T_map_camera of a keyframe in its segment's chain."""
        return self.graph.node(seq).T_odom_camera

    def place(self, seq: int) -> Placed:
        """The keyframe in the world, as known now. Raises KeyError for an unknown keyframe."""
        pose = self.graph.pose(seq)
        known = self.graph.similarity(self.graph.node(seq).segment) is not None
        covariance = pose.covariance if known else np.eye(6)
        return Placed(seq, pose.T_world_camera, self.graph.scale(seq), covariance, pose.sources)

    def ride(self, seq: int, T_key_camera: F64) -> Placed:
        """A frame's world pose from its pose relative to keyframe ``seq`` (odometry units)."""
        key = self.place(seq)
        moved = T_key_camera.copy()
        moved[:3, 3] *= key.scale
        return Placed(seq, key.T_world_camera @ moved, key.scale, key.covariance, key.sources)

    def moved(self, final: bool = False) -> list[Placed]:
        """Keyframes whose world pose changed since it was told by more than is worth it.

        In flight a change must exceed ``repose_m`` and a tenth of the pose's own sigma, or
        each fix of a poor receiver would move the whole scan. At the end (``final``) the graph
        is solved once more and every change is told, so that the result does not hang on when
        corrections were asked for.
        """
        if final:
            self.graph.solve()
        if not self._told:
            return []
        keys = np.array([self.graph.node(seq).key for seq in self._told])
        T, scales = self.graph.pose_array()[keys], self.graph.scales()[keys]
        change = self._change(T, scales)
        sigma = np.array([np.sqrt(np.trace(p.covariance[3:, 3:])) for p in self._told.values()])
        least = np.maximum(self.config.repose_m, self.config.repose_sigmas * sigma)
        seqs = list(self._told)
        rows = np.flatnonzero(change > (1e-6 if final else least))
        if final:
            return [self.place(seqs[i]) for i in rows]
        # In flight with the sigmas told before: newer readings have only made them smaller.
        before = [self._told[seqs[i]] for i in rows]
        return [
            Placed(p.seq, T[i], float(scales[i]), p.covariance, self.graph.sources(p.seq))
            for i, p in zip(rows, before, strict=True)
        ]

    def _change(self, T: F64, scales: F64) -> F64:
        """(N,) metres by which the told keyframes or their ground are off now."""
        old = np.array([p.T_world_camera for p in self._told.values()])
        old_scales = np.array([p.scale for p in self._told.values()])
        heights = np.array([self.graph.node(seq).height or 1.0 for seq in self._told])
        reach = scales * heights
        shift = np.linalg.norm(T[:, :3, 3] - old[:, :3, 3], axis=1)
        # Of a rotation by an angle a, the Frobenius norm of its difference is sqrt(8) sin(a/2).
        apart = np.linalg.norm(T[:, :3, :3] - old[:, :3, :3], axis=(1, 2))
        turn = 2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0)) * reach
        growth = np.abs(scales / old_scales - 1.0) * reach
        return np.asarray(shift + turn + growth)

    def tell(self, placed: Placed) -> None:
        """Remember that this pose of the keyframe was published."""
        self._told[placed.seq] = placed

    def step_between(self, a: int, b: int) -> F64:
        """(4, 4) T_a_b in metres by what the graph holds now."""
        T_a, T_b = self.graph.pose(a).T_world_camera, self.graph.pose(b).T_world_camera
        return np.asarray(se3.inverse(T_a) @ T_b)
