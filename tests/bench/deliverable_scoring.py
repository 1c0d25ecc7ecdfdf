"""The exported files of a scan against the truth of a simulated flight, as JSON.

    python tests/bench/deliverable_scoring.py SCAN FLIGHT/truth

The files are read as anyone would read them (rasterio, laspy, trimesh), and placed by what
they declare: the coordinate system and geotransform, or the origin in the glTF's
``asset.extras``.
"""

from __future__ import annotations

import json
import logging
import struct
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from recon.surface import metrics, triangle_grid
from recon.surface.metrics import Fit
from recon.surface.raster import STEP_M, highest_lowest
from recon.surface.triangle_grid import TriangleGrid
from recon.types import F32, F64, U8, Array, Bool, Camera
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.exports.surface import FILLED, UNCERTAIN
from service.offline.view_scoring import exposed_as, psnr_db
from service.sim.recording import Simulation, SimulationOptions, prepare
from service.sim.render import Look, Renderer
from service.sim.scoring import alignments, read_scan
from service.sim.shapes import FLAT, GABLED, GROUND, KIND, TOP, WALL
from service.sim.truth import (
    Truth,
    heights_below,
    read_surface,
    read_truth,
    reading,
    seen_by_enough,
    seen_surface,
)

log = logging.getLogger(__name__)

REACH_M = 5.0
COVERED_WITHIN_M = 0.5
ORTHO_REACH_M = 3.0
STEP_CELL_M, NEAR_STEP_M = 0.25, 0.5
SAMPLE_SPACING_M = 0.25
MAX_POINTS = 300_000

Fits = dict[str, Fit]


def score_deliverables(scan_folder: Path, truth_folder: Path) -> dict[str, Any]:
    """Figures of each exported file, after the alignments by which the scan is judged."""
    truth = read_truth(truth_folder)
    return score_files(scan_folder, truth, seen_surface(truth).places, fits_of(scan_folder, truth))


def fits_of(scan_folder: Path, truth: Truth) -> Fits:
    """The alignments to the truth by which the surface of a scan is judged."""
    scan = read_scan(scan_folder, truth.frame)
    at_truth, known = metrics.poses_at(truth.times_s, truth.poses, scan.times_s)
    fits = alignments(scan, truth, at_truth, known)["surface"]
    return fits if scan.placed else {"similarity": fits["similarity"]}


def score_files(folder: Path, truth: Truth, seen: F64, fits: Fits) -> dict[str, Any]:
    """Figures of each exported file in ``folder`` by name; a file that is not there is left out.

    ``seen`` (S, 3) are places of the true surface that the flight saw; each file is measured
    after each of the ``fits``. Raises InputError when there is no file, or one is unfit.
    """
    out: dict[str, Any] = {}
    for kind, (name, measure) in _READERS.items():
        path = folder / name
        if path.is_file():
            log.info("measuring %s", path)
            out[kind] = {"file": name} | measure(path, truth, seen, fits)
    if not out:
        raise InputError(f"{folder}: no exported file; `skyrelief export` and `mesh` write them")
    return out


def _dsm(path: Path, truth: Truth, seen: F64, fits: Fits) -> dict[str, Any]:
    """Heights of the cells less the truth's, straight below or above their middles.

    Band 3, where there is one, marks filled cells: they have figures of their own. ``inside`` is
    the share of known cells within the outline of the known ones, ``half_cell_rms_m`` what the true
    heights of places half a cell to the east would have: no step is placed better. ``objects`` are
    the shares of filled and of uncertain cells where something stands on the ground, and of those
    whose top too few frames see; ``buildings`` the same of houses and halls.
    """
    from scipy.ndimage import binary_fill_holes

    image = _Raster(path, truth.frame)
    height = image.bands[0].astype(np.float64)
    known = np.isfinite(height) & (height != image.nodata)
    rows, cols = np.nonzero(known)
    cells = image.places(cols, rows, height[known])
    is_filled = image.bands[2][known] == 1.0 if len(image.bands) > 2 else np.zeros(len(rows), bool)
    out: dict[str, Any] = image.facts | {
        "cells": len(cells),
        "inside": float(known.sum() / max(binary_fill_holes(known).sum(), 1)),
        "filled_share": float(is_filled.mean()) if len(rows) else 0.0,
    }
    for name, fit in fits.items():
        moved = fit.points(cells)
        true = heights_below(truth.surface, moved[:, :2])
        error = moved[:, 2] - true
        beside = heights_below(truth.surface, moved[:, :2] + [0.5 * image.cell_m, 0.0]) - true
        on_truth = np.isfinite(error)
        share = _seen_in(seen, image, known, fit, truth)
        out[name] = {"completeness": share} | _height_figures(error[on_truth])
        out[name]["half_cell_rms_m"] = float(np.sqrt(np.nanmean(beside**2)))
        if is_filled.any():
            out[name]["filled"] = _height_figures(error[on_truth & is_filled])
            places = np.column_stack([moved[:, :2], true])
            for kind, where in _what_stands(truth, places).items():
                out[name][kind] = _unmeasured(truth, places[where], image.bands[2][known][where])
    return out


def _unmeasured(truth: Truth, places: F64, kinds: F32) -> list[float]:
    """Shares of filled, of uncertain and of hidden cells."""
    hidden = ~seen_by_enough(truth, places, np.tile([0.0, 0.0, 1.0], (len(places), 1)))
    shares = kinds == FILLED, kinds == UNCERTAIN, hidden
    return [float(share.mean()) if len(share) else 0.0 for share in shares]


def _what_stands(truth: Truth, places: F64) -> dict[str, Bool]:
    """(N,) which places (N, 3) of the surface are on anything higher than STEP_M above the ground,
    and which on a house or a hall; empty where the truth's place cannot be laid out again.

    There is no ground below a building.
    """
    try:
        scene = _simulated(truth.folder).scene
    except InputError:
        return {}
    down = np.tile([0.0, 0.0, -1.0], (len(places), 1))
    _, hit = truth.surface.cast(places + np.array([0.0, 0.0, 0.1]), down)
    x, y, top = places.T
    stands = (hit >= 0) & (scene.material[hit] != GROUND)
    stands &= top - scene.terrain.height(x, y) > STEP_M
    is_block = stands & np.isin(scene.material[hit], (TOP, WALL))
    block = scene.blocks[scene.owner[hit[is_block]], KIND]
    on_buildings = is_block.copy()
    on_buildings[is_block] = np.isin(block, (FLAT, GABLED))
    return {"objects": stands, "buildings": on_buildings}


def _height_figures(error: F64) -> dict[str, float]:
    if not len(error):
        return {}
    size = np.abs(error)
    return {
        "rms_m": float(np.sqrt(np.mean(error**2))),
        "median_m": float(np.median(size)),
        "bias_m": float(np.median(error)),
        "p95_m": float(np.percentile(size, 95)),
        "within_30cm": float(np.mean(size < 0.3)),
    }


def _seen_in(seen: F64, image: _Raster, known: Array, fit: Fit, truth: Truth) -> float:
    """Share of the seen places that are open to the sky and whose cell is known."""
    top = heights_below(truth.surface, seen[:, :2])
    open_m = seen[np.abs(top - seen[:, 2]) < 0.05]
    cols, rows = image.cells_of((open_m - fit.t) @ fit.R / fit.scale)
    inside = (cols >= 0) & (cols < known.shape[1]) & (rows >= 0) & (rows < known.shape[0])
    held = np.zeros(len(open_m), np.bool_)
    held[inside] = known[rows[inside], cols[inside]]
    return float(held.mean()) if len(held) else float("nan")


def _ortho(path: Path, truth: Truth, seen: F64, fits: Fits) -> dict[str, Any]:
    """Shifts of patches against the place rendered from straight above, and PSNR of the cells where
    each of the fits puts them: of all, and of those next to a step of the true surface. The true
    place has the orthophoto's exposure, by one gain and offset for each channel.
    """
    image = _Raster(path, truth.frame)
    if len(image.bands) < 4:
        raise InputError(f"{path}: {len(image.bands)} bands; expected red, green, blue, opacity")
    known = image.bands[3] > 0
    try:
        true = _true_image(image, known.shape, truth)
    except InputError as error:
        return image.facts | {"trouble": str(error)}
    colour = np.ascontiguousarray(image.bands[2::-1].transpose(1, 2, 0))
    shown, should = (
        cv2.cvtColor(one, cv2.COLOR_BGR2GRAY).astype(np.float32) for one in (colour, true(None))
    )
    found = patch_shifts(shown, should, known, round(ORTHO_REACH_M / image.cell_m))
    out: dict[str, Any] = image.facts | {
        "patches": found.tried,
        "matched_share": found.matched_share,
        "reach_m": ORTHO_REACH_M,
    }
    for name, fit in fits.items():
        moved, near = true(fit), _near_steps(image, truth, fit)
        there = known & (moved.max(axis=2) > 0)
        exposed = exposed_as(colour, moved, there)
        out[name] = {
            "psnr_db": psnr_db(colour, exposed, there),
            "steps_psnr_db": psnr_db(colour, exposed, there & near),
        }
    if not len(found.likeness):
        return out
    (col, row), (du, dv) = found.middle_px.T, found.shift_px.T
    level = np.full(len(col), truth.frame.alt_amsl_m)
    here, there = image.places(col, row, level), image.places(col - du, row - dv, level)
    here[:, 2] = np.nan_to_num(heights_below(truth.surface, there[:, :2]))
    for name, fit in fits.items():
        off = (fit.points(here) - there)[:, :2]
        length = np.hypot(*off.T)
        out[name] |= {
            "rms_m": float(np.sqrt(np.mean(length**2))),
            "median_m": float(np.median(length)),
            "p95_m": float(np.percentile(length, 95)),
            "within_50cm": float(np.mean(length < 0.5)),
            "east_m": float(np.median(off[:, 0])),
            "north_m": float(np.median(off[:, 1])),
        }
    return out


def _true_image(image: _Raster, shape: tuple[int, int], truth: Truth) -> Callable[[Fit | None], U8]:
    """(rows, cols, 3) BGR of the true place on the file's cells, which lie where they say, or where
    a fit moves them by at most ORTHO_REACH_M. Rendered once, at half the cells.

    Raises what :func:`view_from_above` raises.
    """
    step = 0.5 * image.cell_m
    row, col = (axis.ravel() for axis in np.meshgrid(*([0.0, 0.5 * n, n - 1.0] for n in shape)))
    places = image.places(col, row, np.full(len(col), truth.frame.alt_amsl_m))
    west, north = places[:, 0].min() - ORTHO_REACH_M, places[:, 1].max() + ORTHO_REACH_M
    size_m = np.ptp(places[:, :2], axis=0) + 2.0 * ORTHO_REACH_M
    width, height = (int(n) for n in np.ceil(size_m / step) + 1)
    true = view_from_above(truth.folder, west, north, step, (height, width))
    soft = cv2.GaussianBlur(true, (0, 0), 1.0)

    def laid(fit: Fit | None) -> U8:
        ground = (places if fit is None else fit.points(places))[:, :2]
        at_px = (ground - [west, north]) * [1.0, -1.0] / step - 0.5
        # A map projection departs from its tangent by millimetres over the length of a flight.
        cell = np.column_stack([col, row, np.ones(len(col))])
        to_px = np.linalg.lstsq(cell, at_px, rcond=None)[0].T
        onto = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(soft, to_px, shape[::-1], flags=onto), np.uint8)

    return laid


def _near_steps(image: _Raster, truth: Truth, fit: Fit) -> Bool:
    """(rows, cols) cells within NEAR_STEP_M of a step of the true surface higher than STEP_M."""
    shape = image.bands.shape[1:]
    few = max(1, round(STEP_CELL_M / image.cell_m))
    row, col = (n.ravel() for n in np.mgrid[: shape[0] : few, : shape[1] : few] + 0.5 * (few - 1))
    places = fit.points(image.places(col, row, np.full(len(col), truth.frame.alt_amsl_m)))
    height = heights_below(truth.surface, places[:, :2]).reshape(-1, -(-shape[1] // few))
    high, low = highest_lowest(height.astype(np.float32), 1)
    is_step = ((high - low) > STEP_M).astype(np.uint8)
    reach = round(NEAR_STEP_M / (few * image.cell_m))
    near = cv2.dilate(is_step, np.ones((2 * reach + 1,) * 2, np.uint8))
    return np.asarray(near.repeat(few, 0).repeat(few, 1)[: shape[0], : shape[1]] > 0)


def _mesh(path: Path, truth: Truth, seen: F64, fits: Fits) -> dict[str, Any]:
    """Distances of the mesh to the true surface, evenly by area, and of the truth to the mesh."""
    import trimesh

    with reading(path):
        extras = _glb_extras(path)
        mesh: Any = trimesh.load(str(path), force="mesh", process=False)
        x, up, south = np.asarray(mesh.vertices, np.float64).T
        local = np.column_stack([x, -south, up])
        faces = np.asarray(mesh.faces)
        origin = extras.get("origin_lat_lon_amsl")
        own = None if origin is None else LocalFrame(*(float(v) for v in origin))
        placed = local if own is None else truth.frame.to_enu(own.to_geodetic(local))
        triangle_grid.build(placed, faces)
    out: dict[str, Any] = {"vertices": len(local), "faces": len(faces), "placed": own is not None}
    for name, fit in fits.items():
        grid = triangle_grid.build(fit.points(placed), faces)
        out[name] = _mesh_figures(grid, truth, seen)
    return out


def _mesh_figures(grid: TriangleGrid, truth: Truth, seen: F64) -> dict[str, float]:
    samples, _ = metrics.sample_surface(grid, SAMPLE_SPACING_M)
    distance, _ = metrics.distances(samples, truth.surface, REACH_M)
    d = np.where(np.isfinite(distance), distance, REACH_M)
    gap, _, _ = grid.closest(seen, COVERED_WITHIN_M)
    return {
        "median_m": float(np.median(d)),
        "p95_m": float(np.percentile(d, 95)),
        "rms_m": float(np.sqrt(np.mean(d**2))),
        "median_percent_of_altitude": 100.0 * float(np.median(d)) / truth.agl_m,
        "completeness": float(np.isfinite(gap).mean()),
    }


def _glb_extras(path: Path) -> dict[str, Any]:
    """``asset.extras`` of a binary glTF file; ValueError or struct.error when it is none."""
    with path.open("rb") as file:
        magic, _, _, length, kind = struct.unpack("<4sIII4s", file.read(20))
        if magic != b"glTF" or kind != b"JSON" or length > path.stat().st_size:
            raise ValueError("not a binary glTF file")
        return dict(json.loads(file.read(length))["asset"].get("extras", {}))


def _cloud(path: Path, truth: Truth, seen: F64, fits: Fits) -> dict[str, Any]:
    """Distances of the points to the true surface, placed by the file's own coordinate system."""
    import laspy

    with reading(path, laspy.errors.LaspyException):
        with laspy.open(str(path)) as reader:
            crs = reader.header.parse_crs()
        if path.name.endswith(".copc.laz"):  # by its octree, as a viewer would
            with laspy.CopcReader.open(str(path)) as octree:
                las: Any = octree.query()
        else:
            las = laspy.read(str(path))
        points = np.column_stack([las.x, las.y, las.z]).astype(np.float64)
    out: dict[str, Any] = {"epsg": None if crs is None else crs.to_epsg(), "points": len(points)}
    step = max(1, -(-len(points) // MAX_POINTS))
    places = _enu(crs, points[::step], truth.frame)
    for name, fit in fits.items():
        distance, signed = metrics.distances(fit.points(places), truth.surface, REACH_M)
        out[name] = asdict(metrics.surface_errors(distance, signed, REACH_M))
    return out


class _Raster:
    """A GeoTIFF in memory, with the way from its cells to the truth's frame."""

    def __init__(self, path: Path, frame: LocalFrame) -> None:
        """Raises InputError for a file that is not a north-up GeoTIFF."""
        import rasterio

        with reading(path, rasterio.errors.RasterioError), rasterio.open(path) as image:
            self.bands = image.read()
            self.nodata = image.nodata
            self._to_map = image.transform
            self._crs = image.crs
        self._frame = frame
        self.cell_m = float(self._to_map.a)
        if not self.cell_m > 0.0 or self._to_map.b or self._to_map.d:
            raise InputError(f"{path}: not a north-up map")

    @property
    def facts(self) -> dict[str, Any]:
        """The file's own metadata."""
        return {"epsg": None if self._crs is None else self._crs.to_epsg(), "cell_m": self.cell_m}

    def places(self, col: Array, row: Array, height_m: Array) -> F64:
        """(N, 3) of cells (their middles at whole numbers) at heights, in the truth's frame."""
        x = self._to_map.c + self._to_map.a * (np.asarray(col) + 0.5)
        y = self._to_map.f + self._to_map.e * (np.asarray(row) + 0.5)
        return _enu(self._crs, np.column_stack([x, y, height_m]), self._frame)

    def cells_of(self, enu_m: F64) -> tuple[Array, Array]:
        """(column, row) of the cells that hold (N, 3) places of the truth's frame."""
        x, y = _from_enu(self._crs, enu_m, self._frame).T[:2]
        col, row = (x - self._to_map.c) / self._to_map.a, (y - self._to_map.f) / self._to_map.e
        return np.floor(col).astype(np.int64), np.floor(row).astype(np.int64)


def _enu(crs: Any, xyz: F64, frame: LocalFrame) -> F64:
    """(N, 3) coordinates of a file in ``frame``; heights pass through. Without a system: as is."""
    if crs is None:
        return xyz
    lon, lat = _to_globe(crs).transform(xyz[:, 0], xyz[:, 1])
    return frame.to_enu(np.column_stack([lat, lon, xyz[:, 2]]))


def _from_enu(crs: Any, enu_m: F64, frame: LocalFrame) -> F64:
    """Undoes :func:`_enu`."""
    if crs is None:
        return enu_m
    geodetic = frame.to_geodetic(enu_m)
    x, y = _to_globe(crs).transform(geodetic[:, 1], geodetic[:, 0], direction="INVERSE")
    return np.column_stack([x, y, geodetic[:, 2]])


def _to_globe(crs: Any) -> Any:
    """The transformation from a file's coordinate system to longitude and latitude."""
    from pyproj import CRS, Transformer

    return Transformer.from_crs(CRS.from_user_input(crs), CRS.from_epsg(4326), always_xy=True)


_READERS: dict[str, tuple[str, Callable[[Path, Truth, F64, Fits], dict[str, Any]]]] = {
    "dsm": ("dsm.tif", _dsm),
    "ortho": ("ortho.tif", _ortho),
    "mesh": ("mesh.glb", _mesh),
    "laz": ("cloud.laz", _cloud),
    "copc": ("cloud.copc.laz", _cloud),
}
"""Kind to its usual name in the scan folder and what measures it."""


HEIGHT_M = 200_000.0
"""Height of the eye: relief of 20 m at 500 m from the middle is displaced by 5 cm."""
BAND_ROWS = 256
"""Rows rendered at once: a ray takes some 200 bytes."""


def view_from_above(
    truth: Path, west_m: float, north_m: float, cell_m: float, shape: tuple[int, int]
) -> U8:
    """(rows, cols, 3) BGR of the place that ``truth`` was made of, north up, in its own ENU.

    The place is laid out again from ``params.json`` and must agree with ``surface.ply``.
    Raises InputError where it does not, or where its ground was made of photographs, which
    the truth does not hold.
    """
    simulation = _simulated(truth)
    rows, cols = shape
    out = np.empty((rows, cols, 3), np.uint8)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    bands = -(-rows // BAND_ROWS)
    for k in range(bands):
        top, end = k * rows // bands, (k + 1) * rows // bands
        T[:3, 3] = west_m + 0.5 * cols * cell_m, north_m - 0.5 * (top + end) * cell_m, HEIGHT_M
        camera = _straight_down(HEIGHT_M / cell_m, cols, end - top)
        band = Renderer(simulation.scene, simulation.renderer.texture, camera)
        out[top:end] = band.frame(T, 0, Look(0.0, 0.0, 1.0))
    return out


@cache
def _simulated(truth: Path) -> Simulation:
    """The simulation of :func:`view_from_above`, laid out once for all its images."""
    with reading(truth / "params.json"):
        options = options_of(json.loads((truth / "params.json").read_text())["options"])
    if options.photos is not None:
        raise InputError(f"{truth}: the ground was made of photographs, which are not kept there")
    simulation = prepare(options)
    scene = simulation.scene
    vertices, triangles = read_surface(truth / "surface.ply")
    same = vertices.shape == scene.vertices.shape and triangles.shape == scene.triangles.shape
    if not (same and np.abs(vertices - scene.vertices).max() < 0.01):
        raise InputError(f"{truth}: made by another version of simulate; simulate it again")
    return simulation


def _straight_down(focal_px: float, cols: int, rows: int) -> Camera:
    K = np.array([[focal_px, 0.0, 0.5 * (cols - 1)], [0.0, focal_px, 0.5 * (rows - 1)], [0, 0, 1]])
    return Camera(K, np.zeros(5), (cols, rows))


def options_of(values: dict[str, Any]) -> SimulationOptions:
    """The options that ``params.json`` holds; values it does not know take their defaults.

    Raises ValueError for unfit values.
    """
    return msgspec.convert(values, SimulationOptions, dec_hook=lambda kind, value: kind(value))


# ---- shifts of an orthophoto's patches --------------------------------------------------------

MIN_KNOWN = 0.9
MIN_LIKENESS = 0.5
MIN_CONTRAST = 1.5
PATCH_PX = 64
BROAD_PX = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class PatchShifts:
    """Shifts of an image's patches against the same patches of the other image."""

    middle_px: F64  # (N, 2) column and row
    shift_px: F64  # (N, 2) column and row: where the content is, less where it should be
    likeness: F64  # (N,) normalised correlation at that shift
    tried: int  # patches that are known and have texture

    @property
    def matched_share(self) -> float:
        """Share of the patches tried whose shift is known."""
        return len(self.likeness) / self.tried if self.tried else 0.0


def patch_shifts(found: F32, truth: F32, known: Bool, reach_px: int) -> PatchShifts:
    """The displacement of ``found`` against ``truth``, (H, W) each, in patches half overlapping.

    Normalised cross-correlation over shifts of up to ``reach_px``, with a parabola through the
    peak. Shading broader than BROAD_PX is taken out of both first. A patch is tried where
    ``known`` holds nearly everywhere and the truth has texture; a peak at the end of the reach
    or below MIN_LIKENESS is not a match.
    """
    a, b = (_fine(image, known) for image in (found, truth))
    rows, cols = known.shape
    middles, shifts, likenesses, tried = [], [], [], 0
    for top in range(reach_px, rows - PATCH_PX - reach_px + 1, PATCH_PX // 2):
        for left in range(reach_px, cols - PATCH_PX - reach_px + 1, PATCH_PX // 2):
            patch = np.s_[top : top + PATCH_PX, left : left + PATCH_PX]
            if known[patch].mean() < MIN_KNOWN or b[patch].std() < MIN_CONTRAST:
                continue
            tried += 1
            around = b[
                top - reach_px : top + PATCH_PX + reach_px,
                left - reach_px : left + PATCH_PX + reach_px,
            ]
            surface = cv2.matchTemplate(around, a[patch], cv2.TM_CCOEFF_NORMED)
            likeness, shift = _peak(np.asarray(surface, np.float32))
            if likeness >= MIN_LIKENESS and np.isfinite(shift).all():
                middles.append([left + 0.5 * (PATCH_PX - 1), top + 0.5 * (PATCH_PX - 1)])
                shifts.append(reach_px - shift)
                likenesses.append(likeness)
    return PatchShifts(
        np.array(middles, np.float64).reshape(-1, 2),
        np.array(shifts, np.float64).reshape(-1, 2),
        np.array(likenesses, np.float64),
        tried,
    )


def _fine(image: F32, known: Bool) -> F32:
    """The image without its broad shading; zero where it is not known."""
    weight = known.astype(np.float32)
    values = np.where(known, image, 0.0).astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(weight, (0, 0), BROAD_PX), 1e-3)
    mean = cv2.GaussianBlur(values, (0, 0), BROAD_PX) / share
    return np.asarray(np.where(known, values - mean, 0.0), np.float32)


def _peak(surface: F32) -> tuple[float, F64]:
    """(height, (column, row)) of the highest place; NaN at the border, where none was found."""
    row, col = np.unravel_index(int(surface.argmax()), surface.shape)
    height = float(surface[row, col])
    if not (0 < row < surface.shape[0] - 1 and 0 < col < surface.shape[1] - 1):
        return height, np.full(2, np.nan)
    du = _vertex(surface[row, col - 1 : col + 2])
    dv = _vertex(surface[row - 1 : row + 2, col])
    return height, np.array([col + du, row + dv])


def _vertex(three: F32) -> float:
    """Offset of the vertex of the parabola through three equidistant heights, from the middle
    one."""
    left, middle, right = (float(v) for v in three)
    bend = left - 2.0 * middle + right
    return 0.0 if bend >= 0.0 else float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))


if __name__ == "__main__":
    print(json.dumps(score_deliverables(Path(sys.argv[1]), Path(sys.argv[2])), indent=1))
