"""KMZ of the orthophoto, the STAC item; all maps in one folder."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np

from recon.parallel import run_parallel
from recon.types import Array
from service.errors import InputError
from service.offline.exports import EXPORTERS
from service.offline.exports.flight import iso_time
from service.offline.exports.rasters import open_map, warped, write_ortho, written_ortho
from service.offline.exports.view import ExportOptions, ScanView, check, export
from service.offline.tiles import union
from service.scans.folder import Failures
from service.scans.fused_cloud import Box
from service.scans.track import flown_datum, heights_above
from service.scans.trust import lacks_altitude
from service.scans.writing import filling_folder, write_whole, writing
from service.version import software

MAX_OVERLAY_PX = 4096


def write_kmz(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The orthophoto as a ground overlay for Google Earth: doc.kml and a PNG in a zip.

    One that was written from this view before is used, never an older file.
    """
    scan.needs_place("a KMZ")
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        path = written_ortho(scan, options)
        if path is None:
            path = Path(folder) / "ortho.tif"
            write_ortho(scan, path, options)
        image, (west, south, east, north) = _overlay(path)
    _, data = cv2.imencode(".png", image)
    name = escape(scan.store.header.scan_id)
    kml = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">'
        f"<GroundOverlay><name>{name}</name><Icon><href>ortho.png</href></Icon><LatLonBox>"
        f"<north>{north:.9f}</north><south>{south:.9f}</south>"
        f"<east>{east:.9f}</east><west>{west:.9f}</west></LatLonBox></GroundOverlay></kml>\n"
    )
    with writing(out) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as file:
        file.writestr("doc.kml", kml)
        file.writestr("ortho.png", data.tobytes())


def _overlay(path: Path) -> tuple[Array, Box]:
    """(h, w, 4) BGRA of a raster in longitude and latitude, and its bounds in degrees; across 180
    degrees the eastern one is beyond it."""
    from rasterio.transform import from_bounds

    with open_map(path, 4) as image:
        west, south, east, north = _in_degrees(image.crs, image.bounds)
        east += 360.0 if east < west else 0.0
        # Square in degrees, and as many along the diagonal as the raster has.
        pixel = math.hypot(east - west, north - south) / math.hypot(image.width, image.height)
        pixel = max(pixel, max(east - west, north - south) / MAX_OVERLAY_PX)
        w, h = max(1, round((east - west) / pixel)), max(1, round((north - south) / pixel))
        transform = from_bounds(west, south, east, north, w, h)
        rgba = warped(image, transform, "EPSG:4326", (h, w)).transpose(1, 2, 0)
    return np.ascontiguousarray(rgba[..., [2, 1, 0, 3]]), (west, south, east, north)


def _in_degrees(crs: Any, box: Box) -> Box:
    """West, south, east and north of a box on a map; across 180 degrees west is above east."""
    from pyproj import Transformer

    found: Box = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform_bounds(*box)
    return found


RASTERS = {"ortho.tif": "visual", "dsm.tif": "data", "dtm.tif": "data", "coverage.tif": "data"}


def write_stac(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A STAC 1.0 item of the rasters that lie next to it, with the projection extension."""
    frame = scan.needs_place("a STAC item")
    folder = out.parent
    found = {name: _asset(folder / name, role) for name, role in RASTERS.items()
             if (folder / name).is_file()}  # fmt: skip
    if not found:
        raise InputError(f"{folder} contains no raster; export dsm or ortho first")
    box = union(asset.pop("bounds") for asset in found.values())
    west, south, east, north = bbox = _in_degrees(f"EPSG:{frame.epsg}", box)
    # Across 180 degrees west is above east and the polygon is cut (RFC 7946, 3.1.9 and 5.2).
    sides = [(west, east)] if west <= east else [(west, 180.0), (-180.0, east)]
    rings = [[[[w, south], [e, south], [e, north], [w, north], [w, south]]] for w, e in sides]
    geometry: dict[str, Any] = {"type": "MultiPolygon", "coordinates": rings}
    if len(rings) == 1:
        geometry = {"type": "Polygon", "coordinates": rings[0]}
    times = [p.time_unix_ns for p in scan.poses] or [scan.store.header.started_unix_ns]
    start, end = iso_time(min(times)), iso_time(max(times))
    item = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": ["https://stac-extensions.github.io/projection/v1.1.0/schema.json"],
        "id": scan.store.header.scan_id,
        "bbox": bbox,
        "geometry": geometry,
        "properties": {
            "datetime": start,
            "start_datetime": start,
            "end_datetime": end,
            "proj:epsg": frame.epsg,
            "platform": scan.store.header.drone,
        },
        "links": [],
        "assets": {Path(name).stem: asset for name, asset in found.items()},
    }
    write_whole(out, json.dumps(item, indent=1))


def _asset(path: Path, role: str) -> dict[str, Any]:
    with open_map(path) as image:
        return {
            "href": f"./{path.name}",
            "type": "image/tiff; application=geotiff; profile=cloud-optimized",
            "roles": [role],
            "proj:shape": list(image.shape),
            "proj:transform": list(image.transform)[:6],
            "bounds": tuple(image.bounds),
        }


MAPS = ("laz", "dsm", "dtm", "ortho", "contours", "gpkg", "dxf", "coverage", "geojson", "kml",
        "kmz", "stac")  # fmt: skip
FROM_IMAGES = ("ortho", "kmz", "splat")
"""Made at the same time as the others, in this order: kmz uses the orthophoto, and most of a mesh's
steps keep one core busy."""
LAST = ("stac", "report")
"""What describes the others."""

MANIFEST = "manifest.json"


def write_all(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """MAPS into the folder ``out``; ``manifest.json`` lists files, sizes, SHA-256 and failures.

    Raises the first error when none is written, and the disk's after those that are.
    """
    failures = Failures(out, logging.WARNING)
    with filling_folder(out) as part:
        done = write_kinds(scan, MAPS, lambda kind: part / EXPORTERS[kind][1], options, failures)
        if not done and failures.first is not None:
            raise failures.first
        frame = scan.frame
        document = {
            "scan": scan.store.header.scan_id,
            "software": software(),
            "epsg": None if frame is None else frame.epsg,
            "heights": _heights(scan, options),
            "files": [_entry(kind, done[kind]) for kind in MAPS if kind in done],
            "failed": failures.why,
        }
        write_whole(part / MANIFEST, json.dumps(document, indent=1) + "\n")
    full = failures.of_the_disk
    if full is not None and isinstance(full.__cause__, OSError):  # not a missing package
        raise full


def write_kinds(
    scan: ScanView,
    kinds: Sequence[str],
    path_of: Callable[[str], Path],
    options: ExportOptions,
    failures: Failures,
) -> dict[str, Path]:
    """Write some kinds, those from images at the same time as the others.

    Returns the path of each that is written; ``failures`` takes the others: one never ends
    another. What can be checked is checked before the first is made.
    """
    done: dict[str, Path] = {}

    def write(view: ScanView, kind: str) -> None:
        with failures.noted(kind):
            done[kind] = export(view, kind, path_of(kind), options)

    for kind in kinds:
        with failures.noted(kind):
            check(scan, kind, path_of(kind), options)
    _in_two_branches(scan, [kind for kind in kinds if kind not in failures.why], write)
    return done


def _in_two_branches(
    scan: ScanView, kinds: Sequence[str], write: Callable[[ScanView, str], None]
) -> None:
    """Call ``write`` for each kind: those from images in one thread, the others in another, and
    LAST at the end."""
    images = [kind for kind in kinds if kind in FROM_IMAGES]
    rest = [kind for kind in kinds if kind not in (*FROM_IMAGES, *LAST)]

    def work(view: ScanView, some: Sequence[str]) -> None:
        for number, kind in enumerate(some):
            with view.progress.part(kind, 1.0 / (len(some) - number)):
                write(view, kind)

    if images and rest:
        views = [scan.with_progress(branch) for branch in scan.progress.branches(2)]
        run_parallel(lambda: work(views[0], rest), lambda: work(views[1], images))
    else:
        work(scan, [*images, *rest])
    work(scan, [kind for kind in kinds if kind in LAST])


HEIGHTS = (
    "metres above mean sea level as the autopilot reports it (usually EGM96); "
    "no vertical coordinate system is declared"
)


def _heights(scan: ScanView, options: ExportOptions) -> str:
    if scan.frame is None or lacks_altitude(scan.store):
        return heights_above(None, None, True)
    datum = options.vertical_datum
    is_of_tags = datum == flown_datum(scan.store.header)
    says = "the images' tags say" if is_of_tags else "the operator says"
    if options.to_datum is not None:
        return f"metres above {options.to_datum}; above {datum} as flown, {says}"
    return HEIGHTS if datum is None else f"metres above {datum}, as {says}"


def _entry(kind: str, path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    return {
        "kind": kind,
        "name": path.name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
    }
