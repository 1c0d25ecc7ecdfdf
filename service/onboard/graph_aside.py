"""The pose graph beside the flight: asked for poses at once, whatever its process is busy with.

:class:`GraphAside` answers from the newest state that its process told
(:mod:`service.onboard.graph_server`); keyframes that came since are carried on by vision. A
process that dies is started again and given everything once more.
"""

from __future__ import annotations

import logging
import sys
import time
import weakref
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recon import se3
from recon.graph.alignment import Scale, Similarity
from recon.graph.dead_reckoning import carried
from recon.graph.fix_average import at_camera
from recon.graph.loop_book import Edge
from recon.graph.pose_graph import SOURCES
from recon.graph.records import Loop, Node, PoseGraphConfig
from recon.graph.sensor_offsets import Constants
from recon.graph.smoother import moved_covariance
from recon.types import F64, Pose, PosePrior
from service.onboard.graph_process import GraphProcess
from service.onboard.graph_server import GraphState, Order, Watched

log = logging.getLogger(__name__)

WAIT_S = 0.01
"""A new keyframe waits so long for its corrected pose; after that vision carries it on."""

AGAIN_S = 5.0
"""From one start of the process to the next, at least."""

MOST_NODES = PoseGraphConfig().most_nodes
NOT_SENT = sys.maxsize
"""Number of an order that the process's successor will get."""

ATTEMPTS = 2
"""Of an order that must be answered; then it is obeyed in this process."""

LOST = np.diag([0.3**2] * 3 + [5.0**2] * 3)
"""Covariance that a step without vision adds until the graph has weighed it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Carried:
    """A keyframe that the newest state does not hold yet."""

    T: F64  # (4, 4) T_world_camera
    scale: float
    covariance: F64  # (6, 6) left
    sources: tuple[str, ...]


class GraphAside:
    """A :class:`recon.graph.keyframe_graph.KeyframeGraph` whose graph is in another process.

    Not for several threads at once. Poses change only with :meth:`add_keyframe`,
    :meth:`add_loop`, :meth:`solve` and :attr:`version`.
    """

    def __init__(
        self, wait_s: float = WAIT_S, again_s: float = AGAIN_S, most_nodes: int = MOST_NODES
    ) -> None:
        """Starts the process; a new keyframe waits ``wait_s`` at most for it. One that died is
        started again ``again_s`` after its start at the earliest. Of more than ``most_nodes``
        keyframes some stop being nodes."""
        self._wait_s, self._again_s, self._most_nodes = wait_s, again_s, most_nodes
        self.entered = self.generation = 0
        self._nodes: dict[int, Node] = {}  # what the graph holds, and what came since
        self._seqs: list[int] = []  # of those, in order
        self._memory: bytes | None = None  # the graph as it was once, and
        self._orders: list[tuple[int, Order]] = []  # what made it since, by number in the process
        self._state: GraphState | None = None
        self._spread: dict[int, F64] = {}  # by keyframe, as it was last told
        self._carried: list[_Carried] = []  # keyframes after those of the state
        self._here: Watched | None = None  # the graph, when no process can hold it
        self._version = 0
        self._process, self._started = self._begin(), time.monotonic()

    def close(self) -> None:
        """End the process. What was told stays readable."""
        self._process.close()

    @property
    def pid(self) -> int:
        """Of the process that holds the graph now."""
        return self._process.pid

    @property
    def behind(self) -> int:
        """Keyframes and loops that the process has not weighed yet."""
        return self._process.behind

    # ---- what goes in --------------------------------------------------------------------------

    def add_keyframe(
        self, seq: int, time_ns: int, segment: int, T_odom_camera: F64, covariance: F64,
        prior: PosePrior, height: tuple[float, float] | None = None,
    ) -> Pose:  # fmt: skip
        """The new keyframe's pose: the graph's when it answers in time, else vision's."""
        if self._seqs and seq <= self._seqs[-1]:
            raise ValueError(f"keyframe {seq} does not come after {self._seqs[-1]}")
        if T_odom_camera.shape != (4, 4) or covariance.shape != (6, 6):
            raise ValueError("T_odom_camera must be (4, 4) and covariance (6, 6)")
        above, lean = height if height is not None else (None, 0.0)
        T, spread = np.array(T_odom_camera, np.float64), np.array(covariance, np.float64)
        self.entered += 1
        node = Node(seq, len(self._seqs), time_ns, segment, T, spread, prior, above, lean)
        self._give(("keyframe", seq, time_ns, segment, T, spread, prior, height))
        self._nodes[seq] = node
        self._seqs.append(seq)
        self._carried.append(self._carry(node))
        known, value = self._wait(self._wait_s)
        if known and self._carried:  # no state, so the graph has it where it says
            pose, scale = value
            self._spread[seq] = pose.covariance
            self._carried[-1] = _Carried(pose.T_world_camera, scale, pose.covariance, pose.sources)
        return self.pose(seq)

    def add_loop(self, a: int, b: int, T_a_b: F64, covariance: F64, growth: float = 1.0) -> bool:
        """False when the graph said in time that the loop waits or is impossible."""
        if a not in self._nodes or b not in self._nodes or a == b:
            raise ValueError(f"keyframes {a} and {b} are not two of the graph")
        scales = self.scale(a), self.scale(b)
        self._give(("loop", a, b, T_a_b, covariance, growth, scales))
        known, taken = self._wait(self._wait_s)
        return bool(taken) if known else True

    def solve(self) -> None:
        """Weigh everything once more, however long that takes."""
        state = self._answer(("solve",))
        assert isinstance(state, GraphState)
        self._put(state)

    # ---- what comes out ------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self._seqs)

    @property
    def seqs(self) -> list[int]:
        """Numbers of the nodes, in order."""
        return self._seqs

    def __contains__(self, seq: int) -> bool:
        return seq in self._nodes

    def node(self, seq: int) -> Node:
        """What is known of keyframe ``seq``. Raises KeyError for an unknown one."""
        return self._nodes[seq]

    def pose(self, seq: int) -> Pose:
        """The pose of keyframe ``seq`` with its covariance as last told, and its sources."""
        key = self._nodes[seq].key
        return Pose(self._guess(key).T, self._spread.get(seq, LOST), self.sources(seq))

    def scale(self, seq: int) -> float:
        """Metres per unit of the odometry at keyframe ``seq``."""
        return self._guess(self._nodes[seq].key).scale

    def sources(self, seq: int) -> tuple[str, ...]:
        """What keyframe ``seq`` rests on."""
        return self._guess(self._nodes[seq].key).sources

    def pose_array(self) -> F64:
        """(N, 4, 4) T_world_camera in the order of the keyframes."""
        told = self._state.poses if self._state is not None else np.zeros((0, 4, 4))
        ahead = [one.T for one in self._carried]
        return np.concatenate([told, np.array(ahead).reshape(-1, 4, 4)])

    def scales(self) -> F64:
        """(N,) metres per unit of the odometry, in the order of the keyframes."""
        told = self._state.scales if self._state is not None else np.zeros(0)
        return np.concatenate([told, np.array([one.scale for one in self._carried])])

    def similarity(self, segment: int) -> Similarity | None:
        """What brings a segment's odometry to the world; None before that is known."""
        return None if self._state is None else self._state.frames.get(segment)

    def is_tied(self, segment: int) -> bool:
        """True when fixes or a loop tell where the segment lies."""
        return self._state is not None and segment in self._state.tied

    def newest_scales(self) -> tuple[Scale | None, Scale | None]:
        """The newest segment's scale by fixes alone and by heights alone."""
        return (None, None) if self._state is None else self._state.newest_scales

    def residuals(self) -> dict[str, F64]:
        """Whitened residuals by kind of factor; waits for everything that went in."""
        found: dict[str, F64] = self._answer(("residuals",))
        return found

    def constants(self) -> Constants:
        """What the sensors are constantly off by; waits for everything that went in."""
        found: Constants = self._answer(("constants",))
        return found

    def metric_loops(self) -> list[Loop]:
        """Accepted loops with lengths in metres; waits for everything that went in."""
        found: list[Loop] = self._answer(("metric_loops",))
        return found

    @property
    def version(self) -> int:
        """Changes whenever poses told before may be others now."""
        self._take()
        return self._version

    @property
    def counts(self) -> Counter[str]:
        """Readings and loops left out, by reason."""
        return Counter() if self._state is None else self._state.counts

    @property
    def loops(self) -> list[Edge]:
        """All loops that were offered."""
        return [] if self._state is None else self._state.edges

    # ---- the process ---------------------------------------------------------------------------

    def _begin(self) -> GraphProcess:
        """A process that ends with this object, also when nobody closes it."""
        process = GraphProcess(self._most_nodes)
        weakref.finalize(self, process.close)
        return process

    def _give(self, order: Order) -> None:
        if self._here is not None:
            self._here.obey(order)
            return
        self._remember()
        if self._process.is_dead:
            self._orders.append((NOT_SENT, order))
            self._again()
        else:
            self._orders.append((self._process.send(order), order))

    def _again(self, wait: bool = False) -> None:
        """Start a process in place of the dead one, not too soon after that one's start."""
        left_s = self._started + self._again_s - time.monotonic()
        if left_s > 0 and not wait:
            return
        time.sleep(max(left_s, 0.0))
        log.warning("the pose graph's process ended; it is started again with all that it knew")
        self._remember()
        self._process.close()
        self._process, self._started = self._begin(), time.monotonic()
        if self._memory is not None:
            self._process.send(("remember", self._memory))
        self._orders = [(self._process.send(order), order) for _, order in self._orders]

    def _remember(self) -> None:
        """Forget the orders that the process's newest memory stands for."""
        found = self._process.memory()
        if found is not None:
            done, self._memory = found
            self._orders = [one for one in self._orders if one[0] > done]

    def _wait(self, seconds: float) -> tuple[bool, Any]:
        """True and the value of the last order when it was obeyed in time."""
        if self._here is not None:
            self._put(self._here.state())
            return False, None
        known, value = self._process.wait(seconds)
        self._take()
        return known, value

    def _answer(self, order: Order) -> Any:
        """The value of an order that must be obeyed, by a second process or here if need be."""
        for _ in range(ATTEMPTS if self._here is None else 0):
            if self._process.is_dead:
                self._again(wait=True)
            self._process.send(order)
            known, value = self._process.wait(None)
            if known:
                self._take()
                return value
        if self._here is None:
            log.warning("no process can hold the pose graph; it is built here")
            self._remember()
            self._here = Watched(self._most_nodes)
            if self._memory is not None:
                self._here.obey(("remember", self._memory))
            for _, one in self._orders:
                self._here.obey(one)
            self._memory, self._orders = None, []
        return self._here.obey(order)

    def _take(self) -> None:
        state = self._process.news()
        if state is not None and self._is_newer(state):
            self._put(state)

    def _is_newer(self, state: GraphState) -> bool:
        """False of what a process tells that is not where the one before it was."""
        before = self._state
        if before is None or not len(before):
            return True
        return len(state) > 0 and state.seqs[-1] >= before.seqs[-1]

    def _put(self, state: GraphState) -> None:
        """Take a state; the keyframes that it lacks are carried on from it."""
        self._state = state
        if state.generation != self.generation:
            self._thin(state)
        self._spread.update(state.spread)
        self._version += 1
        self._carried = []
        for seq in self._seqs[len(state) :]:
            self._carried.append(self._carry(self._nodes[seq]))

    def _thin(self, state: GraphState) -> None:
        """Let go of the keyframes that are nodes no more."""
        self.generation = state.generation
        last = int(state.seqs[-1])
        self._seqs = state.seqs.tolist() + [seq for seq in self._seqs if seq > last]
        self._nodes = {
            seq: replace(self._nodes[seq], key=key) for key, seq in enumerate(self._seqs)
        }
        self._spread = {seq: one for seq, one in self._spread.items() if seq in self._nodes}

    # ---- keyframes ahead of the graph ----------------------------------------------------------

    def _guess(self, key: int) -> _Carried:
        """A keyframe as the state has it, or as vision carried it on."""
        state = self._state
        if state is None or key >= len(state):
            return self._carried[key - (0 if state is None else len(state))]
        bits = int(state.sources[key])
        sources = tuple(name for i, name in enumerate(SOURCES) if bits >> i & 1)
        seq = self._seqs[key]
        return _Carried(
            state.poses[key], float(state.scales[key]), self._spread.get(seq, LOST), sources
        )

    def _carry(self, node: Node) -> _Carried:
        """The keyframe by the one before it and vision's motion, or telemetry's."""
        found = self._first(node) if node.key == 0 else self._next(node)
        self._spread[node.seq] = found.covariance
        return found

    def _first(self, node: Node) -> _Carried:
        """Its own frame, turned to the attitude."""
        T, R = node.T_odom_camera, node.prior.R_world_camera
        turned = T if R is None else se3.compose(R, R @ T[:3, :3].T @ T[:3, 3])
        return _Carried(turned, 1.0, np.eye(6), ("vision",))

    def _next(self, node: Node) -> _Carried:
        last = self._nodes[self._seqs[node.key - 1]]
        before = self._guess(last.key)
        if node.segment != last.segment:
            frame = self.similarity(node.segment)
            known = at_camera(last.prior, before.T[:3, :3], before.scale)
            T = carried(known, node.prior, before.T, None, 0.0)
            scale = 1.0 if frame is None else frame.scale
            return _Carried(T, scale, before.covariance + LOST, ("dead reckoning",))
        motion = se3.inverse(last.T_odom_camera) @ node.T_odom_camera
        motion[:3, 3] *= before.scale
        units = np.array([1.0] * 3 + [before.scale] * 3)
        step = node.covariance * np.outer(units, units)
        spread = moved_covariance(before.covariance, before.T, step)
        return _Carried(before.T @ motion, before.scale, spread, ("vision",))
