"""The description of the health page's HTTP interface, served at ``/openapi.json``."""

from __future__ import annotations

from typing import Any

_TEXT, _NUMBER, _COUNT = {"type": "string"}, {"type": "number"}, {"type": "integer"}

HEALTH: dict[str, Any] = {
    "type": "object",
    "required": ["ok", "state", "fault"],
    "properties": {
        "ok": {"type": "boolean", "description": "false: it needs somebody"},
        "state": {
            **_TEXT,
            "description": "starting, idle, waiting (to try again), scanning, paused or finalising",
        },
        "fault": {**_TEXT, "description": "why the last scan ended; empty: no reason"},
    },
}

STATUS: dict[str, Any] = {
    "type": "object",
    "required": [*HEALTH["required"], "software", "scan", "load", "machine", "mavlink"],
    "properties": {
        **HEALTH["properties"],
        "software": _TEXT,
        "scan": {**_TEXT, "description": "name of the scan that runs; empty: none does"},
        "recording_s": _NUMBER,
        "backend": _TEXT,
        "backend_failure": {**_TEXT, "description": "why the backend gave way to the CPU"},
        "frames": {**_COUNT, "description": "of the scan that runs, as the next nine"},
        "map_voxels": {**_COUNT, "description": "of known surface in memory"},
        "map_tiles_on_disk": _COUNT,
        "loop_views": {**_COUNT, "description": "keyframes remembered for loops"},
        "graph_keyframes": {**_COUNT, "description": "keyframes in the pose graph"},
        "clouds": _COUNT,
        "points": _COUNT,
        "camera_latency_ms": _NUMBER,
        "camera_latency_sigma_ms": _NUMBER,
        "speed_m_s": _NUMBER,
        "distance_m": _NUMBER,
        "load": {
            "type": "object",
            "required": ["level", "name", "reason"],
            "properties": {
                "level": {**_COUNT, "description": "steps down the ladder; 0: full quality"},
                "name": _TEXT,
                "reason": _TEXT,
                "frame_age_s": _NUMBER,
                "frames_late": _COUNT,
                "views_late": _COUNT,
                "pictures_kept": _COUNT,
                "pictures_lost": _COUNT,
            },
        },
        "mavlink": {
            "type": "object",
            "description": "links, packets, age of the telemetry, what is missing (troubles)",
        },
        "machine": {"type": "object", "description": "heat, power, memory, disk: what it tells"},
    },
}


_NOT_US: dict[str, Any] = {"421": {"description": "the Host header names another machine"}}


def _get(summary: str, kind: str, schema: dict[str, Any], *codes: tuple[int, str]) -> Any:
    content = {kind: {"schema": schema}}
    answers: dict[str, Any] = {
        str(code): {"description": text, "content": content} for code, text in codes
    }
    return {"get": {"summary": summary, "responses": answers | _NOT_US}}


DOCUMENT: dict[str, Any] = {
    "openapi": "3.1.0",
    "info": {"title": "skyrelief on board", "version": "1"},
    "paths": {
        "/healthz": _get(
            "Whether all is well.", "application/json", HEALTH,
            (200, "it is"), (503, "it needs somebody"),
        ),
        "/status": _get("How it goes.", "application/json", STATUS, (200, "everything known")),
        "/metrics": _get(
            "The same numbers for Prometheus.", "text/plain", _TEXT, (200, "text format 0.0.4")
        ),
        "/openapi.json": _get(
            "This description.", "application/json", {"type": "object"}, (200, "OpenAPI 3.1")
        ),
    },
}  # fmt: skip
