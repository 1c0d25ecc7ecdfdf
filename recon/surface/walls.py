"""Walls that moved between two point clouds, along their own normals.

M3C2 (Lague et al. 2013, doi:10.1016/j.isprsjprs.2013.04.009) by py4dgeo, where the earlier surface
is steep: there a difference of heights is the wall's height, whatever it moved by.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from recon.surface.change import sigmas_of_any
from recon.surface.raster import Grid
from recon.types import F32, F64, Bool

STEEPEST_NORMAL = 0.5
"""Vertical part of a unit normal, below which a surface counts as steep: over 60 degrees."""

NORMAL_VOXELS, CYLINDER_VOXELS, REACH_M = 4.0, 2.0, 1.5
MIN_POINTS = 5
"""In each cylinder at both dates."""

MIN_MOVE_M, MIN_AREA_M2, FALSE_ALARM = 0.15, 0.5, 0.05
STEEP_RELIEF = 4.0
"""Voxels by which a place must rise above the lowest point around it to be looked at."""


@dataclass(frozen=True, slots=True)
class Wall:
    """One piece of a steep surface that moved."""

    east_m: float
    north_m: float
    moved_m: float
    sigma_m: float
    towards_deg: float  # from north over east
    area_m2: float  # of the surface


def walls_moved(
    before: tuple[F64, F32], after: tuple[F64, F32], grid: Grid, voxel_m: float,
    alignment_m: float, ground_m2: float,
) -> list[Wall]:  # fmt: skip
    """Steep pieces of ``before`` that lie elsewhere in ``after``, each (N, 3) m and (N,) sigma.

    Sigma holds the scatter in both cylinders, the points' own sigmas and the alignment's, and is
    scaled by the spread on all walls. Noise reaches a piece's mean distance in 5 % of comparisons
    of ``ground_m2`` (Sidak). Raises ImportError without py4dgeo.
    """
    import py4dgeo

    logging.getLogger("py4dgeo").setLevel(logging.WARNING)
    origin = before[0].mean(axis=0)
    one, two = before[0] - origin, after[0] - origin
    near = _on_relief(one, voxel_m)
    if not near.any() or len(two) < MIN_POINTS:
        return []
    cores, sigma = one[near], before[1][near].astype(np.float64)
    m3c2 = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(one), py4dgeo.Epoch(two)), corepoints=cores,
        normal_radii=(NORMAL_VOXELS * voxel_m,), cyl_radius=CYLINDER_VOXELS * voxel_m,
        max_distance=REACH_M, registration_error=0.0,
    )  # fmt: skip
    normals = np.asarray(m3c2.directions())
    steep = np.abs(normals[:, 2]) < STEEPEST_NORMAL
    if not steep.any():
        return []
    distance, found = m3c2.run()
    enough = (found["num_samples1"] >= MIN_POINTS) & (found["num_samples2"] >= MIN_POINTS)
    used = steep & enough & np.isfinite(distance) & np.isfinite(found["lodetection"])
    if not used.any():
        return []
    cores, normals, d, sigma = cores[used], normals[used], distance[used], sigma[used]
    scatter = found["lodetection"][used] / 1.96
    sigma = np.sqrt(scatter**2 + 2.0 * sigma**2 + alignment_m**2)
    sigma *= max(1.0, float(np.median(np.abs(d) / sigma)) / 0.6745)
    return _pieces(cores + origin, normals, d, sigma, grid, voxel_m, ground_m2)


def _on_relief(xyz: F64, voxel_m: float) -> Bool:
    """(N,) points that rise above others around them; most of a site is flat and left out."""
    cell = NORMAL_VOXELS * voxel_m
    at = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / cell).astype(np.int64)
    low = np.full(at.max(axis=0) + 1, np.inf)
    np.minimum.at(low, (at[:, 0], at[:, 1]), xyz[:, 2])
    high = np.full(low.shape, -np.inf)
    np.maximum.at(high, (at[:, 0], at[:, 1]), xyz[:, 2])
    rise = ndimage.maximum_filter(high, 3) - ndimage.minimum_filter(low, 3)
    return np.asarray(rise[at[:, 0], at[:, 1]] > STEEP_RELIEF * voxel_m)


def _pieces(
    cores: F64, normals: F64, d: F64, sigma: F64, grid: Grid, voxel_m: float, ground_m2: float
) -> list[Wall]:
    """The significant places that touch, as one wall each."""
    level = sigmas_of_any(FALSE_ALARM, ground_m2 / MIN_AREA_M2)
    moved = np.abs(d) > np.maximum(2.58 * sigma, MIN_MOVE_M)
    inside = grid.holds(cores[:, :2])
    rows, cols = grid.cells(cores[:, :2])
    cells = np.zeros(grid.shape, np.bool_)
    cells[rows[moved & inside], cols[moved & inside]] = True
    labels, count = ndimage.label(cells, np.ones((3, 3)))
    label = np.where(inside, labels[rows, cols], 0)
    ways = normals * d[:, None]  # the same for a normal and its opposite
    out = []
    for number in range(1, count + 1):
        own = label == number
        way = ways[own].mean(axis=0)
        length = float(np.linalg.norm(way))
        error = float(np.sqrt(np.mean(sigma[own] ** 2)))
        area = float(np.count_nonzero(own)) * voxel_m**2  # a fused cloud has a point per voxel
        if area < MIN_AREA_M2 or length < max(level * error, MIN_MOVE_M):
            continue
        east, north = cores[own, :2].mean(axis=0)
        towards = float(np.degrees(np.arctan2(way[0], way[1]))) % 360.0
        out.append(Wall(float(east), float(north), length, error, towards, area))
    return out
