"""One closed surface from posed depth images: signed distances in a sparse volume.

Each voxel near the surface holds the mean signed distance to what the depth images show, in units
of the truncation (Curless and Levoy 1996, doi:10.1145/237170.237269), and each image that sees
through a voxel votes for free space. What no image sees follows the upper surface: below a roof
is building, around it is air. So the zero crossing is closed inside the outline: walls that no
image sees stand below the edge of the roof.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numba import njit

from recon import se3
from recon.parallel import parallel_for
from recon.surface.ground import terrain
from recon.surface.hole_filling import completed, outline
from recon.surface.meshing import Mesh, largest_parts, reduced
from recon.surface.raster import Raster, reliable, without_cells
from recon.types import F32, F64, I32, I64, Bool, DepthMap

SIDE = 8
"""Voxels along the side of a block, the unit of memory."""

TRUNCATION_VOXELS = 3.0
TRUNCATION_SIGMAS = 3.0
"""Distances are cut off at the larger of the two: below it noise makes two surfaces of one."""

PRIOR_WEIGHT = 0.05
"""Of the upper surface's own distance, beside 1 for an image whose sigma is below a voxel."""

SMOOTHINGS = 5
"""Taubin 1995 (doi:10.1109/ICCV.1995.466848): noise of single voxels goes, corners stay."""

MIN_PART = 0.01
"""Parts of fewer triangles than this share of the largest one float in the air: noise."""

KEPT_FACES, MIN_FACES = 1 / 6, 5000
"""Of the zero crossing: voxels are finer than what they hold, and most ground is flat."""

GROWN_BLOCKS = 16
"""Images move the surface up or down by so many blocks at most."""

LEAST = np.float32(1e-3)
"""The least distance of a voxel, in truncations."""

LARGEST_BLOCKS = 120_000
"""Some 6 GB; a tile has about a thousandth of it to a tenth."""


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """Signed distances, positive in the air, in blocks of SIDE voxels a side."""

    origin_m: F64  # (3,) of voxel (0, 0, 0)
    voxel_m: float
    inside: Bool  # (Y, X, SIDE, SIDE) columns inside the outline, by blocks and in them
    block: I32  # (B, 3) place of each block, in blocks: x, y, z
    distance: F32  # (B, SIDE, SIDE, SIDE) by z, y, x, in truncations
    weight: F32  # the same: of the images; 0 where only the upper surface counts


def volume_mesh(
    depths: Iterable[DepthMap], upper: Raster, largest_faces: int = 400_000,
    progress: Callable[[str], None] = lambda _: None,
) -> Mesh:  # fmt: skip
    """The surface inside the outline of ``upper``, closed but at the outline itself.

    Args:
        depths: all images of the surface.
        upper: its upper surface as measured; the cells are the voxels' size.

    Returns a mesh with colours of ``upper``. Raises ValueError when there is too little surface,
    or too much for the memory.
    """
    sure = reliable(upper)
    inside = outline(upper.known, sure.known, upper.grid.cell_m)
    low_m = terrain(sure, inside).everywhere_m
    upper = without_cells(completed(upper, low_m, inside, upper.known & ~sure.known), ~inside)
    progress("signed distances")
    volume = _voted(upper, low_m, list(depths))
    progress("triangles of the surface")
    vertices, faces = _extracted(volume)
    progress(f"fewer than {len(faces)} triangles")
    vertices, faces = reduced(
        vertices, faces, min(largest_faces, max(MIN_FACES, round(KEPT_FACES * len(faces))))
    )
    vertices, faces = largest_parts(vertices, faces, MIN_PART)
    rgb = upper.rgb[upper.grid.cells(vertices[:, :2])]
    return Mesh(vertices, faces, None, rgb, _measured(volume, vertices))


def _voted(upper: Raster, ground_m: F32, depths: Sequence[DepthMap]) -> Volume:
    """The blocks that the surface passes through, with all votes.

    They are those around ``upper``, and others as far as images have moved the surface out of
    these, but not below the bare ground ``ground_m`` (rows, cols): stray depth alone goes there.
    """
    grid = upper.grid
    rows, cols = grid.shape
    height, ground_m = (
        np.pad(one[::-1], ((0, -rows % SIDE), (0, -cols % SIDE)), constant_values=np.nan)
        for one in (upper.height_m, ground_m)
    )
    if not np.isfinite(height).any():
        raise ValueError("the surface has no cell inside its outline")
    base_m = float(np.nanmin(height))
    origin = np.array(
        [grid.west_m + 0.5 * grid.cell_m, grid.north_m - (rows - 0.5) * grid.cell_m, base_m]
    )
    inside = np.isfinite(_tiles(height))
    lowest, highest, deepest = _layers(height, ground_m, base_m, SIDE * grid.cell_m)
    truncation_m = _truncation(depths, grid.cell_m)
    added, parts = _blocks(lowest, highest), []
    if len(added) > LARGEST_BLOCKS:
        raise ValueError(f"{len(added)} blocks are too many; mesh it in smaller tiles")
    for grown in range(GROWN_BLOCKS + 1):
        zero = np.zeros((2, len(added), SIDE, SIDE, SIDE), np.float32)
        parts.append(Volume(origin, grid.cell_m, inside, added, *zero))
        _vote(parts[-1], height, depths, truncation_m)
        down, up = lowest.copy(), highest.copy()
        for one in parts:
            _leave(
                one.block,
                one.distance,
                inside,
                lowest,
                highest,
                deepest,
                down,
                up,
                grown == GROWN_BLOCKS,
            )
        added = np.concatenate([_blocks(down, lowest - 1), _blocks(highest + 1, up)])
        lowest, highest = down, up
        if not len(added):
            break
    block, distance, weight = (
        np.concatenate([getattr(one, name) for one in parts])
        for name in ("block", "distance", "weight")
    )
    return Volume(origin, grid.cell_m, inside, block, distance, weight)


def _layers(height: F32, ground_m: F32, base_m: float, span_m: float) -> tuple[I32, I32, I32]:
    """(Y, X) lowest and highest block that a surface passes through, counted from ``base_m`` by
    ``span_m``, and the lowest that images may move it to."""
    has, near = np.isfinite(_tiles(height)).any(axis=(2, 3)), np.ones((3, 3), np.uint8)
    low_m, ground_m, high_m = (
        pick(_tiles(one), axis=(2, 3), where=np.isfinite(_tiles(one)), initial=far)
        for one, pick, far in (
            (height, np.min, np.inf), (ground_m, np.min, np.inf), (height, np.max, -np.inf),
        )
    )  # fmt: skip
    low_m = np.where(has, cv2.erode(low_m, near, borderValue=np.inf), 0.0)
    high_m = np.where(has, cv2.dilate(high_m, near, borderValue=-np.inf), -np.inf)
    lowest, deepest = (
        np.floor((one - base_m) / span_m - 0.5).astype(np.int32)
        for one in (low_m, np.minimum(low_m, ground_m))
    )
    highest = np.where(has, np.floor((high_m - base_m) / span_m + 0.5), lowest - 1).astype(np.int32)
    return lowest, highest, deepest


def _tiles(cells: F32) -> F32:
    """(Y, X, SIDE, SIDE) of (rows, cols)."""
    blocks = cells.reshape(cells.shape[0] // SIDE, SIDE, -1, SIDE)
    return np.asarray(blocks.transpose(0, 2, 1, 3))


def _blocks(lowest: I32, highest: I32) -> I32:
    """(B, 3) of the columns (Y, X) from the lowest block to the highest."""
    count = np.maximum(highest - lowest + 1, 0)
    y, x = (np.repeat(at.ravel(), count.ravel()) for at in np.indices(count.shape))
    rank = np.arange(len(x)) - np.repeat(np.cumsum(count) - count.ravel(), count.ravel())
    return np.column_stack([x, y, lowest[y, x] + rank]).astype(np.int32)


@njit(cache=True, nogil=True)
def _leave(
    block: I32, distance: F32, inside: Bool, lowest: I32, highest: I32, deepest: I32, down: I32,
    up: I32, ends: bool,
) -> None:  # fmt: skip
    """Let columns of blocks reach ``down`` and ``up`` to where the surface leaves the blocks:
    above a column is air, below it building. With ``ends``, and below the ``deepest`` block, the
    surface ends there instead."""
    span = np.array([[0, 1], [0, SIDE], [SIDE - 1, SIDE]])
    for b in range(len(block)):
        x, y, z = block[b]
        for turn in range(27):
            dx, dy, dz = turn % 3 - 1, turn // 3 % 3 - 1, turn // 9 - 1
            u, v, w = x + dx, y + dy, z + dz
            if not (0 <= v < lowest.shape[0] and 0 <= u < lowest.shape[1]):
                continue
            if lowest[v, u] > highest[v, u] or lowest[v, u] <= w <= highest[v, u]:
                continue
            air = w > highest[v, u]
            for k in range(span[dz + 1, 0], span[dz + 1, 1]):
                for j in range(span[dy + 1, 0], span[dy + 1, 1]):
                    for i in range(span[dx + 1, 0], span[dx + 1, 1]):
                        if not inside[y, x, j, i] or (distance[b, k, j, i] > 0.0) == air:
                            continue
                        if ends or w < deepest[v, u]:
                            distance[b, k, j, i] = 1.0 if air else -1.0
                        else:
                            down[v, u], up[v, u] = min(down[v, u], w), max(up[v, u], w)


def _truncation(depths: Iterable[DepthMap], voxel_m: float) -> float:
    sigmas = [d.sigma_m[np.isfinite(d.sigma_m)] for d in depths]
    typical = float(np.median(np.concatenate(sigmas))) if any(map(len, sigmas)) else 0.0
    return max(TRUNCATION_VOXELS * voxel_m, TRUNCATION_SIGMAS * typical)


def _vote(volume: Volume, height: F32, depths: Iterable[DepthMap], truncation_m: float) -> None:
    """Add each image's distances, then those of the upper surface's ``height`` (rows, cols) from
    the south, and divide by the weights."""
    middle = volume.origin_m + (volume.block * SIDE + 0.5 * (SIDE - 1)) * volume.voxel_m
    radius = 0.5 * np.sqrt(3.0) * SIDE * volume.voxel_m
    for one in depths:
        T = se3.inverse(one.T_world_camera)
        seen = _in_view(middle, radius, one, T)
        if len(seen):
            parallel_for(
                _add, len(seen), seen, volume.block, volume.distance,
                volume.weight, volume.origin_m, volume.voxel_m, truncation_m, one.depth_m,
                one.sigma_m, one.K, T, cells=SIDE**3 * len(seen),
            )  # fmt: skip
    every = np.arange(len(volume.block))
    parallel_for(
        _add_upper, len(every), every, volume.block, volume.distance,
        volume.weight, volume.origin_m, volume.voxel_m, truncation_m, height,
        cells=SIDE**3 * len(every),
    )  # fmt: skip


def _in_view(middle: F64, radius: float, depth: DepthMap, T: F64) -> I64:
    """Blocks whose sphere touches the image's view, no farther than its surface."""
    known = np.isfinite(depth.depth_m)
    if not known.any():
        return np.zeros(0, np.int64)
    local = middle @ T[:3, :3].T + T[:3, 3]
    h, w = depth.depth_m.shape
    (fx, _, cx), (_, fy, cy) = depth.K[:2]
    z = local[:, 2]
    ok = (z > -radius) & (z < float(depth.depth_m[known].max()) + 2.0 * radius)
    for axis, f, c, size in ((0, fx, cx, w), (1, fy, cy, h)):
        for side in (1.0, -1.0):
            edge = (c + 0.5) / f if side > 0 else (size - 0.5 - c) / f
            inward = (side * local[:, axis] + edge * z) / np.hypot(1.0, edge)
            ok &= inward > -radius
    return np.flatnonzero(ok)


@njit(cache=True, nogil=True)
def _add(
    begin: int, end: int, seen: I64, block: I32, distance: F32, weight: F32, origin: F64,
    voxel: float, truncation: float, depth: F32, sigma: F32, K: F64, T: F64,
) -> None:  # fmt: skip
    h, w = depth.shape
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for n in range(begin, end):
        b = seen[n]
        for k in range(SIDE):
            z = origin[2] + (block[b, 2] * SIDE + k) * voxel
            for j in range(SIDE):
                y = origin[1] + (block[b, 1] * SIDE + j) * voxel
                for i in range(SIDE):
                    x = origin[0] + (block[b, 0] * SIDE + i) * voxel
                    ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
                    if ahead <= 0.0:
                        continue
                    u = fx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / ahead + cx
                    v = fy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / ahead + cy
                    col, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
                    if col < 0 or row < 0 or col >= w or row >= h:
                        continue
                    d = depth[row, col]
                    if not np.isfinite(d):
                        continue
                    t = (d - ahead) / truncation
                    if t < -1.0:
                        continue
                    s = max(sigma[row, col] / voxel, 1.0)
                    one = 1.0 / (s * s)
                    distance[b, k, j, i] += np.float32(one * min(t, 1.0))
                    weight[b, k, j, i] += np.float32(one)


@njit(cache=True, nogil=True)
def _add_upper(
    begin: int, end: int, every: I64, block: I32, distance: F32, weight: F32, origin: F64,
    voxel: float, truncation: float, height: F32,
) -> None:  # fmt: skip
    for n in range(begin, end):
        b = every[n]
        for j in range(SIDE):
            row = block[b, 1] * SIDE + j
            for i in range(SIDE):
                col = block[b, 0] * SIDE + i
                if not np.isfinite(height[row, col]):
                    continue
                for k in range(SIDE):
                    z = origin[2] + (block[b, 2] * SIDE + k) * voxel
                    t = min(max((z - height[row, col]) / truncation, -1.0), 1.0)
                    whole = weight[b, k, j, i] + PRIOR_WEIGHT
                    distance[b, k, j, i] = (distance[b, k, j, i] + PRIOR_WEIGHT * t) / whole


def _extracted(volume: Volume) -> tuple[F64, I32]:
    """Vertices (V, 3) and faces (F, 3) of the zero crossing, by marching cubes of Open3D."""
    import open3d as o3d

    core: Any = o3d.core
    grid: Any = cast(Any, o3d.t.geometry.VoxelBlockGrid)(
        attr_names=("tsdf", "weight"), attr_dtypes=(core.float32, core.float32),
        attr_channels=((1,), (1,)), voxel_size=volume.voxel_m, block_resolution=SIDE,
        block_count=len(volume.block),
    )  # fmt: skip
    places, _ = grid.hashmap().activate(core.Tensor(volume.block))
    at = places.numpy().astype(np.int64)
    distance = volume.distance  # one of zero would put vertices of several edges into one place
    sure = np.where(distance < 0.0, np.minimum(distance, -LEAST), np.maximum(distance, LEAST))
    grid.attribute("tsdf").numpy()[at, ..., 0] = sure
    grid.attribute("weight").numpy()[at, ..., 0] = volume.inside[
        volume.block[:, 1], volume.block[:, 0], None
    ]
    made = grid.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    if not len(made.triangles):
        raise ValueError("no surface crosses the volume")
    vertices, faces = _in_order(np.asarray(made.vertices, np.float64), np.asarray(made.triangles))
    return _smoothed(vertices, faces) + volume.origin_m, faces


def _in_order(vertices: F64, faces: I32) -> tuple[F64, I32]:
    """The same mesh in an order that does not depend on threads, vertices of one place joined."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    is_new = np.ones(len(order), np.bool_)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    place = np.empty(len(order), np.int32)
    place[order] = np.cumsum(is_new) - 1
    faces = place[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    first = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, first, 1)
    return ordered[is_new], faces[np.lexsort(faces.T[::-1])]


def _smoothed(vertices: F64, faces: I32) -> F64:
    """The vertices after SMOOTHINGS steps forth and back; the outline stays."""
    from scipy.sparse import coo_matrix, diags

    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    size = (len(vertices), len(vertices))
    edges = coo_matrix((np.ones(len(ends), np.float32), ends.T), size).tocsr()
    edges = edges + edges.T  # faces at each edge: one at the outline
    border = np.repeat(np.arange(len(vertices)), np.diff(edges.indptr))[edges.data == 1.0]
    edges.data[:] = 1.0
    mean = diags(1.0 / np.maximum(np.diff(edges.indptr), 1)) @ edges
    held = vertices[border]
    for step in (0.5, -0.53) * SMOOTHINGS:
        vertices = vertices + step * (mean @ vertices - vertices)
        vertices[border] = held
    return np.asarray(vertices, np.float64)


def _measured(volume: Volume, vertices: F64) -> Bool:
    """(V,) whether images have voted for all voxels around each vertex: what only one side was
    seen of is guessed."""
    at = np.floor((vertices - volume.origin_m) / volume.voxel_m).astype(np.int64)
    low = volume.block.min(axis=0)
    number: I32 = np.full(volume.block.max(axis=0) - low + 2, -1, np.int32)  # beyond stands none
    number[tuple((volume.block - low).T)] = np.arange(len(volume.block))
    out = np.ones(len(vertices), np.bool_)
    for corner in np.ndindex(2, 2, 2):
        place, (i, j, k) = (at + corner) // SIDE - low, ((at + corner) % SIDE).T
        n = number[tuple(np.clip(place, -1, np.array(number.shape) - 1).T)]
        out &= (n >= 0) & (volume.weight[n, k, j, i] > 0.0)
    return out
