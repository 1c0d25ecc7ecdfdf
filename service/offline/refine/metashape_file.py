"""Markers of Agisoft Metashape (*Export markers*, XML): places, and marks in images.

The upper left corner of its images is 0, 0: half a pixel from the centre of the first one. A marker
whose place Metashape did not use (``enabled``) is a check point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any
from xml.parsers import expat

from service.cameras.xmp import DocumentTypeError, parser_of
from service.georeference import degrees_of, system_of

Attributes = dict[str, str]
DEEPEST = 32
"""Elements within each other; Metashape has seven."""

SYSTEMS = ("reference", "wkt")
"""Elements whose text may be the coordinate system, as WKT or EPSG:n."""


def read_metashape(text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Line number and the fields of each mark: those of ``survey_file.SurveyRow``.

    Raises ValueError, which names the line where there is one.
    """
    reader = _Reader()
    reader.parser = parser_of(reader)
    try:
        reader.parser.Parse(text.encode(), True)
    except DocumentTypeError as error:
        raise ValueError("it declares a document type, which Metashape does not") from error
    except expat.ExpatError as error:
        raise ValueError(f"not XML: {error}") from error
    yield from reader.rows()


def places_in(system: str) -> Callable[[str, str, str | None], dict[str, Any]]:
    """What makes of x, y and z in a surveyor's coordinate system the fields of a place; without z
    its height is not known. Both raise ValueError."""
    to_degrees, datum, unit_m = system_of(system)
    if datum == "ellipsoid":
        raise ValueError("heights above mean sea level are needed, not ellipsoidal")

    def place(x: str, y: str, z: str | None) -> dict[str, Any]:
        lon, lat = degrees_of(to_degrees, float(x), float(y))
        return {"lat": lat, "lon": lon, "alt_amsl_m": None if z is None else unit_m * float(z)}

    return place


class _Reader:
    """Collects cameras, markers with their places, and marks."""

    def __init__(self) -> None:
        self.parser: Any = None
        self._open: list[str] = []
        self._cameras: dict[str, str] = {}  # labels by number
        self._labels: dict[str, str] = {}  # of markers, by number
        self._places: dict[str, Attributes] = {}
        self._marks: list[tuple[int, str, Attributes]] = []  # line, number of the marker
        self._system = self._texts = self._marker = ""

    def start(self, element: str, attributes: Attributes) -> None:
        if len(self._open) == DEEPEST:
            line = self.parser.CurrentLineNumber
            raise ValueError(f"line {line}: more than {DEEPEST} elements within each other")
        self._open.append(element)
        self._texts = ""
        number = attributes.get("marker_id", attributes.get("id", ""))
        if element == "camera" and "label" in attributes:
            self._cameras[number] = attributes["label"]
        elif element == "marker":
            self._marker = number
            if "label" in attributes:
                self._labels[number] = attributes["label"]
        elif element == "reference" and "marker" in self._open and "x" in attributes:
            self._places[self._marker] = attributes
        elif element == "location" and _is_on(attributes, "valid"):
            self._marks.append((self.parser.CurrentLineNumber, self._marker, attributes))

    def end(self, element: str) -> None:
        self._open.pop()
        if element in SYSTEMS and "camera" not in self._open and self._texts.strip():
            self._system = self._system or self._texts.strip()

    def text(self, data: str) -> None:
        self._texts += data

    def rows(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """The marks of markers that have a place."""
        if not self._system:
            raise ValueError("it names no coordinate system; export the markers with one")
        place_of = places_in(self._system)
        for line, marker, mark in self._marks:
            place = self._places.get(marker)
            if place is None:
                continue
            try:
                row = place_of(place["x"], place["y"], place.get("z")) | {
                    "name": self._labels.get(marker, f"point {marker}"),
                    "image": self._cameras[mark["camera_id"]],
                    "u_px": float(mark["x"]) - 0.5, "v_px": float(mark["y"]) - 0.5,
                    "role": "control" if _is_on(place, "enabled") else "check",
                }  # fmt: skip
                across, up = place.get("sxy", place.get("sx", "0")), place.get("sz", "0")
                sigmas = {"sigma_h_m": float(across), "sigma_v_m": float(up)}
                row |= {name: sigma_m for name, sigma_m in sigmas.items() if sigma_m > 0.0}
            except KeyError as error:
                raise ValueError(f"line {line}: no {error} of a mark or its marker") from error
            except ValueError as error:
                raise ValueError(f"line {line}: {error}") from error
            yield line, row


def _is_on(attributes: Attributes, name: str) -> bool:
    return attributes.get(name, "1") in ("1", "true")
