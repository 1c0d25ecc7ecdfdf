"""Bounded hand-over of work and data between threads."""

from __future__ import annotations

import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import suppress
from functools import partial
from queue import SimpleQueue
from threading import Condition, Event, Semaphore
from typing import Generic, TypeVar

from service.workers import PROCESS

T = TypeVar("T")
In = TypeVar("In")
Out = TypeVar("Out")

LOOK_S = 0.2  # how often one who waits for work looks whether it ends


class Channel(Generic[T]):
    """A bounded queue between two threads: one iterates over it, the other calls :meth:`fill`. When
    it is full, the filling thread waits, or with ``drops`` the oldest entry is lost."""

    def __init__(self, bound: int, drops: bool) -> None:
        self._bound, self._drops = bound, drops
        self._items: deque[tuple[float, T]] = deque()
        self._change = Condition()
        self._is_ended = self._is_closed = False
        self._fault: Exception | None = None
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._items)

    @property
    def lag_s(self) -> float:
        """Seconds that the oldest entry has waited."""
        with self._change:
            return time.monotonic() - self._items[0][0] if self._items else 0.0

    def fill(self, items: Iterable[T]) -> None:
        """Put all ``items`` in, then end; their exception is raised to the iterating thread."""
        try:
            for item in items:
                if not self._put(item):
                    break
        except Exception as error:
            self._fault = error
        with self._change:
            self._is_ended = True
            self._change.notify_all()

    def _put(self, item: T) -> bool:
        """Add an entry; False once the queue is closed."""
        with self._change:
            if not self._drops:
                self._change.wait_for(lambda: self._is_closed or len(self._items) < self._bound)
            if self._is_closed:
                return False
            self._items.append((time.monotonic(), item))
            if len(self._items) > self._bound:
                self._items.popleft()
                self.dropped += 1
            self._change.notify_all()
            return True

    def close(self) -> None:
        """Discard what is queued; both threads continue at once."""
        with self._change:
            self._is_closed = True
            self._change.notify_all()

    def __iter__(self) -> Iterator[T]:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._items or self._is_ended or self._is_closed)
                if not self._items or self._is_closed:
                    break
                _, item = self._items.popleft()
                self._change.notify_all()
            yield item
        if self._fault is not None:
            raise self._fault


class BackgroundWorker(Generic[In, Out]):
    """Runs ``work`` on offered items, in order, on a thread of the table, and what ``work`` returns
    on another one: the second half of an item's work, while the first of the next begins.

    When the queue is full, :meth:`offer` waits; live, the oldest item that has not begun is dropped
    instead and counted in :attr:`dropped`, if it ``counts``. Without rows, :meth:`offer` does the
    work itself.
    """

    def __init__(
        self,
        rows: tuple[str, str] | None,
        work: Callable[[In], Callable[[], Out]],
        bound: int,
        live: bool = False,
        counts: Callable[[In], bool] = lambda _: True,
    ) -> None:
        self._work, self._bound, self._live, self._counts = work, bound, live, counts
        self._offered: dict[Future[Out], In] = {}  # in order; dropped items leave at once
        self.dropped = 0
        self._ends, self._patience_s = Event(), 0.0
        self._room = Semaphore()  # for one item between the threads: the first is no further ahead
        self._halves = [_Half(row) for row in rows or ()]
        for half in self._halves:
            weakref.finalize(self, half.todo.put, None)  # also when it is never closed

    @property
    def is_free(self) -> bool:
        """True when no offered work waits to begin."""
        return all(future.running() or future.done() for future in self._offered)

    @property
    def busy_s(self) -> float:
        """Seconds since the current work began, the longer of both halves; 0 when idle."""
        return max((half.busy_s for half in self._halves), default=0.0)

    def end_by(self, event: Event, patience_s: float) -> None:
        """Once ``event`` is set, drop what has not begun, and after ``patience_s`` also what has:
        nothing waits longer."""
        self._ends, self._patience_s = event, patience_s

    def prepare(self, load: Callable[[], object]) -> None:
        """Call ``load()`` on the first thread, if there is one, before the next item."""

        def job() -> Callable[[], object]:
            with suppress(Exception):  # the work that needs it will say so
                load()
            return bool

        if self._halves:
            self._halves[0].todo.put(job)

    def offer(self, item: In) -> None:
        if self._ends.is_set():
            self.dropped += self._counts(item)
            return
        future: Future[Out] = Future()
        self._offered[future] = item
        if not self._halves:
            _end(future, lambda: self._work(item)())()
            return
        self._halves[0].todo.put(partial(self._begin, future))
        waiting = [future for future in self._offered if not future.done()]
        if len(waiting) <= self._bound + 1:  # one or more are being worked on
            return
        if not self._live:
            self._wait(waiting[0])
        elif (late := next((one for one in waiting[1:] if one.cancel()), None)) is not None:
            self.dropped += self._counts(self._offered.pop(late))

    def finished(self, everything: bool = False) -> list[tuple[In, Out]]:
        """Finished work, in order; ``everything`` waits for the rest. Raises what work raised, but
        first returns what was done before it."""
        out: list[tuple[In, Out]] = []
        while self._offered:
            future = next(iter(self._offered))
            if everything and not self._wait(future):
                self.dropped += self._counts(self._offered.pop(future))
                continue
            if not future.done() or (future.exception() is not None and out):
                break
            out.append((self._offered.pop(future), future.result()))
        return out

    def _wait(self, future: Future[Out]) -> bool:
        while not self._ends.is_set():
            if wait([future], LOOK_S).done:
                return True
        return not future.cancel() and bool(wait([future], self._patience_s).done)

    def close(self) -> None:
        """End the threads; queued items are discarded."""
        for future in list(self._offered):
            if future.cancel():
                del self._offered[future]
        for half in self._halves:
            half.todo.put(None)
            half.worker.join(0.0 if self._ends.is_set() else None)

    def _begin(self, future: Future[Out]) -> Callable[[], object]:
        if not future.set_running_or_notify_cancel():
            return bool  # there is nothing to pass on
        try:
            rest = self._work(self._offered[future])
        except Exception as error:  # raised where the result is taken
            return partial(future.set_exception, error)
        return partial(self._hand_over, partial(self._finish, future, rest))

    def _hand_over(self, job: _Job) -> None:
        self._room.acquire()
        self._halves[1].todo.put(job)

    def _finish(self, future: Future[Out], rest: Callable[[], Out]) -> Callable[[], object]:
        self._room.release()
        return _end(future, rest)


def _end(future: Future[Out], rest: Callable[[], Out]) -> Callable[[], object]:
    try:
        return partial(future.set_result, rest())
    except Exception as error:
        return partial(future.set_exception, error)


_Job = Callable[[], Callable[[], object]]  # returns how to pass on what it made


class _Half:
    """A thread that does jobs until one is None."""

    def __init__(self, row: str) -> None:
        self.todo: SimpleQueue[_Job | None] = SimpleQueue()
        self._began_s: list[float] = []  # start of the current job, if any
        todo, began_s = self.todo, self._began_s
        self.worker = PROCESS.start(
            row, lambda _: _run(todo, began_s), todo.qsize, lambda: _since(began_s)
        )

    @property
    def busy_s(self) -> float:
        return _since(self._began_s)


def _run(todo: SimpleQueue[_Job | None], began_s: list[float]) -> None:
    while (job := todo.get()) is not None:
        began_s.append(time.monotonic())
        pass_on = job()
        began_s.clear()
        pass_on()
        del job, pass_on  # releases the owner, whose finaliser ends this thread


def _since(began_s: list[float]) -> float:
    return next((time.monotonic() - began for began in began_s), 0.0)
