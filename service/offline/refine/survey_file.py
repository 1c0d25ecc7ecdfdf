"""Surveyed points: where they are on the globe, and where images or the map have them.

A file is a CSV, or a ``gcp_list.txt`` as OpenDroneMap's users have it: the first line is a
coordinate system, each other one x, y, z of a point, its pixel, and the name of a still and of
the point. Heights that are all 0 are not surveyed. Or it is the XML of Metashape's markers. Pix4D
has places and marks in two files: below the coordinate system rows of name, x, y, z and, where they
are known, the accuracies across and up; and rows of image, name, u and v.

A row of a CSV without ``alt_amsl_m`` is of a point surveyed horizontally only. One row is one
sighting: ``keyframe_seq``, ``time`` or ``image`` with ``u_px,v_px`` in the camera's own image, or
``x,y,z`` in the delivered cloud's coordinates. A row without these is a point that is not marked.
Rows of one name are one point.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from recon.types import F64
from service.errors import InputError
from service.georeference import LocalFrame, is_system
from service.offline.refine.metashape_file import places_in, read_metashape
from service.small_file import read_small

LARGEST_BYTES = 10_000_000

Finite = Annotated[float, Meta(ge=-1e12, le=1e12)]
Sigma = Annotated[float, Meta(gt=0.0, le=100.0)]


class SurveyRow(msgspec.Struct, frozen=True):
    name: Annotated[str, Meta(min_length=1, pattern=r"\S")]
    lat: Annotated[float, Meta(ge=-90.0, le=90.0)]
    lon: Annotated[float, Meta(ge=-180.0, le=180.0)]
    alt_amsl_m: Annotated[float, Meta(ge=-1000.0, le=10_000.0)] | None = None
    sigma_h_m: Sigma = 0.03
    sigma_v_m: Sigma = 0.05
    role: Literal["control", "check"] = "control"
    keyframe_seq: Annotated[int, Meta(ge=0)] | None = None
    time: Finite | None = None
    image: str = ""
    u_px: Finite | None = None
    v_px: Finite | None = None
    x: Finite | None = None
    y: Finite | None = None
    z: Finite | None = None

    def __post_init__(self) -> None:
        which = (self.keyframe_seq is not None) + (self.time is not None) + bool(self.image)
        pixel, place = [self.u_px, self.v_px], [self.x, self.y, self.z]
        in_image = which == 1 and None not in pixel and place == [None] * 3
        in_map = which == 0 and None not in place and pixel == [None] * 2
        unmarked = which == 0 and pixel == [None] * 2 and place == [None] * 3
        if not (in_image or in_map or unmarked):
            raise ValueError(
                "give u_px and v_px with one of keyframe_seq, time (unix seconds) and image "
                "(name of a still), or x, y and z"
            )


Row = tuple[int, Mapping[str, object]]
"""Line number, and what it has of the fields of SurveyRow."""


@dataclass(frozen=True, slots=True)
class Sighting:
    """A mark in an image, or a point of the cloud."""

    line: int
    keyframe_seq: int | None = None
    time_unix_s: float | None = None
    image: str = ""  # file name of a still
    uv_px: tuple[float, float] | None = None
    xyz_m: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class SurveyPoint:
    """A surveyed point and its sightings."""

    name: str
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float | None  # None: surveyed horizontally only
    sigma_h_m: float
    sigma_v_m: float
    is_check: bool
    line: int
    sightings: tuple[Sighting, ...]

    def enu(self, frame: LocalFrame) -> F64:
        """(3,) m in a frame, at its zero where the height is not known."""
        alt = frame.alt_amsl_m if self.alt_amsl_m is None else self.alt_amsl_m
        return np.asarray(frame.to_enu(np.array([[self.lat_deg, self.lon_deg, alt]]))[0])


def read_survey(path: Path, marks: Path | None = None) -> list[SurveyPoint]:
    """The points of a file in order of their first row; some may have no marks.

    Raises InputError in one line, with the number of the line, for anything that is wrong.
    """
    lines = _lines(path)
    if marks is not None or _is_places(lines):
        return _marked(path, lines, marks)
    rows = _marks if is_list(lines) else _rows
    if lines and lines[0].lstrip().startswith("<"):
        rows = _markers
    points: dict[str, SurveyPoint] = {}
    for line, fields in rows(path, lines):
        with _fault_in(f"{path} line {line}"):
            point = _point(line, fields)
        before = points.setdefault(point.name, point)
        if before is point:
            continue
        if replace(point, line=before.line, sightings=before.sightings) != before:
            raise InputError(
                f"{path} line {line}: {point.name} differs from line {before.line} in place, "
                "sigma or role; one name is one point"
            )
        points[point.name] = replace(before, sightings=before.sightings + point.sightings)
    if not points:
        raise InputError(f"{path}: no points below the first line")
    return list(points.values())


@contextmanager
def _fault_in(where: str) -> Iterator[None]:
    """What is wrong, and in which column, as InputError in one line that begins with ``where``."""
    try:
        yield
    except (ValueError, msgspec.ValidationError) as error:
        text, _, column = str(error).partition(" - at `$")
        name = column.strip(".`")
        raise InputError(f"{where}: {f'{name}: ' if name else ''}{text}") from error


def _lines(path: Path) -> list[str]:
    try:
        data = read_small(path, LARGEST_BYTES, "file of surveyed points")
        return data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path} cannot be read ({error}); it should be CSV in UTF-8") from error


def at_times(
    survey: Sequence[SurveyPoint], times_unix_s: Mapping[str, float], path: Path
) -> list[SurveyPoint]:
    """The points with the time of each still that they name, with or without its extension.

    Raises InputError, with the line, for a name that is not among ``times_unix_s``.
    """
    known = {Path(name).stem: time_s for name, time_s in times_unix_s.items()} | dict(times_unix_s)
    return [
        replace(point, sightings=tuple(_at_time(s, known, path) for s in point.sightings))
        for point in survey
    ]


def _at_time(seen: Sighting, times_unix_s: Mapping[str, float], path: Path) -> Sighting:
    if not seen.image or seen.image in times_unix_s:
        return replace(seen, time_unix_s=times_unix_s.get(seen.image, seen.time_unix_s))
    why = "is not in the folder of --video" if times_unix_s else "needs --video with its folder"
    raise InputError(f"{path} line {seen.line}: image {seen.image} {why}")


def _markers(path: Path, lines: Sequence[str]) -> Iterator[Row]:
    """Each mark of Metashape's markers."""
    try:
        yield from read_metashape("\n".join(lines))
    except ValueError as error:
        raise InputError(f"{path} {error}") from error


def _pix4d_marks(path: Path) -> dict[str, list[Sighting]]:
    """The sightings in a file of marks, by the name of their point."""
    found: dict[str, list[Sighting]] = {}
    for line, cells in _cells(_lines(path)):
        try:
            image, name, u, v = cells[:4]
            uv_px = msgspec.convert((u, v), tuple[Finite, Finite], strict=False)
        except (ValueError, msgspec.ValidationError) as error:
            if line == 1:
                continue  # names of the columns
            raise InputError(f"{path} line {line}: image, point, u and v are needed") from error
        found.setdefault(_name(name), []).append(Sighting(line, image=image, uv_px=uv_px))
    return found


def _marked(path: Path, lines: Sequence[str], marks: Path | None) -> list[SurveyPoint]:
    """The points below the coordinate system in ``lines``, with their sightings in ``marks``."""
    seen = {} if marks is None else _pix4d_marks(marks)
    place_of, points = _places(path, lines), dict[str, SurveyPoint]()
    for number, cells in _cells(lines[1:], 2):
        where = f"{path} line {number}"
        with _fault_in(f"{where}: name, x, y, z and accuracies"):
            name, x, y, z, *sigmas = cells
            named = dict(zip(("sigma_h_m", "sigma_v_m"), map(float, sigmas[:2]), strict=False))
            point = _point(number, {"name": name, **place_of(x, y, z), **named})
        name = point.name
        if name in points:
            raise InputError(f"{where}: {name} is also in line {points[name].line}")
        points[name] = replace(point, sightings=tuple(seen.get(name, ())))
    for name in seen:
        if name not in points:
            raise InputError(f"{marks} line {seen[name][0].line}: {path} has no point {name!r}")
    return list(points.values())


def _cells(lines: Sequence[str], first: int = 1) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line, between commas, semicolons, tabs or, without one, spaces."""
    for number, line in enumerate(lines, first):
        if line.strip() and not line.startswith("#"):
            mark = next((mark for mark in ",;\t" if mark in line), None)
            yield number, [cell.strip() for cell in line.split(mark)]


def _is_places(lines: Sequence[str]) -> bool:
    """Whether a file is places alone: names with x, y and z below a coordinate system."""
    row = next((cells for _, cells in _cells(lines[1:])), [])
    if not 4 <= len(row) < LIST_COLUMNS + 1 or is_list(lines):
        return False
    return is_system(lines[0])


LIST_COLUMNS = 6


def is_list(lines: Sequence[str]) -> bool:
    """Whether a file is a ``gcp_list.txt``: rows of six columns between spaces."""
    rows = (line.split() for line in lines[1:] if line.strip() and not line.startswith("#"))
    return len(next(rows, ())) >= LIST_COLUMNS and "lat" not in lines[0].split(",")


def _places(path: Path, lines: Sequence[str]) -> Callable[[str, str, str | None], dict[str, Any]]:
    """:func:`places_in` of the coordinate system in the first line."""
    with _fault_in(f"{path} line 1"):
        return places_in(lines[0] if lines else "")


def _marks(path: Path, lines: Sequence[str]) -> Iterator[Row]:
    """Each row of a ``gcp_list.txt``."""
    place_of = _places(path, lines)
    table = [(n, s.split()) for n, s in enumerate(lines[1:], 2) if s.strip() and s[0] != "#"]
    is_flat = all(
        cells[2:3] in (["0"], ["0.0"], ["0.00"], ["0.000"], ["NaN"]) for _, cells in table
    )
    names: dict[tuple[str, ...], str] = {}
    for number, cells in table:
        with _fault_in(f"{path} line {number}"):
            if len(cells) < LIST_COLUMNS:
                raise ValueError(f"{len(cells)} columns; x, y, z, u, v and an image are needed")
            name = names.setdefault(tuple(cells[:3]), f"point {len(names) + 1}")
            row = place_of(cells[0], cells[1], None if is_flat else cells[2]) | {
                "name": cells[6] if len(cells) > LIST_COLUMNS else name,
                "u_px": float(cells[3]), "v_px": float(cells[4]), "image": cells[5],
            }  # fmt: skip
        yield number, row


def _rows(path: Path, lines: Sequence[str]) -> Iterator[Row]:
    """Each row of a CSV."""
    table = csv.reader(lines)
    try:
        header = [name.strip() for name in next(table, [])]
        known = SurveyRow.__struct_fields__
        is_whole = {"name", "lat", "lon"} <= set(header) <= set(known)
        if len(set(header)) < len(header) or not is_whole:
            raise InputError(
                f"{path} line 1: columns {', '.join(header)[:200]!r}; name, lat and lon are "
                f"needed, each once, separated by commas; there are {', '.join(known)}"
            )
        for cells in table:
            if not any(cell.strip() for cell in cells) or cells[0].startswith("#"):
                continue
            if len(cells) > len(header):
                raise InputError(
                    f"{path} line {table.line_num}: {len(cells)} cells, but {len(header)} columns; "
                    "decimals take a point, not a comma"
                )
            named = zip(header, cells, strict=False)
            yield table.line_num, {name: v for name, cell in named if (v := cell.strip())}
    except csv.Error as error:
        raise InputError(f"{path} line {table.line_num}: not CSV ({error})") from error


def _name(text: str) -> str:
    """A point's name on one line, as a file can keep it."""
    return " ".join(text.split())


def _point(line: int, fields: Mapping[str, object]) -> SurveyPoint:
    """The point of one row, with its sighting. Raises ValidationError."""
    row = msgspec.convert(fields, SurveyRow, strict=False)
    mark = Sighting(line, row.keyframe_seq, row.time, row.image)
    marks: tuple[Sighting, ...] = ()
    if row.u_px is not None and row.v_px is not None:
        marks = (replace(mark, uv_px=(row.u_px, row.v_px)),)
    elif row.x is not None and row.y is not None and row.z is not None:
        marks = (replace(mark, xyz_m=(row.x, row.y, row.z)),)
    return SurveyPoint(
        _name(row.name), row.lat, row.lon, row.alt_amsl_m, row.sigma_h_m, row.sigma_v_m,
        row.role == "check", line, marks,
    )  # fmt: skip
