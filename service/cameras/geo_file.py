"""Positions of stills in a file of their folder: ``geo.txt``, as OpenDroneMap's users have it.

The first line is a coordinate system; each other one a name, x, y and, where they are known, z,
three angles and the accuracies across and up, in metres. The angles are not used: their meaning
differs between programs. Columns stand between spaces, semicolons or commas; decimals may follow a
comma where that separates no columns.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path, PureWindowsPath

from mavlink.telemetry.decode import plausible_place
from service.cameras.source import GeoTag
from service.errors import InputError, refusing
from service.georeference import degrees_of, system_of
from service.small_file import read_small

NAME, IMAGES = "geo.txt", "images"
LARGEST_BYTES = 10_000_000
PLACE, ANGLES, SIGMAS = 3, 3, 2
"""Numbers of a row: x, y, z, angles, accuracies; the angles may be left out."""

MAX_SIGMA_M, MAX_HEIGHT_M = 1000.0, 1e5


def geo_file_of(folder: Path) -> Path | None:
    """The file of a folder of stills: in it or, where it is called ``images``, in the one above."""
    places = [folder, folder.resolve().parent] if folder.resolve().name == IMAGES else [folder]
    return next((path for one in places if (path := one / NAME).is_file()), None)


def read_geo(path: Path) -> dict[str, GeoTag]:
    """Positions by the file names of stills, in lower case, with or without extension. Raises
    InputError in one line, with its number, for anything that is wrong."""
    lines = read_small(path, LARGEST_BYTES, "file of positions").decode("utf-8-sig", "replace")
    head, *rows = lines.splitlines() or [""]
    with refusing(f"{path} line 1"):
        system, datum, unit_m = system_of(head)
    found: dict[str, GeoTag] = {}
    lines_of: dict[str, int] = {}
    for number, row in enumerate(rows, 2):
        name, *cells = _cells(row)
        if not name or name.startswith("#"):
            continue
        name = PureWindowsPath(name).name.lower()  # of either system's paths
        numbers = _numbers(cells)
        if len(numbers) < 2:
            raise InputError(f"{path} line {number}: {row[:80]!r}; give name, x, y and z")
        with refusing(f"{path} line {number}"):
            lon, lat = degrees_of(system, numbers[0], numbers[1])
        height = unit_m * numbers[2] if len(numbers) > 2 else None
        if not plausible_place(lat, lon) or abs(height or 0.0) > MAX_HEIGHT_M:
            raise InputError(f"{path} line {number}: {row[:80]!r} is not on the globe")
        tag = GeoTag(lat, lon, height, datum="" if height is None else datum)
        first = PLACE if len(numbers) == PLACE + SIGMAS else PLACE + ANGLES
        across, up = (*numbers[first:], 0.0, 0.0)[:SIGMAS]
        if 0.0 < across < MAX_SIGMA_M:
            tag = replace(tag, sigma_h_m=across, is_sigma_h_stated=True)
        if 0.0 < up < MAX_SIGMA_M:
            tag = replace(tag, sigma_v_m=up)
        if found.setdefault(name, tag) != tag:
            raise InputError(
                f"{path} line {number}: {name} is elsewhere in line {lines_of[name]}; "
                "one name is one place"
            )
        lines_of[name] = number
    if not found:
        raise InputError(f"{path}: no positions below the first line")
    return found


def _cells(row: str) -> list[str]:
    """The columns of a row, at least one; a name may have spaces, semicolons or commas."""
    spaced = row.split() or [""]
    for mark in ";,":
        cells = [cell.strip() for cell in row.split(mark)]
        if (mark in spaced[0] or len(spaced) < PLACE) and len(_numbers(cells[1:])) >= 2:
            return cells
    return spaced


def _numbers(cells: list[str]) -> list[float]:
    """The finite numbers before the first cell that is none, of a place, angles and accuracies."""
    out = []
    for cell in cells[: PLACE + ANGLES + SIGMAS]:
        try:
            number = float(cell.replace(",", "."))
        except ValueError:
            break
        if not math.isfinite(number):
            break
        out.append(number)
    return out
