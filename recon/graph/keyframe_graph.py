"""What a trajectory asks of the graph that places its keyframes, wherever that graph runs."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

from recon.graph.alignment import Scale, Similarity
from recon.graph.loop_book import Edge
from recon.graph.records import Loop, Node
from recon.graph.sensor_offsets import Constants
from recon.types import F64, Pose, PosePrior


class KeyframeGraph(Protocol):
    """See :class:`recon.graph.pose_graph.PoseGraph` for each method."""

    def add_keyframe(
        self, seq: int, time_ns: int, segment: int, T_odom_camera: F64, covariance: F64,
        prior: PosePrior, height: tuple[float, float] | None = None,
    ) -> Pose:  # fmt: skip
        """The new keyframe's pose, as far as it is known at once."""
        ...

    def add_loop(self, a: int, b: int, T_a_b: F64, covariance: F64, growth: float = 1.0) -> bool:
        """False when the loop waits for another that agrees, or is impossible."""
        ...

    def solve(self) -> None:
        """Weigh everything once more; returns when that is done."""
        ...

    def __len__(self) -> int:
        """How many nodes there are."""
        ...

    def __contains__(self, seq: int) -> bool:
        """True of a node."""
        ...

    @property
    def entered(self) -> int:
        """Keyframes that were added, also those that are nodes no more."""
        ...

    @property
    def generation(self) -> int:
        """How often nodes were thinned out."""
        ...

    @property
    def seqs(self) -> list[int]:
        """Numbers of the nodes, in order."""
        ...

    def node(self, seq: int) -> Node:
        """What is known of a node. Raises KeyError for another keyframe."""
        ...

    def pose(self, seq: int) -> Pose:
        """A node's pose with its covariance and sources."""
        ...

    def scale(self, seq: int) -> float:
        """Metres per unit of the odometry at a node."""
        ...

    def pose_array(self) -> F64:
        """(N, 4, 4) T_world_camera in the order of the nodes."""
        ...

    def scales(self) -> F64:
        """(N,) metres per unit of the odometry, in that order."""
        ...

    def sources(self, seq: int) -> tuple[str, ...]:
        """What a node rests on."""
        ...

    def similarity(self, segment: int) -> Similarity | None:
        """What brings a segment's odometry to the world; None before that is known."""
        ...

    def is_tied(self, segment: int) -> bool:
        """True when fixes or a loop tell where the segment lies."""
        ...

    def newest_scales(self) -> tuple[Scale | None, Scale | None]:
        """The newest segment's scale by fixes alone and by heights alone."""
        ...

    def residuals(self) -> dict[str, F64]:
        """Whitened residuals by kind of factor."""
        ...

    def constants(self) -> Constants:
        """What the sensors are constantly off by."""
        ...

    def metric_loops(self) -> list[Loop]:
        """Accepted loops with lengths in metres."""
        ...

    @property
    def version(self) -> int:
        """Changes whenever poses told before may be others now."""
        ...

    @property
    def counts(self) -> Counter[str]:
        """Readings and loops left out, by reason."""
        ...

    @property
    def loops(self) -> list[Edge]:
        """All loops that were offered."""
        ...
