"""Files of a scan over HTTP: deliverables, 3D Tiles, keyframes' images, coverage."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, cast

import cv2
import numpy as np
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import Route

from recon.types import Keyframe
from service.errors import InputError, MissingError
from service.georeference import line_geometry
from service.ground.live import FlightPath
from service.ground.state import folder_of, names_of, state_of
from service.ground.storage import is_regular
from service.offline.exports import EXPORTERS
from service.offline.exports.maps import MANIFEST
from service.offline.refine.refly import (
    NO_FLIGHT,
    geojson,
    plan_json,
    suggest,
    waypoints_text,
)
from service.scans.main_piece import main_track
from service.scans.track import local_frame
from service.stream.codec import whole_bgr
from service.stream.planes import image_size
from service.stream.store import ScanStore

TILE = re.compile(r"[A-Za-z0-9_]{1,80}\.(json|pnts|b3dm|glb)")
"""Names that py3dtiles gives its files; all are in one folder."""

DEEPEST_TILE = 8
MAPS = EXPORTERS["all"][1]
FOLDERS = {name for _, name, _ in EXPORTERS.values() if "." not in name}
ZIP_PART_BYTES = 1 << 20
SEQ = re.compile(r"[0-9]{1,9}")

DARK = (45, 38, 32)  # where an image shows nothing, BGR
QUALITY = 85  # of JPEG, 1 to 100
SANDBOX = {
    "content-security-policy": "sandbox; default-src 'none'; style-src 'unsafe-inline';"
    " img-src data:"
}


def file_routes(one: str) -> list[Route]:
    return [
        Route(one + "/files/{name}", _file),
        Route(one + "/{folder}.zip", _zipped),
        Route(one + "/tiles/{name:path}", _tile),
        Route(one + "/keyframes/{seq}.jpg", _image),
        Route(one + "/coverage.png", _coverage),
        Route(one + "/coverage.json", _coverage),
        Route(one + "/refly.{kind}", _refly),
        Route(one + "/track.geojson", _track),
    ]


def _file(request: Request) -> Response:
    """A deliverable; byte ranges are honoured."""
    path = state_of(request).library.file(*names_of(request), request.path_params["name"])
    if path.name in ("preview.jpg", "thumbnail.webp", "mesh.glb"):
        return FileResponse(path)
    if path.name in ("report.html", "change.html"):
        return FileResponse(path, headers=SANDBOX)
    return FileResponse(path, filename=f"{request.path_params['scan']}-{path.name}")


def _zipped(request: Request) -> Response:
    """A product that is a folder, in one zip: maps, mesh-obj, colmap, 3dtiles or 3dtiles-mesh."""
    name = request.path_params["folder"]
    folder = folder_of(request) / name
    is_there = name in FOLDERS and folder.is_dir() and not folder.is_symlink()
    if not is_there or (name == MAPS and not is_regular(folder / MANIFEST)):  # written last
        raise MissingError(f"no {name} yet; make it first")
    name = f"{request.path_params['scan']}-{name}.zip"
    headers = {"content-disposition": f'attachment; filename="{name}"'}  # FileResponse's alone
    return StreamingResponse(zip_parts(folder), media_type="application/zip", headers=headers)


class _Pipe(list[bytes]):
    """Keeps what is written until it is taken: zipfile needs a file, and a package for streaming
    (zipstream-ng) would replace these lines only."""

    def write(self, data: Any) -> int:
        self.append(bytes(data))
        return len(self[-1])

    def flush(self) -> None:
        pass

    def take(self) -> bytes:
        out = b"".join(self)
        self.clear()
        return out


def zip_parts(folder: Path) -> Iterator[bytes]:
    """The regular files of a folder, and of those in it, as a zip, made while it is read."""
    pipe = _Pipe()
    with zipfile.ZipFile(cast(IO[bytes], pipe), "w") as whole:
        for path in sorted(p for p in folder.rglob("*") if is_regular(p)):
            about = zipfile.ZipInfo.from_file(path, path.relative_to(folder))
            with whole.open(about, "w", force_zip64=True) as out, open(path, "rb") as file:
                while data := file.read(ZIP_PART_BYTES):
                    out.write(data)
                    yield pipe.take()
    yield pipe.take()


def _tile(request: Request) -> Response:
    """A file of the scan's 3D Tiles, from ``3dtiles/`` or a folder in it."""
    folder = folder_of(request) / "3dtiles"
    *inner, name = request.path_params["name"].split("/")
    fit = TILE.fullmatch(name) and all(re.fullmatch(r"[A-Za-z0-9_]{1,80}", part) for part in inner)
    path = folder.joinpath(*inner, name) if fit and len(inner) < DEEPEST_TILE else folder
    if not is_regular(path):
        raise MissingError("no such tile")
    return FileResponse(path)


def _image(request: Request) -> Response:
    """The JPEG of a whole keyframe, finest where it is new; of an older scan only what was new."""
    seq = seq_of(request)
    with ScanStore.peek(folder_of(request) / "scan.db") as store:
        data, keyframe = store.image(seq), store.keyframe(seq)
    if keyframe is not None:
        data = _jpeg(keyframe, data)
    if data is None:
        raise MissingError("no such keyframe")
    return Response(data, media_type="image/jpeg")


def seq_of(request: Request) -> int:
    """The keyframe in the path. Raises InputError for what is no number of one."""
    if not SEQ.fullmatch(request.path_params["seq"]):
        raise MissingError("no such keyframe")
    return int(request.path_params["seq"])


def _jpeg(keyframe: Keyframe, image: bytes | None) -> bytes:
    """The keyframe's ``image``, with its own colours where they are new and no coarser."""
    if image is None:
        shown = np.where(keyframe.fresh[..., None], keyframe.bgr, np.array(DARK, np.uint8))
    elif keyframe.bgr.shape[1] >= (image_size(image) or (0,))[0]:
        shown = whole_bgr(keyframe, image)
    else:
        return image
    return cv2.imencode(".jpg", shown, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))[1].tobytes()


def _coverage(request: Request) -> Response:
    """The coverage layer as it is now, also of a scan that still grows."""
    found = state_of(request).coverages.view(folder_of(request)).found
    if found is None:
        raise MissingError("no surface yet")
    if request.scope["path"].endswith(".png"):
        return Response(found.png_bytes(), media_type="image/png")
    return Response(found.json_bytes(), media_type="application/json")


def _track(request: Request) -> Response:
    """The flight path so far as GeoJSON: longitude, latitude and metres above mean sea level."""
    with ScanStore.peek(folder_of(request) / "scan.db") as store:
        frame, path = local_frame(store.header), FlightPath(store)
        path.grown()
    if frame is None:
        raise MissingError("no track on a map: the scan has no georeference")
    places = frame.to_geodetic(np.array(path.places(), np.float64).reshape(-1, 3))
    geometry = line_geometry(places[:, [1, 0, 2]]) if len(places) > 1 else None
    document = {"type": "Feature", "properties": {}, "geometry": geometry}
    return Response(json.dumps(document), media_type="application/geo+json")


def _refly(request: Request) -> Response:
    """A flight over the gaps and weak places as they are now: geojson (lines and the ground that
    their images cover), plan (QGroundControl) or waypoints (Mission Planner)."""
    kind = request.path_params["kind"]
    if kind not in ("geojson", "plan", "waypoints"):
        raise InputError("there is refly.geojson, refly.plan and refly.waypoints")
    folder = folder_of(request)
    found = state_of(request).coverages.view(folder).found
    if found is None:
        raise MissingError("no surface yet")
    if found.frame is None:
        raise InputError("the scan has no georeference")
    with ScanStore.peek(folder / "scan.db") as store:
        flight = suggest(found, main_track(store))
    if kind == "geojson":
        return Response(geojson(flight, found.frame), media_type="application/geo+json")
    if flight is None:
        raise MissingError(NO_FLIGHT)
    text = plan_json(flight) if kind == "plan" else waypoints_text(flight)
    name = f"{request.path_params['scan']}-refly.{kind}"
    return Response(text, headers={"content-disposition": f'attachment; filename="{name}"'})
