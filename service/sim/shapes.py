"""Triangles of the things that stand on the ground: blocks with flat or gabled roofs, crowns."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.types import F64, I32, U8
from service.sim.noise import value3

GROUND, TOP, WALL, CROWN = 0, 1, 2, 3
"""Materials of triangles: GROUND and TOP show the image from above, the others are solid."""

# Columns of the block table, one row per block.
KIND, X, Y, COS, SIN, HALF_L, HALF_W, BASE, EAVE, RIDGE = range(10)
TOP_B, TOP_G, TOP_R, WALL_B, WALL_G, WALL_R, SEED = range(10, 17)
COLUMNS = 17
FLAT, GABLED, VEHICLE, PLAIN = 0.0, 1.0, 2.0, 3.0
"""Kinds of block; PLAIN has no windows and its top is a plain colour (chimney, trunk)."""

# Columns of the tree table.
TREE_X, TREE_Y, TREE_Z, TREE_R, TREE_B, TREE_G, TREE_RED, TREE_SEED = range(8)


Body = tuple[F64, I32, int, int]
"""Vertices (N, 3), triangles (M, 3) of them, their material and row in the block or tree table."""


def joined(bodies: list[Body]) -> tuple[F64, I32, U8, I32]:
    """(vertices (N, 3), triangles (M, 3), material (M,), owner (M,)) of all bodies."""
    vertices, triangles, material, owner = zip(*bodies, strict=True)
    first = np.cumsum([0, *map(len, vertices[:-1])])
    each = [len(some) for some in triangles]
    moved = [some + start for some, start in zip(triangles, first, strict=True)]
    return (
        np.concatenate(vertices), np.concatenate(moved).astype(np.int32),
        np.repeat(np.array(material, np.uint8), each), np.repeat(np.array(owner, np.int32), each),
    )  # fmt: skip


def footprint(block: F64, grow_m: float = 0.0) -> F64:
    """(4, 2) corners of a block's outline, counter-clockwise, grown by ``grow_m``."""
    l, w = block[HALF_L] + grow_m, block[HALF_W] + grow_m
    local = np.array([[-l, -w], [l, -w], [l, w], [-l, w]])
    turn = np.array([[block[COS], block[SIN]], [-block[SIN], block[COS]]])
    return np.asarray(local @ turn + block[[X, Y]])


def inside(block: F64, x_m: F64, y_m: F64, shrink_m: float = 0.0) -> npt.NDArray[np.bool_]:
    """True where positions lie within a block's outline, shrunk by ``shrink_m``."""
    dx, dy = x_m - block[X], y_m - block[Y]
    u = dx * block[COS] + dy * block[SIN]
    v = -dx * block[SIN] + dy * block[COS]
    return np.asarray(
        (np.abs(u) < block[HALF_L] - shrink_m) & (np.abs(v) < block[HALF_W] - shrink_m)
    )


def block_bodies(block: F64, owner: int) -> list[Body]:
    """Walls and roof of one block; outward normals, no floor."""
    corners = footprint(block)
    bottom = np.column_stack([corners, np.full(4, block[BASE])])
    eave = np.column_stack([corners, np.full(4, block[EAVE])])
    walls = np.vstack([bottom, eave])
    quads = [[i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)]
    body = walls, _split(quads), WALL, owner
    if block[KIND] != GABLED:
        return [body, (eave, _split([[0, 1, 2, 3]]), TOP, owner)]
    west = np.append(0.5 * (corners[0] + corners[3]), block[RIDGE])
    east = np.append(0.5 * (corners[1] + corners[2]), block[RIDGE])
    roof = np.vstack([eave, east, west])  # 4 = east end of the ridge, 5 = west end
    gables = np.array([[1, 2, 4], [3, 0, 5]], np.int32)
    slopes = _split([[0, 1, 4, 5], [2, 3, 5, 4]])
    return [body, (roof, slopes, TOP, owner), (roof, gables, WALL, owner)]


def _split(quads: list[list[int]]) -> I32:
    """Two triangles for each counter-clockwise quadrangle."""
    return np.array([t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])], np.int32)


def icosphere(subdivisions: int) -> tuple[F64, I32]:
    """Unit sphere: vertices (N, 3) and triangles (M, 3), outward."""
    g = (1 + 5**0.5) / 2
    v = [
        [-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g],
        [0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1],
    ]  # fmt: skip
    f = [
        [0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4],
        [11, 10, 2], [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8],
        [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1],
    ]  # fmt: skip
    corners = np.array([v[k] for triangle in f for k in triangle], float).reshape(-1, 3, 3)
    corners /= np.linalg.norm(corners, axis=2, keepdims=True)
    for _ in range(subdivisions):
        a, b, c = corners.transpose(1, 0, 2)
        ab, bc, ca = (m / np.linalg.norm(m, axis=1, keepdims=True) for m in (a + b, b + c, c + a))
        finer = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        corners = np.concatenate([np.stack(triangle, axis=1) for triangle in finer])
    points, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return points, index.reshape(-1, 3).astype(np.int32)


SPHERE = icosphere(2)


def crown(tree: F64, height_m: float, owner: int) -> Body:
    """A lumpy crown: an ellipsoid, flatter below, pushed in and out by noise."""
    unit, triangles = SPHERE
    seed = int(tree[TREE_SEED])
    lumps = np.array([value3(3 * x + 9, 3 * y + 9, 3 * z + 9, seed) for x, y, z in unit])
    radius = tree[TREE_R] * (0.72 + 0.5 * lumps)[:, None]
    half = 0.4 * height_m
    flat = np.where(unit < 0, [1.0, 1.0, 0.7], 1.0)
    centre = tree[[TREE_X, TREE_Y, TREE_Z]] + [0.0, 0.0, 0.6 * height_m]
    vertices = centre + unit * radius * np.array([1.0, 1.0, half / tree[TREE_R]]) * flat
    return vertices, triangles, CROWN, owner
