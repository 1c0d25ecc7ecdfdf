"""JSON of the portal's requests and answers, and the endpoints that change something."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import wraps
from typing import Any

import msgspec
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse as StarletteJSONResponse
from starlette.responses import Response

from service.errors import InputError
from service.ground.guard import note

BODIES: dict[Callable[..., Any], type[msgspec.Struct]] = {}  # bodies of the endpoints that take one


class Body(msgspec.Struct, forbid_unknown_fields=True):
    """The JSON object of a request."""


class JSONResponse(StarletteJSONResponse):
    """JSON in ASCII: any text can be sent, also one with a lone surrogate."""

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode("ascii")


def changing(action: str, body: type[Body] | None = None) -> Callable[..., Callable[..., Any]]:
    """Makes an endpoint of ``work(request)`` or ``work(request, body)``, which runs on a thread.
    The audit log gets the ``action`` and the scan, also where the body is refused."""

    def decorate(work: Callable[..., Response]) -> Callable[..., Any]:
        @wraps(work)
        async def endpoint(request: Request) -> Response:
            note(request, action)
            if "scan" in request.path_params:
                note(request, action, scan="{drone}/{scan}".format(**request.path_params))
            if body is None:
                return await run_in_threadpool(work, request)
            try:  # Starlette's own checks no types
                given = msgspec.json.decode(await request.body(), type=body)
            except ClientDisconnect:
                raise InputError("the request was cancelled") from None
            except (ValueError, RecursionError) as error:
                raise InputError(f"the request is not valid: {error}"[:300]) from error
            return await run_in_threadpool(work, request, given)

        if body is not None:
            BODIES[endpoint] = body
        return endpoint

    return decorate
