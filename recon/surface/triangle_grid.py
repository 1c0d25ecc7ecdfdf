"""Rays and closest points against a triangle mesh that is wider than it is tall.

The triangles are sorted into square columns over x and y, each with its range of z. Terrain
with buildings has a handful of triangles per column, so a ray from a drone meets few of them.
Exact in double precision: ray and triangle by Moeller and Trumbore (1997,
DOI 10.1080/10867651.1997.10487468), closest point by the region test of Ericson, Real-Time
Collision Detection (2005), section 5.1.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from recon.parallel import parallel_for
from recon.types import F64, I32

BLOCK = 8  # columns along the side of a coarse block
EDGE = 1e-9  # rays that graze a shared edge must not slip through
SLACK_M = 1e-6  # nor those whose first step would end on a level surface, but for rounding


@dataclass(frozen=True, slots=True, eq=False)
class TriangleGrid:
    """A mesh, indexed. Build it with :func:`build`."""

    corners: F64  # (M, 9) first corner, edge to the second, edge to the third
    start: I32  # (ny * nx + 1,) first entry of a column in items
    items: I32  # (R,) triangles, column by column
    column_z: F64  # (ny, nx, 2) lowest and highest z; empty columns have lowest > highest
    block_z: F64  # (by, bx, 2) the same of coarse blocks
    bounds: F64  # (6,) x0 y0 z0 x1 y1 z1
    cell_m: float

    def normals(self) -> F64:
        """(M, 3) unit normals, right-handed about the corners; zero for slivers."""
        n = np.cross(self.corners[:, 3:6], self.corners[:, 6:9])
        length = np.linalg.norm(n, axis=1, keepdims=True)
        return np.asarray(n / np.maximum(length, 1e-30))

    def areas(self) -> F64:
        """(M,) areas in square units."""
        n = np.cross(self.corners[:, 3:6], self.corners[:, 6:9])
        return np.asarray(0.5 * np.linalg.norm(n, axis=1))

    def cast(self, origins: F64, directions: F64) -> tuple[F64, I32]:
        """Where rays first meet the mesh: ``t`` (N,) and triangle (N,); NaN and -1 for none.

        The hit is at ``origin + t * direction``, t > 0; directions (N, 3) need no unit length.
        ``origins`` is (N, 3) or (3,). Raises ValueError for other shapes.
        """
        directions = _rows(directions, "directions")
        origins = np.broadcast_to(origins, directions.shape)
        origins = np.require(origins, np.float64, ("C", "W"))  # each layout would be compiled
        t = np.empty(len(directions))
        hit = np.empty(len(directions), np.int32)
        parallel_for(_cast_all, len(directions), self.arrays(), origins, directions, t, hit)
        return t, hit

    def closest(self, points: F64, max_m: float) -> tuple[F64, F64, I32]:
        """Nearest point of the mesh: distance (N,), point (N, 3), triangle (N,).

        Farther than ``max_m``: NaN, NaN, -1. Raises ValueError for points not (N, 3).
        """
        points = _rows(points, "points")
        distance = np.empty(len(points))
        nearest = np.empty((len(points), 3))
        hit = np.empty(len(points), np.int32)
        found = distance, nearest, hit
        parallel_for(_closest_all, len(points), self.arrays(), points, float(max_m), *found)
        return distance, nearest, hit

    def arrays(self) -> tuple[Any, ...]:
        """What the compiled functions of this module take as ``grid``."""
        return (
            self.corners, self.start, self.items, self.column_z, self.block_z, self.bounds,
            self.cell_m,
        )  # fmt: skip


def build(vertices: F64, triangles: npt.NDArray[np.integer], cell_m: float = 1.0) -> TriangleGrid:
    """The grid of a mesh with (N, 3) ``vertices`` and (M, 3) ``triangles``.

    Raises ValueError for wrong shapes, non-finite vertices, indices out of range, an empty
    mesh or a cell size that would need more than 50 million columns.
    """
    vertices = _rows(vertices, "vertices")
    triangles = np.ascontiguousarray(triangles, dtype=np.int64)
    if triangles.ndim != 2 or triangles.shape[1:] != (3,) or len(triangles) == 0:
        raise ValueError(f"triangles must be (M, 3) with M > 0, got {triangles.shape}")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError("a triangle names a vertex that does not exist")
    if not np.isfinite(vertices).all():
        raise ValueError("vertices must be finite numbers")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    nx, ny = (int(n) for n in np.maximum(1, np.ceil((high - low)[:2] / cell_m)))
    if cell_m <= 0 or nx * ny > 50_000_000:
        raise ValueError(f"cells of {cell_m:g} m do not suit a mesh of {nx} x {ny} columns")
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    corners = np.ascontiguousarray(np.hstack([a, b - a, c - a]))
    start, items, column_z = _fill(corners, low[0], low[1], cell_m, nx, ny)
    by, bx = -(-ny // BLOCK), -(-nx // BLOCK)
    block_z = np.empty((by, bx, 2))
    for j in range(by):
        for i in range(bx):
            part = column_z[j * BLOCK : (j + 1) * BLOCK, i * BLOCK : (i + 1) * BLOCK]
            block_z[j, i] = part[..., 0].min(), part[..., 1].max()
    bounds = np.concatenate([low, high])
    return TriangleGrid(corners, start, items, column_z, block_z, bounds, float(cell_m))


def _rows(values: F64, name: str) -> F64:
    rows = np.ascontiguousarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f"{name} must be (N, 3), got {rows.shape}")
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def _span(corners, m, x0, y0, cell_m, nx, ny):  # type: ignore[no-untyped-def]
    """Columns that triangle ``m``'s bounding box touches, and its range of z."""
    ax, ay, az = corners[m, 0], corners[m, 1], corners[m, 2]
    bx, by, bz = ax + corners[m, 3], ay + corners[m, 4], az + corners[m, 5]
    cx, cy, cz = ax + corners[m, 6], ay + corners[m, 7], az + corners[m, 8]
    # A triangle that only touches a column's border belongs to its own side alone.
    i0 = int(np.floor((min(ax, bx, cx) - x0) / cell_m + 1e-9))
    i1 = int(np.ceil((max(ax, bx, cx) - x0) / cell_m - 1e-9)) - 1
    j0 = int(np.floor((min(ay, by, cy) - y0) / cell_m + 1e-9))
    j1 = int(np.ceil((max(ay, by, cy) - y0) / cell_m - 1e-9)) - 1
    i0, j0 = min(max(i0, 0), nx - 1), min(max(j0, 0), ny - 1)
    i1, j1 = min(max(i1, i0), nx - 1), min(max(j1, j0), ny - 1)
    return i0, i1, j0, j1, min(az, bz, cz), max(az, bz, cz)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(corners, x0, y0, cell_m, nx, ny):  # type: ignore[no-untyped-def]
    """The columns' starts, items and ranges of z."""
    start = np.zeros(nx * ny + 1, np.int32)
    column_z = np.empty((ny, nx, 2))
    column_z[:, :, 0], column_z[:, :, 1] = np.inf, -np.inf
    for m in range(len(corners)):
        i0, i1, j0, j1, z0, z1 = _span(corners, m, x0, y0, cell_m, nx, ny)
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                start[j * nx + i + 1] += 1
                column_z[j, i, 0] = min(column_z[j, i, 0], z0)
                column_z[j, i, 1] = max(column_z[j, i, 1], z1)
    for k in range(nx * ny):
        start[k + 1] += start[k]
    items = np.empty(start[nx * ny], np.int32)
    place = start[:-1].copy()
    for m in range(len(corners)):
        i0, i1, j0, j1, _, _ = _span(corners, m, x0, y0, cell_m, nx, ny)
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                items[place[j * nx + i]] = m
                place[j * nx + i] += 1
    return start, items, column_z


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(corners, m, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """t of the ray's hit of triangle ``m``, or -1."""
    e1x, e1y, e1z = corners[m, 3], corners[m, 4], corners[m, 5]
    e2x, e2y, e2z = corners[m, 6], corners[m, 7], corners[m, 8]
    px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
    det = e1x * px + e1y * py + e1z * pz
    if abs(det) < 1e-14:
        return -1.0
    inv = 1.0 / det
    sx, sy, sz = ox - corners[m, 0], oy - corners[m, 1], oz - corners[m, 2]
    u = (sx * px + sy * py + sz * pz) * inv
    if u < -EDGE or u > 1.0 + EDGE:
        return -1.0
    qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    v = (dx * qx + dy * qy + dz * qz) * inv
    if v < -EDGE or u + v > 1.0 + EDGE:
        return -1.0
    return (e2x * qx + e2y * qy + e2z * qz) * inv


@njit(cache=True, nogil=True, error_model="numpy")
def _clip(bounds, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """(t_in, t_out) of the ray through the mesh's bounding box; t_in > t_out when it misses."""
    t0, t1 = 0.0, np.inf
    for axis in range(3):
        o = ox if axis == 0 else (oy if axis == 1 else oz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        low, high = bounds[axis] - SLACK_M, bounds[axis + 3] + SLACK_M
        if abs(d) < 1e-15:
            if o < low or o > high:
                return 1.0, 0.0
            continue
        ta, tb = (low - o) / d, (high - o) / d
        t0, t1 = max(t0, min(ta, tb)), min(t1, max(ta, tb))
    return t0, t1


@njit(cache=True, nogil=True, error_model="numpy")
def _exit(x0, y0, size, i, j, ox, oy, ix, iy):  # type: ignore[no-untyped-def]
    """When a ray leaves square (i, j) of side ``size``, and through which axis.

    ``ix``, ``iy`` are the inverses of the direction, 0 where it does not move.
    """
    tx = ty = np.inf
    if ix != 0.0:
        tx = (x0 + (i + 1 if ix > 0.0 else i) * size - ox) * ix
    if iy != 0.0:
        ty = (y0 + (j + 1 if iy > 0.0 else j) * size - oy) * iy
    return (tx, 0) if tx < ty else (ty, 1)


@njit(cache=True, nogil=True, error_model="numpy")
def first_hit(grid, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """(t, triangle) of the first hit of one ray, or (inf, -1); for use in compiled loops."""
    corners, start, items, column_z, block_z, bounds, cell_m = grid
    t, t_out = _clip(bounds, ox, oy, oz, dx, dy, dz)
    if t > t_out:
        return np.inf, -1
    ny, nx = column_z.shape[0], column_z.shape[1]
    x0, y0 = bounds[0], bounds[1]
    ix = 1.0 / dx if abs(dx) > 1e-15 else 0.0
    iy = 1.0 / dy if abs(dy) > 1e-15 else 0.0
    i = min(max(int(np.floor((ox + dx * t - x0) / cell_m)), 0), nx - 1)
    j = min(max(int(np.floor((oy + dy * t - y0) / cell_m)), 0), ny - 1)
    best, found, ui, uj = np.inf, -1, -1, -1
    while 0 <= i < nx and 0 <= j < ny and t <= t_out:
        bi, bj = i // BLOCK, j // BLOCK
        za = oz + dz * t
        if bi != ui or bj != uj:  # a block that was not looked at yet
            te, axis = _exit(x0, y0, cell_m * BLOCK, bi, bj, ox, oy, ix, iy)
            zb = oz + dz * min(te, t_out)
            if min(za, zb) > block_z[bj, bi, 1] or max(za, zb) < block_z[bj, bi, 0]:
                t = max(t, te)
                if axis == 0:
                    i = (bi + 1) * BLOCK if ix > 0.0 else bi * BLOCK - 1
                    j = int(np.floor((oy + dy * t - y0) / cell_m))
                    j = min(max(j, bj * BLOCK), min((bj + 1) * BLOCK, ny) - 1)
                else:
                    j = (bj + 1) * BLOCK if iy > 0.0 else bj * BLOCK - 1
                    i = int(np.floor((ox + dx * t - x0) / cell_m))
                    i = min(max(i, bi * BLOCK), min((bi + 1) * BLOCK, nx) - 1)
                continue
            ui, uj = bi, bj
            if dz < 0.0 and za > block_z[bj, bi, 1]:  # fall to the block's highest point at once
                t = max(t, (block_z[bj, bi, 1] + SLACK_M - oz) / dz)
                za = oz + dz * t
                i = int(np.floor((ox + dx * t - x0) / cell_m))
                j = int(np.floor((oy + dy * t - y0) / cell_m))
                i = min(max(i, bi * BLOCK), min((bi + 1) * BLOCK, nx) - 1)
                j = min(max(j, bj * BLOCK), min((bj + 1) * BLOCK, ny) - 1)
        te, axis = _exit(x0, y0, cell_m, i, j, ox, oy, ix, iy)
        zb = oz + dz * min(te, t_out)
        if min(za, zb) <= column_z[j, i, 1] and max(za, zb) >= column_z[j, i, 0]:
            for k in range(start[j * nx + i], start[j * nx + i + 1]):
                tm = _meet(corners, items[k], ox, oy, oz, dx, dy, dz)
                if 1e-9 < tm < best:
                    best, found = tm, items[k]
            if best <= te:
                break
        t = max(t, te)
        if axis == 0:
            i += 1 if ix > 0.0 else -1
        else:
            j += 1 if iy > 0.0 else -1
    return best, found


@njit(cache=True, nogil=True, error_model="numpy")
def _cast_all(begin, end, grid, origins, directions, t, hit):  # type: ignore[no-untyped-def]
    for n in range(begin, end):
        o, d = origins[n], directions[n]
        tn, m = first_hit(grid, o[0], o[1], o[2], d[0], d[1], d[2])
        t[n] = tn if m >= 0 else np.nan
        hit[n] = m


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_on(corners, m, px, py, pz):  # type: ignore[no-untyped-def]
    """(x, y, z) of triangle ``m`` nearest to a point (Ericson 5.1.5)."""
    ax, ay, az = corners[m, 0], corners[m, 1], corners[m, 2]
    bx, by, bz = corners[m, 3], corners[m, 4], corners[m, 5]
    cx, cy, cz = corners[m, 6], corners[m, 7], corners[m, 8]
    x, y, z = px - ax, py - ay, pz - az
    d1, d2 = bx * x + by * y + bz * z, cx * x + cy * y + cz * z
    if d1 <= 0.0 and d2 <= 0.0:
        return ax, ay, az
    bb, cc = bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz
    bc = bx * cx + by * cy + bz * cz
    d3, d4 = d1 - bb, d2 - bc  # about the second corner
    if d3 >= 0.0 and d4 <= d3:
        return ax + bx, ay + by, az + bz
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3) if d1 != d3 else 0.0
        return ax + v * bx, ay + v * by, az + v * bz
    d5, d6 = d1 - bc, d2 - cc  # about the third corner
    if d6 >= 0.0 and d5 <= d6:
        return ax + cx, ay + cy, az + cz
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6) if d2 != d6 else 0.0
        return ax + w * cx, ay + w * cy, az + w * cz
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        whole = (d4 - d3) + (d5 - d6)
        w = (d4 - d3) / whole if whole > 0.0 else 0.0
        return ax + bx + w * (cx - bx), ay + by + w * (cy - by), az + bz + w * (cz - bz)
    whole = va + vb + vc
    v, w = vb / whole, vc / whole
    return ax + v * bx + w * cx, ay + v * by + w * cy, az + v * bz + w * cz


@njit(cache=True, nogil=True, error_model="numpy")
def _column_distance2(column_z, bounds, cell_m, i, j, px, py, pz):  # type: ignore[no-untyped-def]
    """Squared distance from a point to the box of column (i, j): a bound from below."""
    dx = max(bounds[0] + i * cell_m - px, 0.0, px - bounds[0] - (i + 1) * cell_m)
    dy = max(bounds[1] + j * cell_m - py, 0.0, py - bounds[1] - (j + 1) * cell_m)
    dz = max(column_z[j, i, 0] - pz, 0.0, pz - column_z[j, i, 1])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True, error_model="numpy")
def _closest_all(  # type: ignore[no-untyped-def]
    begin, end, grid, points, max_m, distance, nearest, hit
):
    corners, start, items, column_z, _, bounds, cell_m = grid
    ny, nx = column_z.shape[0], column_z.shape[1]
    for n in range(begin, end):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        best2, found = max_m * max_m, -1
        bx, by, bz = np.nan, np.nan, np.nan
        ci = int(np.floor((px - bounds[0]) / cell_m))
        cj = int(np.floor((py - bounds[1]) / cell_m))
        for r in range(int(max_m / cell_m) + 2):
            if r > 1 and ((r - 1) * cell_m) ** 2 > best2:
                break
            for j in range(max(cj - r, 0), min(cj + r, ny - 1) + 1):
                step = 1 if abs(j - cj) == r or r == 0 else 2 * r
                for i in range(ci - r, ci + r + 1, step):
                    if i < 0 or i >= nx:
                        continue
                    gap2 = _column_distance2(column_z, bounds, cell_m, i, j, px, py, pz)
                    if gap2 > best2:
                        continue
                    for k in range(start[j * nx + i], start[j * nx + i + 1]):
                        x, y, z = _nearest_on(corners, items[k], px, py, pz)
                        d2 = (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2
                        if d2 <= best2:
                            best2, found, bx, by, bz = d2, items[k], x, y, z
        hit[n] = found
        distance[n] = np.sqrt(best2) if found >= 0 else np.nan
        nearest[n, 0], nearest[n, 1], nearest[n, 2] = bx, by, bz
