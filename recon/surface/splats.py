"""A surface as 3D Gaussians, straight from posed depth images, and views of them.

Each pixel of an image with a depth becomes one Gaussian (Kerbl et al. 2023,
doi:10.1145/3592433), or each square of pixels without detail: its place is the middle's,
two axes lie in the surface and are as long as the footprint, the third is as thick as the depth's
sigma, and its opacity follows the number of views that agree. What no depth image shows is filled
from a closed surface. Colours are fitted to all images by simultaneous iterative reconstruction
(Gilbert 1972, doi:10.1016/0022-5193(72)90180-4); nothing else is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, partial, reduce

import cv2
import numpy as np
from numba import njit

from recon import se3
from recon.camera_model import rays
from recon.mapping.cloud_fusion import ISLAND_POINTS, ISLAND_SHIFT, pieces
from recon.mapping.free_space import seen_through, spread
from recon.mapping.voxel_map import find_slot, rehash, voxel_key
from recon.parallel import run_parallel, threads
from recon.surface.meshing import Mesh
from recon.surface.texture_views import TextureView, rays_onto
from recon.surface.texturing import between_seen
from recon.types import F32, F64, I32, I64, U8, Array, Bool, DepthMap, Keyframe, PointCloud

WIDTH = 0.5
"""Sigma along the surface, in footprints of a pixel: neighbours meet at 0.37 of their height."""

MAX_SLOPE = 0.03
"""Depths of one surface differ by less than this share from pixel to pixel."""

SIDES_PX = 2, 4, 8
"""Of squares of pixels that one Gaussian may stand for."""

FLAT = 0.003
"""Inverse depths of a plane are linear over the image: no other differ by less than this share."""

NORMAL_PX = 2
"""A normal is that of the places so far to each side."""

MIN_COSINE = 0.2
"""A flatter view of the surface stretches no Gaussian further."""

MERGED = 1.0
"""Of several Gaussians in a cell of so many footprints the one with the least sigma stays."""

BARE_PX, BEHIND, THIN = 3.0, 3, 0.2
"""Where the closed surface has no Gaussian in a cell of so many footprints, nor in so many in front
and behind, where noise has put it, it gets some half a cell apart, as wide as half a cell to each
side and of so much of that across the surface."""

MAX_OPACITY, SINGLE = 0.95, 0.85
"""Opacity of what many views, and of what one view or none has measured."""

COVERED = 0.5
"""A pixel with less opacity than this shows a hole."""

LOW_PASS_PX2 = 0.3
"""Variance that viewers add to each Gaussian in the image, as the reference does."""

WIDEST = 1.3
"""Beyond so many half images from the middle a Gaussian is projected as there, as the reference
does: one next to the camera is not drawn all over the image."""

LARGEST_ALPHA, SMALLEST_ALPHA, DONE = 0.99, 1.0 / 255.0, 1e-3
REACH = 3.33
"""Sigmas from a Gaussian's middle to where it is fainter than SMALLEST_ALPHA."""

SUBSETS = 2
"""Colours are fitted to every other view, then to the others (ordered subsets, Hudson and Larkin
1994, doi:10.1109/42.363108): as good as two rounds of all, in half the time."""

VIEWS_PER_THREAD = 4
"""What each has found is in memory for so many views at a time."""

AROUND = np.ones((2 * NORMAL_PX + 1,) * 2, np.uint8)
"""Of a pixel: what its normal is taken from."""


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """3D Gaussians in metres."""

    xyz_m: F32  # (N, 3)
    q_wxyz: F32  # (N, 4) from each one's axes to the world's
    sigma_m: F32  # (N, 3) 1 sigma along these axes; the third is across the surface
    opacity: F32  # (N,)
    rgb: F32  # (N, 3) 0 to 255

    def __len__(self) -> int:
        return len(self.xyz_m)

    def at(self, rows: I64 | Bool) -> Splats:
        return Splats(*(getattr(self, f.name)[rows] for f in fields(self)))


def joined(parts: Sequence[Splats]) -> Splats:
    return Splats(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Splats)))


def splats_of(
    keyframes: Sequence[Keyframe],
    views: Sequence[TextureView],
    surface: Callable[[], Mesh],
    progress: Callable[[str], None] = lambda _: None,
    detail_levels: float = 0,
) -> Splats:
    """Gaussians of what the keyframes measured; holes in their views take the closed ``surface``.

    ``views`` are the keyframes' images without distortion, as fine as the Gaussians shall be. A
    square of pixels that differ by at most ``detail_levels`` from the squares' interpolated means
    has no detail. ``surface`` is asked for late: it may be made meanwhile.
    ``progress`` is called once per keyframe and :func:`steps` times in all.
    """

    def measured(keyframe: Keyframe, view: TextureView) -> _Pixels:
        progress("Gaussians from depth images")
        return _known_pixels(keyframe.depth, keyframe.fresh, view, detail_levels)

    found = run_parallel(*(partial(measured, k, v) for k, v in zip(keyframes, views, strict=True)))
    kept = _merged(found, [k.depth for k in keyframes])
    made = (partial(_gaussians, *one) for one in zip(found, kept, views, strict=True))
    splats, surface = joined(run_parallel(*made)), cache(surface)
    splats = joined([splats, *_fillings(splats, views, surface, progress)])
    splats = joined([splats, _on_bare(splats, surface(), _footprint_m(found))])
    return _fitted(splats, views, progress)


def gaussians(keyframe: Keyframe, view: TextureView, detail_levels: float) -> int:
    """How many a view becomes before they are merged with others'."""
    return int(np.count_nonzero(_squares(keyframe.depth, keyframe.fresh, view, detail_levels)))


def steps(keyframes: int) -> int:
    return 3 * keyframes


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """The pixels of a view whose depth is known."""

    places_m: F32  # (N, 3) in the world
    xyz_m: F32  # (N, 3) in the camera's axes
    normal: F32  # (N, 3) in the camera's axes
    sigma_m: F32  # (N,) of the depth
    opacity: F32  # (N,)
    rgb: F32  # (N, 3)
    side_px: F32  # (N,) of the square of pixels that it stands for
    footprint_m: F32  # (N,) of a pixel


def _known_pixels(
    depth: DepthMap, mask: Bool, view: TextureView, detail_levels: float = 0
) -> _Pixels:
    """Those of ``view`` where the depth is known and ``mask`` (h, w) says so.

    The view is taken from the depth map's own place; its grid may be finer.
    """
    xyz, normal, sigma, opacity, rgb, side = _pixels(
        np.ascontiguousarray(depth.depth_m, np.float32), np.ascontiguousarray(depth.sigma_m),
        np.ascontiguousarray(depth.views), mask, depth.K, view.bgra, view.K,
        _squares(depth, mask, view, detail_levels),
    )  # fmt: skip
    footprint = xyz[:, 2] / np.float32(np.sqrt(view.K[0, 0] * view.K[1, 1]))
    places = se3.transform(view.T_world_camera, xyz.astype(np.float64)).astype(np.float32)
    return _Pixels(places, xyz, normal, sigma, opacity, rgb, side, footprint)


def _squares(depth: DepthMap, mask: Bool, view: TextureView, detail_levels: float) -> U8:
    """(h, w) of ``view``: at the upper left pixel of each square that a Gaussian stands for its
    side, 0 elsewhere and where no depth is known."""
    h, w = view.bgra.shape[:2]
    known: Bool = mask & (depth.depth_m > 0.0) & np.isfinite(depth.sigma_m)
    inverse = np.zeros(mask.shape, np.float32)
    inverse[known] = 1.0 / depth.depth_m[known]
    u, v = (
        ((np.arange(size) - view.K[axis, 2]) / view.K[axis, axis] * depth.K[axis, axis]
         + depth.K[axis, 2]).astype(np.float32) for axis, size in ((0, w), (1, h))
    )  # fmt: skip
    places = np.broadcast_to(u, (h, w)), np.broadcast_to(v[:, None], (h, w))
    fine = cv2.remap(inverse, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    out = cv2.remap(known.astype(np.uint8), *places, cv2.INTER_NEAREST)
    out[view.bgra[..., 3] == 0] = 0
    is_blank = out == 0
    for side in SIDES_PX if detail_levels else ():
        rows, cols = h // side, w // side
        whole = np.s_[: rows * side, : cols * side]
        blocks = rows, side, cols, side

        def off(image: Array) -> Array:
            """How far pixels are from the squares' interpolated means."""
            few = cv2.resize(image, (cols, rows), interpolation=cv2.INTER_AREA)  # noqa: B023
            return cv2.absdiff(image, cv2.resize(few, image.shape[1::-1]))

        busy = reduce(np.maximum, np.moveaxis(off(view.bgra[whole]), 2, 0)) > detail_levels
        busy |= (off(fine[whole]) > FLAT * fine[whole]) | is_blank[whole]
        is_flat = ~busy.reshape(blocks).any(axis=(1, 3))
        square = out[whole].reshape(blocks)
        square[:] = np.where(is_flat[:, None, :, None], 0, square)
        square[:, 0, :, 0][is_flat] = side
        out[whole] = square.reshape(rows * side, cols * side)
    return np.asarray(out, np.uint8)


def _gaussians(pixels: _Pixels, rows: I64 | slice, view: TextureView) -> Splats:
    """A Gaussian for some of the pixels of ``view``."""
    xyz, footprint = pixels.xyz_m[rows], pixels.side_px[rows] * pixels.footprint_m[rows]
    axes, cosine = _axes(xyz, pixels.normal[rows])
    thick = np.minimum(pixels.sigma_m[rows], WIDTH * footprint)
    sizes = np.column_stack([WIDTH * footprint / cosine, WIDTH * footprint, thick])
    turned = se3.each_quaternion(view.T_world_camera[:3, :3] @ axes).astype(np.float32)
    return Splats(
        pixels.places_m[rows], turned, sizes.astype(np.float32), pixels.opacity[rows],
        pixels.rgb[rows],
    )  # fmt: skip


def of_depth(depth: DepthMap, mask: Bool, view: TextureView) -> Splats:
    """Gaussians for the pixels of ``view`` whose depth is known where ``mask`` (h, w) says so."""
    return _gaussians(_known_pixels(depth, mask, view), slice(None), view)


@njit(cache=True, nogil=True)
def _normal(depth: F32, K: F64, row: int, col: int, out: F32) -> None:
    """Fill ``out`` (3,) with the surface's normal at a pixel in the camera's axes, towards it; to
    the camera itself where the neighbours belong to other surfaces."""
    n, (h, w) = NORMAL_PX, depth.shape
    x, y = (col - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]
    a, b, c = -x, -y, -1.0
    if n <= row < h - n and n <= col < w - n:
        west, east = float(depth[row, col - n]), float(depth[row, col + n])
        north, south = float(depth[row - n, col]), float(depth[row + n, col])
        rise, fall = east - west, south - north
        limit = np.float32(2 * n * MAX_SLOPE) * depth[row, col]
        if abs(rise) < limit and abs(fall) < limit:
            right = x * rise + n / K[0, 0] * (east + west)
            down = y * fall + n / K[1, 1] * (south + north)
            a, b = down * rise - y * fall * rise, fall * right - x * fall * rise
            c = x * fall * y * rise - down * right
    size = np.sqrt(a * a + b * b + c * c)
    out[0], out[1], out[2] = a / size, b / size, c / size


@njit(cache=True, nogil=True)
def _pixels(
    depth: F32, sigma: F32, views: U8, mask: Bool, K: F64, bgra: U8, K_view: F64, sides: U8
) -> tuple[F32, F32, F32, F32, F32, F32]:  # fmt: skip
    """Of squares of pixels: place and normal (N, 3) in the camera's axes, sigma (N,) m, opacity
    (N,), mean RGB (N, 3) and side (N,)."""
    h, w = depth.shape
    most = np.count_nonzero(sides)
    xyz, normal = np.empty((most, 3), np.float32), np.empty((most, 3), np.float32)
    spread_m, opacity = np.empty(most, np.float32), np.empty(most, np.float32)
    rgb, side_px = np.empty((most, 3), np.float32), np.empty(most, np.float32)
    n = 0
    for row in range(bgra.shape[0]):
        for col in range(bgra.shape[1]):
            side = int(sides[row, col])
            if side == 0:
                continue
            y = (row + 0.5 * (side - 1) - K_view[1, 2]) / K_view[1, 1]
            x = (col + 0.5 * (side - 1) - K_view[0, 2]) / K_view[0, 0]
            u, v = x * K[0, 0] + K[0, 2], y * K[1, 1] + K[1, 2]
            at_u, at_v = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
            if at_u < 0 or at_u >= w or at_v < 0 or at_v >= h or not mask[at_v, at_u]:
                continue
            near = depth[at_v, at_u]
            if not near > 0.0 or not np.isfinite(sigma[at_v, at_u]):
                continue
            u0 = min(max(int(np.floor(u)), 0), max(w - 2, 0))
            v0 = min(max(int(np.floor(v)), 0), max(h - 2, 0))
            total, weights = 0.0, 0.0
            for j in range(v0, min(v0 + 2, h)):
                for i in range(u0, min(u0 + 2, w)):
                    if abs(depth[j, i] - near) < MAX_SLOPE * near:
                        weight = max(1.0 - abs(u - i), 0.0) * max(1.0 - abs(v - j), 0.0)
                        total += weight * depth[j, i]
                        weights += weight
            z = total / weights if weights > 0.0 else near
            xyz[n, 0], xyz[n, 1], xyz[n, 2] = x * z, y * z, z
            _normal(depth, K, at_v, at_u, normal[n])
            for k in range(3):
                total = 0.0
                for j in range(row, row + side):
                    for i in range(col, col + side):
                        total += bgra[j, i, 2 - k]
                rgb[n, k] = total / side**2
            side_px[n] = side
            spread_m[n] = sigma[at_v, at_u]
            agree = max(float(views[at_v, at_u]), 1.0)
            opacity[n] = MAX_OPACITY - (MAX_OPACITY - SINGLE) / agree
            n += 1
    return (
        xyz[:n].copy(),
        normal[:n].copy(),
        spread_m[:n].copy(),
        opacity[:n].copy(),
        rgb[:n].copy(),
        side_px[:n].copy(),
    )


def _axes(xyz: F32, normal: F32) -> tuple[F64, F64]:
    """(N, 3, 3) axes as columns: down the view's slope, across it, and the normal; and (N,) the
    cosine between normal and line of sight."""
    sight = -xyz.astype(np.float64) / np.linalg.norm(xyz, axis=1, keepdims=True)
    up = normal.astype(np.float64)
    along = np.einsum("nk,nk->n", sight, up)
    slope = sight - along[:, None] * up
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    least = np.eye(3)[np.abs(up).argmin(axis=1)]  # where the view is straight, any across
    slope = np.where(length > 1e-3, slope, np.cross(up, least))
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    axes = np.stack([slope, np.cross(up, slope), up], axis=2)
    return axes, np.maximum(np.abs(along), MIN_COSINE)


def _merged(found: Sequence[_Pixels], depths: Sequence[DepthMap]) -> list[I64]:
    """The pixels of each view that stay: without what other views see through, and of squares of
    one size one where several images show a place."""
    first = np.cumsum([0, *(len(one.sigma_m) for one in found)])
    places_m, sigma_m, side_px, opacity = (
        np.concatenate([getattr(one, name) for one in found])
        for name in ("places_m", "sigma_m", "side_px", "opacity")
    )
    seen = np.where(opacity > SINGLE + 1e-3, 2, 1).astype(np.uint8)
    cell_m = MERGED * _footprint_m(found)
    cell, cells, kept = np.empty(len(seen), np.int32), 0, [first[:0]]
    for side in np.unique(side_px):
        some = np.flatnonzero(side_px == side)
        number, keys = _cells(places_m[some], cell_m * float(side))
        cell[some], cells = number + cells, cells + len(keys)
    rest, is_done = np.arange(len(seen)), np.zeros(len(seen), np.bool_)
    while len(rest):  # only the best of each cell are looked at, until none is seen through
        best = _least(rest, cell, sigma_m, cells)
        black = np.zeros((len(best), 3), np.uint8)
        cloud = PointCloud(places_m[best], black, sigma_m[best], seen[best])
        is_false = seen_through(cloud, spread(depths))
        kept.append(best[~is_false])
        again = np.zeros(cells, np.bool_)
        again[cell[best[is_false]]], is_done[best] = True, True
        rest = rest[again[cell[rest]] & ~is_done[rest]]
    stay = np.sort(np.concatenate(kept))
    if len(stay):
        is_lone = _is_lone(places_m[stay], side_px[stay] ** 2, cell_m * (1 << ISLAND_SHIFT))
        stay = stay[~is_lone]
    at = np.searchsorted(stay, first)
    return [stay[a:b] - n for a, b, n in zip(at[:-1], at[1:], first[:-1], strict=True)]


def _footprint_m(found: Sequence[_Pixels]) -> float:
    """The middle one of a pixel; 1 without any."""
    all_m = np.concatenate([one.footprint_m for one in found])
    return float(np.median(all_m)) if len(all_m) else 1.0


@njit(cache=True, nogil=True)
def _cells(xyz: F32, cell_m: float) -> tuple[I32, I64]:
    """(N,) number of the cell that each place lies in, and (C,) the cells' keys."""
    keys, ids = np.full(1 << 16, -1, np.int64), np.zeros(1 << 16, np.int32)
    number, count = np.empty(len(xyz), np.int32), 0
    for n in range(len(xyz)):
        key = voxel_key(xyz[n, 0], xyz[n, 1], xyz[n, 2], 1.0 / cell_m)
        slot = find_slot(keys, key)
        if keys[slot] == -1:
            keys[slot], ids[slot] = key, count
            count += 1
        number[n] = ids[slot]
        if 2 * count > len(keys):
            keys, ids = rehash(keys, ids, 2 * len(keys))
    out = np.full(count, -1, np.int64)
    for slot in range(len(keys)):
        if keys[slot] != -1:
            out[ids[slot]] = keys[slot]
    return number, out


@njit(cache=True, nogil=True)
def _least(rows: I64, cell: I32, sigma_m: F32, cells: int) -> I64:
    """The row of each cell with the least sigma, the first one of equals, rising."""
    best = np.full(cells, -1, np.int64)
    for n in rows:
        held = best[cell[n]]
        if held < 0 or sigma_m[n] < sigma_m[held]:
            best[cell[n]] = n
    return np.sort(best[best >= 0])


def _is_lone(xyz_m: F32, pixels: F32, cell_m: float) -> Bool:
    """(N,) those in pieces of surface of fewer ``pixels`` than ISLAND_POINTS, by cells that
    touch."""
    cell, keys = _cells(xyz_m, cell_m)
    order = np.argsort(keys)
    part = np.empty(len(keys), np.int64)
    part[order] = pieces(keys[order])
    count = np.bincount(part[cell], pixels)
    return np.asarray((count < min(ISLAND_POINTS, count.max()))[part][cell])


def _fillings(
    splats: Splats, views: Sequence[TextureView], surface: Callable[[], Mesh],
    progress: Callable[[str], None],
) -> list[Splats]:  # fmt: skip
    """Gaussians on ``surface`` where views show a hole, which no earlier view has filled."""

    def behind(view: TextureView) -> F32:
        progress("filling holes from the closed surface")
        left = np.ones(view.bgra.shape[:2], np.float32)
        _hide(splats, view, left)
        return left

    out: list[Splats] = []
    lefts = run_parallel(*(partial(behind, v) for v in views))
    reach = rays_onto(surface())
    for view, left in zip(views, lefts, strict=True):
        for one in out:
            _hide(one, view, left)
        hole = (left > 1.0 - COVERED) & (view.bgra[..., 3] > 0)
        if not hole.any():
            continue
        v, u = np.nonzero(cv2.dilate(hole.astype(np.uint8), AROUND) > 0)
        ways = rays(view.K, np.column_stack([u, v]).astype(np.float64))
        length = np.linalg.norm(ways, axis=1)
        T = view.T_world_camera
        found_m = reach(T[:3, 3], (ways / length[:, None]) @ T[:3, :3].T) / length
        depth_m = np.full(hole.shape, np.nan, np.float32)
        depth_m[v, u] = np.where(np.isfinite(found_m), found_m, np.nan)
        sigma_m = (depth_m / np.float32(view.K[0, 0])).astype(np.float32)
        depth = DepthMap(depth_m, sigma_m, np.zeros(hole.shape, np.uint8), view.K, T)
        out.append(of_depth(depth, hole, view))
    return out


def _on_bare(splats: Splats, mesh: Mesh, footprint_m: float) -> Splats:
    """Gaussians of the ``mesh`` where it has none next to it: on walls that the views see too flat,
    or not at all. Their colours run evenly between those around them; without colours of the mesh
    there are none."""
    if mesh.rgb is None or not len(splats):
        return splats.at(np.zeros(0, np.int64))
    step_m = BARE_PX * footprint_m
    number, keys = _cells(np.concatenate([splats.xyz_m, *_spread_over(splats, step_m)]), step_m)
    corners = mesh.vertices_m[mesh.faces]
    a, b, c = np.moveaxis(corners, 1, 0)
    up = np.cross(b - a, c - a)
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)

    def look(faces: I64, apart_m: float) -> tuple[I64, F32, F32, I32]:
        """Triangles, corners' weights, places and cells next to these of a lattice on ``faces``."""
        row, weights = _lattice(mesh.vertices_m, mesh.faces[faces], apart_m)
        face = faces[row]
        places = np.einsum("nk,nkd->nd", weights, corners[face]).astype(np.float32)
        return face, weights, places, _cell_along(places, up[face].astype(np.float32), keys, step_m)

    face, weights, _, cell = look(np.arange(len(mesh.faces)), step_m)
    # A vertex has the colours of the Gaussians around it, in the cells that they lie in.
    number, met = number[: len(splats)], np.flatnonzero(cell >= 0)
    corner, share = mesh.faces[face[met]].ravel(), weights[met].ravel()
    count = np.bincount(number, minlength=len(keys))
    share *= np.repeat(count[cell[met]] > 0, 3)
    total = np.bincount(corner, share, len(mesh.vertices_m))
    is_seen, colour = total > 0, mesh.rgb.astype(np.float64)
    for k in range(3):
        mean = np.bincount(number, splats.rgb[:, k], len(keys)) / np.maximum(count, 1)
        sums = np.bincount(corner, share * np.repeat(mean[cell[met]], 3), len(total))
        colour[is_seen, k] = sums[is_seen] / total[is_seen]
    face, weights, places, cell = look(np.unique(face[cell < 0]), 0.5 * step_m)
    bare = np.flatnonzero(cell < 0)
    face, weights = face[bare], weights[bare]
    rgb = between_seen(mesh.faces, colour, is_seen)[mesh.faces[face]].astype(np.float32)
    along = (b - a)[face]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    q = se3.each_quaternion(np.stack([along, np.cross(up[face], along), up[face]], axis=2))
    sizes = np.full((len(bare), 3), WIDTH * step_m) * [1.0, 1.0, THIN]
    return Splats(
        places[bare], q.astype(np.float32), sizes.astype(np.float32),
        np.full(len(bare), SINGLE, np.float32), np.einsum("nk,nkd->nd", weights, rgb),
    )  # fmt: skip


def _spread_over(splats: Splats, cell_m: float) -> list[F32]:
    """Places (N, 3) all over Gaussians that are wider than such a cell, to one sigma."""
    widest = splats.sigma_m[:, :2].max(axis=1)
    out = []
    for few, some in ((1, (2.0 * widest > cell_m) & (widest <= cell_m)), (2, widest > cell_m)):
        large, ways = splats.at(some), np.arange(-few, few + 1) / few
        for side in ((i, j, 0.0) for i in ways for j in ways if i or j):
            offset = large.sigma_m * np.array(side, np.float32)
            out.append(large.xyz_m + _turned(large.q_wxyz, offset))
    return out


def _turned(q_wxyz: F32, v: F32) -> F32:
    """Vectors (N, 3) turned by unit quaternions (N, 4)."""
    twice = 2.0 * np.cross(q_wxyz[:, 1:], v)
    return np.asarray(v + q_wxyz[:, :1] * twice + np.cross(q_wxyz[:, 1:], twice), np.float32)


@njit(cache=True, nogil=True)
def _lattice(vertices: F64, faces: I32, step_m: float) -> tuple[I64, F32]:
    """Places on triangles at most ``step_m`` apart: the triangle (N,) of each and its corners'
    weights (N, 3)."""
    total = 0
    face, weights = np.empty(0, np.int64), np.empty((0, 3), np.float32)
    for turn in range(2):  # count, then fill
        if turn == 1:
            face, weights, total = np.empty(total, np.int64), np.empty((total, 3), np.float32), 0
        for f in range(len(faces)):
            longest, first = -1.0, 0
            for k in range(3):
                side = vertices[faces[f, (k + 1) % 3]] - vertices[faces[f, k]]
                length = np.sqrt(np.sum(side * side))
                if length > longest:
                    longest, first = length, k
            one, other = vertices[faces[f, first]], vertices[faces[f, (first + 1) % 3]]
            top = vertices[faces[f, (first + 2) % 3]]
            high = np.sqrt(np.sum(np.cross(other - one, top - one) ** 2)) / max(longest, 1e-9)
            rows = max(int(np.ceil(high / step_m)), 1)
            for i in range(rows):  # from the longest side to the corner opposite
                up = (i + 0.5) / rows
                cols = max(int(np.ceil((1.0 - up) * longest / step_m)), 1)
                for j in range(cols if turn == 1 else 0):
                    face[total + j] = f
                    weights[total + j, first] = (1.0 - up) * (1.0 - (j + 0.5) / cols)
                    weights[total + j, (first + 1) % 3] = (1.0 - up) * (j + 0.5) / cols
                    weights[total + j, (first + 2) % 3] = up
                total += cols
    return face, weights


@njit(cache=True, nogil=True)
def _cell_along(places: F32, up: F32, cells: I64, cell_m: float) -> I32:
    """(N,) which of the ``cells`` (C,), by keys, each place lies in, or what is up to BEHIND cells
    from it across the surface (N, 3); -1: none."""
    size = 16
    while size < 2 * len(cells):
        size *= 2
    keys, ids = rehash(cells, np.arange(len(cells)).astype(np.int32), size)
    out = np.full(len(places), -1, np.int32)
    for n in range(len(places)):
        for m in range(4 * BEHIND + 1):
            off = 0.5 * cell_m * ((m + 1) // 2 if m % 2 else -(m // 2))
            x, y = places[n, 0] + off * up[n, 0], places[n, 1] + off * up[n, 1]
            key = voxel_key(x, y, places[n, 2] + off * up[n, 2], 1.0 / cell_m)
            slot = find_slot(keys, key)
            if keys[slot] != -1:
                out[n] = ids[slot]
                break
    return out


def _hide(splats: Splats, view: TextureView, left: F32) -> None:
    """Take from ``left`` (h, w), the share of light from behind, what the Gaussians hide; at least
    until they cover a pixel."""
    _, flat = _projected(splats, view.K, left.shape[::-1], view.T_world_camera)
    _cover(flat, left, 1.0 - COVERED)


def _fitted(
    splats: Splats, views: Sequence[TextureView], progress: Callable[[str], None]
) -> Splats:
    """The Gaussians with colours that reproduce the images better: each takes the mean error of the
    pixels that it colours."""

    def errors(view: TextureView) -> tuple[I32, F32]:
        progress("fitting colours")
        size_px = view.bgra.shape[1], view.bgra.shape[0]
        rows, flat = _projected(splats, view.K, size_px, view.T_world_camera)
        return rows, _errors(flat, *_tiled(flat, *size_px), view.bgra)

    for first in range(SUBSETS):
        sums, subset = np.zeros((len(splats), 4), np.float32), views[first::SUBSETS]
        together = VIEWS_PER_THREAD * threads()
        for at in range(0, len(subset), together):
            for found in run_parallel(*(partial(errors, v) for v in subset[at : at + together])):
                _add_rows(sums, *found)
        rgb = splats.rgb + sums[:, :3] / np.maximum(sums[:, 3:], 0.05)
        splats = replace(splats, rgb=np.clip(rgb, 0, 255))
    return splats


@njit(cache=True, nogil=True)
def _add_rows(sums: F32, rows: I32, found: F32) -> None:
    for m in range(len(rows)):
        for k in range(found.shape[1]):
            sums[rows[m], k] += found[m, k]


def rendered(
    splats: Splats, K: F64, size_px: tuple[int, int], T_world_camera: F64
) -> tuple[F32, F32]:
    """(H, W, 3) RGB over black, 0 to 255, and (H, W) opacity of a view of the Gaussians.

    As the reference draws them: projected to first order, sorted by depth, front to back.
    """
    w, h = size_px
    _, flat = _projected(splats, K, size_px, T_world_camera)
    image = np.empty((h, w, 4), np.float32)
    first, items, _ = _tiled(flat, w, h)
    _draw(flat, first, items, image)
    return image[..., :3], 1.0 - image[..., 3]


Tiled = tuple[I64, I32, int]
"""(T + 1,) where each tile of an image begins in what follows; the Gaussians that reach into the
tiles; the most pixels that those of one tile reach in it together."""


def _widest(K: F64, size_px: tuple[int, int]) -> tuple[float, float]:
    w, h = size_px
    x, y = max(K[0, 2], w - K[0, 2]) / K[0, 0], max(K[1, 2], h - K[1, 2]) / K[1, 1]
    return WIDEST * x, WIDEST * y


def _projected(splats: Splats, K: F64, size_px: tuple[int, int], T: F64) -> tuple[I32, F32]:
    """(M,) the Gaussians that may show in an image, in their own order, and (M, 12) of each: u, v,
    the inverse covariance uu, uv, vv in the image, how many pixels it reaches along u and v,
    opacity, RGB, and its depth, m."""
    rows, flat = np.empty(len(splats), np.int32), np.empty((len(splats), 12), np.float32)
    arrays = (getattr(splats, f.name) for f in fields(splats))
    T_camera_world = np.ascontiguousarray(se3.inverse(T))
    count = _project(*arrays, K, T_camera_world, size_px, _widest(K, size_px), rows, flat)
    return rows[:count], flat[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def _project(
    xyz: F32, q: F32, sigma: F32, opacity: F32, rgb: F32, K: F64, T: F64,
    size_px: tuple[int, int], widest: tuple[float, float], rows: I32, out: F32,
) -> int:  # fmt: skip
    """Fill ``rows`` and ``out``; of how many. A bound of how far each reaches in the image says
    which."""
    length = K[0, 0] * np.sqrt(1.0 + widest[0] ** 2), K[1, 1] * np.sqrt(1.0 + widest[1] ** 2)
    m = 0
    for n in range(len(xyz)):
        z = T[2, 0] * xyz[n, 0] + T[2, 1] * xyz[n, 1] + T[2, 2] * xyz[n, 2] + T[2, 3]
        if z <= 0.1:
            continue
        x = (T[0, 0] * xyz[n, 0] + T[0, 1] * xyz[n, 1] + T[0, 2] * xyz[n, 2] + T[0, 3]) / z
        y = (T[1, 0] * xyz[n, 0] + T[1, 1] * xyz[n, 1] + T[1, 2] * xyz[n, 2] + T[1, 3]) / z
        u, v = K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]
        longest = max(sigma[n, 0], sigma[n, 1], sigma[n, 2]) / z
        reach_u = REACH * np.sqrt(LOW_PASS_PX2 + (length[0] * longest) ** 2)
        reach_v = REACH * np.sqrt(LOW_PASS_PX2 + (length[1] * longest) ** 2)
        if not (-reach_u < u < size_px[0] + reach_u and -reach_v < v < size_px[1] + reach_v):
            continue
        fx, fy = K[0, 0] / z, K[1, 1] / z
        slope_x = min(max(x, -widest[0]), widest[0])
        slope_y = min(max(y, -widest[1]), widest[1])
        # What a step along each axis of the world moves in the image; then along its own axes.
        u0, v0 = fx * (T[0, 0] - slope_x * T[2, 0]), fy * (T[1, 0] - slope_y * T[2, 0])
        u1, v1 = fx * (T[0, 1] - slope_x * T[2, 1]), fy * (T[1, 1] - slope_y * T[2, 1])
        u2, v2 = fx * (T[0, 2] - slope_x * T[2, 2]), fy * (T[1, 2] - slope_y * T[2, 2])
        w, a, b, c = (
            np.float64(q[n, 0]),
            np.float64(q[n, 1]),
            np.float64(q[n, 2]),
            np.float64(q[n, 3]),
        )
        uu, uv, vv = LOW_PASS_PX2, 0.0, LOW_PASS_PX2
        for s, r0, r1, r2 in (
            (sigma[n, 0], 0.5 - b * b - c * c, a * b + w * c, a * c - w * b),
            (sigma[n, 1], a * b - w * c, 0.5 - a * a - c * c, b * c + w * a),
            (sigma[n, 2], a * c + w * b, b * c - w * a, 0.5 - a * a - b * b),
        ):
            du = 2.0 * s * (r0 * u0 + r1 * u1 + r2 * u2)
            dv = 2.0 * s * (r0 * v0 + r1 * v1 + r2 * v2)
            uu += du * du
            uv += du * dv
            vv += dv * dv
        det = uu * vv - uv * uv
        out[m, 0], out[m, 1] = u, v
        out[m, 2], out[m, 3], out[m, 4] = vv / det, -uv / det, uu / det
        out[m, 5], out[m, 6] = REACH * np.sqrt(uu), REACH * np.sqrt(vv)
        out[m, 7], out[m, 8], out[m, 9] = opacity[n], rgb[n, 0], rgb[n, 1]
        out[m, 10], out[m, 11] = rgb[n, 2], z
        rows[m] = n
        m += 1
    return m


@njit(cache=True, nogil=True, inline="always")
def _span(middle: float, reach: float, first: int, end: int) -> tuple[int, int]:
    return max(int(np.ceil(middle - reach)), first), min(int(np.floor(middle + reach)) + 1, end)


TILE_PX = 64
"""Side of the squares that an image is drawn in: of one all pixels and shares stay in the cache."""


@njit(cache=True, nogil=True)
def _tiled(flat: F32, w: int, h: int) -> tuple[I64, I32, int]:
    """The tiles, row by row, of the Gaussians ``flat`` (M, 12)."""
    across, down = -(-w // TILE_PX), -(-h // TILE_PX)
    first, reached = np.zeros(across * down + 2, np.int64), np.zeros(across * down, np.int64)
    items = np.empty(0, np.int32)
    for turn in range(2):  # count, then fill
        for n in range(len(flat)):
            top, bottom = _span(flat[n, 1], flat[n, 6], 0, h)
            left, right = _span(flat[n, 0], flat[n, 5], 0, w)
            if top >= bottom or left >= right:
                continue
            for y in range(top // TILE_PX, (bottom - 1) // TILE_PX + 1):
                rows = min(bottom, (y + 1) * TILE_PX) - max(top, y * TILE_PX)
                for x in range(left // TILE_PX, (right - 1) // TILE_PX + 1):
                    tile = y * across + x
                    if turn == 0:
                        cols = min(right, (x + 1) * TILE_PX) - max(left, x * TILE_PX)
                        reached[tile] += rows * cols
                        first[tile + 2] += 1
                    else:
                        items[first[tile + 1]] = n
                        first[tile + 1] += 1
        if turn == 0:
            first = np.cumsum(first)
            items = np.empty(first[-1], np.int32)
    return first[:-1], items, reached.max()


DIGIT_BITS = 11


@njit(cache=True, nogil=True)
def _sort(flat: F32, items: I32) -> None:
    """Put Gaussians in order of depth, those equally near, of which flat ground has many, in their
    own order on every machine: by digits of the bits of these positive numbers."""
    depth = np.empty(len(items), np.float32)
    for k in range(len(items)):
        depth[k] = flat[items[k], 11]
    keys = depth.view(np.uint32)
    keys -= keys.min() if len(keys) else np.uint32(0)
    most, shift, sorted_items = keys.max() if len(keys) else np.uint32(0), 0, items
    other_keys, other = keys.copy(), items.copy()
    while most >> shift:
        place = np.zeros((1 << DIGIT_BITS) + 1, np.int64)
        for key in keys:
            place[((key >> shift) & ((1 << DIGIT_BITS) - 1)) + 1] += 1
        place = np.cumsum(place)
        for k in range(len(keys)):
            digit = (keys[k] >> shift) & ((1 << DIGIT_BITS) - 1)
            other_keys[place[digit]], other[place[digit]] = keys[k], sorted_items[k]
            place[digit] += 1
        keys, other_keys, sorted_items, other = other_keys, keys, other, sorted_items
        shift += DIGIT_BITS
    items[:] = sorted_items


FAINTEST = 5.6
"""Half the square of the sigmas from a Gaussian's middle to where it hides nothing."""

_FADING = np.exp(-FAINTEST * np.arange(1025) / 1024).astype(np.float32)
FADING = np.column_stack([_FADING[:-1], np.diff(_FADING)])
"""(1024, 2) how much a Gaussian hides so many 1024ths of FAINTEST from its middle, and what the
next one differs by."""


@njit(cache=True, nogil=True)
def _alpha(far: float, opacity: float) -> float:
    """How much a Gaussian hides at ``far`` 1024ths of FAINTEST from its middle, 0 to below 1024."""
    step = np.uint32(far)
    near = FADING[step, 0] + (far - np.float32(step)) * FADING[step, 1]
    alpha: float = min(opacity * near, np.float32(LARGEST_ALPHA))
    return alpha


@njit(cache=True, nogil=True)
def _blend(
    flat: F32, items: I32, top: int, left: int, h: int, w: int, light: F32, shares: F32
) -> None:  # fmt: skip
    """Draw Gaussians one behind the other in a tile of (h, w) pixels from row ``top`` and column
    ``left`` of the image.

    ``light`` (TILE_PX**2, 4) is made: colours over black and the share of light that comes from
    behind; a pixel with less than DONE of it takes no more. ``shares`` takes the share of each
    Gaussian of the light of each pixel that it reaches; none, of none, are not kept.
    """
    keeps = shares.size > 0
    scale = np.float32(1024.0 / FAINTEST)
    half = scale * np.float32(0.5)
    least, enough = np.float32(SMALLEST_ALPHA), np.float32(DONE)
    zero, end = np.float32(0.0), np.float32(1024.0)
    at, one = np.uint64(0), np.uint64(1)  # without a sign none counts from the end
    light[:, :3], light[:, 3] = 0.0, 1.0
    for n in items:
        u, v, reach_u, reach_v = flat[n, 0], flat[n, 1], flat[n, 5], flat[n, 6]
        uu, uv, vv = half * flat[n, 2], scale * flat[n, 3], half * flat[n, 4]
        first_row, last_row = _span(v, reach_v, top, top + h)
        first, last = _span(u, reach_u, left, left + w)
        opacity, red, green, blue = flat[n, 7], flat[n, 8], flat[n, 9], flat[n, 10]
        for row in range(first_row, last_row):
            dv = np.float32(row) - v
            along, across = uv * dv, vv * dv * dv
            p = np.uint64((row - top) * TILE_PX + first - left)
            for col in range(first, last):
                # Without branches: half of them would be guessed wrong.
                du, before = np.float32(col) - u, light[p, 3]
                far = (uu * du + along) * du + across
                is_near = far < end  # also no NaN, nor what no integer holds
                far = max(far, zero) if is_near else zero
                alpha = _alpha(far, opacity)
                share = alpha * before
                share = share if is_near & (alpha >= least) & (before >= enough) else zero
                light[p, 0] += share * red
                light[p, 1] += share * green
                light[p, 2] += share * blue
                light[p, 3] = before - share
                p += one
                if keeps:
                    shares[at] = share
                    at += one


@njit(cache=True, nogil=True)
def _draw_tile(
    flat: F32, first: I64, items: I32, tile: int, h: int, w: int, light: F32, shares: F32
) -> tuple[I32, int, int, int, int]:  # fmt: skip
    """Draw one tile of an image (h, w), as :func:`_blend`; its Gaussians, now from the nearest on,
    its first row and column, and how many rows and columns it has."""
    across = -(-w // TILE_PX)
    top, left = tile // across * TILE_PX, tile % across * TILE_PX
    rows, cols = min(TILE_PX, h - top), min(TILE_PX, w - left)
    some = items[first[tile] : first[tile + 1]]
    _sort(flat, some)
    _blend(flat, some, top, left, rows, cols, light, shares)
    return some, top, left, rows, cols


@njit(cache=True, nogil=True)
def _draw(flat: F32, first: I64, items: I32, image: F32) -> None:
    """Fill ``image`` (h, w, 4): colours over black and the share of light from behind."""
    h, w = image.shape[:2]
    light, none = np.empty((TILE_PX * TILE_PX, 4), np.float32), np.empty(0, np.float32)
    for tile in range(len(first) - 1):
        _, top, left, rows, cols = _draw_tile(flat, first, items, tile, h, w, light, none)
        for row in range(rows):
            for col in range(cols):
                image[top + row, left + col] = light[row * TILE_PX + col]


@njit(cache=True, nogil=True)
def _errors(flat: F32, first: I64, items: I32, most: int, bgra: U8) -> F32:
    """(M, 4) of each Gaussian, sums over its pixels by its share of them: what an image has more of
    red, green and blue than they show, and of these shares; holes do not count."""
    h, w = bgra.shape[:2]
    light = np.empty((TILE_PX * TILE_PX, 4), np.float32)
    shares, sums = np.empty(max(most, 1), np.float32), np.zeros((len(flat), 4), np.float32)
    for tile in range(len(first) - 1):
        some, top, left, rows, cols = _draw_tile(flat, first, items, tile, h, w, light, shares)
        for row in range(rows):
            for col in range(cols):
                p = row * TILE_PX + col
                counts = bgra[top + row, left + col, 3] > 0 and light[p, 3] <= 1.0 - COVERED
                for k in range(3):
                    off = np.float32(bgra[top + row, left + col, 2 - k]) - light[p, k]
                    light[p, k] = off if counts else 0.0
                light[p, 3] = counts
        _back(flat, some, top, left, rows, cols, light, shares, sums)
    return sums


@njit(cache=True, nogil=True)
def _cover(flat: F32, left: F32, done: float) -> None:
    """What :func:`_blend` does to the share of light ``left`` (h, w), with branches: most pixels
    are soon covered."""
    (h, w), light = left.shape, left.reshape(-1)
    scale = np.float32(1024.0 / FAINTEST)
    half = scale * np.float32(0.5)
    least, enough = np.float32(SMALLEST_ALPHA), np.float32(done)
    zero, end, one = np.float32(0.0), np.float32(1024.0), np.uint64(1)
    for n in range(flat.shape[0]):
        u, v, reach_u, reach_v = flat[n, 0], flat[n, 1], flat[n, 5], flat[n, 6]
        uu, uv, vv = half * flat[n, 2], scale * flat[n, 3], half * flat[n, 4]
        first_row, last_row = _span(v, reach_v, 0, h)
        first, last = _span(u, reach_u, 0, w)
        for row in range(first_row, last_row):
            dv = np.float32(row) - v
            along, across = uv * dv, vv * dv * dv
            p = np.uint64(row * w + first)
            for col in range(first, last):
                before = light[p]
                if before >= enough:
                    du = np.float32(col) - u
                    far = (uu * du + along) * du + across
                    if far < end:
                        alpha = _alpha(max(far, zero), flat[n, 7])
                        if alpha >= least:
                            light[p] = before - alpha * before
                p += one


@njit(cache=True, nogil=True)
def _back(
    flat: F32, items: I32, top: int, left: int, h: int, w: int, error: F32, shares: F32, sums: F32
) -> None:  # fmt: skip
    """Add to ``sums`` those of the ``error`` (TILE_PX**2, 4) of a tile, by the ``shares`` that
    :func:`_blend` found."""
    at, one = np.uint64(0), np.uint64(1)
    for n in items:
        first_row, last_row = _span(flat[n, 1], flat[n, 6], top, top + h)
        first, last = _span(flat[n, 0], flat[n, 5], left, left + w)
        red = green = blue = total = np.float32(0.0)
        for row in range(first_row, last_row):
            p = np.uint64((row - top) * TILE_PX + first - left)
            for _ in range(first, last):
                share = shares[at]
                red += share * error[p, 0]
                green += share * error[p, 1]
                blue += share * error[p, 2]
                total += share * error[p, 3]
                at += one
                p += one
        sums[n, 0] += red
        sums[n, 1] += green
        sums[n, 2] += blue
        sums[n, 3] += total
