"""KMZ of the orthophoto, the STAC item; all maps in one folder."""

from __future__ import annotations

import hashlib
import itertools
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
from recon.types import F32, F64, Array
from service.errors import InputError
from service.georeference import between_nodes, unwrapped
from service.offline.exports import EXPORTERS
from service.offline.exports.flight import iso_time
from service.offline.exports.rasters import open_map, write_ortho, written_ortho
from service.offline.exports.view import ExportOptions, ScanView, check, export
from service.scans.folder import Failures
from service.scans.track import flown_datum
from service.scans.writing import filling_folder, write_whole, writing
from service.version import software

MAX_OVERLAY_PX = 4096
JPEG_QUALITY = 85


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
        image, (west, south, east, north) = _in_degrees(path)
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


def _in_degrees(path: Path) -> tuple[Any, tuple[float, float, float, float]]:
    """(h, w, 4) BGRA of a raster in longitude and latitude, and its bounds in degrees."""
    from pyproj import Transformer

    with open_map(path, 4) as image:
        west, south, east, north = _box_in_degrees(image)
        # Square in degrees, and as many along the diagonal as the raster has.
        pixel = math.hypot(east - west, north - south) / math.hypot(image.width, image.height)
        pixel = max(pixel, max(east - west, north - south) / MAX_OVERLAY_PX)
        w, h = max(1, round((east - west) / pixel)), max(1, round((north - south) / pixel))
        to_map = Transformer.from_crs("EPSG:4326", image.crs, always_xy=True)
        lon = west + (east - west) * (np.arange(w) + 0.5) / w
        lat = north - (north - south) * (np.arange(h) + 0.5) / h
        rgba = resampled(image, 4, lon, lat, lambda at: np.array(to_map.transform(*at.T)).T)
    return np.ascontiguousarray(rgba[..., [2, 1, 0, 3]]), (west, south, east, north)


def resampled(
    image: Any,
    bands: int,
    x: F64,
    y: F64,
    to_map: Callable[[F64], F64],
    unknown: float | None = None,
) -> Array:
    """(len(y), len(x), bands) of an open raster, reduced to MAX_OVERLAY_PX where it is larger.

    ``to_map`` takes (N, 2) columns x and y to the raster's own coordinates. Outside stands 0; with
    a value for ``unknown`` cells that, and nothing is interpolated.
    """
    from rasterio.enums import Resampling

    shrink = max(1.0, max(image.width, image.height) / MAX_OVERLAY_PX)
    size = round(image.height / shrink), round(image.width / shrink)
    how = Resampling.average if unknown is None else Resampling.nearest
    data = image.read(list(range(1, bands + 1)), out_shape=(bands, *size), resampling=how)
    scale = image.transform.scale(image.width / size[1], image.height / size[0])
    from_map = ~(image.transform * scale)

    def pixels(at: F64) -> F32:
        cols, rows = from_map * to_map(at).T
        return np.column_stack([cols - 0.5, rows - 0.5]).astype(np.float32)

    u, v = between_nodes(x, y, pixels)
    flat = np.ascontiguousarray(data.transpose(1, 2, 0))
    between = cv2.INTER_LINEAR if unknown is None else cv2.INTER_NEAREST
    found = cv2.remap(flat, u, v, between, borderValue=[unknown or 0.0] * 4)
    return np.asarray(found).reshape(len(y), len(x), bands)


def _box_in_degrees(image: Any) -> tuple[float, float, float, float]:
    """West, south, east and north of a map; across 180 degrees one longitude lies beyond it."""
    from pyproj import Transformer

    west, south, east, north = image.bounds
    side = np.linspace(0.0, 1.0, 33)[:, None]
    corners = np.array([[west, north], [east, north], [east, south], [west, south], [west, north]])
    border = np.concatenate([a + side * (b - a) for a, b in itertools.pairwise(corners)])
    to_degrees = Transformer.from_crs(image.crs, "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(*border.T)
    lon = unwrapped(lon)
    return float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max())


RASTERS = {"ortho.tif": "visual", "dsm.tif": "data", "dtm.tif": "data", "coverage.tif": "data"}


def write_stac(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A STAC 1.0 item of the rasters that lie next to it, with the projection extension."""
    frame = scan.needs_place("a STAC item")
    folder = out.parent
    found = {name: _asset(folder / name, role) for name, role in RASTERS.items()
             if (folder / name).is_file()}  # fmt: skip
    if not found:
        raise InputError(f"{folder} contains no raster; export dsm or ortho first")
    corners = np.concatenate([a.pop("corners") for a in found.values()])
    geodetic = frame.to_geodetic(frame.from_utm(corners))
    bbox, geometry = _extent(geodetic[:, 0], geodetic[:, 1])
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


def _extent(lat_deg: F64, lon_deg: F64) -> tuple[list[float], dict[str, Any]]:
    """Box and GeoJSON polygon of places; across 180 degrees west is above east and the polygon is
    cut (RFC 7946, 3.1.9 and 5.2)."""
    lon = unwrapped(lon_deg)
    low, high, south, north = (float(f(v)) for v in (lon, lat_deg) for f in (np.min, np.max))
    west, east = ((v + 180.0) % 360.0 - 180.0 for v in (low, high))
    sides = [(west, east)] if west <= east else [(west, 180.0), (-180.0, east)]
    rings = [[[[w, south], [e, south], [e, north], [w, north], [w, south]]] for w, e in sides]
    if len(rings) == 1:
        return [west, south, east, north], {"type": "Polygon", "coordinates": rings[0]}
    return [west, south, east, north], {"type": "MultiPolygon", "coordinates": rings}


def _asset(path: Path, role: str) -> dict[str, Any]:
    with open_map(path) as image:
        west, south, east, north = image.bounds
        return {
            "href": f"./{path.name}",
            "type": "image/tiff; application=geotiff; profile=cloud-optimized",
            "roles": [role],
            "proj:shape": list(image.shape),
            "proj:transform": list(image.transform)[:6],
            "corners": np.array(
                [[west, south, 0.0], [west, north, 0.0], [east, south, 0.0], [east, north, 0.0]]
            ),
        }


MAPS = ("laz", "dsm", "dtm", "ortho", "contours", "gpkg", "dxf", "coverage", "geojson", "kml",
        "kmz", "stac")  # fmt: skip
FROM_IMAGES = ("ortho", "kmz")
"""Made at the same time as the others, in this order: kmz uses the orthophoto."""
LAST = ("stac", "report")
"""What describes the others."""

MANIFEST = "manifest.json"


def write_all(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """MAPS into the folder ``out``; ``manifest.json`` lists files, sizes, SHA-256 and failures.

    Raises the first error when none is written.
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
    if scan.frame is None:
        return "metres above the scan's origin"
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
