"""Annotations of a scan: places with a text, and named measurements, kept as GeoJSON in its
folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec

from service.errors import InputError, MissingError
from service.scans.writing import write_whole
from service.small_file import read_json

ANNOTATIONS = "annotations.geojson"
MAX_ANNOTATIONS = 200
MAX_TEXT = 500
MAX_PLACES = 50  # of a measurement

MAX_BYTES = 1_000_000

Spot = tuple[
    Annotated[float, msgspec.Meta(ge=-180, le=180)],
    Annotated[float, msgspec.Meta(ge=-90, le=90)],
    Annotated[float, msgspec.Meta(ge=-1e5, le=1e6)],
]
"""Longitude and latitude in degrees, AMSL metres."""


Number = Annotated[int, msgspec.Meta(ge=1, le=2**53)]
"""Of an annotation; never given twice in a scan."""


class Point(msgspec.Struct, forbid_unknown_fields=True, tag_field="type", tag="Point"):
    coordinates: Spot


Line = Annotated[list[Spot], msgspec.Meta(min_length=2, max_length=MAX_PLACES)]
"""The places of a measurement, in their order."""


class LineString(msgspec.Struct, forbid_unknown_fields=True, tag_field="type", tag="LineString"):
    coordinates: Line


class About(msgspec.Struct, forbid_unknown_fields=True):
    text: Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_TEXT)]
    by: Annotated[str, msgspec.Meta(max_length=100)]
    made_unix_s: Annotated[float, msgspec.Meta(ge=-1e11, le=1e11)]


class Annotation(msgspec.Struct, forbid_unknown_fields=True):
    type: Literal["Feature"]
    id: Number
    geometry: Point | LineString
    properties: About


class Annotations(msgspec.Struct, forbid_unknown_fields=True):
    """All of a scan; an identifier comes once."""

    type: Literal["FeatureCollection"] = "FeatureCollection"
    features: Annotated[list[Annotation], msgspec.Meta(max_length=MAX_ANNOTATIONS)] = []
    last_id: Number | msgspec.UnsetType = msgspec.UNSET  # the highest ever given


def read_annotations(folder: Path) -> Annotations:
    """The annotations of a scan folder, none without the file; InputError for an unfit file."""
    path = folder / ANNOTATIONS
    if not path.exists():
        return Annotations()
    return read_json(path, Annotations, MAX_BYTES, "GeoJSON")


def add_annotation(
    folder: Path, geometry: Point | LineString, text: str, by: str, unix_s: float
) -> Annotation:
    """Append one and write the file. InputError for an unfit text or when there are too many."""
    found = read_annotations(folder)
    if len(found.features) >= MAX_ANNOTATIONS:
        raise InputError(f"a scan holds at most {MAX_ANNOTATIONS} annotations; delete some")
    number = (_last_id(found) or 0) + 1
    if number > 2**53:
        raise InputError(f"{ANNOTATIONS} has no number left for one more annotation")
    about = About(_text(text), by[:100], round(unix_s, 3))
    new = Annotation("Feature", number, geometry, about)
    _write(folder, Annotations(features=[*found.features, new], last_id=number))
    return new


def delete_annotation(folder: Path, number: int) -> None:
    """Take one out and write the file. InputError when there is none of this number."""
    found = read_annotations(folder)
    rest = [one for one in found.features if one.id != number]
    if len(rest) == len(found.features):
        raise MissingError(f"no annotation {number}")
    _write(folder, Annotations(features=rest, last_id=_last_id(found)))


def _last_id(known: Annotations) -> Number | msgspec.UnsetType:
    """The highest number given so far; unset before the first."""
    given = [one.id for one in known.features]
    if known.last_id is not msgspec.UNSET:
        given.append(known.last_id)
    return max(given, default=msgspec.UNSET)


def _text(text: str) -> str:
    if any(0xD800 <= ord(letter) <= 0xDFFF for letter in text):
        raise InputError("the text holds an invalid character (a lone surrogate)")
    one_line = " ".join(text.split())
    if not 0 < len(one_line) <= MAX_TEXT:
        raise InputError(f"an annotation is a text of 1 to {MAX_TEXT} letters")
    return one_line


def _write(folder: Path, known: Annotations) -> None:
    write_whole(folder / ANNOTATIONS, msgspec.json.encode(known))
