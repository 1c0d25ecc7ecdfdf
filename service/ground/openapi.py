"""The description of the portal's HTTP interface, served at ``/api/openapi.json``."""

from __future__ import annotations

from typing import Any

from service.exports import EXPORTERS
from service.ground.vehicle import BUTTONS


def _operation(
    summary: str, answer: str, change: bool = False, body: dict[str, Any] | None = None
) -> dict[str, Any]:
    """One operation; a change needs the token."""
    out: dict[str, Any] = {"summary": summary, "responses": {"200": {"description": answer}}}
    if change:
        out["security"] = [{"token": []}]
        out["responses"]["401"] = {"description": "the token is missing"}
        out["responses"]["413"] = {"description": "the request is too large"}
    if body is not None:
        schema = {"type": "object", "properties": body, "additionalProperties": False}
        out["requestBody"] = {"required": True, "content": {"application/json": {"schema": schema}}}
    return out


def _path(*names: str, **operations: dict[str, Any]) -> dict[str, Any]:
    """A path with text parameters."""
    parameters = [
        {"name": n, "in": "path", "required": True, "schema": {"type": "string"}} for n in names
    ]
    return {**({"parameters": parameters} if parameters else {}), **operations}


_TEXT = {"type": "string"}

DOCUMENT: dict[str, Any] = {
    "openapi": "3.1.0",
    "info": {"title": "skyrelief portal", "version": "1"},
    "components": {"securitySchemes": {"token": {"type": "http", "scheme": "bearer"}}},
    "paths": {
        "/api/scans": _path(get=_operation("All scans, the newest first.", "a list of scans")),
        "/api/scans/{drone}/{scan}": _path(
            "drone",
            "scan",
            get=_operation("One scan with its files and jobs.", "a scan"),
            patch=_operation(
                "Rename or tag. With the edition that was seen: 409 when it is no longer the last.",
                "the labels",
                True,
                {
                    "title": _TEXT,
                    "tags": {"type": "array", "items": _TEXT},
                    "edition": {"type": "integer"},
                },
            ),
            delete=_operation("Move to the bin.", "the name in the bin", True),
        ),
        "/api/scans/{drone}/{scan}/files/{name}": _path(
            "drone", "scan", "name", get=_operation("A deliverable; ranges work.", "the file")
        ),
        "/api/scans/{drone}/{scan}/tiles/{name}": _path(
            "drone", "scan", "name", get=_operation("A file of the 3D Tiles.", "the file")
        ),
        "/api/scans/{drone}/{scan}/keyframes/{seq}.jpg": _path(
            "drone", "scan", "seq", get=_operation("The colours of a keyframe.", "a picture")
        ),
        "/api/scans/{drone}/{scan}/exports": _path(
            "drone",
            "scan",
            post=_operation(
                "Make a deliverable in the background.",
                "the job",
                True,
                {"kind": {"type": "string", "enum": list(EXPORTERS)}},
            ),
        ),
        **{
            f"/api/scans/{{drone}}/{{scan}}/coverage.{kind}": _path(
                "drone", "scan", get=_operation(f"How well the ground was seen, {what}.", what)
            )
            for kind, what in (("png", "a picture"), ("json", "figures and corners"))
        },
        "/api/scans/{drone}/{scan}/live": _path(
            "drone",
            "scan",
            get=_operation("WebSocket: chunks, corrections and track as they come.", "messages"),
        ),
        "/api/bin": _path(get=_operation("Names of deleted scans.", "a list of names")),
        "/api/bin/{name}/restore": _path(
            "name", post=_operation("Bring a scan back.", "its drone and scan", True)
        ),
        "/api/import": _path(
            post=_operation(
                "Copy the known files of a scan folder, or an MCAP, of this machine in;"
                " 409 while another import runs.",
                "its drone and scan",
                True,
                {"folder": _TEXT},
            )
        ),
        "/api/status": _path(get=_operation("What is being received.", "the status")),
        "/api/vehicle": _path(
            get=_operation("Battery, satellites, speed, height, distance from home.", "figures"),
            post=_operation(
                "Give an order to the companion; 429 when they come too fast, but for stop.",
                "its answer",
                True,
                {
                    "action": {"type": "string", "enum": list(BUTTONS)},
                    "metres": {"type": "number", "minimum": 0, "maximum": 1000},
                },
            ),
        ),
        "/metrics": _path(get=_operation("Figures for Prometheus.", "text")),
    },
}
