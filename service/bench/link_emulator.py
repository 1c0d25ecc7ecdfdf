"""A radio link between two sockets of this machine: delay, rate, loss, cuts, byte counts.

TCP is relayed as a stream; a lost segment holds the stream back for one retransmission, and a
cut until the retransmission after it, whose waits double (RFC 6298), as TCP shows it to an
application.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

SEGMENT_BYTES = 1400
SEGMENT_HEADER_BYTES = 52
CHUNK_BYTES = 1400
QUEUE_BYTES = 32_768
"""The radio's own buffer; TCP is held back beyond it."""
SOCKET_BYTES = 4096
"""Receive buffer of the relay: what a sender's system holds is in the sender's buffer."""
ESTABLISHED = 1  # state of an open connection in TCP_INFO
FIRST_WAIT_S, MIN_WAIT_S = 1.0, 0.2
"""TCP's first wait for an answer to a call, and the least for data."""


@dataclass(frozen=True, slots=True)
class LinkModel:
    """Impairments of the link in each direction."""

    rate_kbit_s: float = 1000.0
    delay_s: float = 0.05  # one way
    loss: float = 0.0  # share of segments
    cuts: tuple[tuple[float, float], ...] = ()  # (from, to) seconds after the start
    seed: int = 1


class Direction:
    """One direction of the link: serialised at the rate, delayed, lost, cut."""

    def __init__(self, model: LinkModel, started: float, seed: int) -> None:
        self._model = model
        self.started = started
        self.traffic: list[tuple[float, int]] = []  # time, bytes on the wire handed to the link
        self._random = random.Random(seed)
        self._free_at = started

    def total_bytes(self) -> int:
        return sum(size for _, size in self.traffic)

    def busiest_second_bytes(self) -> int:
        """The most bytes in any second."""
        most = held = 0
        window: deque[tuple[float, int]] = deque()
        for at, size in self.traffic:
            window.append((at, size))
            held += size
            while window[0][0] <= at - 1.0:
                held -= window.popleft()[1]
            most = max(most, held)
        return most

    def backlog_bytes(self, now: float) -> float:
        """Bytes that wait for the radio."""
        return max(0.0, self._free_at - now) * self._model.rate_kbit_s * 125

    def resumes(self, at: float, wait_s: float) -> float:
        """The time at which TCP succeeds, sending first at a given time and again after doubling
        waits."""
        first_at = at
        for first, last in self._model.cuts:
            if self.started + first <= first_at < self.started + last:
                while at < self.started + last:
                    at += wait_s
                    wait_s *= 2
        return at

    @property
    def wait_s(self) -> float:
        """TCP's first wait for the acknowledgement of data."""
        return max(MIN_WAIT_S, 3 * self._model.delay_s)

    def send(self, size: int, now: float) -> float:
        """When ``size`` bytes come out at the far end."""
        wire = size + SEGMENT_HEADER_BYTES * -(-size // SEGMENT_BYTES)
        self.traffic.append((now, wire))
        begin = max(now, self._free_at)
        self._free_at = begin + wire / (self._model.rate_kbit_s * 125)
        if self._random.random() < self._model.loss:  # again a round trip later; the rest waits
            self._free_at += wire / (self._model.rate_kbit_s * 125)
            return self._free_at + 3 * self._model.delay_s
        return self._free_at + self._model.delay_s


class LinkEmulator:
    """Relays ``listen_port`` to ``target_port`` of this machine through a :class:`LinkModel`.
    :attr:`up` is the direction from the side that calls, the drone."""

    def __init__(
        self,
        model: LinkModel,
        listen_port: int,
        target_port: int,
        loop: asyncio.AbstractEventLoop | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._model, self._clock = model, clock
        self._ports = listen_port, target_port
        self.started = clock()
        self.up = Direction(model, self.started, model.seed)
        self._down = Direction(model, self.started, model.seed + 1)
        self._loop = loop or asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="link-emulator", daemon=True)

    def take_off(self, now: float) -> None:
        """Count the times of the cuts from now on, and forget the traffic so far."""
        self.started = self.up.started = self._down.started = now
        self.up.traffic.clear()

    def start(self) -> None:
        self._thread.start()
        self._ready.wait(5.0)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._open())
        self._ready.set()
        self._loop.run_forever()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()

    async def _open(self) -> None:
        listener = socket.create_server(("127.0.0.1", self._ports[0]))
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BYTES)
        await asyncio.start_server(self._accept, sock=listener, limit=CHUNK_BYTES)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        now = self._clock()
        await asyncio.sleep(self.up.resumes(now, FIRST_WAIT_S) - now)
        try:
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._ports[1])
        except OSError:
            writer.close()
            return
        await asyncio.gather(
            self.relay(reader, far_writer, self.up), self.relay(far_reader, writer, self._down)
        )

    async def relay(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, pipe: Direction
    ) -> None:
        """Carry one direction until its sender is done.

        After a cut, data for an end that has closed meanwhile is sent as one segment, because a
        reset answers it. No two calls have one time: the loop orders those as it likes.
        """
        latest = 0.0
        with contextlib.suppress(OSError):
            while data := await reader.read(CHUNK_BYTES):
                now = self._clock()
                late = pipe.resumes(now, pipe.wait_s) - now
                await asyncio.sleep(late)
                now = self._clock()
                out = pipe.send(len(data), now)
                if late > 0 and _has_closed(writer):
                    break
                latest = max(math.nextafter(latest, math.inf), out)
                self._loop.call_at(latest, writer.write, data)
                excess = pipe.backlog_bytes(now) - QUEUE_BYTES
                if excess > 0:
                    await asyncio.sleep(excess / (self._model.rate_kbit_s * 125))
        self._loop.call_at(math.nextafter(latest, math.inf), writer.close)


def _has_closed(writer: asyncio.StreamWriter) -> bool:
    """Whether the process at that end has closed its socket, or its system has."""
    connection = writer.get_extra_info("socket")
    try:
        state = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]
    except OSError:
        return True
    return bool(state != ESTABLISHED)
