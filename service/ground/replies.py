"""Replies to the receiver's requests, polled: no thread of the Zenoh library runs our code."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.workers import Worker

if TYPE_CHECKING:
    import zenoh

CHANNEL = 256
"""Replies to one request that may wait."""
MAX_AT_ONCE = 64
"""Replies to one request that are taken before the next one's turn."""
POLL_S = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class _Pending:
    replies: zenoh.handlers.Handler[Any]
    on_message: Callable[[bytes], object]
    on_end: Callable[[], object]


class Replies:
    """The requests under way. :meth:`add` is safe from any thread."""

    def __init__(self) -> None:
        self._pending: deque[_Pending] = deque()
        self._news = threading.Event()

    def add(
        self,
        replies: zenoh.handlers.Handler[Any],
        on_message: Callable[[bytes], object],
        on_end: Callable[[], object],
    ) -> None:
        """Have the payloads of ``replies`` and their end reported."""
        self._pending.append(_Pending(replies, on_message, on_end))
        self._news.set()

    def run(self, worker: Worker) -> None:
        """Poll until the worker is to stop; then all are dropped."""
        while not worker.stop.is_set():
            worker.beat()
            if not self._pending:
                self._news.wait(0.1)
                self._news.clear()
            elif not self._poll():
                worker.stop.wait(POLL_S)
        self._pending.clear()

    def _poll(self) -> bool:
        """Take some replies of each request; whether there were any."""
        moved = False
        for _ in range(len(self._pending)):
            pending = self._pending.popleft()
            count, is_over = _take(pending)
            moved = moved or count > 0
            if is_over:
                pending.on_end()
            else:
                self._pending.append(pending)
        return moved


def _take(pending: _Pending) -> tuple[int, bool]:
    """How many replies there were, and whether that is all."""
    import zenoh

    for count in range(MAX_AT_ONCE):
        try:
            reply = pending.replies.try_recv()
        except zenoh.ZError:
            return count, True
        if reply is None:
            return count, False
        if reply.ok is not None:
            pending.on_message(reply.ok.payload.to_bytes())
    return MAX_AT_ONCE, False
