"""Access to the portal, limits of one request, and the audit log of changes.

This machine may read, holders of a token may do the rest. Every change, and every refused one,
leaves a line in the audit log.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import logging
import os
import re
import secrets
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from service.errors import InputError
from service.listener import BoundedListener, Peer, host_name, is_loopback
from service.scans.writing import writing
from service.small_file import read_small

log = logging.getLogger(__name__)

TOKEN_FILE = "portal-token"
"""Name of the file in the store that holds the token that was made there."""

DEFAULT_NAME = "operator"
MAX_TOKEN_FILE_BYTES = 65_536
TOKEN_LINE = re.compile(r"(?:([A-Za-z0-9][A-Za-z0-9_-]{0,39})[ \t]+)?([!-~]{1,200})")


SESSION_S = 12 * 3600.0
"""A browser's session ends so long after its last cookie, which is renewed at half of it."""


class Tokens:
    """Tokens by the name of who holds them. A browser's session is signed with its token.

    Not Starlette's sessions: one secret signs them for all holders, so that neither a changed token
    nor a logout ends them.
    """

    def __init__(self, by_name: Mapping[str, str], clock: Callable[[], float] = time.time) -> None:
        self._by_name = {name: token.encode() for name, token in by_name.items()}
        self._clock = clock
        self._ended: dict[str, float] = {}  # holders that logged out; until no cookie is valid

    def name_of(self, token: str) -> str | None:
        given = token.encode(errors="replace")
        found = [n for n, known in self._by_name.items() if hmac.compare_digest(given, known)]
        return found[0] if found else None

    def new_session(self, name: str) -> str:
        """A cookie's value for a new browser of ``name``; it does not hold the token."""
        return self._session(f"{name}.{secrets.token_hex(4)}")

    def renewed(self, session: str) -> str | None:
        """The same browser's next value; None while this one has half of its time left."""
        holder = self.holder_of(session)
        is_due = holder is not None and self.holder_of(session, SESSION_S / 2) is None
        return self._session(holder) if is_due and holder is not None else None

    def end_session(self, session: str) -> None:
        """Let no cookie of this browser be valid any more."""
        holder, now = self.holder_of(session), self._clock()
        if holder is not None:
            left = {name: until for name, until in self._ended.items() if until > now}
            self._ended = {**left, holder: now + SESSION_S}

    def _session(self, holder: str) -> str:
        body = f"{holder}.{int(self._clock() + SESSION_S)}"
        return f"{body}.{self._signature(holder.partition('.')[0], body)}"

    def holder_of(self, session: str, left_s: float = 0.0) -> str | None:
        """NAME.BROWSER of a cookie's value; None when we did not make it, or it ends so soon."""
        body, _, signature = session.rpartition(".")
        holder, _, end = body.rpartition(".")
        name = holder.partition(".")[0]
        if name not in self._by_name or holder in self._ended:
            return None
        expected = self._signature(name, body).encode()
        if not hmac.compare_digest(signature.encode(errors="replace"), expected):
            return None
        is_valid = end.isascii() and end.isdigit() and int(end) > self._clock() + left_s
        return holder if is_valid else None

    def _signature(self, name: str, session: str) -> str:
        return hmac.new(self._by_name[name], session.encode(), hashlib.sha256).hexdigest()


def parse_tokens(text: str) -> dict[str, str]:
    """Name to token of a token file: one ``TOKEN`` or ``NAME TOKEN`` per line. Raises InputError
    for anything else and for a file without a token."""
    out: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        found = TOKEN_LINE.fullmatch(line.strip())
        name = (found and found[1]) or DEFAULT_NAME
        if found is None or name in out:
            raise InputError(f"line {number} is not TOKEN or NAME TOKEN with a new name")
        out[name] = found[2]
    if not out:
        raise InputError("it contains no token")
    return out


def read_tokens(path: Path) -> str:
    """The text of a token file. Raises InputError, in one line, when it cannot be used."""
    try:
        text = read_small(path, MAX_TOKEN_FILE_BYTES, "file of tokens").decode()
        parse_tokens(text)
        if path.stat().st_mode & 0o077:
            log.warning("portal token %s can be read by others; chmod 600 %s", path, path)
    except (InputError, OSError, UnicodeDecodeError) as error:
        raise InputError(f"portal token {path}: {error}") from error
    return text


def kept_token(store: Path) -> str:
    """The token kept in ``store`` (mode 600), made on the first call. Raises OutsideError when it
    cannot be written there, InputError when it cannot be read."""
    path = store / TOKEN_FILE
    if not path.exists():
        with writing(path) as part:
            part.touch(0o600, exist_ok=False)
            part.write_text(f"{secrets.token_urlsafe(24)}\n", encoding="ascii")
    return read_tokens(path)


AUDIT_FILE = "audit.jsonl"
MAX_AUDIT_BYTES = 8_000_000
MAX_TEXT = 200
NOTED = "skyrelief.change"  # key of a request's scope for the notes of its endpoint


class AuditLog:
    """Appends lines of JSON to ``audit.jsonl`` (mode 600); the file before it is ``.1``.

    A full disk stops no order; the line is logged instead. Not the standard library's rotating
    handler: it follows links, and its file is readable by others.
    """

    def __init__(self, folder: Path, max_bytes: int = MAX_AUDIT_BYTES) -> None:
        self.path = folder / AUDIT_FILE
        self._max_bytes = max_bytes
        self._lock = threading.Lock()

    def write(self, who: str, where: str, action: str, status: int, **details: Any) -> None:
        """One line; texts are cut to 200 letters."""
        now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        entry = {"time": now, "who": who, "from": where, "action": action, "status": status}
        entry |= {name: _short(value) for name, value in details.items()}
        line = json.dumps(entry) + "\n"
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            with self._lock:
                with open(os.open(self.path, flags, 0o600), "ab") as file:
                    file.write(line.encode())
                    size = file.tell()
                if size > self._max_bytes:
                    os.replace(self.path, self.path.with_name(f"{AUDIT_FILE}.1"))
        except OSError as error:
            log.warning("%s cannot be written (%s): %s", self.path, error.strerror, line.strip())


class Pace:
    """A token bucket: ``burst`` at once, then ``rate_hz`` a second. Not slowapi: it limits routes
    by address, not orders, refusals and warnings in the log."""

    def __init__(
        self, rate_hz: float, burst: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate_hz, self._burst, self._clock = rate_hz, float(burst), clock
        self._left, self._at = float(burst), clock()

    def take(self) -> bool:
        now = self._clock()
        self._left = min(self._burst, self._left + (now - self._at) * self._rate_hz)
        self._at = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def note(connection: HTTPConnection, action: str, **details: Any) -> None:
    """Say what a changing request is about, for its line in the audit log."""
    noted = connection.scope.get(NOTED)
    if noted is not None:
        noted |= {"action": action, **details}


def _short(value: Any) -> Any:
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, (list, tuple)):
        return [_short(item) for item in value[:20]]
    return str(value)[:MAX_TEXT]


MAX_PATH = 1000  # letters of an address before its query; the longest of ours has some 300
MAX_BODY_BYTES = 65_536
UPLOAD, MAX_UPLOAD_BYTES = "/api/upload", 16 << 30
SURVEY, MAX_SURVEY_BYTES = "/control-points", 24_000_000
"""What the paths end with whose bodies may be larger; two files of control points, escaped."""
MIN_UPLOAD_HZ = 20_000  # bytes a second that a large body comes with at least
CLOSE = {"connection": "close"}


class _StalledError(Exception):
    """The other end has stopped reading."""


class RequestLimits:
    """The outermost ASGI layer: bounds every request and marks it as served at the listener.
    Starlette's own limit counts bytes only; a body or a reader that is slow without end is ours."""

    def __init__(
        self, app: ASGIApp, listener: BoundedListener, body_s: float, stall_s: float
    ) -> None:
        """Bounds: seconds of a whole body, and seconds without progress of a reader."""
        self._app, self._listener = app, listener
        self._body_s, self._stall_s = body_s, stall_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        peer: Peer | None = scope.get("client") and tuple(scope["client"])
        self._listener.begin(peer)
        try:
            if scope["type"] == "http":
                receive = self._bounded_receive(scope, receive)
            await self._app(scope, receive, self._bounded_send(send))
        except _StalledError:
            log.debug("%s has stopped reading", peer)
            self._listener.drop(peer)
            await asyncio.wait_for(_gone(receive), self._stall_s)
        finally:
            self._listener.end(peer)

    def _bounds(self, scope: Scope) -> tuple[int, float]:
        """Bytes and seconds of a request's body at most."""
        limit = _most(scope)
        if limit == MAX_BODY_BYTES:
            return limit, self._body_s
        length = HTTPConnection(scope).headers.get("content-length", "")
        most = min(int(length), limit) if is_length(length) else MAX_BODY_BYTES
        return most, self._stall_s + most / MIN_UPLOAD_HZ

    def _bounded_receive(self, scope: Scope, receive: Receive) -> Receive:
        """``receive`` of a request that ends a body too large or too slow with 413 or 408."""
        max_bytes, seconds = self._bounds(scope)
        seen, complete, deadline = 0, False, asyncio.get_running_loop().time() + seconds

        async def bounded() -> Message:
            nonlocal seen, complete
            if complete:  # what comes now is the end of the connection
                return await receive()
            remaining = deadline - asyncio.get_running_loop().time()
            try:
                message = await asyncio.wait_for(receive(), min(remaining, self._stall_s))
            except asyncio.TimeoutError:
                raise HTTPException(408, "the request's body did not come in time", CLOSE) from None
            seen += len(message.get("body", b""))
            complete = not message.get("more_body", False)
            if seen > max_bytes:
                raise HTTPException(413, "the request is too large", CLOSE)
            return message

        return bounded

    def _bounded_send(self, send: Send) -> Callable[[Message], Awaitable[None]]:
        async def bounded(message: Message) -> None:
            try:
                await asyncio.wait_for(send(message), self._stall_s)
            except asyncio.TimeoutError:
                raise _StalledError from None

        return bounded


def _most(scope: Scope) -> int:
    """Bytes of a body at most, by the request's path."""
    if scope["path"] == UPLOAD:
        return MAX_UPLOAD_BYTES
    return MAX_SURVEY_BYTES if scope["path"].endswith(SURVEY) else MAX_BODY_BYTES


def is_length(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 12


async def _gone(receive: Receive) -> None:
    """Return once the server has noticed that the connection is closed."""
    while (await receive())["type"] not in ("http.disconnect", "websocket.disconnect"):
        pass


COOKIE = "skyrelief"


def cookie_name(connection: HTTPConnection) -> str:
    """Name of the session's cookie. Browsers take __Host- from this host by TLS only."""
    return f"__Host-{COOKIE}" if _is_tls(connection) else COOKIE


def _is_tls(connection: HTTPConnection) -> bool:
    return connection.scope["scheme"] in ("https", "wss")


WHO = "skyrelief.who"
"""Key of a request's scope for its sender: NAME of a token's holder, or NAME.BROWSER of a session;
None for anybody else."""

CHANGING = {"POST", "PATCH", "DELETE", "PUT"}
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "content-security-policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval';"
    " img-src 'self' blob: data:; style-src 'self' 'unsafe-inline';"
    " connect-src 'self' blob:; worker-src 'self' blob:; frame-ancestors 'none'",
}
"""On every answer, refusals too. Starlette has no layer for them, and a package only the values."""


class Guard:
    """Lets through who may come in, and puts the safety headers on every answer.

    Not Starlette's layers for hosts and users: one does not read IPv6 addresses, the other refuses
    by the route and not by the method, and neither leaves a line in the audit log.
    """

    def __init__(self, app: ASGIApp, tokens: Tokens, local: bool, audit: AuditLog) -> None:
        self._app, self._tokens, self._local, self._audit = app, tokens, local, audit
        self._refused_pace = Pace(rate_hz=1.0, burst=20)  # a flood must not fill the log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        session = connection.cookies.get(cookie_name(connection)) or ""
        bearer = connection.headers.get("authorization", "").removeprefix("Bearer ")
        who = self._tokens.name_of(bearer) if bearer else self._tokens.holder_of(session)
        scope[WHO] = who
        renewal, following = Response(), self._tokens.renewed(session)
        if following is not None:
            _set_cookie(renewal, connection, following)
        send = _with_headers(send, renewal.headers.getlist("set-cookie"))
        opening = scope["path"] == "/" and "token" in connection.query_params
        refusal = self._refusal(connection, who, opening)
        if refusal is not None:
            status, reason = refusal
            self._note_refusal(connection, who, status)
            answer: ASGIApp = JSONResponse({"error": reason}, status, CLOSE)
            if scope["type"] == "websocket":
                answer = WebSocketClose(1008, reason[:100])
            await answer(scope, receive, send)
        elif opening and scope["type"] == "http":
            await self._open(connection)(scope, receive, send)
        elif scope.get("method") in CHANGING:
            await self._change(connection, receive, send, str(who))
        else:
            await self._app(scope, receive, send)

    def _refusal(
        self, connection: HTTPConnection, who: str | None, opening: bool
    ) -> tuple[int, str] | None:
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
        if len(connection.scope["path"]) > MAX_PATH:
            return 414, "the address is too long"
        length = headers.get("content-length", "0")
        if is_length(length) and int(length) <= _most(connection.scope):
            return None
        return 413, "the request is too large"

    def _open(self, connection: HTTPConnection) -> RedirectResponse:
        """The page, with a session where the token in the address is right."""
        answer = RedirectResponse("/", 303)
        name = self._tokens.name_of(connection.query_params["token"])
        if name is None:
            self._note_refusal(connection, None, 401)
            return answer
        session = self._tokens.new_session(name)
        _set_cookie(answer, connection, session)
        self._audit.write(str(self._tokens.holder_of(session)), where(connection), "login", 303)
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


def _set_cookie(answer: Response, connection: HTTPConnection, session: str) -> None:
    answer.set_cookie(
        cookie_name(connection), session, max_age=int(SESSION_S), httponly=True,
        samesite="strict", secure=_is_tls(connection),
    )  # fmt: skip


def logged_out(connection: HTTPConnection, tokens: Tokens) -> Response:
    """End the browser's session; the answer deletes its cookie."""
    name = cookie_name(connection)
    tokens.end_session(connection.cookies.get(name) or "")
    answer = Response(status_code=204)
    answer.delete_cookie(name, httponly=True, samesite="strict", secure=_is_tls(connection))
    return answer


def where(connection: HTTPConnection) -> str:
    return connection.client.host if connection.client is not None else ""


def _with_headers(send: Send, cookies: list[str]) -> Send:
    """``send`` that puts the safety headers, and cookies, on every answer."""

    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
            for cookie in cookies:
                headers.append("set-cookie", cookie)
        await send(message)

    return wrapped
