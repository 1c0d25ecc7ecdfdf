"""The port where drones connect: passes connections on to Zenoh, within limits.

Zenoh accepts nothing for 0.1 s after each TLS handshake that failed, or did not come within 10 s: a
thousand idle connections of one address would keep drones out for minutes. Here a connection
reaches Zenoh with its first bytes, and few of one address are in their handshake at a time. The
bytes pass unread, so certificates and access rights stay between the drone and Zenoh. A proxy of
the system would limit addresses, but not by Zenoh's handshakes.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from service.errors import OutsideError, outside
from service.listener import (
    BoundedListener,
    ListenerLimits,
    Peer,
    fitting,
    network_of,
)
from service.stream.session import ENDPOINT, SessionConfig
from service.workers import Worker

LIMITS = ListenerLimits(total=512, per_address=128, wait_s=10.0)
"""64 drones may share an address, that of a router."""
MAX_HANDSHAKES, MAX_OF_ADDRESS, KEPT = 48, 16, 12
"""Connections that Zenoh has and has not admitted yet: in all, of one address, and more for
addresses with none. Others wait."""
HANDSHAKE_S = 12.0  # Zenoh has given a handshake up by then
ADMITTED = 2
"""Replies of Zenoh after which it has checked the other end: the second of TLS needs its
certificate."""
BLOCK_BYTES = 131_072
"""A stream is read in fewer, larger parts: a quarter of it costs twice the time per byte."""
LOOK_S, CLOSE_S = 0.1, 5.0
BACKLOG = 512

Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class Front:
    """Passes connections to an endpoint on to :attr:`inner`, with :meth:`run` on a worker. Raises
    OutsideError when the address is not available."""

    def __init__(self, endpoint: str) -> None:
        found = ENDPOINT.fullmatch(endpoint)
        assert found is not None
        self.endpoint = endpoint
        self._host, self._port = found[2].strip("[]"), int(found[3])
        self._listener = self._listen()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._inner = probe.getsockname()[:2]
        self.inner = f"{found[1]}/127.0.0.1:{self._inner[1]}"
        self._handshakes = Counter[str]()  # by network

    def _listen(self) -> BoundedListener:
        remedy = "another program may have this port, such as a second ground station"
        with outside(f"datalink does not open at {self.endpoint}", remedy):
            # A connection takes two descriptors.
            return BoundedListener(self._host, self._port, fitting(LIMITS, 8))

    def close(self) -> None:
        self._listener.close()

    def run(self, worker: Worker) -> None:
        if worker.restarts:
            self._listener = self._listen()
        try:
            asyncio.run(self._serve(worker, self._listener))
        finally:
            self._listener.close()

    async def _serve(self, worker: Worker, listener: BoundedListener) -> None:
        async def accept(*outer: Any) -> None:
            with contextlib.suppress(OSError, asyncio.TimeoutError):
                with contextlib.closing(outer[1]):
                    await self._pass(listener, outer)
                await asyncio.wait_for(outer[1].wait_closed(), CLOSE_S)
            outer[1].transport.abort()  # it does not take what is left

        server = await asyncio.start_server(accept, sock=listener, backlog=BACKLOG)
        while not worker.stop.is_set():
            listener.sweep()
            await asyncio.sleep(LOOK_S)
        server.close()

    async def _pass(self, listener: BoundedListener, outer: Stream) -> None:
        peer: Peer = (outer[1].get_extra_info("peername") or ("", 0))[:2]
        loop, network = asyncio.get_running_loop(), network_of(peer[0])
        first = await outer[0].read(BLOCK_BYTES)
        if not first:
            return
        deadline = loop.time() + LIMITS.wait_s
        while not self._has_place(network):
            await asyncio.sleep(LOOK_S)
            if loop.time() > deadline or outer[0].at_eof():
                return
        self._handshakes[network] += 1
        with contextlib.ExitStack() as handshake:
            handshake.callback(self._end_handshake, network)
            inner = await asyncio.open_connection(*self._inner)

            def admit() -> None:
                handshake.close()
                listener.begin(peer)

            with contextlib.closing(inner[1]):
                inner[1].write(first)
                is_over = await _exchange(outer, inner, admit)
                outer[1].close()
                inner[1].write_eof()
                with contextlib.suppress(asyncio.TimeoutError):
                    while not is_over:  # Zenoh still works on it
                        is_over = not await asyncio.wait_for(inner[0].read(4096), HANDSHAKE_S)

    def _has_place(self, network: str) -> bool:
        own, total = self._handshakes[network], sum(self._handshakes.values())
        return own < MAX_OF_ADDRESS and total < MAX_HANDSHAKES + (0 if own else KEPT)

    def _end_handshake(self, network: str) -> None:
        self._handshakes -= Counter([network])  # which keeps no network without any


async def _exchange(outer: Stream, inner: Stream, admit: Callable[[], None]) -> bool:
    """Pass bytes both ways until an end closes; ``admit`` is called once Zenoh has admitted it.
    Returns whether it has, or has refused it."""
    replies, is_answered = 0, False

    async def inwards() -> None:
        nonlocal is_answered
        while data := await outer[0].read(BLOCK_BYTES):
            is_answered = False
            inner[1].write(data)
            await inner[1].drain()

    async def outwards() -> None:
        nonlocal replies, is_answered
        while data := await inner[0].read(BLOCK_BYTES):
            if not is_answered:
                is_answered, replies = True, replies + 1
                if replies == ADMITTED:
                    admit()
            outer[1].write(data)
            await outer[1].drain()

    tasks = [asyncio.create_task(inwards()), asyncio.create_task(outwards())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return replies >= ADMITTED or tasks[1].done()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def behind_fronts(session: SessionConfig) -> tuple[SessionConfig, list[Front]]:
    """The session with its TCP listeners on this machine only, and the fronts before them."""
    fronts: list[Front] = []
    listen = []
    try:
        for endpoint in session.listen:
            found = ENDPOINT.fullmatch(endpoint)
            if found is None or found[1] not in ("tcp", "tls", "ws") or found[4]:
                listen.append(endpoint)  # without TCP, or with options for Zenoh
                continue
            fronts.append(Front(endpoint))
            listen.append(fronts[-1].inner)
    except OutsideError:
        for front in fronts:
            front.close()
        raise
    return replace(session, listen=tuple(listen)), fronts
