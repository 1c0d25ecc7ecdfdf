"""Triangle meshes of the surveyed surface: 2.5D from a raster, or Poisson from a cloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.surface.raster import Raster
from recon.types import F32, F64, I32, U8, Bool, PointCloud

TRIM_SHARE = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles in metres, z up; seen from outside their corners run counter-clockwise."""

    vertices_m: F64  # (V, 3)
    faces: I32  # (F, 3)
    uv: F32 | None = None  # (V, 2) texture coordinates from the image's upper left corner
    rgb: U8 | None = None  # (V, 3)


def height_mesh(raster: Raster, largest_faces: int = 400_000) -> Mesh:
    """The raster's surface as one sheet.

    A vertex per known cell, two triangles per four known cells. Above ``largest_faces`` flat
    parts are merged (quadric error by Open3D; without it vertices are clustered). Walls are steep
    triangles, undersides are not there: meant for surveys flown looking down. Raises ValueError
    without two triangles.
    """
    known = raster.known
    index = np.full(known.shape, -1, np.int64)
    index[known] = np.arange(int(known.sum()))
    a, b = index[:-1, :-1], index[:-1, 1:]
    c, d = index[1:, :-1], index[1:, 1:]
    whole = (a >= 0) & (b >= 0) & (c >= 0) & (d >= 0)
    if not whole.any():
        raise ValueError("the surface has no four known cells side by side")
    z = np.where(known, raster.height_m, 0.0)
    flat_diagonal = np.abs(z[:-1, :-1] - z[1:, 1:]) <= np.abs(z[:-1, 1:] - z[1:, :-1])
    first, second = whole & flat_diagonal, whole & ~flat_diagonal
    faces = np.concatenate(
        [
            np.column_stack([a[first], c[first], d[first]]),
            np.column_stack([a[first], d[first], b[first]]),
            np.column_stack([a[second], c[second], b[second]]),
            np.column_stack([b[second], c[second], d[second]]),
        ]
    ).astype(np.int32)
    places = raster.grid.centres(*np.nonzero(known))
    vertices = np.column_stack([places, raster.height_m[known].astype(np.float64)])
    vertices, faces = _without_lone_vertices(vertices, faces)
    if len(faces) > largest_faces:
        vertices, faces = _simplified(vertices, faces, largest_faces)
    return Mesh(vertices, faces)


def poisson_mesh(
    cloud: PointCloud,
    towards_m: F64,
    spacing_m: float,
    largest_faces: int = 400_000,
) -> Mesh:
    """A closed-form surface through an oriented cloud, with colours per vertex.

    Screened Poisson (Kazhdan and Hoppe 2013, doi:10.1145/2487228.2487237) by Open3D; the
    TRIM_SHARE of the vertices with the least support is cut away, and so is what lies
    farther than a few spacings from every point. Above ``largest_faces`` flat parts are merged.

    Args:
        towards_m: (N, 3) a place that each point was seen from.
        spacing_m: distance between neighbouring points; the finest cell is about twice it.

    Raises ValueError when there are too few points for a surface.
    """
    import open3d as o3d

    if len(cloud) < 100:
        raise ValueError(f"{len(cloud)} points are too few for a surface")
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.xyz_m.astype(np.float64)))
    points.colors = o3d.utility.Vector3dVector(cloud.rgb / 255.0)
    points.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(6.0 * spacing_m, 30))
    normals = np.asarray(points.normals)
    away = np.einsum("ij,ij->i", normals, towards_m - cloud.xyz_m) < 0.0
    normals[away] *= -1.0
    points.normals = o3d.utility.Vector3dVector(normals)
    side = float(np.ptp(cloud.xyz_m, axis=0).max())
    depth = int(np.clip(np.ceil(np.log2(1.1 * side / (2.0 * spacing_m))), 5, 11))
    mesh, support = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(points, depth=depth)
    density: F64 = np.asarray(support)
    far = _distance(np.asarray(mesh.vertices), cloud.xyz_m) > 4.0 * spacing_m
    loose = (density < np.quantile(density, TRIM_SHARE)) | far
    mesh.remove_vertices_by_mask(loose.tolist())
    if len(mesh.triangles) > largest_faces:
        mesh = _reduced(mesh, largest_faces)
    colours = np.clip(np.rint(255.0 * np.asarray(mesh.vertex_colors)), 0, 255).astype(np.uint8)
    return Mesh(
        np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles, np.int32).copy(), None, colours
    )


def _distance(places: F64, points: F32) -> F64:
    """(P,) distance from each place to the nearest point."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(points).query(places, workers=-1)[0])


def _without_lone_vertices(vertices: F64, faces: I32) -> tuple[F64, I32]:
    used, faces = _used(len(vertices), faces)
    return vertices[used], faces


def _used(vertices: int, faces: I32) -> tuple[Bool, I32]:
    """Which of so many vertices the faces use, and the faces numbered by these alone."""
    used: Bool = np.zeros(vertices, np.bool_)
    used[faces.ravel()] = True
    return used, (np.cumsum(used) - 1)[faces].astype(np.int32)


def _simplified(vertices: F64, faces: I32, largest_faces: int) -> tuple[F64, I32]:
    """About ``largest_faces`` triangles of the same surface."""
    try:
        import open3d as o3d
    except ImportError:
        return _clustered(vertices, faces, largest_faces)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces)
    )
    small = _reduced(mesh, largest_faces)
    return np.asarray(small.vertices).copy(), np.asarray(small.triangles, np.int32).copy()


def _clustered(vertices: F64, faces: I32, largest_faces: int) -> tuple[F64, I32]:
    """At most ``largest_faces`` triangles: the vertices of each cell of a grid become their mean.

    Rossignac and Borrel 1993 (doi:10.1007/978-3-642-78114-8_29); flat parts get no fewer
    triangles than others.
    """
    width, depth = np.ptp(vertices[:, :2], axis=0)
    cell = float(np.sqrt(2.0 * width * depth / largest_faces))
    while True:
        _, number = np.unique(np.floor(vertices / cell), axis=0, return_inverse=True)
        number = number.ravel()
        joined = number[faces].astype(np.int32)
        whole = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
        if int(whole.sum()) <= largest_faces:
            count = np.bincount(number)[:, None]
            sums = np.column_stack([np.bincount(number, vertices[:, k]) for k in range(3)])
            return _without_lone_vertices(sums / count, joined[whole])
        cell *= 1.2


def _reduced(mesh: Any, largest_faces: int) -> Any:
    """An Open3D mesh reduced by quadric error (Garland and Heckbert 1997); colours stay."""
    small = mesh.simplify_quadric_decimation(largest_faces, boundary_weight=10.0)
    small.remove_degenerate_triangles()
    small.remove_unreferenced_vertices()
    return small


def cut(mesh: Mesh, box: tuple[float, float, float, float]) -> Mesh:
    """The part of an untextured mesh inside (west, south, east, north), cut at its borders.

    Triangles across a border are divided along it, so that tiles cut at the same border meet.
    Infinite borders cut nothing.
    """
    for axis, side, limit in ((0, 1, box[0]), (1, 1, box[1]), (0, -1, box[2]), (1, -1, box[3])):
        if np.isfinite(limit) and len(mesh.faces):
            mesh = _half(mesh, side * (mesh.vertices_m[:, axis] - limit))
    return mesh


def _half(mesh: Mesh, inside_m: F64) -> Mesh:
    """The part where ``inside_m`` (V,), linear over each triangle, is not negative."""
    keep = inside_m >= 0.0
    count = keep[mesh.faces].sum(axis=1)
    parts = [mesh.faces[count == 3]]
    # Turn the triangles so that the corner that differs from the two others comes first.
    mixed = mesh.faces[(count == 1) | (count == 2)]
    one = keep[mixed].sum(axis=1) == 1
    first = np.argmax(keep[mixed] == one[:, None], axis=1)
    mixed = np.take_along_axis(mixed, (first[:, None] + np.arange(3)) % 3, 1)
    edges = np.concatenate([mixed[:, [0, 1]], mixed[:, [0, 2]]]).astype(np.int64)
    low, high = edges.min(axis=1), edges.max(axis=1)
    total = len(mesh.vertices_m)
    key, number = np.unique(low * total + high, return_inverse=True)
    a, b = key // total, key % total
    share = inside_m[a] / (inside_m[a] - inside_m[b])
    vertices = [mesh.vertices_m, _between(mesh.vertices_m[a], mesh.vertices_m[b], share)]
    new = number.reshape(2, -1) + total
    parts.append(np.column_stack([mixed[one, 0], new[0, one], new[1, one]]))
    two = ~one
    parts.append(np.column_stack([new[0, two], mixed[two, 1], mixed[two, 2]]))
    parts.append(np.column_stack([new[0, two], mixed[two, 2], new[1, two]]))
    faces = np.concatenate(parts).astype(np.int32)
    rgb = None
    if mesh.rgb is not None:
        mean = _between(mesh.rgb[a].astype(np.float64), mesh.rgb[b].astype(np.float64), share)
        rgb = np.concatenate([mesh.rgb, np.rint(mean).astype(np.uint8)])
    used, faces = _used(total + len(key), faces)
    return Mesh(np.concatenate(vertices)[used], faces, None, None if rgb is None else rgb[used])


def _between(a: F64, b: F64, share: F64) -> F64:
    """(N, 3) places at ``share`` of the way from ``a`` to ``b``."""
    return np.asarray(a + share[:, None] * (b - a))
