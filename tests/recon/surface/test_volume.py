"""One closed surface from exact depth images of a house: walls, holes, stray heights, outline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from house_flight import HouseFlight

from recon.mapping.cloud_fusion import cloud_of
from recon.surface.meshing import Mesh
from recon.surface.raster import Raster, grid_over, rasterise, without_cells
from recon.surface.volume import SIDE, volume_mesh
from recon.types import F64, I64, DepthMap

VOXEL_M = 0.3

pytestmark = pytest.mark.usefixtures("mesh_libraries")


def seen(house: HouseFlight) -> tuple[list[DepthMap], Raster]:
    """Depth images, and the upper surface of their points."""
    keyframes = [house.keyframe(k, 5.0 * k) for k in range(5)]
    clouds = [cloud_of(k.depth, k.bgr, k.fresh) for k in keyframes]
    cloud = replace(
        clouds[0],
        xyz_m=np.concatenate([c.xyz_m for c in clouds]),
        rgb=np.concatenate([c.rgb for c in clouds]),
        sigma_m=np.concatenate([c.sigma_m for c in clouds]),
    )
    upper = rasterise(cloud, grid_over(cloud.xyz_m[:, :2].astype(np.float64), VOXEL_M, 1))
    return [k.depth for k in keyframes], upper


def border(mesh: Mesh) -> I64:
    """Vertices of edges that belong to one face alone."""
    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges, count = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    assert count.max() == 2
    return np.unique(edges[count == 1])


def from_outline(mesh: Mesh) -> F64:
    """How far inside the box around the mesh each vertex of its border lies."""
    places, xy_m = mesh.vertices_m[border(mesh), :2], mesh.vertices_m[:, :2]
    inward: F64 = np.minimum(places - xy_m.min(axis=0), xy_m.max(axis=0) - places).min(axis=1)
    return inward


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return volume_mesh(*seen(HouseFlight()))


def test_it_is_open_at_the_outline_alone(mesh: Mesh) -> None:
    inward = from_outline(mesh)
    assert len(inward) and inward.max() < 2.0 * VOXEL_M


def test_roof_ground_and_walls_are_where_the_house_is(mesh: Mesh) -> None:
    x, y, z = mesh.vertices_m.T
    roof = (np.abs(x - 10.0) < 5.0) & (np.abs(y - 2.0) < 3.0)
    assert np.abs(z[roof] - 6.0).max() < 0.1
    away = (np.abs(x - 10.0) > 7.0) | (np.abs(y - 2.0) > 5.0)
    assert np.abs(z[away]).max() < 0.1
    wall = (z > 1.5) & (z < 4.5)
    assert wall.sum() > 100
    outside = np.maximum(np.abs(x[wall] - 10.0) - 6.0, np.abs(y[wall] - 2.0) - 4.0)
    assert np.percentile(np.abs(outside), 90) < 1.3 * VOXEL_M
    assert np.abs(outside).max() < 2.2 * VOXEL_M


def test_what_no_image_shows_is_marked(mesh: Mesh) -> None:
    assert mesh.measured is not None
    x, y, z = mesh.vertices_m.T
    flat = (np.abs(x - 10.0) > 8.0) & (np.abs(x - 10.0) < 15.0) & (np.abs(y - 2.0) < 5.0)
    assert mesh.measured[flat & (z < 0.5)].mean() > 0.95
    hidden = (z > 1.0) & (z < 5.0) & (y > 5.5)  # the cameras fly south of this wall
    assert hidden.sum() > 20 and not mesh.measured[hidden].any()


def test_a_stray_tower_that_images_look_through_goes() -> None:
    depths, upper = seen(HouseFlight())
    height = upper.height_m.copy()
    rows, cols = upper.grid.cells(np.array([[22.0, -4.0]]))
    height[rows[0] - 1 : rows[0] + 2, cols[0] - 1 : cols[0] + 2] = 9.0
    mesh = volume_mesh(depths, replace(upper, height_m=height))
    near = np.hypot(*(mesh.vertices_m[:, :2] - [22.0, -4.0]).T) < 2.0
    assert near.any() and mesh.vertices_m[near, 2].max() < 0.5


def test_fewer_triangles_are_the_same_surface(mesh: Mesh) -> None:
    depths, upper = seen(HouseFlight())
    small = volume_mesh(depths, upper, largest_faces=3000)
    assert len(small.faces) <= 3000 < len(mesh.faces)
    x, y, z = small.vertices_m.T
    roof = (np.abs(x - 10.0) < 5.0) & (np.abs(y - 2.0) < 3.0)
    assert np.abs(z[roof] - 6.0).max() < 0.15
    border(small)


def test_no_surface_is_an_error() -> None:
    depths, upper = seen(HouseFlight())
    nowhere = without_cells(upper, upper.known)
    with pytest.raises(ValueError, match="no cell inside"):
        volume_mesh(depths, nowhere)


def test_it_is_closed_where_images_see_far_through_the_upper_surface() -> None:
    """As where stray points make a platform in the air."""
    depths, upper = seen(HouseFlight())
    height = upper.height_m.copy()
    x, y = upper.grid.centres(*np.indices(upper.grid.shape).reshape(2, -1)).T
    raised = (np.abs(x - 24.0) < 7.0) & (np.abs(y) < 9.0)
    height.ravel()[raised] = 9.0
    mesh = volume_mesh(depths, replace(upper, height_m=height))
    assert from_outline(mesh).max() < 2.0 * VOXEL_M
    middle = np.hypot(*(mesh.vertices_m[:, :2] - [24.0, 0.0]).T) < 4.0
    assert middle.any() and np.abs(mesh.vertices_m[middle, 2]).max() < 0.5


def test_stray_depth_far_below_the_ground_digs_no_deep_hole() -> None:
    (*_, last), upper = seen(HouseFlight())
    depth = last.depth_m.copy()
    depth[20:40, 90:120] = 60.0
    mesh = volume_mesh([replace(last, depth_m=depth)], upper)
    assert from_outline(mesh).max() < 2.0 * VOXEL_M
    assert -2.0 * SIDE * VOXEL_M < mesh.vertices_m[:, 2].min() < -1.0
