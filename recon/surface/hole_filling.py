"""Unknown cells of a surface model filled from the known ones around them.

A hole has known cells on nearly all sides, within a few metres. On level ground it takes their
heights. Next to a step it takes the lower surface, because a roof hides the ground there;
next to the step, where matching makes roofs too wide, it stays unknown.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numba import njit

from recon.parallel import parallel_for
from recon.surface.harmonic import between
from recon.surface.raster import STEP_M, Grid, Raster, rasterise_points, reliable
from recon.types import F32, F64, U8, Bool

BEYOND_M = 3.0
"""The outline reaches so far beyond certain heights: half a crown at the border."""

OPENING_M = 1.5
ISLAND_SHARE = 0.02
"""Of the largest part; a smaller one is an island."""

THIN_CELLS = 1.5
"""A gap of one cell, also across."""

SPREAD = 0.2
"""Sigma of a filled height per distance from what is known."""

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
    parallel_for(
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


def outline(known: Bool, sure: Bool, cell_m: float) -> Bool:
    """(rows, cols) the surveyed ground: the ``known`` cells near ``sure`` ones, and what they
    enclose, without teeth at its border, strips and islands."""
    from scipy import ndimage

    if not sure.any():
        return np.zeros_like(known)
    far = ndimage.distance_transform_edt(~sure) > BEYOND_M / cell_m
    cells = np.pad(known & ~far, 1).astype(np.uint8)
    closed = cv2.morphologyEx(cells, cv2.MORPH_CLOSE, _disc(0.5, cell_m))
    whole = np.asarray(ndimage.binary_fill_holes(closed), np.uint8)
    opened = cv2.morphologyEx(whole, cv2.MORPH_OPEN, _disc(OPENING_M, cell_m)).astype(np.float32)
    soft = cv2.GaussianBlur(opened, (0, 0), max(1.0, OPENING_M / cell_m))
    parts, _ = ndimage.label((whole > 0) & (soft > 0.5))
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray((sizes > ISLAND_SHARE * sizes.max())[parts][1:-1, 1:-1])


def _disc(radius_m: float, cell_m: float) -> U8:
    size = 2 * max(1, round(radius_m / cell_m)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def completed(raster: Raster, low_m: F32, inside: Bool, unsure: Bool) -> Raster:
    """``raster`` with every cell ``inside`` filled, from the lower side.

    Next to a known cell it takes that one's height, because voxels leave lines without a point;
    else the ground ``low_m`` (rows, cols), or, in holes that no ground touches, what is around.
    At steps, filled and ``unsure`` cells are of the surface that most of the cells around are of.
    """
    from scipy import ndimage

    known, cell_m = raster.known, raster.grid.cell_m
    if not known.any():
        return raster
    wanted = inside & ~known
    distance, near = ndimage.distance_transform_edt(~known, return_indices=True)
    height = raster.height_m[tuple(near)]
    rest = wanted & (distance > THIN_CELLS)
    level = known & (np.abs(raster.height_m - low_m) <= STEP_M)
    parts, count = ndimage.label(rest, np.ones((3, 3)))
    reach = 2 * math.ceil(THIN_CELLS) + 1
    touched = parts[cv2.dilate(level.astype(np.uint8), np.ones((reach, reach))) > 0]
    is_open = np.isin(np.arange(count + 1), touched)
    is_open[0] = False
    below = is_open[parts]
    height = np.where(below, low_m, height).astype(np.float32)
    rgb = np.where(wanted[..., None], raster.rgb[tuple(near)], raster.rgb)
    for cells, fixed in ((below, level), (rest & ~below, known)):
        if fixed is known:
            height[cells] = between(raster.height_m, known, cells, cell_m)[cells]
        for k in range(3):
            channel = between(raster.rgb[..., k].astype(np.float32), fixed, cells, cell_m)
            rgb[cells, k] = np.clip(channel[cells], 0, 255)
    height = np.where(wanted, height, raster.height_m[tuple(near)]).astype(np.float32)
    middle = float(np.median(raster.height_m[known]))
    most = cv2.medianBlur(height - middle, 5) + middle
    torn = (wanted | unsure) & (np.abs(most - height) > STEP_M)
    height[torn] = most[torn]
    sigma = np.hypot(2.0 * raster.sigma_m[tuple(near)], SPREAD * cell_m * distance)
    return replace(
        raster,
        height_m=np.where(wanted | torn, height, raster.height_m),
        sigma_m=np.where(wanted, sigma, raster.sigma_m).astype(np.float32),
        rgb=rgb,
    )


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
