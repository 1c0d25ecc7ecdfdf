"""The portal's routes: page, scan library, downloads and live view over HTTP and WebSocket.

Reading is free on this machine; every change needs the token. On other addresses the token
is needed for everything and must be given by the operator. Nothing is fetched from outside.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    Response,
)
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from service.errors import InputError, OutsideError
from service.ground.guard import LARGEST_BODY_BYTES, Guard
from service.ground.jobs import Jobs
from service.ground.library import Library, StaleError
from service.ground.live_socket import serve_live
from service.ground.openapi import DOCUMENT
from service.ground.scan_files import file_routes
from service.ground.state import PortalState, names_of, state_of
from service.ground.vehicle import Vehicle

PAGE = Path(__file__).parent / "web" / "dist"
MOST_LIVE_VIEWS = 16
NO_PAGE = (
    "<!doctype html><meta charset=utf-8><title>skyrelief</title><h1>skyrelief</h1>"
    "<p>The page was not built when skyrelief was installed. Build it with <code>npm ci</code>"
    " and <code>npm run build</code> in <code>service/ground/web</code>, or install again with"
    " the npm registry in reach. The interface works: <a href=/api/scans>scans</a>,"
    " <a href=/api/openapi.json>description</a>.</p>"
)


def portal_app(
    store: Path,
    token: str,
    local: bool,
    progress: Callable[[], list[dict[str, Any]]] | None = None,
    vehicle: Vehicle | None = None,
) -> ASGIApp:
    """The portal as an ASGI application; ``local`` when only this machine can reach it."""
    state = PortalState(Library(store), Jobs(), progress or list, vehicle)
    one = "/api/scans/{drone}/{scan}"
    routes: list[Any] = [
        Route("/", _page),
        Route("/api/scans", _scans),
        Route(one, _scan, methods=["GET"]),
        Route(one, _label, methods=["PATCH"]),
        Route(one, _delete, methods=["DELETE"]),
        *file_routes(one),
        Route(one + "/exports", _export, methods=["POST"]),
        WebSocketRoute(one + "/live", _live),
        Route("/api/bin", _bin),
        Route("/api/bin/{name}/restore", _restore, methods=["POST"]),
        Route("/api/import", _import, methods=["POST"]),
        Route("/api/status", _status),
        Route("/api/vehicle", _figures, methods=["GET"]),
        Route("/api/vehicle", _order, methods=["POST"]),
        Route("/api/openapi.json", lambda _: JSONResponse(DOCUMENT)),
        Route("/metrics", _metrics),
    ]
    if PAGE.is_dir():
        routes.append(Mount("/assets", StaticFiles(directory=PAGE / "assets", check_dir=False)))
    app = Starlette(
        routes=routes,
        exception_handlers={InputError: _said, OutsideError: _said, HTTPException: _refused},
    )
    app.state.portal = state
    return Guard(app, token, local)


def _said(request: HTTPConnection, error: Exception) -> Response:
    """An error of ours as JSON: 404 for what is not there, 400 otherwise, 503 for the world.

    409 where someone else was faster.
    """
    if isinstance(error, OutsideError):
        return JSONResponse({"error": str(error)}, 503)
    if isinstance(error, StaleError):
        return JSONResponse({"error": str(error)}, 409)
    return JSONResponse({"error": str(error)}, 404 if str(error).startswith("no ") else 400)


def _refused(request: HTTPConnection, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code)


async def _body(request: Request) -> dict[str, Any]:
    """The JSON object sent; InputError for anything else."""
    data = await request.body()
    try:
        document = json.loads(data[: LARGEST_BODY_BYTES + 1])
    except (ValueError, RecursionError) as error:
        raise InputError("the request is not JSON") from error
    if not isinstance(document, dict):
        raise InputError("the request is not a JSON object")
    return document


def _page(request: Request) -> Response:
    index = PAGE / "index.html"
    return FileResponse(index) if index.is_file() else HTMLResponse(NO_PAGE)


def _scans(request: Request) -> Response:
    return JSONResponse(state_of(request).library.scans())


def _scan(request: Request) -> Response:
    state, names = state_of(request), names_of(request)
    entry = state.library.entry(*names)
    entry["jobs"] = state.jobs.of(state.library.folder(*names))
    return JSONResponse(entry)


async def _label(request: Request) -> Response:
    body = await _body(request)
    unknown = set(body) - {"title", "tags", "edition"}
    if unknown:
        raise InputError(f"unknown: {', '.join(sorted(unknown))[:100]}")
    edition = body.get("edition")
    if edition is not None and (isinstance(edition, bool) or not isinstance(edition, int)):
        raise InputError("edition is a whole number")
    library = state_of(request).library
    labels = await run_in_threadpool(
        library.label, *names_of(request), body.get("title"), body.get("tags"), edition
    )
    return JSONResponse(
        {"title": labels.title, "tags": list(labels.tags), "edition": labels.edition}
    )


def _delete(request: Request) -> Response:
    state, (drone, scan) = state_of(request), names_of(request)
    for entry in state.progress():
        if (entry["drone"], entry["scan"]) == (drone, scan):
            raise HTTPException(409, "this scan is open at the receiver; delete it after a restart")
    if state.jobs.busy(state.library.folder(drone, scan)):
        raise HTTPException(409, "a deliverable of this scan is being made; wait for it")
    state.coverages.forget(state.library.folder(drone, scan))
    return JSONResponse({"bin": state.library.delete(drone, scan)})


async def _export(request: Request) -> Response:
    body = await _body(request)
    state = state_of(request)
    folder = state.library.folder(*names_of(request))
    job = state.jobs.start(folder, str(body.get("kind", "")))
    return JSONResponse(job, 202)


def _bin(request: Request) -> Response:
    return JSONResponse(state_of(request).library.bin())


def _restore(request: Request) -> Response:
    drone, scan = state_of(request).library.restore(request.path_params["name"])
    return JSONResponse({"drone": drone, "scan": scan})


async def _import(request: Request) -> Response:
    body = await _body(request)
    folder = body.get("folder")
    if not isinstance(folder, str) or not folder or "\0" in folder:
        raise InputError("give the folder or the .mcap to import")
    drone, scan = await run_in_threadpool(state_of(request).library.bring_in, Path(folder))
    return JSONResponse({"drone": drone, "scan": scan}, 201)


def _status(request: Request) -> Response:
    state = state_of(request)
    return JSONResponse(
        {
            "up_s": round(time.monotonic() - state.started, 1),
            "live_views": state.live_views,
            "receiving": state.progress(),
        }
    )


def _figures(request: Request) -> Response:
    vehicle = state_of(request).vehicle
    return JSONResponse({"connected": None} if vehicle is None else vehicle.figures())


async def _order(request: Request) -> Response:
    """An order to the vehicle; the answer is the companion's own."""
    body = await _body(request)
    vehicle = state_of(request).vehicle
    if vehicle is None:
        raise InputError("no vehicle: start with 'skyrelief ground --vehicle ENDPOINT'")
    metres = body.get("metres")
    if metres is not None and (isinstance(metres, bool) or not isinstance(metres, (int, float))):
        raise InputError("metres is a number")
    answer = await run_in_threadpool(vehicle.order, str(body.get("action", "")), metres)
    return JSONResponse(answer)


def _metrics(request: Request) -> Response:
    """The receiver's figures in the text form of Prometheus."""
    lines = ["# TYPE skyrelief_received_bytes counter", "# TYPE skyrelief_keyframes gauge"]
    for entry in state_of(request).progress():
        labels = f'{{drone="{_quoted(entry["drone"])}",scan="{_quoted(entry["scan"])}"}}'
        lines.append(f"skyrelief_received_bytes{labels} {entry['received_bytes']}")
        lines.append(f"skyrelief_keyframes{labels} {entry['held'].get('k0', 0)}")
    return PlainTextResponse("\n".join(lines) + "\n")


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")


async def _live(socket: WebSocket) -> None:
    """Messages of :mod:`service.ground.live` until the browser goes away."""
    state = state_of(socket)
    try:
        folder = state.library.folder(*names_of(socket))
    except InputError as error:
        await socket.close(1008, str(error)[:100])
        return
    if state.live_views >= MOST_LIVE_VIEWS:
        await socket.close(1013, "too many live views")
        return
    await socket.accept()
    state.live_views += 1
    try:
        await serve_live(socket, folder)
    finally:
        state.live_views -= 1
