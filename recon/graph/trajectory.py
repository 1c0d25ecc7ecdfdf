"""The keyframes' poses: chained from vision and ICP, placed in the world by the pose graph.

A scan may break into segments (the camera lost its way and found it again elsewhere). Each
segment has a chain of its own; the graph (:mod:`recon.graph.pose_graph`) holds them all in one
frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon import se3
from recon.graph.alignment import Similarity
from recon.graph.keyframe_graph import KeyframeGraph
from recon.graph.pose_graph import PoseGraph
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


class _Told:
    """Keyframes as they were last published, as columns that grow."""

    def __init__(self) -> None:
        self.placed: list[Placed] = []
        self.checked = -1  # version of the graph that they were compared with
        self._row: dict[int, int] = {}
        self._columns = np.zeros((64, 20))  # pose, scale, sigma, height, key

    def __len__(self) -> int:
        return len(self.placed)

    def put(self, placed: Placed, key: int, height: float) -> None:
        """Take a keyframe's newest published pose; ``height`` in odometry units."""
        row = self._row.setdefault(placed.seq, len(self.placed))
        if row == len(self.placed):
            self.placed.append(placed)
        if row == len(self._columns):
            self._columns = np.concatenate([self._columns, np.zeros_like(self._columns)])
        self.placed[row] = placed
        sigma = float(np.sqrt(np.trace(placed.covariance[3:, 3:])))
        self._columns[row, :16] = placed.T_world_camera.ravel()
        self._columns[row, 16:] = placed.scale, sigma, height, key

    @property
    def keys(self) -> npt.NDArray[np.int64]:
        """(N,) keys in the graph."""
        return self._columns[: len(self), 19].astype(np.int64)

    @property
    def sigma(self) -> F64:
        """(N,) m of the place."""
        return self._columns[: len(self), 17]

    def change(self, T: F64, scales: F64) -> F64:
        """(N,) metres by which the keyframes or their ground are off, given where they are now."""
        rows = self._columns[: len(self)]
        old = rows[:, :16].reshape(-1, 4, 4)
        reach = scales * rows[:, 18]
        shift = np.linalg.norm(T[:, :3, 3] - old[:, :3, 3], axis=1)
        # Of a rotation by an angle a, the Frobenius norm of its difference is sqrt(8) sin(a/2).
        apart = np.linalg.norm(T[:, :3, :3] - old[:, :3, :3], axis=(1, 2))
        turn = 2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0)) * reach
        growth = np.abs(scales / rows[:, 16] - 1.0) * reach
        return np.asarray(shift + turn + growth)


class Trajectory:
    """Keyframe poses of one scan, segment by segment."""

    def __init__(
        self, config: TrajectoryConfig | None = None, graph: KeyframeGraph | None = None
    ) -> None:
        """``graph`` places the keyframes; a :class:`PoseGraph` when left out."""
        self.config = config or TrajectoryConfig()
        self.graph: KeyframeGraph = PoseGraph() if graph is None else graph
        self._told = _Told()

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

        ``height`` comes from :func:`recon.graph.alignment.height_above`, in odometry units, and
        ``covariance`` is of the step from the keyframe before, as in
        :meth:`recon.graph.pose_graph.PoseGraph.add_keyframe`.
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
        told = self._told
        if not len(told) or (told.checked == self.graph.version and not final):
            return []
        told.checked = self.graph.version
        keys = told.keys
        T, scales = self.graph.pose_array()[keys], self.graph.scales()[keys]
        least = np.maximum(self.config.repose_m, self.config.repose_sigmas * told.sigma)
        change = told.change(T, scales)
        rows = np.flatnonzero(change > (1e-6 if final else least))
        if final:
            return [self.place(told.placed[i].seq) for i in rows]
        # In flight with the sigmas told before: newer readings have only made them smaller.
        before = [told.placed[i] for i in rows]
        return [
            Placed(p.seq, T[i], float(scales[i]), p.covariance, self.graph.sources(p.seq))
            for i, p in zip(rows, before, strict=True)
        ]

    def tell(self, placed: Placed) -> None:
        """Remember that this pose of the keyframe was published."""
        node = self.graph.node(placed.seq)
        self._told.put(placed, node.key, node.height or 1.0)

    def step_between(self, a: int, b: int) -> F64:
        """(4, 4) T_a_b in metres by what the graph holds now."""
        T_a, T_b = self.graph.pose(a).T_world_camera, self.graph.pose(b).T_world_camera
        return np.asarray(se3.inverse(T_a) @ T_b)
