"""The process that holds the pose graph, as its parent sees it."""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import threading
from typing import Any

from service.onboard.graph_server import GraphState, Order

_CHILD = (
    "import sys; most = int(sys.argv[1]); sys.path[:] = sys.argv[2:]; "
    "from service.onboard.graph_server import main; main(most)"
)  # fmt: skip


class GraphProcess:
    """The graph's process and the newest of what it said. Neither way ever blocks the caller."""

    def __init__(self, most_nodes: int) -> None:
        paths = [path or os.getcwd() for path in sys.path]
        self._child = subprocess.Popen(
            [sys.executable, "-c", _CHILD, str(most_nodes), *paths],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self._orders: queue.SimpleQueue[Order | None] = queue.SimpleQueue()
        self._news = threading.Condition()
        self._sent, self._done = 0, -1
        self._value: Any = None
        self._state: GraphState | None = None
        self._memory: tuple[int, bytes] | None = None
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

    def send(self, order: Order) -> int:
        """Put an order into the queue; its number, from 1 on."""
        self._sent += 1
        self._orders.put(order)
        return self._sent

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

    def memory(self) -> tuple[int, bytes] | None:
        """What makes the graph as it was after the order of that number, once; else None."""
        with self._news:
            memory, self._memory = self._memory, None
            return memory

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
                done, value, state, memory = pickle.load(pipe)
                with self._news:
                    self._done, self._value = done, value
                    self._state = state if state is not None else self._state
                    self._memory = (done, memory) if memory is not None else self._memory
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
