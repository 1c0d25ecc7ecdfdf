"""Contours of the bare ground, as GeoJSON, GeoPackage and DXF."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from recon.surface.ground import BareGround
from recon.surface.raster import Grid
from recon.types import F32, F64, Array, Bool
from service.errors import InputError
from service.georeference import LocalFrame, geojson_of, line_geometry
from service.offline.exports.rasters import GROUND_MARGIN_M
from service.offline.exports.surface import bare_ground
from service.offline.exports.view import ExportOptions, ScanView, in_parts, made_once
from service.offline.geopackage import Columns, Layer, write_layers
from service.scans.annotations import Point, Spot, read_annotations
from service.scans.fused_cloud import EVERYWHERE, Box
from service.scans.writing import write_whole

SMOOTH_M, SMOOTH_CELLS = 1.0, 1.5
"""Sigma of the Gaussian over the ground: the larger of the two."""

MIN_LENGTH_M = 5.0
OBJECT_M = 3.0
"""Lines end at what hides so much ground across, houses and crowns; below less they go on."""

INDEX = 5
"""Every fifth line is an index line, with a label."""

TOLERANCE_M = 0.03
"""By which lines are simplified."""

MAX_CONTOURS = 5000
"""Heights at which contours are drawn: every metre up to the highest mountains."""

TEXT_M = 1.5
"""Height of labels in DXF."""


@dataclass(frozen=True, slots=True, eq=False)
class Contour:
    """A line of one height."""

    height_m: float
    is_index: bool
    line: F64  # (N, 2) map metres

    @property
    def label(self) -> str:
        """Text of an index line; empty for others."""
        return f"{self.height_m:g}" if self.is_index else ""

    @property
    def places(self) -> F64:
        """(N, 3) with the height."""
        return np.column_stack([self.line, np.full(len(self.line), self.height_m)])


def write_contours(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """GeoJSON lines of longitude, latitude and height."""
    frame = scan.needs_place("a contour map")
    found = contours_of(scan, options)
    ends = np.cumsum([len(one.line) for one in found])[:-1]
    utm = np.concatenate([np.zeros((0, 3)), *(one.places for one in found)])
    whole = frame.to_geodetic(frame.from_utm(utm))[:, [1, 0, 2]]
    key = options.height_key
    features = (
        ({key: round(o.height_m, 3), "index": o.is_index, "label": o.label}, line_geometry(line))
        for o, line in zip(found, np.split(whole, ends), strict=bool(found))
    )
    write_whole(out, geojson_of(features))


def write_contours_gpkg(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """Contours, annotations and measurements as a GeoPackage: a layer each, in the scan's UTM
    zone."""
    frame = scan.needs_place("a contour map")
    found = contours_of(scan, options)
    columns: Columns = {
        options.height_key: [one.height_m for one in found],
        "is_index": [float(one.is_index) for one in found],
        "label": [one.label for one in found],
    }
    layers = [Layer("contours", "LINESTRING", [one.places for one in found], columns)]
    notes = read_annotations(scan.folder).features
    shapes = [_in_utm(frame, one.geometry.coordinates) for one in notes]
    spots = [k for k, one in enumerate(notes) if isinstance(one.geometry, Point)]
    ways = [k for k in range(len(notes)) if k not in spots]

    def about(which: list[int]) -> Columns:
        return {
            "text": [notes[k].properties.text for k in which],
            "by": [notes[k].properties.by for k in which],
            "made_unix_s": [notes[k].properties.made_unix_s for k in which],
        }

    if spots:
        places = np.concatenate([shapes[k] for k in spots])
        height: Columns = {options.height_key: places[:, 2].tolist()}
        layers.append(
            Layer("annotations", "POINT", [*places[:, None, :2]], {**height, **about(spots)})
        )
    if ways:
        layers.append(Layer("measurements", "LINESTRING", [shapes[k] for k in ways], about(ways)))
    write_layers(out, frame.epsg, layers)


def _in_utm(frame: LocalFrame, coordinates: Spot | Sequence[Spot]) -> F64:
    """(N, 3) UTM metres and height of longitudes, latitudes and heights as flown."""
    spots = np.atleast_2d(np.array(coordinates, np.float64))[:, [1, 0, 2]]
    if frame.heights is not None:
        spots = frame.heights(spots)
    height_m = spots[:, 2]
    return np.column_stack([frame.to_utm(frame.to_enu(spots))[:, :2], height_m])


def write_contours_dxf(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """3D polylines of DXF R12 in UTM metres: a layer of index lines, in red, one of their labels
    and one of the others."""
    rows = ["0", "SECTION", "2", "ENTITIES"]
    for one in contours_of(scan, options):
        layer = "CONTOUR_INDEX" if one.is_index else "CONTOUR"
        rows += ["0", "POLYLINE", "8", layer, "62", "1" if one.is_index else "7"]
        rows += ["66", "1", "70", "8", "10", "0", "20", "0", "30", "0"]
        for place in one.places.tolist():
            rows += ["0", "VERTEX", "8", layer, *_at(place), "70", "32"]
        rows += ["0", "SEQEND", "8", layer]
        if one.is_index:
            rows += _text(one)
    write_whole(out, "\n".join([*rows, "0", "ENDSEC", "0", "EOF", ""]))


def _at(place: list[float]) -> list[str]:
    x, y, z = place
    return ["10", f"{x:.3f}", "20", f"{y:.3f}", "30", f"{z:.3f}"]


def _text(one: Contour) -> list[str]:
    """The label in the middle of the line, along it and never upside down."""
    k = len(one.line) // 2
    x, y = one.line[k] - one.line[k - 1]
    turn_deg = (math.degrees(math.atan2(y, x)) + 90.0) % 180.0 - 90.0
    kind = ["0", "TEXT", "8", "CONTOUR_LABELS", *_at(one.places[k].tolist())]
    return [*kind, "40", f"{TEXT_M:g}", "1", one.label, "50", f"{turn_deg:.1f}"]


@made_once
def contours_of(scan: ScanView, options: ExportOptions) -> list[Contour]:
    """The contours in UTM metres; InputError without a georeference.

    Where there are more points than one tile may have, lines end at the borders of tiles.
    """
    scan.needs_place("a contour map")
    return list(chain(*in_parts(scan, _contours, options, GROUND_MARGIN_M)))


def _contours(scan: ScanView, options: ExportOptions, box: Box) -> list[Contour]:
    grid = scan.grid(options.cell_m)
    return list(contour_lines(bare_ground(scan, options.cell_m), grid, options.contour_m, box))


def contour_lines(
    ground: BareGround, grid: Grid, step_m: float, box: Box = EVERYWHERE
) -> Iterator[Contour]:
    """The contours of the smoothed ground at whole multiples of ``step_m``.

    They end at the outline, at the border of ``box``, and at what stands on the ground.
    """
    shown = ground.is_inside & ~_objects(ground, grid.cell_m)
    if not shown.any():
        return
    sigma = max(SMOOTH_CELLS, SMOOTH_M / grid.cell_m)
    smooth = np.asarray(cv2.GaussianBlur(ground.everywhere_m, (0, 0), sigma), np.float32)
    low, high = float(smooth[shown].min()), float(smooth[shown].max())
    if (high - low) / step_m > MAX_CONTOURS:
        raise InputError(
            f"contours every {step_m:g} m over {high - low:.0f} m of height are too many; "
            "give a larger --contour-m"
        )
    rows, cols = grid.window(box)
    mine = np.zeros_like(shown)
    mine[rows.start : rows.stop + 1, cols.start : cols.stop + 1] = True
    shown &= mine
    shown[[0, 1, -2, -1]] = shown[:, [0, 1, -2, -1]] = False  # where loops follow the grid
    slope = np.gradient(smooth)
    for n in range(math.ceil(low / step_m), math.floor(high / step_m) + 1):
        above = (smooth >= n * step_m).astype(np.uint8)
        above[[0, -1]] = above[:, [0, -1]] = 0
        loops, _ = cv2.findContours(above, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        for loop in loops:
            cells = loop[:, 0]
            for run in _stretches(cells, shown[cells[:, 1], cells[:, 0]]):
                line = _at_level(run.astype(np.float64), smooth, slope, n * step_m)
                line = cv2.approxPolyDP(
                    line.astype(np.float32)[:, None], TOLERANCE_M / grid.cell_m, False
                )[:, 0].astype(np.float64)
                length_m = grid.cell_m * np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
                if length_m >= MIN_LENGTH_M:
                    yield Contour(n * step_m, n % INDEX == 0, grid.centres(line[:, 1], line[:, 0]))


def _objects(ground: BareGround, cell_m: float) -> Bool:
    """(rows, cols) what hides the ground over OBJECT_M and more across."""
    across = 2 * max(1, round(0.5 * OBJECT_M / cell_m)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (across, across))
    hidden = ground.is_bridged.astype(np.uint8)
    return np.asarray(cv2.morphologyEx(hidden, cv2.MORPH_OPEN, disc) > 0)


def _at_level(line: F64, smooth: F32, slope: list[F32], height_m: float) -> F64:
    """The vertices (N, 2) of a chain of cells (column, row), moved to where the ground has the
    height."""
    is_closed = len(line) > 2 and np.abs(line[0] - line[-1]).max() == 0
    for _ in range(3):
        at = line.T[::-1]
        z, down, right = (
            map_coordinates(one, at, np.float64, order=1, mode="nearest")
            for one in (smooth, *slope)
        )
        steep = np.maximum(right**2 + down**2, 1e-8)
        step = ((height_m - z) / steep)[:, None] * np.column_stack([right, down])
        size = np.linalg.norm(step, axis=1, keepdims=True)
        line = line + step * np.minimum(1.0, 1.0 / np.maximum(size, 1e-9))
        if is_closed:
            ring = line[:-1]
            ring = 0.25 * np.roll(ring, 1, 0) + 0.5 * ring + 0.25 * np.roll(ring, -1, 0)
            line = np.vstack([ring, ring[:1]])
        else:
            line[1:-1] = 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:]
    return line


def _stretches(loop: Array, ok: Array) -> list[Array]:
    """The parts of a closed loop (N, 2) whose vertices are all ``ok`` (N,), of two or more."""
    if ok.all():
        return [np.concatenate([loop, loop[:1]])]
    start = int(np.argmin(ok))
    loop, ok = np.roll(loop, -start, axis=0), np.roll(ok, -start)
    edges = np.flatnonzero(np.diff(np.r_[False, ok, False].astype(np.int8)))
    ends = zip(edges[::2], edges[1::2], strict=True)
    return [loop[a:b] for a, b in ends if b - a > 1]
