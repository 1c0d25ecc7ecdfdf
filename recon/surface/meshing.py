"""Triangle meshes: fewer triangles of the same surface, and parts cut at borders."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from recon.types import F32, F64, I32, I64, U8, Bool


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles in metres, z up; seen from outside their corners run counter-clockwise."""

    vertices_m: F64  # (V, 3)
    faces: I32  # (F, 3)
    uv: F32 | None = None  # (V, 2) texture coordinates from the image's upper left corner
    rgb: U8 | None = None  # (V, 3)
    measured: Bool | None = None  # (V,) False where the surface only follows what is around it


def reduced(vertices: F64, faces: I32, largest_faces: int) -> tuple[F64, I32]:
    """About ``largest_faces`` triangles of the same surface, or all of one with fewer: flat parts
    are merged. No edge has more than two triangles.

    Quadric error (Garland and Heckbert 1997, doi:10.1145/258734.258849).
    """
    if len(faces) <= largest_faces:
        return vertices, faces
    from fast_simplification import simplify

    middle = vertices.mean(axis=0)  # single precision counts from there
    small, triangles = simplify(
        (vertices - middle).astype(np.float32), faces, target_count=largest_faces
    )
    return repaired(small.astype(np.float64) + middle, triangles.astype(np.int32))


def repaired(vertices: F64, faces: I32) -> tuple[F64, I32]:
    """The surface without edges of more than two triangles, where sheets touch each other.

    A cone over each loop around such triangles takes their place.
    """
    _, number, count = edges(faces)
    is_bad = (count > 2)[number].any(axis=1)
    if not is_bad.any():
        return vertices, faces
    bad = faces[is_bad]
    ways = np.stack([bad, np.roll(bad, -1, axis=1)], axis=2).reshape(-1, 2).tolist()
    times = Counter((a, b) for a, b in ways)
    after: dict[int, list[int]] = {a: [] for a, _ in times}
    for (a, b), n in times.items():
        after[a] += [b] * (n - times[b, a])
    places, cones = [vertices], [faces[~is_bad]]
    for first in after:
        path = [first]
        while after[path[-1]]:
            path.append(after[path[-1]].pop())
            at = path.index(path[-1])
            loop, path = path[at:-1], path[: at + 1]
            if loop:
                top = np.full(len(loop), len(vertices) + len(places) - 1)
                places.append(vertices[loop].mean(axis=0)[None])
                cones.append(np.column_stack([loop, np.roll(loop, -1), top]))
    return np.concatenate(places), np.concatenate(cones).astype(np.int32)


def edges(faces: I32) -> tuple[I64, I64, I64]:
    """(E, 2) vertices of each edge, the lower one first; (F, 3) the edge from corner k to k + 1;
    (E,) how many triangles have it."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).astype(np.int64)
    total = int(faces.max(initial=0)) + 1
    key, number, count = np.unique(
        ends[..., 0] * total + ends[..., 1], return_inverse=True, return_counts=True
    )
    return np.column_stack([key // total, key % total]), number.reshape(faces.shape), count


def face_neighbours(faces: I32) -> I32:
    """(F, 3) the triangle across each edge (corner k to k + 1); -1 where not two share it."""
    _, number, count = edges(faces)
    order = np.argsort(number, axis=None, kind="stable")
    first = (np.cumsum(count) - count)[count == 2]
    one, other = order[first], order[first + 1]
    out = np.full(3 * len(faces), -1, np.int32)
    out[one], out[other] = other // 3, one // 3
    return out.reshape(-1, 3)


def largest_parts(vertices: F64, faces: I32, share: float) -> tuple[F64, I32]:
    """The parts with at least this ``share`` of the triangles of the largest one."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    size, ends = (len(vertices),) * 2, np.concatenate([faces[:, :2], faces[:, 1:]])
    ones = np.ones(len(ends), np.int8)
    part = connected_components(coo_matrix((ones, ends.T), size), directed=False)[1][faces[:, 0]]
    count = np.bincount(part)
    used, faces = used_vertices(len(vertices), faces[(count >= share * count.max())[part]])
    return vertices[used], faces


def coarser(mesh: Mesh, largest_faces: int) -> Mesh:
    """An untextured mesh as one of fewer triangles; vertices take what the nearest ones have."""
    from scipy.spatial import cKDTree

    vertices, faces = reduced(mesh.vertices_m, mesh.faces, largest_faces)
    near = cKDTree(mesh.vertices_m).query(vertices)[1]
    rgb, measured = (None if a is None else a[near] for a in (mesh.rgb, mesh.measured))
    return Mesh(vertices, faces, None, rgb, measured)


def used_vertices(vertices: int, faces: I32) -> tuple[Bool, I32]:
    """Which of so many vertices the faces use, and the faces numbered by these alone."""
    used: Bool = np.zeros(vertices, np.bool_)
    used[faces.ravel()] = True
    return used, (np.cumsum(used) - 1)[faces].astype(np.int32)


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
    used, faces = used_vertices(total + len(key), faces)
    rgb = measured = None
    if mesh.rgb is not None:
        mean = _between(mesh.rgb[a].astype(np.float64), mesh.rgb[b].astype(np.float64), share)
        rgb = np.concatenate([mesh.rgb, np.rint(mean).astype(np.uint8)])[used]
    if mesh.measured is not None:
        both = mesh.measured[a] & mesh.measured[b]
        measured = np.concatenate([mesh.measured, both])[used]
    return Mesh(np.concatenate(vertices)[used], faces, None, rgb, measured)


def _between(a: F64, b: F64, share: F64) -> F64:
    """(N, 3) places at ``share`` of the way from ``a`` to ``b``."""
    return np.asarray(a + share[:, None] * (b - a))
