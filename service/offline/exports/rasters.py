"""Surface model, bare ground and orthophoto as Cloud Optimized GeoTIFF."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon.mapping.voxel_map import ground_sample_m
from recon.parallel import run_parallel, threads
from recon.surface.orthophoto import STEPS, Terrain, orthophoto
from recon.surface.raster import LARGEST_CELLS, Grid, Raster, round_cell
from recon.surface.texture_views import TextureView
from recon.types import U8, Array, Bool
from service.errors import InputError
from service.georeference import map_crs
from service.offline.exports.images import recording_for, shared_images
from service.offline.exports.surface import bare_ground, cell_places, complete_model, surface_model
from service.offline.exports.view import (
    NO_POINTS,
    ExportOptions,
    Make,
    NoPointsError,
    ScanView,
    in_parts,
)
from service.offline.tiles import box_around, grown
from service.scans.coverage import coverage_of
from service.scans.fused_cloud import Box
from service.scans.main_piece import main_keyframes, main_seqs
from service.scans.track import heights_above
from service.scans.trust import lacks_altitude
from service.scans.writing import writing

NODATA_M = -9999.0
COG = {"level": 4, "overview_resampling": "AVERAGE", "statistics": "YES"}
"""Half the time of GDAL's defaults for 3 % larger files; the mean of heights never overshoots. GIS
stretch colours by the statistics, which they else take from the overviews or not at all."""

RAW = {"tiled": True, "sparse_ok": True, "bigtiff": "IF_SAFER"}
GDAL_CACHE_BYTES = 128_000_000

SOME_MAP = "EPSG:32631"
"""Stands for the map of a scan without georeference, whose metres stay as they are."""

OBJECT_M = 1.0
"""Above the bare ground; seams of the orthophoto run around what is higher."""

MEAN_OF = 4
"""A cell shows the mean of so many places along each side at most: one place of a large cell would
make dots of edges and lines."""

GROUND_MARGIN_M = 40.0
"""Around a tile: the widest object that the bare ground is bridged below."""


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """What a GeoTIFF holds."""

    grid: Grid
    bands: Array  # (bands, rows, cols)
    names: tuple[str, ...]
    nodata: float | None = None
    vertical: str | None = None  # what service.georeference.map_crs takes

    def within(self, box: Box) -> Layers:
        """The cells whose centres lie in the box."""
        rows, cols = self.grid.window(box)
        bands = np.ascontiguousarray(self.bands[:, rows, cols])
        return replace(self, grid=self.grid.part(rows, cols), bands=bands)


def dsm(scan: ScanView, options: ExportOptions, box: Box) -> Layers:
    """Heights in metres (float32, -9999 where unknown), their sigma within the map, 1 where filled,
    2 where measured but uncertain, and their sigma in the world."""
    if options.strict:
        raster = surface_model(scan, options.cell_m)
        origin = np.zeros(raster.grid.shape, np.uint8)
    else:
        raster, origin = complete_model(scan, options.cell_m)
    absolute_m = np.full(raster.grid.shape, NODATA_M, np.float32)
    if scan.shared_sigma is not None:
        places = cell_places(scan, raster.grid, raster.height_m)[raster.known]
        absolute_m[raster.known] = scan.shared_sigma.absolute_m(
            raster.sigma_m[raster.known], places
        )
    bands = np.stack([raster.height_m, raster.sigma_m, origin.astype(np.float32), absolute_m])
    image = np.where(raster.known, bands, NODATA_M).astype(np.float32)
    names = (f"height {scan.above(options)}, m", "sigma, m", "filled", "sigma in the world, m")
    return Layers(raster.grid, image, names, NODATA_M, options.datum).within(box)


def dtm(scan: ScanView, options: ExportOptions, box: Box) -> Layers:
    """Heights of the bare ground (float32, -9999 where unknown), and 1 where they are bridged."""
    raster, found = surface_model(scan, options.cell_m), bare_ground(scan, options.cell_m)
    bands = np.stack([found.everywhere_m, found.is_bridged])
    image = np.where(found.is_inside, bands, NODATA_M).astype(np.float32)
    names = (f"ground {scan.above(options)}, m", "bridged")
    return Layers(raster.grid, image, names, NODATA_M, options.datum).within(box)


def ortho(scan: ScanView, options: ExportOptions, box: Box) -> Layers:
    """Red, green, blue and opacity, one byte each; seen from straight above everywhere.

    Cells are as large as pixels of the recording on the ground, rounded down to a round length;
    as those of the stored images where there is no recording.
    """
    keyframes = list(main_keyframes(scan.store))
    if not any(np.isfinite(k.depth.depth_m).any() for k in keyframes):
        raise NoPointsError(f"{scan.folder} {NO_POINTS}")
    with scan.progress.part("reading the images", 0.6):
        here, there = scan.progress.branches(2)
        surface: list[Raster] = []
        views: list[TextureView] = []
        run_parallel(
            lambda: surface.append(complete_model(scan.with_progress(here), None)[0]),
            lambda: views.extend(shared_images(scan.with_progress(there), options)),
        )
    terrain = _terrain(scan, surface[0], views)
    sample_m = [
        (ground_sample_m(k.depth) or np.nan) * k.depth.K[0, 0] / v.K[0, 0]
        for k, v in zip(keyframes, views, strict=True)
    ]
    cell_m = options.cell_m or round_cell(float(np.nanmedian(sample_m)))
    grid = over(terrain.raster.grid.bounds, cell_m)
    finer = min(
        cell_m / float(np.nanmedian(sample_m)), np.sqrt(LARGEST_CELLS / np.prod(grid.shape))
    )
    fine = grid.divided(min(max(1, int(finer)), MEAN_OF))
    with scan.progress.part("orthophoto of {1} x {0} cells of {2:g} m".format(*grid.shape, cell_m)):
        rgb, known = orthophoto(terrain, views, fine, scan.progress.counting(STEPS))
    rgb, known = _averaged(rgb, known, grid.shape)
    opacity = np.where(known, 255, 0).astype(np.uint8)
    bands = np.concatenate([rgb.transpose(2, 0, 1), opacity[None]])
    return Layers(grid, bands, ("red", "green", "blue", "opacity")).within(box)


def _averaged(rgb: U8, known: Bool, shape: tuple[int, int]) -> tuple[U8, Bool]:
    """Colours of whole cells (rows, cols), the means of ``known`` finer ones; where most are."""
    if rgb.shape[:2] == shape:
        return rgb, known
    total, share = (
        cv2.resize(one, shape[::-1], interpolation=cv2.INTER_AREA)
        for one in (rgb, known.astype(np.float32))
    )
    mean = np.clip(np.rint(total / np.maximum(share, 1e-6)[..., None]), 0, 255)
    return mean.astype(np.uint8), share > 0.5


def write_ortho(scan: ScanView, out: Path, options: ExportOptions) -> None:
    _write(scan, out, options, ortho)
    scan.shared(("written ortho", options), lambda: out)


def written_ortho(scan: ScanView, options: ExportOptions) -> Path | None:
    """Where :func:`write_ortho` wrote the orthophoto of this view with these options, if it did."""
    path: Path | None = scan.shared(("written ortho", options), lambda: None)
    return path if path is not None and path.is_file() else None


def _write(scan: ScanView, out: Path, options: ExportOptions, make: Make[Layers]) -> None:
    """One kind of raster, in tiles where there are more points than one may have."""
    cut, whole = scan.tiling(options, GROUND_MARGIN_M), None
    if len(cut.tiles) > 1:
        fixed = scan.for_tiles(options, cut)
        if make is ortho and options.cell_m is None:
            fixed = replace(fixed, cell_m=round_cell(cut.sample_m / _finer(scan, options)))
        assert fixed.cell_m is not None and fixed.voxel_m is not None
        edge = 2.0 * max(fixed.cell_m, fixed.voxel_m)
        whole, options = over(grown(cut.bounds, edge), fixed.cell_m), fixed
    parts = in_parts(scan, make, options, GROUND_MARGIN_M)
    first = next(parts)
    with mosaic(scan, out, whole or first.grid, first) as image:
        for layers in chain([first], parts):
            put(image, layers)


write_dsm, write_dtm = partial(_write, make=dsm), partial(_write, make=dtm)


def _finer(scan: ScanView, options: ExportOptions) -> float:
    """By how much pixels of the recording are finer than those of the store; 1 without one."""
    seqs, camera = main_seqs(scan.store), scan.store.header.camera
    if recording_for(scan, options).path is None:
        return 1.0
    first = scan.store.keyframe(seqs[0])
    assert first is not None  # there is more than one tile
    return float(camera["K"][0]) / float(first.depth.K[0, 0])


def _terrain(scan: ScanView, raster: Raster, views: Sequence[TextureView]) -> Terrain:
    eyes = np.array([v.T_world_camera[:3, 3] for v in views])
    if scan.frame is not None:
        eyes = scan.frame.to_utm(eyes)
    above_m = raster.height_m - bare_ground(scan, None).everywhere_m
    high = (above_m > OBJECT_M).astype(np.uint8)
    whole = cv2.morphologyEx(high, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    objects = np.asarray(cv2.connectedComponents(whole)[1], np.int32)
    return Terrain(raster, cell_places(scan, raster.grid, raster.height_m), eyes, objects)


def over(bounds: Box, cell_m: float) -> Grid:
    """The grid of ``cell_m`` over the same ground, its edges on multiples of the cell."""
    west, south, east, north = bounds
    low = math.floor(west / cell_m + 1e-6), math.floor(south / cell_m + 1e-6)
    high = math.ceil(east / cell_m - 1e-6), math.ceil(north / cell_m - 1e-6)
    try:
        return Grid(low[0] * cell_m, high[1] * cell_m, cell_m, (high[1] - low[1], high[0] - low[0]))
    except ValueError as error:
        raise InputError(f"{error} with --cell-m") from error


@contextmanager
def mosaic(scan: ScanView, out: Path, grid: Grid, like: Layers) -> Iterator[Any]:
    """A raster file over ``grid`` that is written piece by piece with :func:`put`, then stored as
    Cloud Optimized GeoTIFF in the scan's UTM zone.

    Heights above the ellipsoid are a tag only.
    """
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.shutil import copy

    profile: dict[str, Any] = {
        "driver": "GTiff",
        "height": grid.shape[0],
        "width": grid.shape[1],
        "count": len(like.bands),
        "dtype": like.bands.dtype,
        "transform": transform_of(grid),
        "nodata": like.nodata,
    }
    if scan.frame is not None:
        # GeoTIFF has no code for ellipsoidal heights on a map.
        coded = None if like.vertical == "ellipsoid" else like.vertical
        profile["crs"] = rasterio.crs.CRS.from_wkt(map_crs(scan.frame.epsg, coded).to_wkt())
    heights = heights_above(scan.frame, like.vertical, lacks_altitude(scan.store))
    with (
        writing(out) as part,
        tempfile.TemporaryDirectory(dir=out.parent) as folder,
        rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_BYTES),
    ):
        raw = Path(folder) / "raw.tif"
        with rasterio.open(raw, "w+", **profile, **RAW) as image:
            image.descriptions = like.names
            image.units = ["metre" if name.endswith(", m") else "" for name in like.names]
            image.update_tags(SCAN=scan.store.header.scan_id, HEIGHTS=heights)
            if like.bands.dtype == np.uint8:
                kinds = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
                image.colorinterp = kinds
            yield image
        predictor = "YES" if like.bands.dtype.kind == "f" else "STANDARD"
        how = {"driver": "COG", "compress": "DEFLATE", "predictor": predictor} | COG
        copy(str(raw), str(part), **how, num_threads=threads())


def put(image: Any, layers: Layers) -> None:
    """Write the layers into the open raster of the same cells, at their place."""
    image.write(layers.bands, window=window_in(image, layers.grid))


def window_in(image: Any, grid: Grid) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns of a grid in an open raster of the same cells, which holds it."""
    row = round((image.transform.f - grid.north_m) / grid.cell_m)
    col = round((grid.west_m - image.transform.c) / grid.cell_m)
    return (row, row + grid.shape[0]), (col, col + grid.shape[1])


def write_coverage(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """coverage.tif: views, sigma and height as float32, -9999 where unknown, in the scan's UTM.

    Raises InputError when the scan contains no surface.
    """
    found = coverage_of(scan.store, options.cell_m)
    if found is None:
        raise InputError(f"{scan.folder} {NO_POINTS}")
    layer, grid = found.layer, found.layer.grid
    zero_m = 0.0 if scan.frame is None else scan.frame.to_geodetic(np.zeros((1, 3)))[0, 2]
    height_m = layer.height_m + zero_m
    bands = np.stack([layer.views.astype(np.float32), layer.sigma_m, height_m]).astype(np.float32)
    bands[:, ~(layer.known | (layer.views > 0))] = np.nan
    if scan.frame is not None:
        grid = over(box_around(layer.grid.bounds, scan.frame.to_utm), layer.grid.cell_m)
        level = np.full(grid.shape, zero_m, np.float32)
        xy_m = cell_places(scan, grid, level)[..., :2].reshape(-1, 2)
        rows, cols = layer.grid.cells(xy_m)
        bands = np.where(layer.grid.holds(xy_m), bands[:, rows, cols], np.nan)
        bands = bands.reshape(-1, *grid.shape)
    bands = np.where(np.isfinite(bands), bands, np.float32(NODATA_M))
    names = ("views", "sigma, m", "height, m")
    layers = Layers(grid, bands, names, NODATA_M, options.to_datum)
    with mosaic(scan, out, grid, layers) as image:
        put(image, layers)


def transform_of(grid: Grid) -> Any:
    from rasterio.transform import from_origin

    return from_origin(grid.west_m, grid.north_m, grid.cell_m, grid.cell_m)


def warped(
    image: Any, transform: Any, crs: str, shape: tuple[int, int], is_smooth: bool = True
) -> Array:
    """(bands, rows, cols) of an open raster on another map."""
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    grid = {"transform": transform, "crs": crs, "height": shape[0], "width": shape[1]}
    how = Resampling.bilinear if is_smooth else Resampling.nearest
    with WarpedVRT(image, src_crs=image.crs or SOME_MAP, resampling=how, **grid) as other:
        found: Array = other.read()
        return found


MAX_BLOCK_PX = 1 << 22
"""Of a block that is decoded at once; exports have 512 by 512 pixels."""

ALONE = {
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
}
"""GDAL reads no hosts, and no other file than the one that is opened."""


@contextmanager
def open_map(path: Path, bands: int = 1) -> Iterator[Any]:
    """The GeoTIFF at ``path``, which may come from anyone, with so many bands at least.

    Raises InputError for any other file: other formats of GDAL name files and hosts to read.
    """
    import rasterio
    from rasterio._err import CPLE_BaseError  # of GDAL itself; no RasterioError

    try:
        with rasterio.Env(**ALONE), rasterio.open(path, driver="GTiff") as image:
            if image.count < bands or max(h * w for h, w in image.block_shapes) > MAX_BLOCK_PX:
                raise InputError(f"{path.name} is not a map of a scan; make it again")
            yield image
    except (rasterio.errors.RasterioError, CPLE_BaseError, ValueError) as error:
        raise InputError(f"{path.name} cannot be read as a GeoTIFF; make it again") from error
