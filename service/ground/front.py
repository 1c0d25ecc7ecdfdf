"""The port where drones connect: passes connections on to Zenoh, within limits.

Zenoh accepts nothing for 0.1 s after each TLS handshake that failed, or did not come within 10 s: a
thousand idle connections of one address would keep drones out for minutes. Here a connection
reaches Zenoh with its first bytes, and few of one address are in their handshake at a time. The
bytes pass unread, so certificates and access rights stay between the drone and Zenoh.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from service.errors import OutsideError
from service.listener import (
    BoundedListener,
    ListenerLimits,
    Peer,
    fitting,
    network_of,
)
from service.stream.session import ENDPOINT, SessionConfig
from service.workers import Worker

log = logging.getLogger(__name__)

LIMITS = ListenerLimits(total=512, per_address=128, wait_s=10.0)
"""64 drones may share an address, that of a router."""
MAX_HANDSHAKES, MAX_OF_ADDRESS, KEPT = 48, 16, 12
"""Connections that Zenoh has and has not admitted yet: in all, of one address, and more for
addresses with none. Others wait."""
HANDSHAKE_S = 12.0
"""Zenoh has given a handshake up by then."""
ADMITTED = 2
"""Replies of Zenoh after which it has checked the other end: the second of TLS needs its
certificate."""
BLOCK_BYTES = 65_536
LOOK_S, SWEEP_S = 0.1, 1.0
BACKLOG = 512


class Front:
    """Passes connections to an endpoint on to :attr:`inner`, with :meth:`run` on a worker.

    Raises OutsideError when the address is not available.
    """

    def __init__(self, endpoint: str) -> None:
        found = ENDPOINT.fullmatch(endpoint)
        assert found is not None
        self.endpoint = endpoint
        self._host, self._port = found[2].strip("[]"), int(found[3])
        self._listener: BoundedListener | None = self._listen()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._inner = probe.getsockname()[:2]
        self.inner = f"{found[1]}/127.0.0.1:{self._inner[1]}"
        self._handshakes = Counter[str]()  # by network

    def _listen(self) -> BoundedListener:
        try:
            limits = fitting(LIMITS, 8)  # a connection takes two descriptors
            listener = BoundedListener(self._host, self._port, limits)
        except OSError as error:
            raise OutsideError(
                f"datalink does not open at {self.endpoint}: {error.strerror}; another program may "
                "have this port, such as a second ground station"
            ) from error
        listener.listen(BACKLOG)
        listener.setblocking(False)
        return listener

    def close(self) -> None:
        """Release the address where :meth:`run` was not called."""
        if self._listener is not None:
            self._listener.close()

    def run(self, worker: Worker) -> None:
        listener, self._listener = self._listener or self._listen(), None
        try:
            asyncio.run(self._serve(worker, listener))
        finally:
            listener.close()

    async def _serve(self, worker: Worker, listener: BoundedListener) -> None:
        accepting = asyncio.create_task(self._accept(listener))
        loop, sweep_at = asyncio.get_running_loop(), 0.0
        while not worker.stop.is_set() and not accepting.done():
            if loop.time() >= sweep_at:
                sweep_at = loop.time() + SWEEP_S
                listener.sweep()
            await asyncio.sleep(LOOK_S)
        accepting.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await accepting  # its fault, if it has one

    async def _accept(self, listener: BoundedListener) -> None:
        loop, passing = asyncio.get_running_loop(), set[asyncio.Task[None]]()
        while True:
            await asyncio.sleep(0)  # a connection that waits already would not let others run
            try:
                outer, address = await loop.sock_accept(listener)
            except ConnectionError:  # over the limits, or gone already
                continue
            except OSError as error:
                log.warning("datalink at %s: %s", self.endpoint, error)
                await asyncio.sleep(SWEEP_S)
                continue
            task = asyncio.create_task(self._pass(listener, outer, address[:2]))
            passing.add(task)
            task.add_done_callback(passing.discard)

    async def _pass(self, listener: BoundedListener, outer: socket.socket, peer: Peer) -> None:
        """Pass the bytes of one connection until an end closes it."""
        loop, network = asyncio.get_running_loop(), network_of(peer[0])
        with outer, contextlib.suppress(OSError):
            first = await loop.sock_recv(outer, BLOCK_BYTES)
            if not first:
                return
            deadline = loop.time() + LIMITS.wait_s
            while not self._has_place(network):
                await asyncio.sleep(LOOK_S)
                if loop.time() > deadline or _is_closed(outer):
                    return
            self._handshakes[network] += 1
            handshake = _Handshake(partial(self._end_handshake, network))
            with socket.socket() as inner, contextlib.closing(handshake):
                inner.setblocking(False)
                for end in (outer, inner):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                await loop.sock_connect(inner, self._inner)
                await loop.sock_sendall(inner, first)
                await _exchange(outer, inner, handshake, partial(listener.begin, peer))
                outer.close()
                inner.shutdown(socket.SHUT_WR)
                with contextlib.suppress(asyncio.TimeoutError):
                    while not handshake.is_over:  # Zenoh still works on it
                        data = await asyncio.wait_for(loop.sock_recv(inner, 4096), HANDSHAKE_S)
                        handshake.is_over = not data

    def _has_place(self, network: str) -> bool:
        own, total = self._handshakes[network], sum(self._handshakes.values())
        return own < MAX_OF_ADDRESS and total < MAX_HANDSHAKES + (0 if own else KEPT)

    def _end_handshake(self, network: str) -> None:
        self._handshakes[network] -= 1
        if not self._handshakes[network]:
            del self._handshakes[network]


class _Handshake:
    """A connection's handshake with Zenoh; ``ended`` is called once."""

    def __init__(self, ended: Callable[[], None]) -> None:
        self._ended, self.is_over = ended, False
        self._is_counted = True

    def close(self) -> None:
        """Zenoh has admitted or refused it."""
        self.is_over = True
        if self._is_counted:
            self._is_counted = False
            self._ended()


async def _exchange(
    outer: socket.socket, inner: socket.socket, handshake: _Handshake, admit: Callable[[], None]
) -> None:
    """Pass bytes both ways until an end closes; ``admit`` is called once Zenoh has admitted it."""
    loop = asyncio.get_running_loop()
    replies, is_answered = 0, False

    async def inwards() -> None:
        nonlocal is_answered
        while data := await loop.sock_recv(outer, BLOCK_BYTES):
            is_answered = False
            await loop.sock_sendall(inner, data)

    async def outwards() -> None:
        nonlocal replies, is_answered
        while data := await loop.sock_recv(inner, BLOCK_BYTES):
            if not is_answered:
                is_answered, replies = True, replies + 1
                if replies == ADMITTED:
                    handshake.close()
                    admit()
            await loop.sock_sendall(outer, data)
        handshake.close()

    tasks = [asyncio.create_task(inwards()), asyncio.create_task(outwards())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _is_closed(connection: socket.socket) -> bool:
    """Whether the other end, or the listener, has closed it."""
    try:
        return not connection.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return False


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
