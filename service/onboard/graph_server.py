"""The pose graph as a process of its own: orders on standard input, answers on standard output.

GTSAM keeps the interpreter to itself while it solves, seconds on a long flight. Here it may:
nothing else runs in this process. Both ways carry pickles, between a process and its own child.
It ends when its input does; signals are the parent's to heed.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import signal
import sys
import threading
from collections import Counter
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from recon.graph.alignment import Scale, Similarity
from recon.graph.graph_memory import GraphMemory
from recon.graph.loop_book import Edge
from recon.graph.pose_graph import SOURCES, PoseGraph
from recon.graph.records import PoseGraphConfig
from recon.types import F64

Order = tuple[Any, ...]
"""A name, and what :func:`obey` takes with it."""

LOOK_GROWTH = 1.1
"""Scales by single kinds of reading are told again when the keyframes have grown by so much."""

NICE = 5
"""Of this process: tracking comes first."""


@dataclass(frozen=True, slots=True, eq=False)
class GraphState:
    """All that others read of a pose graph, at one moment."""

    seqs: npt.NDArray[np.int64]  # (N,) numbers of the nodes
    generation: int  # how often nodes were thinned out
    poses: F64  # (N, 4, 4) T_world_camera
    scales: F64  # (N,) metres per unit of the odometry
    sources: npt.NDArray[np.uint8]  # (N,) a bit for each of SOURCES
    spread: dict[int, F64]  # (6, 6) left covariances by node: the newest's, or all
    frames: dict[int, Similarity]  # by segment
    tied: frozenset[int]  # segments
    counts: Counter[str]
    edges: list[Edge]
    newest_scales: tuple[Scale | None, Scale | None]

    def __len__(self) -> int:
        return len(self.poses)


Answer = tuple[int, Any, "GraphState | None", "bytes | None"]
"""Number of orders done, the last one's value, a state and a memory when there are new ones."""


class Watched:
    """A pose graph, and how its state was told last."""

    def __init__(self, most_nodes: int) -> None:
        self.graph = PoseGraph(PoseGraphConfig(most_nodes=most_nodes))
        self._segments: list[int] = []
        self._remembered = 0  # generation of the graph in the last memory
        self._told = -1  # version of the graph in the last state
        self._bits: list[int] = []
        self._looked = 0
        self._scales: tuple[Scale | None, Scale | None] = (None, None)

    @property
    def has_news(self) -> bool:
        """True when poses may have changed since the last state."""
        return self.graph.version != self._told

    def obey(self, order: Order) -> Any:
        """What the order asks for: a keyframe's pose and scale, whether a loop was taken …"""
        name, *rest = order
        if name == "keyframe":
            seq, _, segment = rest[:3]
            if segment not in self._segments:
                self._segments.append(segment)
            return self.graph.add_keyframe(*rest), self.graph.scale(seq)
        if name == "loop":
            return self._loop(*rest)
        if name == "remember":
            memory: GraphMemory = pickle.loads(rest[0])
            self.graph = PoseGraph.restored(memory)
            self._segments = list(memory.segments.nodes)
            self._remembered = self.graph.generation
            return None
        if name == "solve":
            self.graph.solve()
            return self.state(True)
        if name in ("residuals", "metric_loops", "constants"):
            return getattr(self.graph, name)()
        raise ValueError(f"no such order: {name}")

    def _loop(
        self, a: int, b: int, T_a_b: F64, covariance: F64, growth: float,
        scales: tuple[float, float],
    ) -> bool:  # fmt: skip
        """``scales`` are those at both ends by which the loop was measured in metres."""
        if self.graph.is_let_go(a) or self.graph.is_let_go(b):
            return False
        ends = self.graph.carrier(a), self.graph.carrier(b)
        first = self.graph.scale(ends[0]) / scales[0]
        units = np.array([1.0] * 3 + [first] * 3)
        T = T_a_b.copy()
        T[:3, 3] *= first
        growth *= first * scales[1] / self.graph.scale(ends[1])
        self._bits = []  # the loop's end rests on it now
        return self.graph.add_loop(a, b, T, covariance * np.outer(units, units), growth)

    def state(self, final: bool = False) -> GraphState:
        """The state now; with all covariances when it is ``final``."""
        graph, seqs = self.graph, self.graph.seqs
        if final or graph.version // 1_000_000 != self._told // 1_000_000:
            self._bits = []  # it was built anew
        self._told = graph.version
        if final or graph.entered >= LOOK_GROWTH * self._looked:
            self._looked, self._scales = graph.entered, graph.newest_scales()
        frames = {k: found for k in self._segments if (found := graph.similarity(k)) is not None}
        return GraphState(
            np.array(seqs, np.int64),
            graph.generation,
            graph.pose_array() if seqs else np.zeros((0, 4, 4)),
            graph.scales() if seqs else np.zeros(0),
            np.array(self._sources(seqs), np.uint8),
            {seq: graph.pose(seq).covariance for seq in (seqs if final else seqs[-1:])},
            frames,
            frozenset(k for k in self._segments if graph.is_tied(k)),
            graph.counts,
            graph.loops,
            self._scales,
        )  # fmt: skip

    def memory(self) -> bytes | None:
        """A pickle to remember after nodes were thinned out, once; it replaces all orders before.
        None while there is no news."""
        if self.graph.generation == self._remembered:
            return None
        self._remembered = self.graph.generation
        return pickle.dumps(self.graph.memory(), protocol=5)

    def _sources(self, seqs: list[int]) -> list[int]:
        """A number per node with a bit for each of its SOURCES."""
        for seq in seqs[len(self._bits) :]:
            self._bits.append(sum(1 << SOURCES.index(s) for s in self.graph.sources(seq)))
        return self._bits


def serve(orders: BinaryIO, answers: BinaryIO, most_nodes: int) -> None:
    """Obey until the input ends. Each answer is an :data:`Answer`.

    A state goes out when no order waits and it brings something new.
    """
    waiting: queue.SimpleQueue[Order | None] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(orders, waiting), daemon=True).start()
    watched, done = Watched(most_nodes), 0
    _answer(answers, (0, None, None, None))
    while (order := waiting.get()) is not None:
        value = watched.obey(order)
        done += 1
        is_due = waiting.empty() and watched.has_news
        state = watched.state() if is_due else None
        _answer(answers, (done, value, state, watched.memory()))


def _read(orders: BinaryIO, waiting: queue.SimpleQueue[Order | None]) -> None:
    try:
        while True:
            waiting.put(pickle.load(orders))
    except EOFError:
        waiting.put(None)


def _answer(answers: BinaryIO, answer: Answer) -> None:
    pickle.dump(answer, answers, protocol=5)
    answers.flush()


def main(most_nodes: int) -> None:
    """Serve the parent process a graph of ``most_nodes`` keyframes at most.

    What anything prints goes to standard error.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICE)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    with contextlib.suppress(BrokenPipeError):  # the parent is gone
        serve(sys.stdin.buffer, answers, most_nodes)
