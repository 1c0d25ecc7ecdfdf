"""Surface model and orthophoto on a north-up grid, from points.

Cells hold the upper surface: of the points in a cell those within the noise of the highest
count, each by the inverse of its variance, so flat ground is averaged and a roof above it
is not mixed with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit

from recon.types import F32, F64, I64, U8, Array, Bool, PointCloud

TOP_SIGMAS = 4.0
"""Points this many of its sigmas below the highest point of a cell are its surface too."""

STEP_M = 0.8
"""Heights within a few cells that differ by more are two surfaces."""

SMEAR_SLOPE = 1.2
SMEAR_CELLS = (1, 2, 4, 6)
EDGE_CELLS = 3
EDGE_PRECISION = 1.25
SPARSE_CELLS = 8
SPARSE_SHARE = 0.5

SMOOTH_CELLS = 1.5
BAND_ROWS = 128
LARGEST_CELLS = 200_000_000

CELLS_PER_POINT, MIN_CELLS = 1000, 10_000_000
"""A rectangle with more cells than the larger of the two holds only stray points, which must not
determine the memory."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A north-up grid: cell (row, col) spans west + col * cell_m ... , north - row * cell_m ..."""

    west_m: float
    north_m: float
    cell_m: float
    shape: tuple[int, int]  # (rows, columns)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell_m) and self.cell_m > 0.0):
            raise ValueError(f"cell_m is {self.cell_m}, must be positive")
        if self.shape[0] * self.shape[1] > LARGEST_CELLS:
            raise ValueError(_too_large(self.shape[0], self.shape[1]))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(west, south, east, north) in metres."""
        rows, cols = self.shape
        return (
            self.west_m,
            self.north_m - rows * self.cell_m,
            self.west_m + cols * self.cell_m,
            self.north_m,
        )

    def window(self, box: tuple[float, float, float, float]) -> tuple[slice, slice]:
        """Rows and columns of the cells whose centres lie in (west, south, east, north) m."""
        west, south, east, north = box
        rows, cols = self.shape
        ends = np.array([west, east, self.north_m - north, self.north_m - south])
        ends[:2] -= self.west_m
        c0, c1, r0, r1 = np.ceil(ends / self.cell_m - 0.5)
        return (
            slice(int(np.clip(r0, 0, rows)), int(np.clip(r1, 0, rows))),
            slice(int(np.clip(c0, 0, cols)), int(np.clip(c1, 0, cols))),
        )

    def part(self, rows: slice, cols: slice) -> Grid:
        """The grid of some of its rows and columns."""
        return Grid(
            self.west_m + cols.start * self.cell_m, self.north_m - rows.start * self.cell_m,
            self.cell_m, (rows.stop - rows.start, cols.stop - cols.start),
        )  # fmt: skip

    def divided(self, by: int) -> Grid:
        """The grid whose cells are so many times as small."""
        rows, cols = self.shape
        return Grid(self.west_m, self.north_m, self.cell_m / by, (rows * by, cols * by))

    def pixels(self, xy_m: F64) -> F64:
        """(N, 2) column and row, real-valued with whole numbers at cell centres, of (N, 2) m."""
        xy = np.asarray(xy_m, np.float64)
        col = (xy[:, 0] - self.west_m) / self.cell_m - 0.5
        row = (self.north_m - xy[:, 1]) / self.cell_m - 0.5
        return np.column_stack([col, row])

    def centres(self, rows: Array, cols: Array) -> F64:
        """(N, 2) metres east and north of the middles of cells (N,)."""
        x, y = (np.asarray(at, np.float64) + 0.5 for at in (cols, rows))
        return np.column_stack([self.west_m + x * self.cell_m, self.north_m - y * self.cell_m])

    def holds(self, xy_m: F64) -> Bool:
        """(N,) which of (N, 2) m lie on the grid; what is not finite does not."""
        at = np.rint(self.pixels(xy_m))
        return np.asarray(((at >= 0) & (at < self.shape[::-1])).all(axis=1))

    def cells(self, xy_m: F64) -> tuple[I64, I64]:
        """(N,) rows and (N,) columns of (N, 2) m, those outside at the nearest edge."""
        cols, rows = np.rint(self.pixels(xy_m)).astype(np.int64).T
        return np.clip(rows, 0, self.shape[0] - 1), np.clip(cols, 0, self.shape[1] - 1)


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Height and colour of the upper surface on a grid; height is NaN where nothing is known."""

    grid: Grid
    height_m: F32  # (rows, cols), NaN = unknown
    sigma_m: F32  # (rows, cols), NaN = unknown
    rgb: U8  # (rows, cols, 3), black where unknown

    @property
    def known(self) -> Bool:
        """(rows, cols) cells with a height."""
        return np.isfinite(self.height_m)

    @property
    def area_m2(self) -> float:
        return float(self.known.sum()) * self.grid.cell_m**2


SUMMED_CELLS, SUMMED_BANDS = 1 << 18, 8
"""Cells that are summed up at a time, at least, and the most times that all points are read."""

ROUND = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


def round_cell(cell_m: float, up: bool = False) -> float:
    """The nearest round length at or below ``cell_m`` (m), with ``up`` at or above.

    Grids lie on multiples of their cell, so those of scans with the same cell align.
    """
    power = 10.0 ** math.floor(math.log10(cell_m) + 1e-9)
    ratio = cell_m / power
    if up:
        return round(power * next(n for n in ROUND if n >= ratio - 1e-6), 9)
    return round(power * max(n for n in ROUND if n <= ratio + 1e-6), 9)


def bounds_of(xy_m: Array) -> tuple[float, float, float, float]:
    """(west, south, east, north) of one point or more (N, 2); NaN where a coordinate is.

    One axis after the other takes a tenth to a thirtieth of the time of both at once.
    """
    (west, east), (south, north) = ((float(c.min()), float(c.max())) for c in xy_m.T)
    return west, south, east, north


def grid_over(xy_m: F64 | F32, cell_m: float, margin_cells: int = 0) -> Grid:
    """The grid of ``cell_m`` that covers (N, 2) points, its edges on multiples of the cell."""
    xy = np.asarray(xy_m)
    if xy.ndim != 2 or xy.shape[1] != 2 or not len(xy):
        raise ValueError(f"expected points of shape (N, 2) with N > 0, got {xy.shape}")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        west, south, east, north = bounds_of(xy)
        low = np.floor(np.array([west, south]) / cell_m) - margin_cells
        high = np.floor(np.array([east, north]) / cell_m) + 1 + margin_cells
        cells = float(np.prod(high - low))
    if not cells <= min(LARGEST_CELLS, max(MIN_CELLS, CELLS_PER_POINT * len(xy))):
        raise ValueError(_too_large(high[1] - low[1], high[0] - low[0]))
    cols, rows = (high - low).astype(int)
    return Grid(float(low[0] * cell_m), float(high[1] * cell_m), cell_m, (int(rows), int(cols)))


def _too_large(rows: float, cols: float) -> str:
    return f"a grid of {rows:.0f} x {cols:.0f} cells is too large; take larger cells"


def rasterise(cloud: PointCloud, grid: Grid) -> Raster:
    """Upper surface of ``cloud`` on ``grid``; points outside are not used, holes stay."""
    return rasterise_points(cloud.xyz_m, cloud.rgb, cloud.sigma_m, grid)


def rasterise_points(xyz_m: F64 | F32, rgb: U8, sigma_m: F32, grid: Grid) -> Raster:
    """As :func:`rasterise` for arrays: (N, 3) m in any frame with z up, (N, 3), (N,)."""
    rows, cols = grid.shape
    height, sigma, colour = _top_surface(
        np.ascontiguousarray(xyz_m),
        np.ascontiguousarray(rgb, np.uint8),
        np.ascontiguousarray(sigma_m, np.float32),
        grid.west_m,
        grid.north_m,
        1.0 / grid.cell_m,
        rows,
        cols,
    )
    return Raster(grid, height, sigma, colour)


@njit(cache=True, nogil=True)
def _top_surface(
    xyz: F64 | F32, rgb: U8, sigma: F32, west: float, north: float, inverse: float,
    rows: int, cols: int,
) -> tuple[F32, F32, U8]:  # fmt: skip
    """Height, sigma and colour per cell in two passes: the highest point, then its layer.

    The upper left corner of the grid lies at (west, north) m; a cell has 1 over ``inverse`` m.
    The passes take some rows at a time: their sums are 56 bytes a cell.
    """
    height = np.full((rows, cols), np.nan, np.float32)
    spread = np.full((rows, cols), np.nan, np.float32)
    colour = np.zeros((rows, cols, 3), np.uint8)
    band = max(SUMMED_CELLS // cols, -(-rows // SUMMED_BANDS), 1)
    for first in range(0, rows, band):
        count = min(band, rows - first)
        floor = np.full((count, cols), -np.inf)  # lowest height that still is the top surface
        top = np.full((count, cols), -np.inf)
        n = xyz.shape[0]
        for p in range(n):
            c = int(np.floor((float(xyz[p, 0]) - west) * inverse))
            r = int(np.floor((north - float(xyz[p, 1])) * inverse)) - first
            if 0 <= r < count and 0 <= c < cols and xyz[p, 2] > top[r, c]:
                top[r, c] = xyz[p, 2]
                floor[r, c] = xyz[p, 2] - TOP_SIGMAS * max(float(sigma[p]), 1e-6)
        sums = np.zeros((count, cols, 5))
        for p in range(n):
            c = int(np.floor((float(xyz[p, 0]) - west) * inverse))
            r = int(np.floor((north - float(xyz[p, 1])) * inverse)) - first
            if 0 <= r < count and 0 <= c < cols and xyz[p, 2] >= floor[r, c]:
                w = 1.0 / max(float(sigma[p]), 1e-6) ** 2
                sums[r, c, 0] += w
                sums[r, c, 1] += w * xyz[p, 2]
                for k in range(3):
                    sums[r, c, 2 + k] += w * rgb[p, k]
        for r in range(count):
            for c in range(cols):
                w = sums[r, c, 0]
                if w > 0.0:
                    height[first + r, c] = sums[r, c, 1] / w
                    spread[first + r, c] = 1.0 / np.sqrt(w)
                    for k in range(3):
                        colour[first + r, c, k] = int(sums[r, c, 2 + k] / w + 0.5)
    return height, spread, colour


def reliable(raster: Raster) -> Raster:
    """``raster`` without the cells that stereo cannot place at a step of STEP_M or more.

    Three kinds are left out. Cells on a slope steeper than SMEAR_SLOPE both up and down are what
    matching draws across the ground hidden behind a wall. Cells above a step, within the
    width that matching windows make a roof too wide, are kept only where they are known
    clearly better than their neighbourhood: a true roof edge is seen by all views, a spill
    next to it by few. And cells high above ground nearby with less than SPARSE_SHARE of the
    usual number of known neighbours: crumbs of what hides behind a roof or in a crown.
    """
    height = raster.height_m.copy()
    sigma = np.nan_to_num(raster.sigma_m, nan=1.0)
    for reach in SMEAR_CELLS:
        high, low = highest_lowest(height, reach)
        limit = SMEAR_SLOPE * reach * raster.grid.cell_m + sigma
        height[(high - height > limit) & (height - low > limit)] = np.nan
    height[_spills(height, sigma)] = np.nan
    known = np.isfinite(height)
    held = cv2.boxFilter(known.astype(np.float32), -1, (5, 5))
    high = height - highest_lowest(height, SPARSE_CELLS)[1] > STEP_M
    usual = float(np.median(held[known])) if known.any() else 1.0
    height[high & (held < SPARSE_SHARE * usual)] = np.nan
    return without_cells(raster, ~np.isfinite(height))


def _spills(height_m: F32, sigma_m: F32) -> Bool:
    """(rows, cols) cells above a step that are not clearly better known than those around."""
    known = np.isfinite(height_m)
    precision = np.where(known, 1.0 / np.maximum(sigma_m, 1e-3), 0.0).astype(np.float32)
    window = (9, 9)
    count = cv2.boxFilter(known.astype(np.float32), -1, window, normalize=False)
    mean = cv2.boxFilter(precision, -1, window, normalize=False) / np.maximum(count, 1.0)
    above = height_m - highest_lowest(height_m, EDGE_CELLS)[1] > STEP_M
    return np.asarray(above & (precision < EDGE_PRECISION * mean))


def without_cells(raster: Raster, unknown: Bool) -> Raster:
    """``raster`` with the cells that ``unknown`` (rows, cols) marks taken out."""
    known = raster.known & ~unknown
    height = np.where(known, raster.height_m, np.float32(np.nan)).astype(np.float32)
    spread = np.where(known, raster.sigma_m, np.float32(np.nan)).astype(np.float32)
    rgb = np.where(known[..., None], raster.rgb, 0).astype(np.uint8)
    return replace(raster, height_m=height, sigma_m=spread, rgb=rgb)


def standing_height(raster: Raster) -> float:
    """Height of objects on this ground: 99 % of the known cells are no higher above the lowest one
    within 2 m. 0 where nothing is known."""
    known = raster.known
    if not known.any():
        return 0.0
    low = highest_lowest(raster.height_m, max(1, round(2.0 / raster.grid.cell_m)))[1]
    return float(np.quantile((raster.height_m - low)[known], 0.99))


def highest_lowest(height_m: F32, reach_cells: int) -> tuple[F32, F32]:
    """Highest and lowest known height within ``reach_cells`` of each cell, in both axes."""
    known = np.isfinite(height_m)
    square = np.ones((2 * reach_cells + 1, 2 * reach_cells + 1), np.uint8)
    far = np.float32(1e6)
    high = cv2.dilate(np.where(known, height_m, -far).astype(np.float32), square)
    low = cv2.erode(np.where(known, height_m, far).astype(np.float32), square)
    return np.asarray(high, np.float32), np.asarray(low, np.float32)


def fill_holes(raster: Raster, largest_cells: int = 4) -> Raster:
    """``raster`` with its holes up to ``largest_cells`` wide filled by the mean around them.

    Only holes are closed: the outline of the surveyed area does not grow into the unknown. Filled
    cells carry the sigma of their surroundings, doubled. For display, as a mean next to steps is
    wrong; :func:`recon.surface.change.level_filled`, for narrow holes, and
    :mod:`recon.surface.hole_filling` are for measurement.
    """
    known = raster.known
    if largest_cells < 1 or known.all() or not known.any():
        return raster
    size = largest_cells + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    pad = size
    mask = np.pad(known, pad).astype(np.uint8)
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel)[pad:-pad, pad:-pad] > 0
    holes = closed & ~known
    height, sigma, rgb = raster.height_m.copy(), raster.sigma_m.copy(), raster.rgb.copy()
    _fill(np.ascontiguousarray(np.argwhere(holes)), known, largest_cells, height, sigma, rgb)
    return replace(raster, height_m=height, sigma_m=sigma, rgb=rgb)


@njit(cache=True, nogil=True)
def _fill(
    holes: I64, known: Bool, largest_cells: int, height: F32, sigma: F32, rgb: U8
) -> None:  # pragma: no cover - compiled
    """Fill the cells ``holes`` (N, 2) by the mean of the smallest window with a known cell."""
    rows, cols = known.shape
    sums = np.empty(5)
    for r, c in holes:
        for reach in range(1, largest_cells + 1):
            count = 0
            sums[:] = 0.0
            for v in range(max(r - reach, 0), min(r + reach + 1, rows)):
                for u in range(max(c - reach, 0), min(c + reach + 1, cols)):
                    if known[v, u]:
                        count += 1
                        sums[0] += height[v, u]
                        sums[1] += sigma[v, u]
                        for k in range(3):
                            sums[2 + k] += rgb[v, u, k]
            if count:
                height[r, c] = sums[0] / count
                sigma[r, c] = 2.0 * sums[1] / count
                for k in range(3):
                    rgb[r, c, k] = np.rint(sums[2 + k] / count)
                break


def smoothed(raster: Raster) -> Raster:
    """``raster`` with noise taken out of its heights and steps kept.

    A median over 5x5 cells, which also joins surfaces of two keyframes that interleave, then
    a bilateral filter whose tolerance in height is 1.5 times the median sigma of the cells.
    """
    known = raster.known
    if not known.any():
        return raster
    tolerance = max(1.5 * float(np.median(raster.sigma_m[known])), 1e-3)
    middle = np.float32(np.median(raster.height_m[known]))
    out = np.empty_like(raster.height_m)
    for band, own in _bands(len(out), margin=8):
        out[band][own] = _smoothed(raster.height_m[band] - middle, tolerance)[own]
    out += middle
    return replace(raster, height_m=out)


def _smoothed(height_m: F32, tolerance_m: float) -> F32:
    known = np.isfinite(height_m)
    far = np.float32(1e6)
    height = np.where(known, height_m, far)
    median = cv2.medianBlur(height, 5)
    np.copyto(height, median, where=known & (median < 0.5 * far))
    smooth = cv2.bilateralFilter(height, -1, tolerance_m, SMOOTH_CELLS)
    smooth[~known] = np.nan
    return np.asarray(smooth)


def _bands(rows: int, margin: int) -> Iterator[tuple[slice, slice]]:
    """Rows of a map with ``margin`` neighbours, and which of these are the band's own.

    What a filter needs in addition to the map is several times as large as the map.
    """
    for top in range(0, rows, BAND_ROWS):
        first = max(top - margin, 0)
        yield slice(first, top + BAND_ROWS + margin), slice(top - first, top - first + BAND_ROWS)


SUN = (-0.5, 0.5, math.sqrt(0.5))
"""East, north and up to the light: in the north-west, halfway up the sky."""


def hillshade(height_m: F32, cell_m: float) -> F32:
    """(rows, cols) brightness 0 to 1 of the surface lit by the SUN; NaN where unknown.

    Lambertian shading of the surface normal (Horn 1981, doi:10.1109/PROC.1981.11918), with
    slopes from differences to the known neighbours.
    """
    out = np.empty(height_m.shape, np.float32)
    for band, own in _bands(len(out), margin=1):
        dz_east = _slope(height_m[band], axis=1) / cell_m
        dz_north = -_slope(height_m[band], axis=0) / cell_m
        dot = -dz_east * SUN[0] - dz_north * SUN[1] + SUN[2]
        shade = np.clip(dot / np.sqrt(1.0 + dz_east**2 + dz_north**2), 0.0, 1.0)
        out[band][own] = shade[own]
    out[~np.isfinite(height_m)] = np.nan
    return out


def _slope(height_m: F32, axis: int) -> F32:
    """Height difference per cell along ``axis``: central where both neighbours are known."""
    step = np.diff(height_m, axis=axis)
    widths = [(0, 0), (0, 0)]
    widths[axis] = (1, 0)
    before = np.pad(step, widths, constant_values=np.nan)
    widths[axis] = (0, 1)
    after = np.pad(step, widths, constant_values=np.nan)
    both = 0.5 * (before + after)
    one = np.where(np.isfinite(before), before, after)
    out = np.where(np.isfinite(both), both, one)
    return np.asarray(np.nan_to_num(out), np.float32)
