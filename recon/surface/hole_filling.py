"""Unknown cells of a surface model filled from the known ones around them.

A hole has known cells on nearly all sides, within a few metres. On level ground it takes their
heights. Next to a step it takes the lower surface, because a roof hides the ground there;
next to the step, where matching makes roofs too wide, it stays unknown.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numba import njit

from recon.bands import in_bands
from recon.surface.raster import Grid, Raster, rasterise_points, reliable
from recon.types import F32, F64, U8, Bool

DIRECTIONS = 16
MAX_OPEN_DIRECTIONS = 5
"""Maximum number of neighbouring directions without a known cell; with more the cell is outside the
survey."""

REACH_M = 2.0
LEVEL_M = 0.4
SLOPE = 0.3
"""Heights around a hole that differ by more than LEVEL_M and SLOPE times their distance are two
surfaces."""

GAP_CELLS = 1
"""The outline of known cells closes gaps of twice this width."""

EDGE_CELLS = 2
"""This close to something higher, a cell next to a step may be roof or ground."""


def surface_model(xyz_m: F64 | F32, rgb: U8, sigma_m: F32, grid: Grid) -> Raster:
    """The upper surface of points where it is certain, its holes filled."""
    measured = rasterise_points(xyz_m, rgb, sigma_m, grid)
    return filled(reliable(measured), measured)[0]


def filled(
    certain: Raster, measured: Raster, reach_m: float = REACH_M, edge_cells: int = EDGE_CELLS
) -> tuple[Raster, Bool]:
    """``certain`` with its holes filled, and (rows, cols) which cells were filled.

    ``measured`` holds all cells, also the doubtful ones: a hole is not filled below a doubtful
    height, nor within ``edge_cells`` of something higher. A filled cell has twice the sigma of its
    surroundings and half their range.
    """
    layers = np.dstack([certain.height_m, certain.sigma_m, certain.rgb]).astype(np.float32)
    doubtful = np.where(certain.known, np.float32(np.nan), measured.height_m)
    reach = max(1, round(reach_m / certain.grid.cell_m))
    near = cv2.dilate(certain.known.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1)))
    holes = (near > 0) & ~certain.known
    out = layers.copy()
    rows, rise_m = len(layers), SLOPE * certain.grid.cell_m
    in_bands(
        _fill, rows, layers, doubtful.astype(np.float32), holes, reach, rise_m, edge_cells, out
    )
    new = np.isfinite(out[..., 0]) & ~certain.known
    rgb = np.where(new[..., None], np.rint(out[..., 2:]), certain.rgb).astype(np.uint8)
    return replace(certain, height_m=out[..., 0].copy(), sigma_m=out[..., 1].copy(), rgb=rgb), new


def outlined(known: Bool) -> Bool:
    """(rows, cols) the cells within the outline of the ``known`` ones: those and their holes."""
    from scipy.ndimage import binary_fill_holes

    square = np.ones((2 * GAP_CELLS + 1,) * 2, np.uint8)
    closed = cv2.morphologyEx(known.astype(np.uint8), cv2.MORPH_CLOSE, square)
    return np.asarray(binary_fill_holes(closed), np.bool_)


@njit(cache=True, nogil=True)
def _fill(
    begin: int, end: int, layers: F32, doubtful: F32, holes: Bool, reach: int, rise_m: float,
    edge_cells: int, out: F32,
) -> None:  # fmt: skip
    """Fill rows of ``out`` from ``layers`` (rows, cols, 5: height, sigma, colour)."""
    near = np.empty((DIRECTIONS, 4))
    above = np.empty((DIRECTIONS, 2))
    for r in range(begin, end):
        for c in range(layers.shape[1]):
            if not holes[r, c]:
                continue
            count, doubts = _around(layers, doubtful, r, c, reach, near, above)
            if count == 0:
                continue
            ordered = near[:count][np.argsort(near[:count, 0])]
            first, last = _surface(ordered, doubtful[r, c], rise_m)
            one = ordered[first:last]
            height = np.sum(one[:, 0] / one[:, 1] ** 2) / np.sum(1.0 / one[:, 1] ** 2)
            tolerance = LEVEL_M + rise_m * one[:, 1].min()
            if one[-1, 0] - one[0, 0] > 3.0 * LEVEL_M:
                continue
            if abs(doubtful[r, c] - height) > tolerance:
                continue
            if _to_higher(ordered[last:], above[:doubts], height) > edge_cells:
                _mean(layers, one, out[r, c])


@njit(cache=True, nogil=True)
def _around(
    layers: F32, doubtful: F32, r: int, c: int, reach: int, near: F64, above: F64
) -> tuple[int, int]:
    """The first known cell in each direction, and the first doubtful one before it.

    Writes ``near`` (height, distance in cells, row, column) and ``above`` (height, distance);
    returns how many. None are near where too many neighbouring directions are open.
    """
    count, doubts, is_open, max_open, first_open = 0, 0, 0, 0, 0
    for k in range(DIRECTIONS):
        angle = 2.0 * np.pi * k / DIRECTIONS
        is_open += 1
        doubted = False
        for step in range(1, reach + 1):
            row, col = round(r + step * np.sin(angle)), round(c + step * np.cos(angle))
            if not (0 <= row < layers.shape[0] and 0 <= col < layers.shape[1]):
                break
            if not np.isnan(layers[row, col, 0]):
                if count == 0:
                    first_open = k
                is_open = 0
                near[count, 0], near[count, 1] = layers[row, col, 0], step
                near[count, 2], near[count, 3] = row, col
                count += 1
                break
            if not doubted and not np.isnan(doubtful[row, col]):
                above[doubts, 0], above[doubts, 1] = doubtful[row, col], step
                doubts += 1
                doubted = True
        max_open = max(max_open, is_open)
    max_open = max(max_open, is_open + first_open)  # the last and the first are neighbours
    return (0, 0) if max_open > MAX_OPEN_DIRECTIONS else (count, doubts)


@njit(cache=True, nogil=True)
def _surface(ordered: F64, doubtful_m: float, rise_m: float) -> tuple[int, int]:
    """First and end of the heights, in rising order, that a cell belongs to.

    They lie below the largest step between them; or above it, where a doubtful height says so
    and it is all around.
    """
    largest, count = 0.0, len(ordered)
    for n in range(1, len(ordered)):
        step = ordered[n, 0] - ordered[n - 1, 0]
        limit = LEVEL_M + rise_m * min(ordered[n, 1], ordered[n - 1, 1])
        if step > max(limit, largest):
            largest, count = step, n
    is_high = doubtful_m > ordered[count - 1, 0] + LEVEL_M
    if is_high and len(ordered) - count >= DIRECTIONS - MAX_OPEN_DIRECTIONS:
        return count, len(ordered)
    return 0, count


@njit(cache=True, nogil=True)
def _to_higher(upper: F64, above: F64, height_m: float) -> float:
    """Cells to the nearest height of another, higher surface; infinite without one."""
    distance = np.inf
    for n in range(len(upper)):
        distance = min(distance, upper[n, 1])
    for n in range(len(above)):
        if above[n, 0] > height_m + 2.0 * LEVEL_M:
            distance = min(distance, above[n, 1])
    return distance


@njit(cache=True, nogil=True)
def _mean(layers: F32, cells: F64, out: F32) -> None:
    """Mean of ``cells`` by the inverse square of their distances, with a sigma that covers them."""
    total = np.sum(1.0 / cells[:, 1] ** 2)
    out[:] = 0.0
    for n in range(len(cells)):
        share = 1.0 / cells[n, 1] ** 2 / total
        row, col = int(cells[n, 2]), int(cells[n, 3])
        for k in range(len(out)):
            out[k] += share * layers[row, col, k]
    out[1] = np.hypot(2.0 * out[1], 0.5 * (cells[-1, 0] - cells[0, 0]))
