"""The values that makers of drones and Pix4D write into a still's XMP packet (ISO 16684-1)."""

from __future__ import annotations

from typing import Protocol
from xml.parsers import expat

MAX_BYTES = 1 << 18  # of a packet that is read; those of DJI have 10 KiB

PREFIXES = frozenset(("drone-dji", "drone-parrot", "drone"))
"""Autel's names are those of DJI with the prefix drone."""

TEAL = {
    "exif:CameraYaw": "GimbalYawDegree",
    "exif:CameraPitch": "GimbalPitchDegree",
    "exif:CameraRoll": "GimbalRollDegree",
    "exif:PlatformYaw": "FlightYawDegree",
    "exif:CameraHorizontalFOV": "CameraHorizontalFOV",
}
"""Teal's names, to the name that a value is stored by; their values are rationals."""

CAMERA, PIX4D = "Camera", "pix4d.com"
"""A prefix of several makers: a Disco's angles by it are its body's, a phone's values others."""

SKYDIO, NED = "drone-skydio", "CameraOrientationNED"
"""Skydio's angles by frame of reference; those of other frames have the same names."""


class DocumentTypeError(ValueError):
    """It declares a document type, whose entities may grow without bound."""


class Handler(Protocol):
    """Takes the elements and texts of a parser."""

    def start(self, element: str, attributes: dict[str, str]) -> None: ...

    def end(self, element: str) -> None: ...

    def text(self, data: str) -> None: ...


def parser_of(handler: Handler) -> expat.XMLParserType:
    """A parser of foreign XML for ``handler``; it raises DocumentTypeError while it parses."""
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartElementHandler = handler.start
    parser.EndElementHandler = handler.end
    parser.CharacterDataHandler = handler.text
    parser.StartDoctypeDeclHandler = _refuse
    return parser


def xmp_values(packet: bytes) -> dict[str, str]:
    """Values by name without prefix; elements of a list are joined by commas. Of a packet that is
    no XML the part before the error counts; one with a document type is not read."""
    reader = _Reader()
    try:
        parser_of(reader).Parse(packet[:MAX_BYTES].decode("utf-8", "replace").encode(), True)
    except DocumentTypeError:
        return {}
    except expat.ExpatError:
        pass
    return reader.values


def _refuse(*_: object) -> None:
    raise DocumentTypeError


class _Reader:
    """Collects attributes, and the texts within elements, of the names that are read."""

    def __init__(self) -> None:
        self.values: dict[str, str] = {}
        self._open: list[str | None] = []  # names of the elements, None where it is not read
        self._texts: list[str] = []  # since the last one that is read
        self._skydio: list[bool] = [False]
        self._is_pix4d = True  # what the prefix Camera stands for

    def start(self, element: str, attributes: dict[str, str]) -> None:
        is_ned = self._skydio[-1] or element == f"{SKYDIO}:{NED}"
        self._skydio.append(is_ned)
        if (namespace := attributes.get(f"xmlns:{CAMERA}")) is not None:
            self._is_pix4d = PIX4D in namespace
        for attribute, value in attributes.items():
            if (name := self._name(attribute, is_ned)) is not None:
                self.values[name] = value
        name = self._name(element, is_ned)
        self._open.append(name)
        if name is not None:
            self._texts.clear()

    def text(self, data: str) -> None:
        if data.strip():
            self._texts.append(data.strip())

    def end(self, element: str) -> None:
        self._skydio.pop()
        name = self._open.pop()
        if name is not None and self._texts:
            self.values[name] = ",".join(self._texts)
            self._texts.clear()

    def _name(self, qualified: str, is_ned: bool) -> str | None:
        """The name that a value is stored by; None where it is not read."""
        prefix, _, name = qualified.partition(":")
        if prefix in PREFIXES or (prefix == CAMERA and self._is_pix4d):
            return name
        if is_ned and prefix == SKYDIO and name != NED:
            return f"Gimbal{name}Degree"
        return TEAL.get(qualified)
