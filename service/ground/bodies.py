"""JSON of the portal's requests and answers."""

from __future__ import annotations

import json
from typing import Any, TypeVar

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse as StarletteJSONResponse

from service.errors import InputError

T = TypeVar("T")


class JSONResponse(StarletteJSONResponse):
    """JSON in ASCII: any text can be sent, also one with a lone surrogate."""

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode("ascii")


async def body_of(request: Request, kind: type[T]) -> T:
    """The JSON object sent; InputError for anything else. Starlette's own checks no types."""
    try:
        return msgspec.json.decode(await request.body(), type=kind)
    except ClientDisconnect:
        raise InputError("the request was cancelled") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"the request is not valid: {error}"[:300]) from error
