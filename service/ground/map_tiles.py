"""Maps of a scan over HTTP: XYZ tiles in Web Mercator, TileJSON, WMTS, KML.

A layer comes from the exported raster where that is newer than the scan's other files, else from
the keyframes as they arrive. The documents are templates: tile servers (TiTiler, MapProxy) write
them for rasters, not for a map that grows.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from xml.sax.saxutils import escape

import cv2
import numpy as np
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from recon.surface.raster import Grid, Raster, hillshade
from recon.types import F32, U8
from service.errors import InputError, MissingError
from service.ground.basemap import Basemap, tile_of, tile_px
from service.ground.live_map import (
    EQUATOR_M,
    MARGIN,
    MAX_ZOOM,
    SIDE,
    WIDE,
    LiveMap,
    Tile,
    degrees,
    on_map,
    pixel_m,
)
from service.ground.scan_facts import is_current
from service.ground.state import PortalState, folder_of, state_of
from service.offline.exports.rasters import open_map, warped
from service.scans.coverage import Coverage
from service.scans.writing import SUMMARY

TERRAIN = "terrain"
"""Heights as colours in the Terrarium encoding: metres are 256 R + G + B / 256 - 32768."""

RASTERS = {"ortho": "ortho.tif", "dsm": "dsm.tif", "contours": "dsm.tif", TERRAIN: "dsm.tif"}
"""The layers that a finished scan may have as rasters."""

LAYERS = ("ortho", "dsm", "contours", "coverage")  # those that are seen as they are
INK = (40, 60, 110)  # BGR of contours
SMOOTH_PX = 1.5
CONTOUR_PX = 4.0
"""Interval of contours in pixels on the ground, rounded up to 1, 2 or 5 times a power of ten."""

BOUNDS = ("west", "south", "east", "north")
KML_TILES = 4
THUMBNAIL_PX = 480  # of its longer side, at most
REFRESH_S = 2
FRESH = {"cache-control": "max-age=1"}  # an ETag needs the tile drawn first
NOW = {"cache-control": "no-cache"}  # whoever asks for the version of a map wants that of now


def map_routes() -> list[Route]:
    one = "/tiles/{drone}/{scan}/{layer}"
    return [
        Route(one + ".json", _tile_json),
        Route(one + ".kml", _kml),
        Route("/tiles/{drone}/{scan}/wmts.xml", _wmts),
        Route("/tiles/{drone}/{scan}/thumbnail.png", _thumbnail),
        Route(one + "/{z:int}/{x:int}/{y:int}.png", _tile),
        Route("/tiles/basemap.json", _basemap_json),
        Route("/tiles/basemap/{z:int}/{x:int}/{y:int}", _basemap),
    ]


def _tile(request: Request) -> Response:
    """A map tile of a scan: ortho, dsm, contours, coverage or terrain (heights in the Terrarium
    encoding); transparent where nothing is known."""
    state, folder, layer = _asked(request)
    z, x, y = _place(request)
    image = tile_image(state, folder, layer, (z, x, y))
    return Response(_png(image), media_type="image/png", headers=FRESH)


def _thumbnail(request: Request) -> Response:
    """The whole orthophoto of a scan as it is now, also while it grows, as bright as in the portal;
    transparent where nothing is known."""
    state, folder = state_of(request), folder_of(request)
    with state.maps.lock:
        live = state.maps.view(folder)
        corners, exposure = live.bounds, live.exposure
    zoom, columns, rows = _tiles_under(corners, THUMBNAIL_PX / SIDE)
    left, top, right, bottom = (int(v * (SIDE << zoom)) for v in corners)
    whole = np.vstack([
        np.hstack([tile_image(state, folder, "ortho", (zoom, x, y)) for x in columns])
        for y in rows
    ])  # fmt: skip
    x, y = SIDE * columns[0], SIDE * rows[0]
    image = whole[top - y : bottom - y + 1, left - x : right - x + 1]
    image[..., :3] = cv2.convertScaleAbs(image[..., :3], alpha=exposure)
    return Response(_png(image), media_type="image/png", headers=FRESH)


def _place(request: Request) -> Tile:
    """The tile of a request; InputError where the map has none such."""
    z, x, y = (request.path_params[name] for name in "zxy")
    if not (z <= MAX_ZOOM and x < 1 << z and y < 1 << z):
        raise MissingError("no such tile")
    return z, x, y


def _asked(request: Request) -> tuple[PortalState, Path, str]:
    """State, folder and layer of a request; InputError where there is none."""
    state, layer = state_of(request), request.path_params["layer"]
    if layer not in (*LAYERS, TERRAIN):
        raise MissingError(f"no layer {layer[:40]}; there are {', '.join((*LAYERS, TERRAIN))}")
    return state, folder_of(request), layer


def _png(image: U8) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def tile_image(state: PortalState, folder: Path, layer: str, tile: Tile) -> U8:
    """(SIDE, SIDE, 4) BGRA of one tile."""
    raster = newer_raster(folder, layer)
    if raster is not None:
        return _drawn(layer, _from_raster(raster, layer, tile))
    if layer == "coverage":
        found = state.coverages.view(folder).found
        return _clear() if found is None else coverage_image(found, tile)
    with state.maps.lock:
        live = state.maps.view(folder)
        up = max(0, tile[0] - (tile[0] if live.zoom is None else live.zoom))
        parent = tile[0] - up, tile[1] >> up, tile[2] >> up
        surface = live.surface(parent, seen=layer == "ortho")
    return _enlarged(_drawn(layer, surface), tile, up, smooth=layer != TERRAIN)


def _clear() -> U8:
    return np.zeros((SIDE, SIDE, 4), np.uint8)


def _enlarged(image: U8, tile: Tile, up: int, smooth: bool = True) -> U8:
    """The part of an ancestor's image, ``up`` zooms above, that a tile shows."""
    if not up:
        return image
    side = SIDE / (1 << up)
    left, top = ((tile[k] & ((1 << up) - 1)) * side for k in (1, 2))
    shift = np.array([[side / SIDE, 0.0, left], [0.0, side / SIDE, top]])
    shift[:, 2] += 0.5 * side / SIDE - 0.5  # centres of pixels
    flags = cv2.WARP_INVERSE_MAP | (cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)
    return np.asarray(cv2.warpAffine(image, shift, (SIDE, SIDE), flags=flags,
                                     borderMode=cv2.BORDER_REPLICATE), np.uint8)  # fmt: skip


def newer_raster(folder: Path, layer: str) -> Path | None:
    """The exported raster of a layer, unless the scan has changed since."""
    try:
        path = folder / RASTERS[layer]
        import rasterio  # noqa: F401

        return path if (folder / SUMMARY).exists() and is_current(path) else None
    except (OSError, KeyError, ImportError):
        return None


def _from_raster(path: Path, layer: str, tile: Tile) -> Raster:
    from rasterio.transform import from_origin

    step = EQUATOR_M / (SIDE << tile[0])
    west = tile[1] * SIDE * step - 0.5 * EQUATOR_M - MARGIN * step
    north = 0.5 * EQUATOR_M - tile[2] * SIDE * step + MARGIN * step
    corner = from_origin(west, north, step, step)
    with open_map(path, 4 if layer == "ortho" else 1) as image:
        if image.crs is None:
            raise MissingError("no map: the scan has no georeference")
        bands, unknown = warped(image, corner, "EPSG:3857", (WIDE, WIDE)), image.nodata
    latitude, _ = degrees(0.5, (tile[2] + 0.5) / (1 << tile[0]))
    grid = Grid(0.0, 0.0, pixel_m(tile[0], latitude), (WIDE, WIDE))
    if layer == "ortho":
        height, rgb = np.where(bands[3] > 0, 0.0, np.nan), bands[:3].transpose(1, 2, 0)
    else:
        height = np.where(bands[0] == unknown, np.nan, bands[0])
        rgb = np.zeros((WIDE, WIDE, 3), np.uint8)
    no_sigma = np.full((WIDE, WIDE), np.nan, np.float32)
    return Raster(grid, height.astype(np.float32), no_sigma, rgb)


def _drawn(layer: str, surface: Raster) -> U8:
    """(SIDE, SIDE, 4) BGRA of a layer, without the margin."""
    out = np.zeros((WIDE, WIDE, 4), np.uint8)
    known, cell_m = surface.known, surface.grid.cell_m
    if layer == "ortho":
        out[..., :3] = surface.rgb[..., ::-1]
        out[..., 3] = np.where(known, 255, 0)
    elif layer == TERRAIN:
        out[...] = _terrarium(surface.height_m)
    elif known.any():
        height = _smooth(surface.height_m)
        if layer == "dsm":
            out[..., :3] = np.nan_to_num(255.0 * hillshade(height, cell_m))[..., None]
            out[..., 3] = np.where(known, 255, 0)
        else:
            lines = contour_mask(height, interval_m(cell_m)) & known
            out[lines] = (*INK, 255)
    inner = slice(MARGIN, MARGIN + SIDE)
    return np.ascontiguousarray(out[inner, inner])


def _terrarium(height_m: F32) -> U8:
    """(h, w, 4) BGRA of heights to 4 mm, clear where unknown or beyond the encoding."""
    known = np.abs(height_m) < 32768.0
    code = np.where(known, (height_m.astype(np.float64) + 32768.0) * 256.0 + 0.5, 0.0)
    bytes_ = code.astype(np.uint32)[..., None] >> np.array([0, 8, 16], np.uint32)
    return np.dstack([bytes_ & 255, np.where(known, 255, 0)]).astype(np.uint8)


def _smooth(height_m: F32) -> F32:
    """Heights without noise of single pixels; unknown ones stay unknown."""
    known = np.isfinite(height_m)
    middle = np.float32(np.median(height_m[known]))
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), SMOOTH_PX)
    sums = cv2.GaussianBlur(np.where(known, height_m - middle, 0.0), (0, 0), SMOOTH_PX)
    smooth = middle + sums / np.maximum(weight, 1e-6)
    return np.where(known, smooth, np.nan).astype(np.float32)


def interval_m(cell_m: float) -> float:
    """A round interval of contours for pixels of this length."""
    wanted = CONTOUR_PX * cell_m
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(next(power * n for n in (1, 2, 5, 10) if power * n >= wanted))


def contour_mask(height_m: F32, step_m: float) -> np.ndarray:
    """Pixels where a contour passes on to the next pixel east or south."""
    level = np.floor(height_m / step_m)
    mask = np.zeros(level.shape, np.bool_)
    with np.errstate(invalid="ignore"):
        mask[:, :-1] |= np.abs(np.diff(level, axis=1)) > 0
        mask[:-1] |= np.abs(np.diff(level, axis=0)) > 0
    return mask


def coverage_image(found: Coverage, tile: Tile) -> U8:
    if found.frame is None:
        raise MissingError("no map: the scan has no georeference")
    west, south, east, north = found.layer.grid.bounds
    corners = np.array([[west, north, 0.0], [east, north, 0.0], [west, south, 0.0]])
    scale = float(SIDE << tile[0])
    on_tile = on_map(found.frame, corners)[:, :2] * scale - np.array(tile[1:]) * SIDE - 0.5
    image = found.image()
    rows, cols = image.shape[:2]
    ends = np.array([[-0.5, -0.5], [cols - 0.5, -0.5], [-0.5, rows - 0.5]], np.float32)
    A = cv2.getAffineTransform(ends, on_tile.astype(np.float32))
    out = cv2.warpAffine(np.ascontiguousarray(image), A, (SIDE, SIDE), flags=cv2.INTER_NEAREST)
    return np.asarray(out, np.uint8)


def _tiles_under(
    corners: tuple[float, float, float, float], wide: float
) -> tuple[int, range, range]:
    """The finest zoom at which what lies within ``corners`` is no wider than ``wide`` tiles, and
    the columns and rows of the tiles that show it."""
    west, north, east, south = corners
    side = max(east - west, south - north, 1e-9)
    zoom = min(MAX_ZOOM, max(0, int(np.floor(np.log2(wide / side)))))
    n = 1 << zoom
    return zoom, range(int(west * n), int(east * n) + 1), range(int(north * n), int(south * n) + 1)


def _bounds(live: LiveMap) -> tuple[float, float, float, float]:
    """(west, south, east, north) in degrees; InputError without surface."""
    west, north, east, south = live.bounds
    (n, w), (s, e) = degrees(west, north), degrees(east, south)
    return w, s, e, n


def _tile_json(request: Request) -> Response:
    """A layer of a scan as TileJSON 3.0. ``version`` changes with the map; the portal shows the
    orthophoto's colours times ``exposure``."""
    state, folder, layer = _asked(request)
    with state.maps.lock:
        live = state.maps.view(folder)
        bounds, version, exposure = _bounds(live), live.version, live.exposure
    if layer == "coverage" and (found := state.coverages.view(folder).found) is not None:
        version = zlib.crc32(found.image().tobytes())
    raster = newer_raster(folder, layer)
    document = {
        "tilejson": "3.0.0",
        "name": f"{folder.name}, {layer}",
        "tiles": [str(request.base_url) + _path(folder, layer) + "/{z}/{x}/{y}.png"],
        "bounds": [round(v, 8) for v in bounds],
        "minzoom": 0,
        "maxzoom": MAX_ZOOM,
        "version": f"{version}.0.{0 if raster is None else int(raster.stat().st_mtime)}",
    }
    if layer == "ortho":
        document["exposure"] = round(exposure, 3)
    if layer == "contours":
        latitude = 0.5 * (bounds[1] + bounds[3])
        finest = MAX_ZOOM if raster is not None or live.zoom is None else live.zoom
        zooms = (min(z, finest) for z in range(MAX_ZOOM + 1))
        document["intervals_m"] = [interval_m(pixel_m(z, latitude)) for z in zooms]
    return JSONResponse(document, headers=NOW)


def _path(folder: Path, layer: str) -> str:
    return f"tiles/{folder.parent.name}/{folder.name}/{layer}"


SCALE = 559082264.0287178
"""Denominator of the scale of zoom 0: pixels of 0.28 mm (OGC 07-057r7, annex E.4)."""

WMTS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<Capabilities version="1.0.0" '
    'xmlns="http://www.opengis.net/wmts/1.0" xmlns:ows="http://www.opengis.net/ows/1.1" '
    'xmlns:xlink="http://www.w3.org/1999/xlink"><ows:ServiceIdentification>'
    "<ows:Title>{title}</ows:Title><ows:ServiceType>OGC WMTS</ows:ServiceType>"
    "<ows:ServiceTypeVersion>1.0.0</ows:ServiceTypeVersion></ows:ServiceIdentification>"
    "<Contents>{layers}<TileMatrixSet><ows:Identifier>GoogleMapsCompatible</ows:Identifier>"
    "<ows:SupportedCRS>urn:ogc:def:crs:EPSG::3857</ows:SupportedCRS><WellKnownScaleSet>"
    "urn:ogc:def:wkss:OGC:1.0:GoogleMapsCompatible</WellKnownScaleSet>{zooms}</TileMatrixSet>"
    '</Contents><ServiceMetadataURL xlink:href="{own}"/></Capabilities>\n'
)
WMTS_LAYER = (
    "<Layer><ows:Title>{name}</ows:Title><ows:WGS84BoundingBox><ows:LowerCorner>{west:.8f} "
    "{south:.8f}</ows:LowerCorner><ows:UpperCorner>{east:.8f} {north:.8f}</ows:UpperCorner>"
    "</ows:WGS84BoundingBox><ows:Identifier>{name}</ows:Identifier><Style isDefault="
    '"true"><ows:Identifier>default</ows:Identifier></Style><Format>image/png</Format>'
    "<TileMatrixSetLink><TileMatrixSet>GoogleMapsCompatible</TileMatrixSet></TileMatrixSetLink>"
    '<ResourceURL format="image/png" resourceType="tile" template='
    '"{tiles}/{name}/{{TileMatrix}}/{{TileCol}}/{{TileRow}}.png"/></Layer>'
)
WMTS_ZOOM = (
    "<TileMatrix><ows:Identifier>{z}</ows:Identifier><ScaleDenominator>{scale!r}"
    "</ScaleDenominator><TopLeftCorner>{left!r} {top!r}</TopLeftCorner><TileWidth>{side}"
    "</TileWidth><TileHeight>{side}</TileHeight><MatrixWidth>{n}</MatrixWidth>"
    "<MatrixHeight>{n}</MatrixHeight></TileMatrix>"
)


def _wmts(request: Request) -> Response:
    """All layers of a scan as WMTS 1.0.0 capabilities, whose tiles are the XYZ ones."""
    state, folder = state_of(request), folder_of(request)
    with state.maps.lock:
        bounds = dict(zip(BOUNDS, _bounds(state.maps.view(folder)), strict=True))
    tiles = escape(f"{request.base_url}tiles/{folder.parent.name}/{folder.name}")
    layers = "".join(WMTS_LAYER.format(name=name, tiles=tiles, **bounds) for name in LAYERS)
    corner = {"left": -0.5 * EQUATOR_M, "top": 0.5 * EQUATOR_M, "side": SIDE}
    zooms = "".join(
        WMTS_ZOOM.format(z=z, scale=SCALE / (1 << z), n=1 << z, **corner)
        for z in range(MAX_ZOOM + 1)
    )
    text = WMTS.format(
        title=escape(folder.name), layers=layers, zooms=zooms, own=f"{tiles}/wmts.xml"
    )
    return Response(text, media_type="application/xml", headers=NOW)


def _kml(request: Request) -> Response:
    """A layer as overlays for Google Earth and TAK, each fetched again every few seconds."""
    state, folder, layer = _asked(request)
    with state.maps.lock:
        corners = state.maps.view(folder).bounds
    zoom, columns, rows = _tiles_under(corners, KML_TILES - 1)
    overlays = "".join(
        _overlay(f"{request.base_url}{_path(folder, layer)}/{zoom}/{x}/{y}.png", (zoom, x, y))
        for x in columns
        for y in rows
    )
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">'
        f"<Document><name>{escape(folder.name)}, {layer}</name>{overlays}</Document></kml>\n"
    )
    return Response(text, media_type="application/vnd.google-earth.kml+xml", headers=FRESH)


def _overlay(address: str, tile: Tile) -> str:
    zoom, x, y = tile
    (north, west), (south, east) = (degrees((x + k) / (1 << zoom), (y + k) / (1 << zoom))
                                    for k in (0, 1))  # fmt: skip
    return (
        f"<GroundOverlay><Icon><href>{escape(address)}</href><refreshMode>onInterval</refreshMode>"
        f"<refreshInterval>{REFRESH_S}</refreshInterval></Icon><LatLonBox>"
        f"<north>{north:.9f}</north><south>{south:.9f}</south><east>{east:.9f}</east>"
        f"<west>{west:.9f}</west></LatLonBox></GroundOverlay>"
    )


def _basemap_json(request: Request) -> Response:
    """The operator's own basemap as TileJSON; 404 where none was given."""
    found = _given(request)
    tiles = str(request.base_url) + "tiles/basemap/{z}/{x}/{y}"
    return JSONResponse({"tilejson": "3.0.0", "tiles": [tiles], **found.about})


def _given(request: Request) -> Basemap:
    found = state_of(request).basemap
    if found is None:
        raise MissingError("no basemap: start with 'skyrelief ground --basemap FILE'")
    return found


def _basemap(request: Request) -> Response:
    """A tile of the basemap; below its finest zoom enlarged, clear where it has none."""
    found = _given(request)
    z, x, y = _place(request)
    up = max(0, z - found.max_zoom)
    data = tile_of(found, z - up, x >> up, y >> up)
    if data is None:
        return Response(_png(_clear()), media_type="image/png")
    if not up:
        return Response(data, media_type=found.media_type)
    try:
        tile_px(data)
        image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)
        whole = np.asarray(cv2.resize(image, (SIDE, SIDE)), np.uint8)
    except (TypeError, ValueError, cv2.error) as error:  # TypeError: it is None
        raise InputError("the basemap is damaged: no image in this tile") from error
    return Response(_png(_enlarged(whole, (z, x, y), up)), media_type="image/png")
