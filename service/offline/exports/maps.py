"""Contours for GIS and CAD, KMZ of the orthophoto, the STAC item; all maps in one folder."""

from __future__ import annotations

import hashlib
import json
import logging
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon.bands import at_once
from recon.types import F32, F64
from service.errors import InputError, SkyreliefError
from service.georeference import between_nodes
from service.offline.exports import EXPORTERS
from service.offline.exports.flight import iso_time
from service.offline.exports.rasters import contours_of, open_map, write_ortho
from service.offline.exports.view import ExportOptions, ScanView, export
from service.offline.geopackage import lines, points, write_layers
from service.scans.annotations import read_annotations
from service.scans.track import flown_datum
from service.scans.writing import write_whole, writing
from service.version import software

log = logging.getLogger(__name__)

MAX_OVERLAY_PX = 4096
JPEG_QUALITY = 85


def write_contours_dxf(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """Contours as 3D polylines of DXF R12 in UTM metres; a layer per height."""
    rows = ["0", "SECTION", "2", "ENTITIES"]
    for height_m, line in contours_of(scan, options):
        layer = f"CONTOUR_{height_m:g}".replace("-", "M").replace(".", "_")
        rows += ["0", "POLYLINE", "8", layer, "66", "1", "70", "8", "10", "0", "20", "0", "30", "0"]
        for x, y in line.tolist():
            place = ["10", f"{x:.3f}", "20", f"{y:.3f}", "30", f"{height_m:.3f}"]
            rows += ["0", "VERTEX", "8", layer, *place, "70", "32"]
        rows += ["0", "SEQEND", "8", layer]
    write_whole(out, "\n".join([*rows, "0", "ENDSEC", "0", "EOF", ""]))


def write_contours_gpkg(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """Contours and annotations as a GeoPackage: a layer each, in the scan's UTM zone."""
    frame = scan.needs_place("a contour map")
    found = contours_of(scan, options)
    heights = {options.height_key: [height_m for height_m, _ in found]}
    layers = [lines("contours", [line for _, line in found], heights)]
    notes = read_annotations(scan.folder).features
    if notes:
        spots = np.array([one.geometry.coordinates for one in notes])[:, [1, 0, 2]]
        if frame.heights is not None:
            spots = frame.heights(spots)
        about = {
            options.height_key: spots[:, 2].tolist(),
            "text": [one.properties.text for one in notes],
            "by": [one.properties.by for one in notes],
            "made_unix_s": [one.properties.made_unix_s for one in notes],
        }
        places = frame.to_utm(frame.to_enu(spots))[:, :2]
        layers.append(points("annotations", places, about))
    write_layers(out, frame.epsg, layers)


def write_kmz(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The orthophoto as a ground overlay for Google Earth: doc.kml and a PNG in a zip."""
    scan.needs_place("a KMZ")
    path = out.parent / "ortho.tif"
    if not path.is_file():
        write_ortho(scan, path, options)
    image, (west, south, east, north) = _in_degrees(path)
    _, data = cv2.imencode(".png", image)
    name = scan.store.header.scan_id
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
    from rasterio.enums import Resampling
    from rasterio.transform import array_bounds
    from rasterio.warp import calculate_default_transform

    with open_map(path, 4) as image:
        to, w, h = calculate_default_transform(
            image.crs, "EPSG:4326", image.width, image.height, *image.bounds
        )
        shrink = max(1.0, max(w, h) / MAX_OVERLAY_PX)
        w, h = round(w / shrink), round(h / shrink)
        to = to * to.scale(shrink)
        size = round(image.height / shrink), round(image.width / shrink)
        bands = image.read(out_shape=(4, *size), resampling=Resampling.average)
        to_map = Transformer.from_crs("EPSG:4326", image.crs, always_xy=True)
        from_map = ~(image.transform * image.transform.scale(
            image.width / size[1], image.height / size[0]
        ))  # fmt: skip

    def pixels(lon_lat: F64) -> F32:
        cols, rows = from_map * np.array(to_map.transform(*lon_lat.T))
        return np.column_stack([cols - 0.5, rows - 0.5]).astype(np.float32)

    lon, lat = to.c + to.a * (np.arange(w) + 0.5), to.f + to.e * (np.arange(h) + 0.5)
    x, y = between_nodes(lon, lat, pixels)
    bgra = np.ascontiguousarray(bands[[2, 1, 0, 3]].transpose(1, 2, 0))
    west, south, east, north = array_bounds(h, w, to)
    return cv2.remap(bgra, x, y, cv2.INTER_LINEAR), (west, south, east, north)


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
    south, west = geodetic[:, :2].min(axis=0).tolist()
    north, east = geodetic[:, :2].max(axis=0).tolist()
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    times = [p.time_unix_ns for p in scan.poses] or [scan.store.header.started_unix_ns]
    start, end = iso_time(min(times)), iso_time(max(times))
    item = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": [
            "https://stac-extensions.github.io/projection/v1.1.0/schema.json",
        ],
        "id": scan.store.header.scan_id,
        "bbox": [west, south, east, north],
        "geometry": {"type": "Polygon", "coordinates": [ring]},
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
LAST = ("stac",)
"""What describes the others."""

MANIFEST = "manifest.json"


def write_all(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """MAPS into the folder ``out``; ``manifest.json`` lists files, sizes, SHA-256 and failures.

    A kind that fails does not stop the others. Raises the last error when none is written.
    """
    out.mkdir(parents=True, exist_ok=True)
    done: dict[str, Path | SkyreliefError] = {}

    def write(view: ScanView, kind: str) -> None:
        try:
            done[kind] = export(view, kind, out / EXPORTERS[kind][1], options)
        except SkyreliefError as error:
            log.warning("%s is left out: %s", kind, error)
            done[kind] = error

    _in_two_branches(scan, MAPS, write)
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


def write_kinds(
    scan: ScanView,
    kinds: Sequence[str],
    out: Path | None,
    options: ExportOptions,
    done: dict[str, Path],
) -> None:
    """Write some kinds, those from images at the same time as the others; ``done`` takes each
    one's path. Raises the first error, after the other branch has ended."""

    def write(view: ScanView, kind: str) -> None:
        done[kind] = export(view, kind, out, options)

    _in_two_branches(scan, kinds, write)


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
        at_once(lambda: work(views[0], rest), lambda: work(views[1], images))
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
