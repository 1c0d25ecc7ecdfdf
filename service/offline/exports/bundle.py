"""All maps of a scan in one folder, with a manifest."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from service.errors import SkyreliefError
from service.offline.exports import EXPORTERS
from service.offline.exports.view import ExportOptions, ScanView, export
from service.version import software

MAPS = ("laz", "dsm", "dtm", "ortho", "contours", "gpkg", "dxf", "coverage", "geojson", "kml",
        "kmz", "stac")  # fmt: skip
"""In this order: kmz and stac use the rasters."""

MANIFEST = "manifest.json"


def write_all(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """MAPS into the folder ``out``; ``manifest.json`` lists files, sizes, SHA-256 and failures.

    A kind that fails does not stop the others. Raises the last error when none is written.
    """
    out.mkdir(parents=True, exist_ok=True)
    files, failed = [], {}
    trouble: SkyreliefError | None = None
    for number, kind in enumerate(MAPS):
        try:
            with scan.progress.part(kind, 1.0 / (len(MAPS) - number)):
                path = export(scan, kind, out / EXPORTERS[kind][1], options)
            files.append(_entry(kind, path))
        except SkyreliefError as error:
            trouble = error
            failed[kind] = str(error)
    if trouble is not None and not files:
        raise trouble
    frame = scan.frame
    document = {
        "scan": scan.store.header.scan_id,
        "software": software(),
        "epsg": None if frame is None else frame.epsg,
        "heights": HEIGHTS if frame is not None else "metres above the scan's origin",
        "files": files,
        "failed": failed,
    }
    (out / MANIFEST).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


HEIGHTS = (
    "metres above mean sea level as the autopilot reports it (usually EGM96); "
    "no vertical coordinate system is declared"
)


def _entry(kind: str, path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    return {
        "kind": kind,
        "name": path.name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
    }
