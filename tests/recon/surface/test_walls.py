"""Walls that moved, found along their normals; misaligned ones are not."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from simulated_place import simulated_place

from recon import se3
from recon.mapping.cloud_fusion import cloud_of, fuse
from recon.surface.raster import Grid, grid_over
from recon.surface.walls import Wall, walls_moved
from recon.types import F32, F64, DepthMap
from service.sim import scene, shapes
from service.sim.recording import Simulation

# It imports seaborn and pandas: seconds, for every worker that collects this file.
pytestmark = pytest.mark.skipif(find_spec("py4dgeo") is None, reason="needs py4dgeo")

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


def orbited(simulation: Simulation, middle: F64, seed: int) -> tuple[F64, F32]:
    """The cloud of a flight around a house, from depth with noise, misplaced by centimetres."""
    rng = np.random.default_rng(seed)
    clouds = []
    for k, angle in enumerate(np.arange(0.0, 2.0 * np.pi, np.pi / 12)):
        eye = middle + np.array([22.0 * np.cos(angle), 22.0 * np.sin(angle), 16.0])
        ahead = (middle - eye) / np.linalg.norm(middle - eye)
        right = np.cross(ahead, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(ahead, [0.0, 0.0, 1.0]))
        T = se3.compose(np.column_stack([right, np.cross(ahead, right), ahead]), eye)
        depth = simulation.renderer.depth(T) + rng.normal(size=(180, 320)) * SIGMA_M
        one = DepthMap(
            depth.astype(np.float32), np.full(depth.shape, SIGMA_M, np.float32),
            np.full(depth.shape, 3, np.uint8), simulation.options.camera.K, T,
        )  # fmt: skip
        image = simulation.renderer.frame(T, k, simulation.options.look)
        clouds.append(cloud_of(one, image, np.isfinite(depth)))
    cloud = fuse(clouds, VOXEL_M)
    near = np.linalg.norm(cloud.xyz_m[:, :2] - middle[:2], axis=1) < 14.0
    return cloud.xyz_m[near] + rng.normal(size=3) * 0.02, cloud.sigma_m[near]


def test_the_moved_wall_of_a_simulated_house_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    before = simulated_place((320, 180))
    houses = [b for b in before.scene.blocks if b[shapes.KIND] < shapes.VEHICLE]
    house = min(houses, key=lambda b: float(np.hypot(b[shapes.X], b[shapes.Y])))
    out = np.array([-house[shapes.SIN], house[shapes.COS]])  # of one of its long walls
    usual = scene._houses

    def extended(*given: object) -> list[F64]:
        rows = usual(*given)  # type: ignore[arg-type]
        row = next(r for r in rows if np.array_equal(r[:8], house[:8]))
        row[shapes.HALF_W] += 0.25
        row[[shapes.X, shapes.Y]] += 0.25 * out
        return rows

    monkeypatch.setattr(scene, "_houses", extended)
    after = simulated_place((320, 180))
    middle = np.append(house[[shapes.X, shapes.Y]], 0.5 * (house[shapes.BASE] + house[shapes.EAVE]))
    one, same, other = (orbited(s, middle, n) for n, s in enumerate((before, before, after)))
    grid = grid_over(np.vstack([one[0], other[0]])[:, :2], VOXEL_M, margin_cells=1)
    ground_m2 = float(np.prod(grid.shape)) * VOXEL_M**2
    assert walls_moved(one, same, grid, VOXEL_M, 0.03, ground_m2) == []
    found = walls_moved(one, other, grid, VOXEL_M, 0.03, ground_m2)
    wall = max(found, key=lambda w: w.area_m2)
    assert wall.moved_m == pytest.approx(0.5, abs=0.1)
    towards = float(np.degrees(np.arctan2(*out))) % 360.0
    assert abs((wall.towards_deg - towards + 180.0) % 360.0 - 180.0) < 10.0
    off = np.array([wall.east_m, wall.north_m]) - middle[:2]
    assert off @ out == pytest.approx(house[shapes.HALF_W], abs=0.4)
