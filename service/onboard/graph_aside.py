"""The pose graph beside the flight: asked for poses at once, whatever its process is busy with.

:class:`GraphAside` answers from the newest state that its process told
(:mod:`service.onboard.graph_server`); keyframes that came since are carried on by vision. A
process that dies is started again and given everything once more.
"""

from __future__ import annotations

import logging
import os
import pickle
import queue
import subprocess
import sys
import threading
import time
import weakref
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon import se3
from recon.graph.alignment import Scale, Similarity
from recon.graph.dead_reckoning import carried
from recon.graph.fix_average import at_camera
from recon.graph.loop_book import Edge
from recon.graph.pose_graph import SOURCES
from recon.graph.records import Loop, Node
from recon.graph.sensor_offsets import Constants
from recon.graph.smoother import moved_covariance
from recon.types import F64, Pose, PosePrior
from service.onboard.graph_server import GraphState, Order, Watched

log = logging.getLogger(__name__)

WAIT_S = 0.01
"""A new keyframe waits so long for its corrected pose; after that vision carries it on."""

AGAIN_S = 5.0
"""From one start of the process to the next, at least."""

ATTEMPTS = 2
"""Of an order that must be answered; then it is obeyed in this process."""

LOST = np.diag([0.3**2] * 3 + [5.0**2] * 3)
"""Covariance that a step without vision adds until the graph has weighed it."""

_CHILD = (
    "import sys; sys.path[:] = sys.argv[1:]; "
    "from service.onboard.graph_server import main; main()"
)  # fmt: skip


class _Process:
    """The graph's process and the newest of what it said. Neither way ever blocks the caller."""

    def __init__(self) -> None:
        self._child = subprocess.Popen(
            [sys.executable, "-c", _CHILD, *(p or os.getcwd() for p in sys.path)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self._orders: queue.SimpleQueue[Order | None] = queue.SimpleQueue()
        self._news = threading.Condition()
        self._sent, self._done = 0, -1
        self._value: Any = None
        self._state: GraphState | None = None
        self.is_dead = False
        threading.Thread(target=self._write, name="graph orders", daemon=True).start()
        threading.Thread(target=self._read, name="graph answers", daemon=True).start()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._child.pid

    @property
    def behind(self) -> int:
        """Orders sent and not obeyed yet."""
        with self._news:
            return self._sent - max(self._done, 0)

    def close(self) -> None:
        """End the process and wait for it."""
        _end(self._child, self._orders)

    def send(self, order: Order) -> None:
        """Put an order into the queue."""
        self._sent += 1
        self._orders.put(order)

    def wait(self, seconds: float | None) -> tuple[bool, Any]:
        """True and the last order's value once it was obeyed; False after ``seconds``, or when
        the process is dead."""
        with self._news:
            self._news.wait_for(lambda: self._done >= self._sent or self.is_dead, seconds)
            return self._done >= self._sent, self._value

    def news(self) -> GraphState | None:
        """The newest state, once; None when there is none newer than that asked for before."""
        with self._news:
            state, self._state = self._state, None
            return state

    def _write(self) -> None:
        pipe = self._child.stdin
        assert pipe is not None
        try:
            while (order := self._orders.get()) is not None:
                pickle.dump(order, pipe, protocol=5)
                pipe.flush()
            pipe.close()
        except OSError:
            pass  # it is dead; the other thread says so

    def _read(self) -> None:
        pipe = self._child.stdout
        assert pipe is not None
        try:
            while True:
                done, value, state = pickle.load(pipe)
                with self._news:
                    self._done, self._value = done, value
                    self._state = state if state is not None else self._state
                    self._news.notify_all()
        except (EOFError, OSError, pickle.UnpicklingError):
            with self._news:
                self.is_dead = True
                self._news.notify_all()


def _end(child: subprocess.Popen[bytes], orders: queue.SimpleQueue[Order | None]) -> None:
    orders.put(None)
    try:
        child.wait(0.5)
    except subprocess.TimeoutExpired:
        child.kill()  # it is solving, and nobody waits for that any more
        child.wait()


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

    def __init__(self, wait_s: float = WAIT_S, again_s: float = AGAIN_S) -> None:
        """Starts the process; a new keyframe waits ``wait_s`` at most for it. One that died is
        started again ``again_s`` after its start at the earliest."""
        self._wait_s, self._again_s = wait_s, again_s
        self._nodes: dict[int, Node] = {}
        self._seqs: list[int] = []
        self._orders: list[Order] = []  # everything that made the graph
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

    def _begin(self) -> _Process:
        """A process that ends with this object, also when nobody closes it."""
        process = _Process()
        weakref.finalize(self, process.close)
        return process

    def _give(self, order: Order) -> None:
        self._orders.append(order)
        if self._here is not None:
            self._here.obey(order)
        elif self._process.is_dead:
            self._again()
        else:
            self._process.send(order)

    def _again(self, wait: bool = False) -> None:
        """Start a process in place of the dead one, not too soon after that one's start."""
        left_s = self._started + self._again_s - time.monotonic()
        if left_s > 0 and not wait:
            return
        time.sleep(max(left_s, 0.0))
        log.warning("the pose graph's process ended; it is started again with all that it knew")
        self._process.close()
        self._process, self._started = self._begin(), time.monotonic()
        for order in self._orders:
            self._process.send(order)

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
            self._here = Watched()
            for one in self._orders:
                self._here.obey(one)
        return self._here.obey(order)

    def _take(self) -> None:
        state = self._process.news()
        if state is not None and len(state) >= len(self) - len(self._carried):
            self._put(state)

    def _put(self, state: GraphState) -> None:
        """Take a state; the keyframes that it lacks are carried on from it."""
        self._state = state
        self._spread.update(state.spread)
        self._version += 1
        self._carried = []
        for seq in self._seqs[len(state) :]:
            self._carried.append(self._carry(self._nodes[seq]))

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
