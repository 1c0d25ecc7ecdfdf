"""The live view's WebSocket: what :mod:`service.ground.live` says, until the browser goes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sqlite3
from collections.abc import Awaitable
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect

from service.errors import SkyreliefError
from service.ground.live import LiveFeed, StoreIndex
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

POLL_S = 0.25


async def serve_live(socket: WebSocket, folder: Path) -> None:
    """Send what is new in the scan of ``folder`` over an accepted socket; close it at the end."""
    store = index = None
    try:
        store = await run_in_threadpool(ScanStore.open, folder / "scan.db")
        index = StoreIndex(store.path)
        feed = LiveFeed(store, index, _most_points(socket))
        gone = asyncio.create_task(_until_gone(socket))
        while not gone.done():
            for message in await run_in_threadpool(lambda: list(feed.news())):
                await _send(socket, message)
            await asyncio.wait({gone}, timeout=POLL_S)
    except (SkyreliefError, sqlite3.Error, WebSocketDisconnect, RuntimeError) as error:
        log.debug("live view of %s ended: %s", folder, error)
    finally:
        for opened in (index, store):
            if opened is not None:
                await run_in_threadpool(opened.close)
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.close()


def _most_points(socket: WebSocket) -> int | None:
    text = socket.query_params.get("points", "")
    is_number = text.isascii() and text.isdigit() and len(text) < 9
    return min(max(int(text), 100), 1_000_000) if is_number else None


def _send(socket: WebSocket, message: str | bytes) -> Awaitable[None]:
    return socket.send_text(message) if isinstance(message, str) else socket.send_bytes(message)


async def _until_gone(socket: WebSocket) -> None:
    """Return when the browser closed the connection; what it sends is not read."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass
