"""Surveyed points of a CSV: where they are on the globe, and where images or the map have them.

A row without ``alt_amsl_m`` is of a point surveyed horizontally only.

One row is one sighting: ``keyframe_seq``, ``time`` or ``image`` with ``u_px,v_px`` in the camera's
own image, or ``x,y,z`` in the delivered cloud's coordinates. Rows of one name are one point.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from service.errors import InputError
from service.small_file import read_small

PLACE = ("lat", "lon")
HEIGHT = "alt_amsl_m"
IMAGE = ("u_px", "v_px")
MAP = ("x", "y", "z")
WHICH = ("keyframe_seq", "time", "image")
COLUMNS = (
    "name", *WHICH, *IMAGE, *MAP, *PLACE, HEIGHT, "sigma_h_m", "sigma_v_m",
    "role",
)  # fmt: skip
ROLES = ("control", "check")
USUAL_SIGMA_H_M, USUAL_SIGMA_V_M = 0.03, 0.05
LARGEST_BYTES = 10_000_000


@dataclass(frozen=True, slots=True)
class Sighting:
    """One row: a mark in an image, or a point of the cloud."""

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


def read_survey(path: Path) -> list[SurveyPoint]:
    """The points of a CSV in order of their first row.

    Raises InputError in one line, with the number of the line, for anything that is wrong.
    """
    points: dict[str, SurveyPoint] = {}
    for line, row in _rows(path):
        point = _point(path, line, row)
        before = points.get(point.name)
        if before is None:
            points[point.name] = point
            continue
        if _said(before) != _said(point):
            raise InputError(
                f"{path} line {line}: {point.name} differs from line {before.line} in place, "
                "sigma or role; one name is one point"
            )
        points[point.name] = SurveyPoint(
            *_said(before), before.line, before.sightings + point.sightings
        )
    if not points:
        raise InputError(f"{path}: no points below the header")
    return list(points.values())


def at_times(
    survey: Sequence[SurveyPoint], times_unix_s: Mapping[str, float], path: Path
) -> list[SurveyPoint]:
    """The points with the time of each still that they name.

    Raises InputError, with the line, for a name that is not among ``times_unix_s``.
    """
    return [
        replace(point, sightings=tuple(_at_time(s, times_unix_s, path) for s in point.sightings))
        for point in survey
    ]


def _at_time(seen: Sighting, times_unix_s: Mapping[str, float], path: Path) -> Sighting:
    if not seen.image or seen.image in times_unix_s:
        return replace(seen, time_unix_s=times_unix_s.get(seen.image, seen.time_unix_s))
    why = "is not in the folder of --video" if times_unix_s else "needs --video with its folder"
    raise InputError(f"{path} line {seen.line}: image {seen.image} {why}")


def _said(p: SurveyPoint) -> tuple[str, float, float, float | None, float, float, bool]:
    return p.name, p.lat_deg, p.lon_deg, p.alt_amsl_m, p.sigma_h_m, p.sigma_v_m, p.is_check


def _rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Line number and the filled cells by column."""
    try:
        text = read_small(path, LARGEST_BYTES, "CSV of surveyed points").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} cannot be read ({error}); it should be CSV in UTF-8") from error
    table = csv.reader(text.splitlines())
    try:
        header = [name.strip() for name in next(table, [])]
        _check_header(path, header)
        for cells in table:
            if not any(cell.strip() for cell in cells) or cells[0].startswith("#"):
                continue
            if len(cells) > len(header):
                raise InputError(
                    f"{path} line {table.line_num}: {len(cells)} cells, but {len(header)} columns; "
                    "decimals take a point, not a comma"
                )
            filled = zip(header, (c.strip() for c in cells), strict=False)
            yield table.line_num, {name: cell for name, cell in filled if cell}
    except csv.Error as error:
        raise InputError(f"{path} line {table.line_num}: not CSV ({error})") from error


def _check_header(path: Path, header: list[str]) -> None:
    unknown = [name for name in header if name not in COLUMNS]
    missing = [name for name in ("name", *PLACE) if name not in header]
    if any(";" in name or "\t" in name for name in header):
        raise InputError(f"{path} line 1: columns must be separated by commas")
    if unknown or len(set(header)) < len(header):
        what = f"unknown column {unknown[0]!r}" if unknown else "a column twice"
        raise InputError(f"{path} line 1: {what}; there are {', '.join(COLUMNS)}")
    if missing:
        raise InputError(
            f"{path} line 1: column {missing[0]} is missing; name, {', '.join(PLACE)} and either "
            "u_px,v_px with keyframe_seq, time or image, or x,y,z are needed"
        )
    if not (set(IMAGE) <= set(header) or set(MAP) <= set(header)):
        raise InputError(f"{path} line 1: neither u_px,v_px nor x,y,z; where are the points seen?")


def _point(path: Path, line: int, row: Mapping[str, str]) -> SurveyPoint:
    """The point of one row, with its one sighting."""
    where = f"{path} line {line}"
    name = row.get("name", "")
    if not name:
        raise InputError(f"{where}: no name; give each point one")
    lat, lon = (_number(where, row, key) for key in PLACE)
    alt = _number(where, row, HEIGHT) if HEIGHT in row else None
    if not abs(lat) <= 90.0 or not abs(lon) <= 180.0:
        raise InputError(
            f"{where}: lat {lat:g}, lon {lon:g} is not on the globe; degrees, latitude first"
        )
    if alt is not None and not -1000.0 < alt < 10_000.0:
        raise InputError(f"{where}: alt_amsl_m {alt:g} is not metres above sea level")
    sigma_h = _number(where, row, "sigma_h_m", USUAL_SIGMA_H_M)
    sigma_v = _number(where, row, "sigma_v_m", USUAL_SIGMA_V_M)
    if not (0.0 < sigma_h <= 100.0 and 0.0 < sigma_v <= 100.0):
        raise InputError(f"{where}: a sigma must be over 0 and at most 100 m")
    role = row.get("role", "control").lower()
    if role not in ROLES:
        raise InputError(f"{where}: role {role!r} is neither control nor check")
    seen = _sighting(where, line, row)
    return SurveyPoint(name, lat, lon, alt, sigma_h, sigma_v, role == "check", line, (seen,))


def _sighting(where: str, line: int, row: Mapping[str, str]) -> Sighting:
    in_map = [key for key in MAP if key in row]
    in_image = [key for key in (*IMAGE, *WHICH) if key in row]
    if in_map and in_image:
        raise InputError(f"{where}: give {in_image[0]} or {in_map[0]}, not both in one row")
    if in_map:
        x, y, z = (_number(where, row, key) for key in MAP)
        return Sighting(line, xyz_m=(x, y, z))
    u, v = (_number(where, row, key) for key in IMAGE)
    if sum(key in row for key in WHICH) != 1:
        raise InputError(
            f"{where}: give one of keyframe_seq, time (unix seconds), image (name of a still)"
        )
    if "image" in row:
        return Sighting(line, image=row["image"], uv_px=(u, v))
    if "time" in row:
        return Sighting(line, time_unix_s=_number(where, row, "time"), uv_px=(u, v))
    seq = _number(where, row, "keyframe_seq")
    if seq != int(seq) or seq < 0:
        raise InputError(f"{where}: keyframe_seq {row['keyframe_seq']} is not a whole number")
    return Sighting(line, keyframe_seq=int(seq), uv_px=(u, v))


def _number(where: str, row: Mapping[str, str], key: str, usual: float | None = None) -> float:
    text = row.get(key)
    if text is None:
        if usual is None:
            raise InputError(f"{where}: {key} is empty")
        return usual
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{where}: {key} is {text[:40]!r}, not a number") from None
    if not math.isfinite(value):
        raise InputError(f"{where}: {key} is {text}, not a finite number")
    return value
