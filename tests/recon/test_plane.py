"""The plane through points that mostly lie near it."""

from __future__ import annotations

import numpy as np
import pytest

from recon.plane import plane_normal, plane_through
from recon.types import F64


def slope(relief: float = 0.0, count: int = 200) -> tuple[F64, F64]:
    """(N, 3) points 40 m ahead on a slope, and its normal towards the camera."""
    rng = np.random.default_rng(0)
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    x, y = rng.uniform(-15, 15, (2, count))
    z = 40.0 + (normal[0] * x + normal[1] * y) / -normal[2]
    points = np.column_stack([x, y, z])
    return points + rng.uniform(-relief, relief, (count, 1)) * normal, normal


def test_the_normal_points_at_the_camera_and_not_every_tree_counts() -> None:
    points, normal = slope(relief=0.1)
    points[::5] += 8.0 * normal
    found = plane_normal(points)
    assert found is not None
    np.testing.assert_allclose(found, normal, atol=0.01)
    away = plane_normal(points - [0.0, 0.0, 80.0])
    assert away is not None and away @ normal < -0.99


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.eye(3)[:2],
        np.zeros((100, 3)),
        np.outer(np.arange(9.0), [1.0, 2.0, 3.0]),
    ],
    ids=["none", "two", "one place", "a line"],
)
def test_points_that_leave_the_plane_open_have_no_normal(points: F64) -> None:
    assert plane_normal(points) is None


@pytest.mark.parametrize(("relief", "is_plane"), [(0.5, True), (12.0, False)])
def test_what_is_as_thick_as_wide_is_no_plane_where_that_is_asked(
    relief: float, is_plane: bool
) -> None:
    points, _ = slope(relief)
    assert (plane_normal(points, 0.2) is not None) == is_plane
    assert plane_normal(points) is not None


def test_the_extent_is_along_the_axes_of_the_plane() -> None:
    x, y = np.meshgrid(np.linspace(-3, 3, 31), np.linspace(-1, 1, 11))
    normal, size = plane_through(np.column_stack([x.ravel(), np.full(x.size, 5.0), y.ravel()]))
    np.testing.assert_allclose(np.abs(normal), [0, 1, 0], atol=1e-9)
    assert size[0] > 2.5 * size[1] and size[2] < 1e-6 * size[1]
