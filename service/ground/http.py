"""The portal's routes: page, scan library, downloads and live view over HTTP and WebSocket.

Reading is free on this machine; every change needs the token. On other addresses the token
is needed for everything and must be given by the operator. Nothing is fetched from outside.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from service.errors import InputError, MissingError, OutsideError, refusing
from service.ground.bodies import BODIES, Body, JSONResponse, changing
from service.ground.control import control_routes
from service.ground.guard import (
    CHANGING,
    UPLOAD,
    WHO,
    AuditLog,
    Guard,
    Pace,
    Tokens,
    is_length,
    logged_out,
    note,
)
from service.ground.library import ConflictError
from service.ground.live import serve_live
from service.ground.map_tiles import map_routes
from service.ground.products import job_title, products_of
from service.ground.scan_files import file_routes
from service.ground.sites import align_by_points
from service.ground.state import KINDS, SILENT_S, PortalState, folder_of, names_of, state_of
from service.ground.upload import Upload, check_parts
from service.ground.vehicle import Button
from service.offline.exports.view import ExportOptions
from service.offline.site.start import Pair
from service.scans.annotations import (
    Line,
    LineString,
    Point,
    Spot,
    add_annotation,
    delete_annotation,
    read_annotations,
)

PAGE = Path(__file__).parent / "web" / "dist"
COMPRESSED = [Middleware(GZipMiddleware, compresslevel=5)]
"""For what a slow network is to carry and is no image: the page, and the list, asked for again and
again."""

MAX_LIVE_VIEWS = {False: 8, True: 16}
"""Without a token, and with one. uvicorn's limit is one for all requests together."""
ORDERS_HZ, ORDERS_AT_ONCE = 1.0, 10  # rate limit of orders to the vehicle; a stop always passes

NO_PAGE = (
    "<!doctype html><meta charset=utf-8><title>skyrelief</title><h1>skyrelief</h1>"
    "<p>The page was not built when skyrelief was installed. Build it with <code>npm ci</code>"
    " and <code>npm run build</code> in <code>service/ground/web</code>, or install again with"
    " the npm registry in reach. The interface works: <a href=/api/scans>scans</a>,"
    " <a href=/api/openapi.json>description</a>.</p>"
)


class LabelChange(Body):
    """A new title or tags, and the edition of the labels that they were made on."""

    title: str | None = None
    tags: list[str] | None = None
    edition: int | None = None


class NewAnnotation(Body):
    """A place (longitude, latitude, AMSL metres) or the places of a measurement, and the text."""

    text: str
    coordinates: Spot | None = None
    line: Line | None = None


class ExportOrder(Body):
    """A deliverable to make; ``vertical_datum`` is that of the heights as flown."""

    kind: Annotated[str, msgspec.Meta(extra_json_schema={"enum": list(KINDS)})]
    vertical_datum: str | None = None
    to_datum: str | None = None


class AlignOrder(Body):
    """A scan or a site with georeference, and three or more points of the scan on its ground."""

    drone: str
    scan: str
    points: list[Pair]


class ImportOrder(Body):
    """A scan folder or a recording of this machine."""

    folder: str


class VehicleOrder(Body):
    """An order to the companion."""

    action: Button
    metres: Annotated[float, msgspec.Meta(ge=0, le=1000)] | None = None


def portal_app(state: PortalState, tokens: Tokens, local: bool) -> ASGIApp:
    """The portal as an ASGI application; ``local`` when only this machine can reach it."""
    one = "/api/scans/{drone}/{scan}"
    routes: list[Any] = [
        Route("/", _page),
        Route("/api/scans", _scans, middleware=COMPRESSED),
        Route(one, _scan, methods=["GET"]),
        Route(one, _label, methods=["PATCH"]),
        Route(one, _delete, methods=["DELETE"]),
        Route(one + "/annotations", _annotations, methods=["GET"]),
        Route(one + "/annotations", _annotate, methods=["POST"]),
        Route(one + "/annotations/{number:int}", _erase_annotation, methods=["DELETE"]),
        *file_routes(one),
        *map_routes(),
        *control_routes(one),
        Route(one + "/exports", _products, methods=["GET"]),
        Route(one + "/exports", _export, methods=["POST"]),
        Route(one + "/alignment", _align, methods=["POST"]),
        WebSocketRoute(one + "/live", _live),
        Route("/api/jobs", _jobs, methods=["GET"]),
        Route("/api/jobs/{number:int}", _cancel, methods=["DELETE"]),
        Route("/api/bin", _bin),
        Route("/api/bin/{name}/restore", _restore, methods=["POST"]),
        Route("/api/import", _import, methods=["POST"]),
        Route(UPLOAD, _may_upload, methods=["GET"]),
        Route(UPLOAD, _upload, methods=["POST"]),
        Route("/api/logout", _logout, methods=["POST"]),
        Route("/api/status", _status),
        Route("/api/vehicle", _figures, methods=["GET"]),
        Route("/api/vehicle", _order, methods=["POST"]),
        Route("/metrics", _metrics),
    ]
    document = _description(routes)
    routes.append(Route("/api/openapi.json", lambda _: JSONResponse(document)))
    if PAGE.is_dir():
        files = StaticFiles(directory=PAGE / "assets", check_dir=False)
        routes.append(Mount("/assets", files, middleware=COMPRESSED))
    app = Starlette(
        routes=routes,
        exception_handlers=dict.fromkeys((InputError, OutsideError, HTTPException), _said),
    )
    app.state.portal = state
    app.state.tokens = tokens
    app.state.order_pace = Pace(ORDERS_HZ, ORDERS_AT_ONCE)
    return Guard(app, tokens, local, AuditLog(state.library.store))


def _description(routes: list[Any]) -> dict[str, Any]:
    """The routes as an OpenAPI document, from docstrings and bodies. Starlette's generator wants
    the same once more, as YAML in docstrings."""
    _, schemas = msgspec.json.schema_components(
        BODIES.values(), ref_template="#/components/schemas/{name}"
    )
    token = {"token": {"type": "http", "scheme": "bearer"}}
    paths: dict[str, dict[str, Any]] = {}
    for route in routes:
        if not route.endpoint.__doc__:
            continue
        parameters = [
            {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
            for name in route.param_convertors
        ]
        path = paths.setdefault(route.path_format, {"parameters": parameters} if parameters else {})
        methods = {"GET"} if isinstance(route, WebSocketRoute) else route.methods - {"HEAD"}
        path |= {method.lower(): _operation(route.endpoint, method) for method in methods}
    return {
        "openapi": "3.1.0",
        "info": {"title": "skyrelief portal", "version": "1"},
        "components": {"securitySchemes": token, "schemas": schemas},
        "paths": paths,
    }


def _operation(endpoint: Callable[..., Any], method: str) -> dict[str, Any]:
    """One operation; a change needs the token."""
    answers = {"2XX": {"description": "done"}}
    out: dict[str, Any] = {"summary": " ".join(str(endpoint.__doc__).split()), "responses": answers}
    if method in CHANGING:
        out["security"] = [{"token": []}]
        answers["401"] = {"description": "the token is missing"}
        answers["413"] = {"description": "the request is too large"}
    if endpoint in BODIES:
        schema = {"$ref": f"#/components/schemas/{BODIES[endpoint].__name__}"}
        out["requestBody"] = {"required": True, "content": {"application/json": {"schema": schema}}}
    return out


CODES = {MissingError: 404, ConflictError: 409, OutsideError: 503}  # of other refusals it is 400


def _said(request: HTTPConnection, error: Exception) -> Response:
    if isinstance(error, HTTPException):
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)
    status = next((code for kind, code in CODES.items() if isinstance(error, kind)), 400)
    return JSONResponse({"error": str(error)}, status)


def _page(request: Request) -> Response:
    index = PAGE / "index.html"
    return FileResponse(index) if index.is_file() else HTMLResponse(NO_PAGE)


def _is_growing(state: PortalState, entry: dict[str, Any]) -> bool:
    if entry["finished"]:
        return False
    heard_unix_s = state.receiving(entry["drone"], entry["scan"]).get("heard_unix_s", 0.0)
    return bool(heard_unix_s > time.time() - SILENT_S)


def _scans(request: Request) -> Response:
    """All scans, the newest first."""
    state = state_of(request)
    entries = state.library.scans()
    for entry in entries:
        entry["growing"] = _is_growing(state, entry)
    return JSONResponse(entries)


def _scan(request: Request) -> Response:
    """One scan with its files and jobs."""
    state, names = state_of(request), names_of(request)
    entry = state.library.entry(*names)
    entry["growing"] = _is_growing(state, entry)
    entry["jobs"] = state.jobs.of(state.library.folder(*names))
    return JSONResponse(entry)


@changing("rename", LabelChange)
def _label(request: Request, change: LabelChange) -> Response:
    """Rename or tag. With the edition that was seen: 409 when it is no longer the last."""
    note(request, "rename", title=change.title, tags=change.tags)
    library = state_of(request).library
    labels = library.label(*names_of(request), change.title, change.tags, change.edition)
    return JSONResponse(msgspec.to_builtins(labels))


@changing("delete")
def _delete(request: Request) -> Response:
    """Move a scan to the bin; its name there."""
    state, folder = state_of(request), folder_of(request)
    if (entry := state.receiving(*names_of(request))) and entry.get("open", True):
        raise HTTPException(409, "this scan is being received; delete it some minutes later")
    if state.jobs.busy(folder):
        raise HTTPException(409, "a deliverable of this scan is being made; wait for it")
    for kept in (state.coverages, state.maps):
        kept.forget(folder)
    return JSONResponse({"bin": state.library.delete(*names_of(request))})


def _annotations(request: Request) -> Response:
    """The annotations of a scan as GeoJSON."""
    return JSONResponse(msgspec.to_builtins(read_annotations(folder_of(request))))


@changing("annotate", NewAnnotation)
def _annotate(request: Request, new: NewAnnotation) -> Response:
    """Add a place with a text, or a named measurement; the feature."""
    note(request, "annotate", text=new.text)
    if (new.coordinates is None) == (new.line is None):
        raise InputError("the request is not valid: it gives coordinates or a line")
    geometry = LineString(new.line) if new.line else Point(new.coordinates or (0.0, 0.0, 0.0))
    by = str(request.scope[WHO]).partition(".")[0]
    with state_of(request).library.changing(*names_of(request)) as folder:
        made = add_annotation(folder, geometry, new.text, by, time.time())
    return JSONResponse(msgspec.to_builtins(made), 201)


@changing("erase annotation")
def _erase_annotation(request: Request) -> Response:
    """Delete an annotation."""
    number = request.path_params["number"]
    note(request, "erase annotation", number=number)
    with state_of(request).library.changing(*names_of(request)) as folder:
        delete_annotation(folder, number)
    return JSONResponse({})


def _products(request: Request) -> Response:
    """What can be made of a scan: what each is, its file, about its size and time."""
    library, names = state_of(request).library, names_of(request)
    entry = library.entry(*names)
    points = entry.get("counts", {}).get("points")
    return JSONResponse(products_of(library.folder(*names), points, entry["origin"] is not None))


@changing("export", ExportOrder)
def _export(request: Request, order: ExportOrder) -> Response:
    """Make a deliverable in the background, or refine the scan; the job."""
    note(request, "export", **msgspec.structs.asdict(order))
    with refusing("the request is not valid"):
        options = ExportOptions(vertical_datum=order.vertical_datum, to_datum=order.to_datum)
    job = state_of(request).jobs.start(folder_of(request), order.kind, options=options)
    return JSONResponse(job, 202)


@changing("align", AlignOrder)
def _align(request: Request, order: AlignOrder) -> Response:
    """Place a scan without georeference by points, and align it with another or a site; the job."""
    note(request, "align", to=f"{order.drone}/{order.scan}", points=len(order.points))
    state, folder = state_of(request), folder_of(request)
    other = state.library.folder(order.drone, order.scan)
    store = state.library.store
    work = partial(align_by_points, store, state.limits, other, folder, order.points)
    return JSONResponse(state.jobs.start(folder, "align", work), 202)


def _jobs(request: Request) -> Response:
    """Jobs that wait, run or have just ended: title, percent, what is being done, seconds left."""
    jobs = state_of(request).jobs.listed()
    return JSONResponse([job | {"title": job_title(job["kind"])} for job in jobs])


@changing("cancel")
def _cancel(request: Request) -> Response:
    """Cancel a job that waits or runs; the job."""
    number = request.path_params["number"]
    note(request, "cancel", job=number)
    return JSONResponse(state_of(request).jobs.cancel(number))


def _bin(request: Request) -> Response:
    """Names of deleted scans."""
    return JSONResponse(state_of(request).library.bin())


@changing("restore")
def _restore(request: Request) -> Response:
    """Bring a scan back; its drone and scan."""
    name = request.path_params["name"]
    note(request, "restore", name=name)
    drone, scan = state_of(request).library.restore(name)
    return JSONResponse({"drone": drone, "scan": scan})


@changing("import", ImportOrder)
def _import(request: Request, order: ImportOrder) -> Response:
    """Copy the known files of a scan folder, or an MCAP, of this machine in; 409 while another
    import runs."""
    note(request, "import", folder=order.folder)
    if not order.folder or "\0" in order.folder:
        raise InputError("give the folder or the .mcap to import")
    state = state_of(request)
    with state.library.importing():
        drone, scan = state.library.take(Path(order.folder))
    state.ended(state.library.folder(drone, scan))
    note(request, "import", scan=f"{drone}/{scan}")
    return JSONResponse({"drone": drone, "scan": scan}, 201)


def _parts(request: Request) -> list[tuple[str, int]]:
    """The ``name`` and ``bytes`` of each file of an upload."""
    names, sizes = (request.query_params.getlist(key)[:5] for key in ("name", "bytes"))
    if len(names) != len(sizes) or not all(map(is_length, sizes)):
        raise InputError("give the name and the bytes of each file")
    return [(name, int(size)) for name, size in zip(names, sizes, strict=True)]


def _may_upload(request: Request) -> Response:
    """Whether files, each with its ``name`` and ``bytes``, can be uploaded; else the reason."""
    if request.scope[WHO] is None:
        raise HTTPException(401, "an upload needs the token: open the printed address")
    check_parts(state_of(request).library, _parts(request))
    return JSONResponse({})


async def _upload(request: Request) -> Response:
    """Import the body: files one after the other, each with its ``name`` and ``bytes``. A ZIP of a
    scan folder, its scan.db or an MCAP becomes a scan at once; a video, with its flight log unless
    that is inside, in a job (202). 409 while another import runs."""
    parts, state = _parts(request), state_of(request)
    note(request, "upload", names=[name for name, _ in parts])
    upload = await run_in_threadpool(Upload, state.library, parts)
    try:
        async for data in request.stream():
            await run_in_threadpool(upload.write, data)
        await run_in_threadpool(upload.end)
        if upload.is_recording:
            video = max(parts, key=lambda part: part[1])[0]
            job = state.jobs.start(Path("upload") / Path(video).name[:100], "scan", upload.replay())
            return JSONResponse(job, 202)
        drone, scan = await run_in_threadpool(upload.finish)
        state.ended(state.library.folder(drone, scan))
    except ClientDisconnect:
        raise InputError("the upload was cancelled") from None
    finally:
        await run_in_threadpool(upload.close)
    note(request, "upload", scan=f"{drone}/{scan}")
    return JSONResponse({"drone": drone, "scan": scan}, 201)


@changing("logout")
def _logout(request: Request) -> Response:
    """End this browser's session."""
    return logged_out(request, request.app.state.tokens)


def _status(request: Request) -> Response:
    """Scans that are being received, and whether who asks has a session or the token."""
    state = state_of(request)
    return JSONResponse(
        {
            "session": request.scope[WHO] is not None,
            "up_s": round(time.monotonic() - state.started, 1),
            "live_views": sum(state.live_views.values()),
            "receiving": state.progress(),
        }
    )


def _figures(request: Request) -> Response:
    """Battery, satellites, speed, height, distance from home."""
    vehicle = state_of(request).vehicle
    return JSONResponse({"connected": None} if vehicle is None else vehicle.figures())


@changing("order", VehicleOrder)
def _order(request: Request, order: VehicleOrder) -> Response:
    """Give an order to the companion; 429 when they come too fast, but for stop."""
    note(request, order.action, metres=order.metres)
    vehicle = state_of(request).vehicle
    if vehicle is None:
        raise MissingError("no vehicle: start with 'skyrelief ground --vehicle ENDPOINT'")
    if order.action != "stop" and not request.app.state.order_pace.take():
        raise HTTPException(429, "too many commands; wait a second", {"retry-after": "1"})
    return JSONResponse(vehicle.order(order.action, order.metres))


def _metrics(request: Request) -> Response:
    """The receiver's figures in the text form of Prometheus. Not prometheus_client: two figures
    that another thread counts take as many lines with it."""
    lines = ["# TYPE skyrelief_received_bytes counter", "# TYPE skyrelief_keyframes gauge"]
    for entry in state_of(request).progress():
        labels = f'{{drone="{_quoted(entry["drone"])}",scan="{_quoted(entry["scan"])}"}}'
        lines.append(f"skyrelief_received_bytes{labels} {entry['received_bytes']}")
        lines.append(f"skyrelief_keyframes{labels} {entry['held'].get('k0', 0)}")
    return PlainTextResponse("\n".join(lines) + "\n")


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")


async def _live(socket: WebSocket) -> None:
    """WebSocket: chunks, corrections and track as they come."""
    state = state_of(socket)
    try:
        folder = folder_of(socket)
    except InputError as error:
        await socket.close(1008, str(error)[:100])
        return
    has_token = socket.scope[WHO] is not None
    if state.live_views[has_token] >= MAX_LIVE_VIEWS[has_token]:
        await socket.close(1013, "too many live views")
        return
    state.live_views[has_token] += 1
    try:
        await socket.accept()
        await serve_live(socket, state.library.store, folder, state.receiving)
    finally:
        state.live_views[has_token] -= 1
