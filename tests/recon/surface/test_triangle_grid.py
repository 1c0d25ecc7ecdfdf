"""The triangle grid against brute force over every triangle, and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from recon.surface import triangle_grid
from recon.types import F64, Array


def mesh(seed: int = 0) -> tuple[F64, Array]:
    """Rolling ground on a grid, and loose triangles of all sizes above and through it."""
    rng = np.random.default_rng(seed)
    n = 15
    x, y = np.meshgrid(np.arange(n, dtype=float), np.arange(n, dtype=float))
    ground = np.stack([x, y, np.sin(x / 3) + np.cos(y / 2)], axis=-1).reshape(-1, 3)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    loose = rng.uniform([0, 0, -2], [14, 14, 6], (30, 3))
    triangles = np.concatenate(
        [
            np.stack([a, b, d], axis=1),
            np.stack([a, d, c], axis=1),
            np.arange(30).reshape(10, 3) + n * n,
        ]
    )
    return np.vstack([ground, loose]), triangles


def brute_cast(corners: F64, origin: F64, direction: F64) -> float:
    """Nearest hit by solving every triangle's 3x3 system."""
    p, e1, e2 = np.moveaxis(corners.reshape(-1, 3, 3), 1, 0)
    M = np.stack([e1, e2, np.broadcast_to(-direction, e1.shape)], axis=-1)
    able = np.abs(np.linalg.det(M)) >= 1e-12
    u, v, t = np.linalg.solve(M[able], (origin - p[able])[..., None])[..., 0].T
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9)
    return float(t[hit].min(initial=np.inf))


def brute_closest(corners: F64, point: F64) -> float:
    """Distance by clamped projection onto every triangle's plane and edges."""
    p, e1, e2 = np.moveaxis(corners.reshape(-1, 3, 3), 1, 0)
    u, v = (np.linalg.pinv(np.stack([e1, e2], axis=-1)) @ (point - p)[..., None])[..., 0].T
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    candidates = [(p + u[:, None] * e1 + v[:, None] * e2)[inside]]
    for start, edge in ((p, e1), (p, e2), (p + e1, e2 - e1)):
        share = np.clip(np.sum((point - start) * edge, 1) / np.sum(edge * edge, 1), 0, 1)
        candidates.append(start + share[:, None] * edge)
    return float(np.linalg.norm(np.concatenate(candidates) - point, axis=1).min())


@pytest.mark.parametrize("cell_m", [0.4, 1.0, 3.7])
def test_rays_agree_with_brute_force(cell_m: float) -> None:
    grid = triangle_grid.build(*mesh(), cell_m=cell_m)
    rng = np.random.default_rng(1)
    origins = rng.uniform([-6, -6, -6], [20, 20, 12], (250, 3))
    directions = rng.uniform([0, 0, -2], [14, 14, 3], (250, 3)) - origins
    directions[::10, 0] = 0.0  # along the axes
    directions[::20, 1] = 0.0
    t, triangle = grid.cast(origins, directions)
    truth = np.array(
        [brute_cast(grid.corners, o, d) for o, d in zip(origins, directions, strict=True)]
    )
    assert np.isfinite(truth).sum() > 50
    np.testing.assert_array_equal(np.isfinite(t), np.isfinite(truth))
    hit = np.isfinite(t)
    np.testing.assert_allclose(t[hit], truth[hit], rtol=1e-7, atol=1e-9)
    assert ((triangle >= 0) == hit).all()


@pytest.mark.parametrize("cell_m", [0.5, 2.0])
def test_closest_points_agree_with_brute_force(cell_m: float) -> None:
    grid = triangle_grid.build(*mesh(), cell_m=cell_m)
    points = np.random.default_rng(2).uniform([-4, -4, -5], [18, 18, 9], (150, 3))
    truth = np.array([brute_closest(grid.corners, p) for p in points])
    distance, nearest, triangle = grid.closest(points, 20.0)
    np.testing.assert_allclose(distance, truth, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points - nearest, axis=1), distance, atol=1e-12)
    assert (triangle >= 0).all()
    near, _, found = grid.closest(points, 1.0)
    np.testing.assert_array_equal(np.isfinite(near), truth <= 1.0)
    np.testing.assert_array_equal(found >= 0, truth <= 1.0)


def test_rays_along_borders_do_not_slip_through() -> None:
    grid = triangle_grid.build(*mesh(), cell_m=1.0)
    x, y = np.meshgrid(np.arange(0, 14.01, 0.5), np.arange(0, 14.01, 0.5))
    origins = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 30.0)])
    t, _ = grid.cast(origins, np.tile([0.0, 0.0, -1.0], (x.size, 1)))
    assert np.isfinite(t).all()


def test_rays_straight_down_hit_level_ground_at_any_height() -> None:
    square = np.array([[0.0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]])
    sides = np.array([[0, 1, 2], [0, 2, 3]])
    for height in np.random.default_rng(0).uniform(-1e-7, 300.0, 200):
        grid = triangle_grid.build(square + np.array([0.0, 0.0, height]), sides)
        t, _ = grid.cast(np.array([[4.3, 2.1, 412.0]]), np.array([[0.0, 0.0, -1.0]]))
        assert t[0] == pytest.approx(412.0 - height)


def test_normals_and_areas() -> None:
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0]], dtype=float)
    grid = triangle_grid.build(vertices, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(grid.normals(), [[0, 0, 1]])
    np.testing.assert_allclose(grid.areas(), [3.0])


@pytest.mark.parametrize(
    ("vertices", "triangles", "word"),
    [
        (np.zeros((3, 2)), np.array([[0, 1, 2]]), "vertices"),
        (np.zeros((3, 3)), np.zeros((0, 3), int), "triangles"),
        (np.zeros((3, 3)), np.array([[0, 1, 3]]), "does not exist"),
        (np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "finite"),
    ],
)
def test_bad_meshes_are_refused(vertices: F64, triangles: Array, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        triangle_grid.build(vertices, triangles)
