"""How much of the portal one request may hold: bytes of its body, and time that nothing moves."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.listener import BoundedListener, Peer

log = logging.getLogger(__name__)

LARGEST_BODY_BYTES = 65_536
BODY_S = 10.0
"""A request's whole body comes within this time."""
STALL_S = 120.0
"""A reader that has taken nothing for so long is gone."""
CLOSE = {"connection": "close"}


class _StalledError(Exception):
    """The other end has stopped reading."""


class Limits:
    """The outermost ASGI layer: bounds every request and marks it as served at the listener."""

    def __init__(self, app: ASGIApp, listener: BoundedListener) -> None:
        self._app, self._listener = app, listener

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        peer: Peer | None = scope.get("client") and tuple(scope["client"])
        self._listener.begin(peer)
        try:
            if scope["type"] == "http":
                await self._app(scope, bounded_receive(receive), _bounded_send(send))
            else:
                await self._app(scope, receive, _bounded_send(send))
        except _StalledError:
            log.debug("%s has stopped reading", peer)
            self._listener.drop(peer)
            await asyncio.wait_for(_gone(receive), STALL_S)
        finally:
            self._listener.end(peer)


def bounded_receive(receive: Receive) -> Receive:
    """``receive`` of one HTTP request that ends a body too large or too slow with 413 or 408."""
    seen, complete, deadline = 0, False, asyncio.get_running_loop().time() + BODY_S

    async def bounded() -> Message:
        nonlocal seen, complete
        if complete:  # what comes now is the end of the connection
            return await receive()
        remaining = deadline - asyncio.get_running_loop().time()
        try:
            message = await asyncio.wait_for(receive(), remaining)
        except asyncio.TimeoutError:
            raise HTTPException(408, "the request's body did not come in time", CLOSE) from None
        seen += len(message.get("body", b""))
        complete = not message.get("more_body", False)
        if seen > LARGEST_BODY_BYTES:
            raise HTTPException(413, "the request is too large", CLOSE)
        return message

    return bounded


def _bounded_send(send: Send) -> Callable[[Message], Awaitable[None]]:
    async def bounded(message: Message) -> None:
        try:
            await asyncio.wait_for(send(message), STALL_S)
        except asyncio.TimeoutError:
            raise _StalledError from None

    return bounded


async def _gone(receive: Receive) -> None:
    """Return once the server has noticed that the connection is closed."""
    while (await receive())["type"] not in ("http.disconnect", "websocket.disconnect"):
        pass
