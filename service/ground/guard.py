"""Who may use the portal: this machine for reading, holders of a token for the rest.

Every change, and every refused one, leaves a line in the audit log.
"""

from __future__ import annotations

from typing import Any

from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from service.ground.audit import NOTED, AuditLog, Pace
from service.ground.limits import CLOSE, LARGEST_BODY_BYTES
from service.ground.tokens import Tokens
from service.listener import host_name, is_loopback

COOKIE = "skyrelief"
WHO = "skyrelief.who"
"""Where a request's scope holds who sent it; None without a token."""

CHANGING = {"POST", "PATCH", "DELETE", "PUT"}
HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (
        b"content-security-policy",
        b"default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline';"
        b" connect-src 'self' blob: ws: wss:; worker-src 'self' blob:; frame-ancestors 'none'",
    ),
)


class Guard:
    """Lets through who may come in, and puts the safety headers on every answer."""

    def __init__(self, app: ASGIApp, tokens: Tokens, local: bool, audit: AuditLog) -> None:
        self._app, self._tokens, self._local, self._audit = app, tokens, local, audit
        self._refused_pace = Pace(rate_hz=1.0, burst=20)  # a flood must not fill the log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        send = _with_headers(send)
        who = scope[WHO] = self._who(connection)
        opening = scope["path"] == "/" and "token" in connection.query_params
        refusal = self._refusal(connection, who, opening)
        if refusal is not None:
            self._note_refusal(connection, who, refusal[0])
            await _refuse(scope, receive, send, refusal)
        elif opening and scope["type"] == "http":
            await self._open(connection)(scope, receive, send)
        elif scope.get("method") in CHANGING:
            await self._change(connection, receive, send, str(who))
        else:
            await self._app(scope, receive, send)

    def _who(self, connection: HTTPConnection) -> str | None:
        """NAME of a token's holder, or NAME.BROWSER of a session's; None for anybody else."""
        bearer = connection.headers.get("authorization", "").removeprefix("Bearer ")
        if bearer:
            return self._tokens.name_of(bearer)
        return self._tokens.holder_of(connection.cookies.get(COOKIE) or "")

    def _refusal(
        self, connection: HTTPConnection, who: str | None, opening: bool
    ) -> tuple[int, str] | None:
        """Status and reason when the request may not pass."""
        headers = connection.headers
        if self._local and not is_loopback(host_name(headers.get("host", ""))):
            return 421, "this portal answers on this machine's own names only"
        origin = headers.get("origin")
        if origin and origin.split("://")[-1] != headers.get("host"):
            return 403, "requests from other sites are refused"
        if connection.scope.get("method") in CHANGING and who is None:
            return 401, "a change needs the token: open the address that skyrelief printed"
        if not self._local and who is None and not opening:
            return 401, "the token is needed: open the address that skyrelief printed"
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdigit() and len(length) < 10):
            return 413, "the request is too large"
        return None if int(length) <= LARGEST_BODY_BYTES else (413, "the request is too large")

    def _open(self, connection: HTTPConnection) -> RedirectResponse:
        """The page, with a session where the token in the address is right."""
        answer = RedirectResponse("/", 303)
        name = self._tokens.name_of(connection.query_params["token"])
        if name is None:
            self._note_refusal(connection, None, 401)
            return answer
        session = self._tokens.new_session(name)
        is_tls = connection.scope["scheme"] in ("https", "wss")
        answer.set_cookie(COOKIE, session, httponly=True, samesite="strict", secure=is_tls)
        self._audit.write(session.rpartition(".")[0], where(connection), "login", 303)
        return answer

    async def _change(
        self, connection: HTTPConnection, receive: Receive, send: Send, who: str
    ) -> None:
        """Pass a change on; its line is in the log before its answer goes out."""
        scope = connection.scope
        noted: dict[str, Any] = {"action": f"{scope['method']} {scope['path']}"}
        scope[NOTED] = noted

        async def seen(message: Message) -> None:
            if message["type"] == "http.response.start":
                action = noted.pop("action")
                self._audit.write(who, where(connection), action, message["status"], **noted)
            await send(message)

        await self._app(scope, receive, seen)

    def _note_refusal(self, connection: HTTPConnection, who: str | None, status: int) -> None:
        scope = connection.scope
        is_login = "token" in connection.query_params
        if (is_login or scope.get("method") in CHANGING) and self._refused_pace.take():
            action = f"{scope.get('method', 'GET')} {scope['path']}"
            self._audit.write(who or "", where(connection), action, status)


def where(connection: HTTPConnection) -> str:
    """The address that a request came from."""
    return connection.client.host if connection.client is not None else ""


async def _refuse(scope: Scope, receive: Receive, send: Send, refusal: tuple[int, str]) -> None:
    status, reason = refusal
    if scope["type"] == "websocket":
        await WebSocket(scope, receive, send).close(1008, reason[:100])
        return
    await JSONResponse({"error": reason}, status, CLOSE)(scope, receive, send)


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
