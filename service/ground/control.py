"""Control points of a scan over HTTP: their file, the images that show them, marks by hand."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import msgspec
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from service.errors import InputError
from service.ground.bodies import Body, JSONResponse, changing
from service.ground.guard import note
from service.ground.scan_files import seq_of
from service.ground.state import folder_of, state_of
from service.offline.refine.marking import (
    GCP,
    Marked,
    Marking,
    image_of,
    marked,
    survey_text,
    without_stills,
)
from service.offline.refine.survey_file import SurveyPoint, read_survey
from service.scans.writing import write_whole
from service.stream.store import ScanStore

_WRITING = threading.Lock()
MAX_POINTS, MAX_MARKS = 1000, 20_000  # the page asks for all of them again after each mark

Px = Annotated[float, msgspec.Meta(ge=-1.0, le=100_000.0)]


class ControlFile(Body):
    """The text of a file of control points, and of Pix4D's file of marks."""

    text: str
    marks: str | None = None


class NewMark(Body):
    """Where a keyframe's image shows a point, in the camera's pixels; null: nowhere."""

    name: str
    keyframe_seq: Annotated[int, msgspec.Meta(ge=0, le=2**31)]
    uv_px: tuple[Px, Px] | None


def control_routes(one: str) -> list[Route]:
    return [
        Route(one + "/control-points", _points, methods=["GET"]),
        Route(one + "/control-points", _replace, methods=["PUT"]),
        Route(one + "/control-points", _mark, methods=["POST"]),
        Route(one + "/control-points/images/{seq}.jpg", _image),
    ]


def _points(request: Request) -> Response:
    """The control points of a scan: the images that show each, where it is expected and marked
    there, and how far the map is off (map less survey: east, north, up)."""
    folder = folder_of(request)
    return JSONResponse(_listed(folder, _known(folder)))


@changing("control points", ControlFile)
def _replace(request: Request, given: ControlFile) -> Response:
    """Give a scan its control points, in any form that `refine --gcp` reads; the points. Marks in
    stills, by file name, are left out."""
    folder = folder_of(request)
    with tempfile.TemporaryDirectory() as place:
        path, marks = Path(place) / "points", None
        path.write_text(given.text, encoding="utf-8")
        if given.marks is not None:
            marks = Path(place) / "marks"
            marks.write_text(given.marks, encoding="utf-8")
        survey = _read(path, marks)
    with _WRITING:
        return _kept(folder, survey)


@changing("mark", NewMark)
def _mark(request: Request, new: NewMark) -> Response:
    """Mark a point in a keyframe's image, or take the mark away; the points."""
    note(request, "mark", point=new.name, keyframe=new.keyframe_seq)
    folder = folder_of(request)
    with _WRITING:
        return _kept(folder, marked(_known(folder), new.name, new.keyframe_seq, new.uv_px))


async def _image(request: Request) -> Response:
    """The image of a keyframe with the lens's distortion: the frame of a recording in the scan's
    folder, else as the scan stores it."""
    folder, seq = folder_of(request), seq_of(request)

    def decoded() -> bytes:
        with ScanStore.peek(folder / "scan.db") as store:
            return image_of(folder, store, seq)

    async with state_of(request).decoding:
        return Response(await run_in_threadpool(decoded), media_type="image/jpeg")


def _known(folder: Path) -> list[SurveyPoint]:
    """The points kept with a scan; their file may have come from elsewhere."""
    return _read(folder / GCP) if (folder / GCP).exists() else []


def _read(path: Path, marks: Path | None = None) -> list[SurveyPoint]:
    try:
        return without_stills(read_survey(path, marks))
    except InputError as error:  # whose paths are of this machine
        raise InputError(str(error).replace(f"{path.parent}/", "")) from error


def _kept(folder: Path, survey: Sequence[SurveyPoint]) -> Response:
    """The points as they are listed, written once all marks fit the scan."""
    listed = _listed(folder, survey)
    write_whole(folder / GCP, survey_text(survey))
    return JSONResponse(listed)


def _listed(folder: Path, survey: Sequence[SurveyPoint]) -> dict[str, Any]:
    if len(survey) > MAX_POINTS or sum(len(p.sightings) for p in survey) > MAX_MARKS:
        raise InputError(f"more than {MAX_POINTS} points or {MAX_MARKS} marks")
    with ScanStore.peek(folder / "scan.db") as store:
        marking = Marking(store)
        return {
            "size_px": marking.camera.size_px,
            "points": [_shown(one) for one in marking.of(survey)],
        }


def _shown(one: Marked) -> dict[str, Any]:
    p = one.point
    return {
        "name": p.name,
        "role": "check" if p.is_check else "control",
        "place": [p.lon_deg, p.lat_deg, p.alt_amsl_m],
        "sigma_m": [p.sigma_h_m, p.sigma_v_m],
        "marks": len(p.sightings),
        "off_m": one.off_m,
        "why_not": one.why_not,
        "images": [asdict(image) for image in one.images],
    }
