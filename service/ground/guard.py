"""Who may use the portal: this machine for reading, holders of the token for the rest."""

from __future__ import annotations

import hmac
import ipaddress

from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

COOKIE = "skyrelief"
LARGEST_BODY_BYTES = 65_536
CHANGING = {"POST", "PATCH", "DELETE", "PUT"}
HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (
        b"content-security-policy",
        b"default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline';"
        b" connect-src 'self' blob: ws: wss:; worker-src 'self' blob:; frame-ancestors 'none'",
    ),
)


def is_loopback(host: str) -> bool:
    """True when only this machine can reach ``host``."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Guard:
    """Lets through who may come in, and puts the safety headers on every answer."""

    def __init__(self, app: ASGIApp, token: str, local: bool) -> None:
        self._app, self._token, self._local = app, token, local

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        refusal = self._refusal(connection)
        if refusal is not None:
            await self._refuse(scope, receive, send, refusal)
            return
        given = connection.query_params.get("token", "")
        if scope["type"] == "http" and scope["path"] == "/" and given:
            answer = RedirectResponse("/", 303)
            if self._is_token(given):
                answer.set_cookie(COOKIE, given, httponly=True, samesite="strict")
            await answer(scope, receive, send)
            return
        await self._app(scope, receive, _with_headers(send))

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())

    def _refusal(self, connection: HTTPConnection) -> tuple[int, str] | None:
        """Status and reason when the request may not pass."""
        host = connection.headers.get("host", "").rsplit(":", 1)[0].strip("[]")
        if self._local and not is_loopback(host):
            return 421, "this portal answers on this machine's own names only"
        origin = connection.headers.get("origin")
        if origin and origin.split("://")[-1] != connection.headers.get("host"):
            return 403, "requests from other sites are refused"
        bearer = connection.headers.get("authorization", "").removeprefix("Bearer ")
        given = bearer or connection.cookies.get(COOKIE) or ""
        known = self._is_token(given)
        method = connection.scope.get("method", "GET")
        if method in CHANGING and not known:
            return 401, "a change needs the token: open the address that skyrelief printed"
        opening = connection.url.path == "/" and "token" in connection.query_params
        if not self._local and not known and not opening:
            return 401, "the token is needed: open the address that skyrelief printed"
        length = connection.headers.get("content-length", "0")
        if not length.isdigit() or int(length) > LARGEST_BODY_BYTES:
            return 413, "the request is too large"
        return None

    async def _refuse(
        self, scope: Scope, receive: Receive, send: Send, refusal: tuple[int, str]
    ) -> None:
        if scope["type"] == "websocket":
            await WebSocket(scope, receive, send).close(1008, refusal[1][:100])
            return
        await JSONResponse({"error": refusal[1]}, refusal[0])(scope, receive, send)


def _with_headers(send: Send) -> Send:
    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            present = {name.lower() for name, _ in message["headers"]}
            message["headers"] = [
                *message["headers"],
                *(pair for pair in HEADERS if pair[0] not in present),
            ]
        await send(message)

    return wrapped
