"""The keyframes' poses: chained from vision and ICP, brought to the world by alignment.

A scan may break into segments (the camera lost its way and found it again elsewhere). Each
segment has a chain of its own and is placed in the world by its own similarity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import alignment, se3
from recon.alignment import Anchor, Similarity
from recon.types import F64, PosePrior


@dataclass(frozen=True, slots=True)
class TrajectoryConfig:
    """When corrected poses are worth telling."""

    repose_m: float = 0.05  # a keyframe that moved or would move its ground by more
    repose_sigmas: float = 0.1  # and by more than this share of the sigma, in flight
    least_anchors: int = 3  # keyframes before the alignment replaces the first guess


@dataclass(slots=True, eq=False)
class _Node:
    seq: int
    segment: int
    T_map_camera: F64  # (4, 4) in the segment's chain
    prior: PosePrior
    height: float | None
    lean: float
    told: tuple[F64, float] | None = None  # world pose and scale last published


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

    def __init__(self, config: TrajectoryConfig | None = None) -> None:
        self.config = config or TrajectoryConfig()
        self._nodes: dict[int, _Node] = {}
        self._segments: dict[int, list[_Node]] = {}
        self._similarity: dict[int, Similarity | None] = {}

    def add(
        self,
        seq: int,
        segment: int,
        T_map_camera: F64,
        prior: PosePrior,
        height: tuple[float, float] | None,
    ) -> None:
        """Append a keyframe to its segment and fit the segment's place in the world anew.

        ``height`` comes from :func:`recon.alignment.height_above`, in odometry units.
        """
        above, lean = height if height is not None else (None, 0.0)
        node = _Node(seq, segment, T_map_camera, prior, above, lean)
        self._nodes[seq] = node
        nodes = self._segments.setdefault(segment, [])
        nodes.append(node)
        if len(nodes) >= self.config.least_anchors:
            self._similarity[segment] = alignment.fit(
                [Anchor(n.T_map_camera, n.prior, n.height, n.lean) for n in nodes]
            )

    def __contains__(self, seq: int) -> bool:
        return seq in self._nodes

    def similarity(self, segment: int) -> Similarity | None:
        """The segment's way to the world; None while it stands where telemetry first put it."""
        return self._similarity.get(segment)

    def map_pose(self, seq: int) -> F64:
        """(4, 4) T_map_camera of a keyframe in its segment's chain."""
        return self._nodes[seq].T_map_camera

    def place(self, seq: int) -> Placed:
        """The keyframe in the world, as known now. Raises KeyError for an unknown keyframe."""
        node = self._nodes[seq]
        similarity = self._similarity.get(node.segment)
        if similarity is None:
            return Placed(seq, node.T_map_camera, 1.0, np.eye(6), ("vision",))
        return Placed(
            seq,
            similarity.pose(node.T_map_camera),
            similarity.scale,
            self._covariance(node, similarity),
            ("vision", *similarity.sources),
        )

    def ride(self, seq: int, T_key_camera: F64) -> Placed:
        """A frame's world pose from its pose relative to keyframe ``seq`` (odometry units)."""
        key = self.place(seq)
        moved = T_key_camera.copy()
        moved[:3, 3] *= key.scale
        return Placed(seq, key.T_world_camera @ moved, key.scale, key.covariance, key.sources)

    def moved(self, final: bool = False) -> list[Placed]:
        """Keyframes whose world pose changed since it was told by more than is worth it.

        In flight a change must exceed ``repose_m`` and a tenth of the pose's own sigma, or
        each fix of a poor receiver would move the whole scan. At the end (``final``) every
        change is told, so that the result does not hang on when corrections were asked for.
        """
        out = []
        for node in self._nodes.values():
            if node.told is None:
                continue
            now = self.place(node.seq)
            T_old, scale_old = node.told
            reach = now.scale * (node.height or 1.0)
            change = se3.log(now.T_world_camera @ se3.inverse(T_old))
            shift = float(np.linalg.norm(now.T_world_camera[:3, 3] - T_old[:3, 3]))
            turn = float(np.linalg.norm(change[:3])) * reach
            growth = abs(now.scale / scale_old - 1.0) * reach
            sigma = float(np.sqrt(np.trace(now.covariance[3:, 3:])))
            least = max(self.config.repose_m, self.config.repose_sigmas * sigma)
            least = 1e-6 if final else least
            if shift + turn + growth > least:
                out.append(now)
        return out

    def tell(self, placed: Placed) -> None:
        """Remember that this pose of the keyframe was published."""
        self._nodes[placed.seq].told = (placed.T_world_camera, placed.scale)

    def _covariance(self, node: _Node, similarity: Similarity) -> F64:
        """(6, 6) of the world pose: that of the alignment, moved to the camera's place."""
        x = similarity.scale * similarity.R @ node.T_map_camera[:3, 3]
        J = np.zeros((6, 7))
        J[:3, :3] = J[3:, 3:6] = np.eye(3)
        J[3:, 6] = x
        return np.asarray(J @ similarity.covariance @ J.T)
