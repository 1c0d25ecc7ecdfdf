"""What can be fetched of a scan: deliverables, 3D Tiles, keyframes' pictures, coverage."""

from __future__ import annotations

import re

import cv2
import numpy as np
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from recon.types import U8, Bool
from service.errors import InputError
from service.ground.state import names_of, state_of
from service.ground.storage import is_regular
from service.stream.store import ScanStore

TILE = re.compile(r"[A-Za-z0-9_]{1,80}\.(json|pnts|b3dm|glb)")
"""What py3dtiles names its files; all lie in one folder."""

DEEPEST_TILE = 8
SEQ = re.compile(r"[0-9]{1,9}")

JPEG_QUALITY = 82
DARK = (45, 38, 32)
SANDBOX = {
    "content-security-policy": "sandbox; default-src 'none'; style-src 'unsafe-inline';"
    " img-src data:"
}


def file_routes(one: str) -> list[Route]:
    """The routes below ``one``, the address of a scan."""
    return [
        Route(one + "/files/{name}", _file),
        Route(one + "/tiles/{name:path}", _tile),
        Route(one + "/keyframes/{seq}.jpg", _picture),
        Route(one + "/coverage.png", _coverage),
        Route(one + "/coverage.json", _coverage),
    ]


def _file(request: Request) -> Response:
    """A deliverable; byte ranges are honoured."""
    path = state_of(request).library.file(*names_of(request), request.path_params["name"])
    if path.name in ("preview.jpg", "mesh.glb"):
        return FileResponse(path)
    if path.name == "report.html":
        return FileResponse(path, headers=SANDBOX)
    return FileResponse(path, filename=f"{request.path_params['scan']}-{path.name}")


def _tile(request: Request) -> Response:
    """A file of the scan's 3D Tiles, from ``3dtiles/`` or a folder in it."""
    folder = state_of(request).library.folder(*names_of(request)) / "3dtiles"
    *inner, name = request.path_params["name"].split("/")
    fit = TILE.fullmatch(name) and all(re.fullmatch(r"[A-Za-z0-9_]{1,80}", part) for part in inner)
    path = folder.joinpath(*inner, name) if fit and len(inner) < DEEPEST_TILE else folder
    if not is_regular(path):
        raise InputError("no such tile")
    return FileResponse(path)


def _picture(request: Request) -> Response:
    """The colours of a keyframe as JPEG; small gaps are closed, the rest is dark."""
    folder = state_of(request).library.folder(*names_of(request))
    if not SEQ.fullmatch(request.path_params["seq"]):
        raise InputError("no such keyframe")
    with ScanStore.open(folder / "scan.db") as store:
        keyframe = store.keyframe(int(request.path_params["seq"]))
    if keyframe is None:
        raise InputError("no such keyframe")
    bgr = _closed(keyframe.bgr, keyframe.fresh)
    ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not ok:
        raise InputError("no picture in this keyframe")
    return Response(data.tobytes(), media_type="image/jpeg")


def _closed(bgr: U8, known: Bool) -> U8:
    """The picture with gaps filled from around, as far as a twentieth of its width."""
    out = np.where(known[..., None], bgr, 0).astype(np.float32)
    weight = known.astype(np.float32)
    side = max(3, bgr.shape[1] // 80)
    for k in (3, side | 1, (2 * side) | 1, (4 * side) | 1):
        total = cv2.boxFilter(weight, -1, (k, k), normalize=False)
        new = (weight == 0.0) & (total > 0.08 * k * k)
        sums = cv2.boxFilter(out * weight[..., None], -1, (k, k), normalize=False)
        out[new] = sums[new] / total[new, None]
        weight[new] = 1.0
    out[weight == 0.0] = DARK
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


def _coverage(request: Request) -> Response:
    """The coverage layer as it is now, also of a scan that still grows."""
    state = state_of(request)
    found = state.coverages.of(state.library.folder(*names_of(request)))
    if found is None:
        raise InputError("no surface yet")
    if request.scope["path"].endswith(".png"):
        return Response(found.png_bytes(), media_type="image/png")
    return Response(found.json_bytes(), media_type="application/json")
