"""Walls that moved, found along their normals; misaligned ones are not."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("py4dgeo")

from recon.surface.raster import Grid
from recon.surface.walls import Wall, walls_moved
from recon.types import F32, F64

VOXEL_M, SIGMA_M, TALL_M = 0.2, 0.04, 6.0
CORNER = np.array([500_000.0, 5_200_000.0, 400.0])
GRID = Grid(500_000.0, 5_200_030.0, VOXEL_M, (150, 150))


def town(seed: int, south_m: float = 5.0, off_m: float = 0.0) -> tuple[F64, F32]:
    """Flat ground with two houses, a point per voxel with noise; one wall lies at ``south_m``."""
    rng = np.random.default_rng(seed)
    side = np.arange(0.5 * VOXEL_M, 30.0, VOXEL_M)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    z = np.zeros(len(x))
    walls = []
    for west, south, east, north in ((5.0, south_m, 12.0, 14.0), (18.0, 6.0, 26.0, 12.0)):
        z[(x > west) & (x < east) & (y > south) & (y < north)] = TALL_M
        up = np.arange(0.5 * VOXEL_M, TALL_M, VOXEL_M)
        for a, b, fixed, axis in (
            (west, east, south, 1), (west, east, north, 1), (south, north, west, 0),
            (south, north, east, 0),
        ):  # fmt: skip
            along, high = (v.ravel() for v in np.meshgrid(np.arange(a, b, VOXEL_M), up))
            still = np.full(len(along), fixed)
            walls.append(np.column_stack([along, still, high] if axis else [still, along, high]))
    points = np.vstack([np.column_stack([x, y, z]), *walls])
    points = points + rng.normal(size=points.shape) * SIGMA_M + [off_m, 0.7 * off_m, 0.0]
    return points + CORNER, np.full(len(points), SIGMA_M, np.float32)


def found(after: tuple[F64, F32]) -> list[Wall]:
    return walls_moved(town(1), after, GRID, VOXEL_M, 0.05, 900.0)


def test_a_wall_that_moved_is_found_along_its_normal() -> None:
    (wall,) = found(town(2, south_m=4.5))
    assert wall.moved_m == pytest.approx(0.5, abs=0.05)
    assert abs(wall.towards_deg - 180.0) < 10.0
    assert wall.area_m2 == pytest.approx(7.0 * TALL_M, rel=0.35)
    east, north = wall.east_m - CORNER[0], wall.north_m - CORNER[1]
    assert abs(east - 8.5) < 0.5 and abs(north - 5.0) < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_walls_that_are_misaligned_did_not_move(seed: int) -> None:
    assert found(town(10 + seed)) == []
    assert found(town(20 + seed, off_m=0.1)) == []


def test_flat_ground_has_no_walls() -> None:
    points, sigma = town(3)
    low = points[:, 2] < CORNER[2] + 0.5
    assert walls_moved((points[low], sigma[low]), (points, sigma), GRID, VOXEL_M, 0.05, 900.0) == []
