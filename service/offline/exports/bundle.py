"""All maps of a scan in one folder, with a manifest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recon.bands import at_once
from service.errors import SkyreliefError
from service.offline.exports import EXPORTERS
from service.offline.exports.view import ExportOptions, ScanView, export
from service.version import software

MAPS = ("laz", "dsm", "dtm", "ortho", "contours", "gpkg", "dxf", "coverage", "geojson", "kml",
        "kmz", "stac")  # fmt: skip
FROM_IMAGES = ("ortho", "kmz")
"""Made at the same time as the others, in this order: kmz uses the orthophoto."""
LAST = ("stac",)
"""What describes the others."""

MANIFEST = "manifest.json"


def write_all(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """MAPS into the folder ``out``; ``manifest.json`` lists files, sizes, SHA-256 and failures.

    A kind that fails does not stop the others. Raises the last error when none is written.
    """
    out.mkdir(parents=True, exist_ok=True)
    done: dict[str, Path | SkyreliefError] = {}
    rest = tuple(kind for kind in MAPS if kind not in (*FROM_IMAGES, *LAST))
    branches = scan.progress.branches(2)
    views = [scan.with_progress(branch) for branch in branches]
    at_once(
        lambda: _write(views[0], rest, out, options, done),
        lambda: _write(views[1], FROM_IMAGES, out, options, done),
    )
    _write(scan, LAST, out, options, done)
    failures = {k: error for k in MAPS if isinstance(error := done[k], SkyreliefError)}
    if len(failures) == len(MAPS):
        raise failures[MAPS[-1]]
    frame = scan.frame
    document = {
        "scan": scan.store.header.scan_id,
        "software": software(),
        "epsg": None if frame is None else frame.epsg,
        "heights": _heights(scan, options),
        "files": [_entry(k, path) for k in MAPS if isinstance(path := done[k], Path)],
        "failed": {kind: str(error) for kind, error in failures.items()},
    }
    (out / MANIFEST).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _write(
    scan: ScanView,
    kinds: Sequence[str],
    out: Path,
    options: ExportOptions,
    done: dict[str, Path | SkyreliefError],
) -> None:
    """Write some kinds, one after the other; ``done`` takes each one's path, or its error."""
    for number, kind in enumerate(kinds):
        try:
            with scan.progress.part(kind, 1.0 / (len(kinds) - number)):
                done[kind] = export(scan, kind, out / EXPORTERS[kind][1], options)
        except SkyreliefError as error:
            done[kind] = error


HEIGHTS = (
    "metres above mean sea level as the autopilot reports it (usually EGM96); "
    "no vertical coordinate system is declared"
)


def _heights(scan: ScanView, options: ExportOptions) -> str:
    if scan.frame is None:
        return "metres above the scan's origin"
    datum = options.vertical_datum
    return HEIGHTS if datum is None else f"metres above {datum}, as the operator says"


def _entry(kind: str, path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    return {
        "kind": kind,
        "name": path.name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
    }
