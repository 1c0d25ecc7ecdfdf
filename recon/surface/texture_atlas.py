"""Charts of one view each, packed into one image and painted from the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse import csgraph

from recon.mapping.free_space import pixel_of
from recon.parallel import parallel_for
from recon.surface.meshing import Mesh
from recon.surface.texture_views import TextureView, TriangleViews, doubled_area, steady_normals
from recon.types import F32, F64, I32, I64, U8, Array, Bool

BORDER_PX = 2
"""Texels around a chart that repeat its colours, for filtering and the first mip levels."""

MARGIN_PX = 1.5
"""Texels so far from a chart are painted as if it went on: four around a place at its edge, and all
of a triangle so narrow that no texel's centre lies in it."""

MIN_WEIGHT = -2.0
"""Of a corner, for a place beyond the edge opposite: farther out a sliver goes on along its longest
edge, as its own plane leads anywhere."""

MAX_SCALE, MIN_SCALE = 2.0, 1 / 64
HEIGHT_STEP = 1.25
"""Charts whose heights differ by no more than this factor may share a shelf."""

UNSEEN_TEXELS = 4.0
"""Of a triangle that no view sees, in the mean: its colours run evenly from corner to corner."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Where each corner of each triangle lies in the atlas."""

    uv_px: F64  # (F, 3, 2) texels from the upper left corner; a texel's centre is at .5
    chart: I32  # (F,)
    size_px: tuple[int, int]  # (w, h)
    scale: float  # texels per pixel of the images


def lay_out(
    mesh: Mesh, views: Sequence[TextureView], label: I32, neighbours: I32, largest_px: int
) -> Layout:
    """The atlas of triangles labelled with their view (-1: none), no side above ``largest_px``.

    The mesh needs ``rgb``. A chart is a connected piece of one label, as the view sees it; of
    triangles without a view, as seen from the side of an axis that they face most. Charts are
    packed in shelves by height, those of like brightness next to each other; when they do not fit,
    all are scaled down, to MIN_SCALE at least: their borders keep their size, and may need a larger
    atlas.
    """
    assert mesh.rgb is not None
    label, uv = label.copy(), _seen_uv(mesh, views, label)
    unseen = np.flatnonzero(label < 0)
    side, uv[unseen] = _flattened(mesh.vertices_m[mesh.faces], neighbours, unseen)
    label[unseen] = -1 - side
    chart = _charts(label, neighbours)
    brightness = np.bincount(chart, mesh.rgb[mesh.faces].mean(axis=(1, 2))) / np.bincount(chart)
    scale = _scale_for(uv[label >= 0])
    while True:
        low, size = _boxes(uv * scale, chart)
        place, (w, h) = pack(size, brightness)
        if max(w, h) <= largest_px or scale < MIN_SCALE:
            break
        scale *= 0.98 * largest_px / max(w, h)
    out = uv * scale + (place + BORDER_PX - low)[chart, None]
    return Layout(out, chart, (int(w), int(h)), scale)


def _flattened(corners: F64, neighbours: I32, some: I64) -> tuple[I64, F64]:
    """Of ``some`` triangles (F, 3, 3): the side (N,) that each faces most, one of two for each
    axis, as both sides of a thin wall would lie on each other; its corners (N, 3, 2) seen along
    that axis, in texels."""
    area, normal = steady_normals(corners, neighbours)
    axis = np.asarray(np.abs(normal[some]).argmax(axis=1), np.int64)
    side = 2 * axis + (normal[some, axis] < 0.0)
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    texels = np.sqrt(UNSEEN_TEXELS * len(some) / max(float(area[some].sum()), 1e-9))
    return side, np.take_along_axis(corners[some], others[:, None], axis=2) * texels


def _scale_for(uv: F64) -> float:
    """1, or up to MAX_SCALE where a middling triangle would cover fewer than four texels."""
    if not len(uv):
        return 1.0
    area = 0.5 * float(np.median(doubled_area(uv)))
    return float(np.clip(np.sqrt(4.0 / max(area, 1e-9)), 1.0, MAX_SCALE))


def _charts(label: I32, neighbours: I32) -> I32:
    """(F,) number of the connected piece of one label."""
    f, e = np.nonzero(neighbours >= 0)
    g = neighbours[f, e]
    same = label[f] == label[g]
    count = len(label)
    graph = sparse.csr_matrix(
        (np.ones(int(same.sum()), np.int8), (f[same], g[same])), shape=(count, count)
    )
    return np.asarray(csgraph.connected_components(graph, directed=False)[1], np.int32)


def _seen_uv(mesh: Mesh, views: Sequence[TextureView], label: I32) -> F64:
    """(F, 3, 2) corners in the image of each triangle's view, in pixels from its corner."""
    out = np.zeros((len(label), 3, 2))
    for number in np.unique(label[label >= 0]):
        view, faces = views[number], np.flatnonzero(label == number)
        T = view.T_world_camera
        local = (mesh.vertices_m[mesh.faces[faces]] - T[:3, 3]) @ T[:3, :3]
        px = local[..., :2] / local[..., 2:] * view.K[[0, 1], [0, 1]] + view.K[:2, 2]
        out[faces] = px + 0.5
    return out


def _boxes(uv: F64, chart: I32) -> tuple[F64, I64]:
    """Whole upper left corner (C, 2) of each chart and its size (C, 2) with border."""
    count = int(chart.max(initial=-1)) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for corner in range(3):
        np.minimum.at(low, chart, uv[:, corner])
        np.maximum.at(high, chart, uv[:, corner])
    low = np.floor(low)
    return low, (np.ceil(high) - low).astype(np.int64) + 2 * BORDER_PX


def pack(size: I64, brightness: F64) -> tuple[F64, tuple[int, int]]:
    """Upper left corners (C, 2) of (C, 2) rectangles in shelves, and the (w, h) of the whole.

    Of about one height, those of like ``brightness`` (C,) lie together: from far away a viewer
    takes a texel of a coarse mip level, the mean of several small charts.
    """
    area = float((size[:, 0] * size[:, 1]).sum())
    width = int(max(np.ceil(np.sqrt(1.1 * area)), size[:, 0].max(initial=1)))
    place = np.zeros((len(size), 2))
    x = y = shelf = 0
    height = np.ceil(np.log(np.maximum(size[:, 1], 1)) / np.log(HEIGHT_STEP))
    up_and_down = np.where(height % 2 == 0, brightness, -brightness)  # no jump between heights
    for n in np.lexsort((up_and_down, -height)):
        w, h = int(size[n, 0]), int(size[n, 1])
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        place[n] = x, y
        x, shelf = x + w, max(shelf, h)
    return place, (max(width, 1), max(y + shelf, 1))


class Images(NamedTuple):
    """Views for compiled functions."""

    pixels: U8  # BGRA of all views, one after the other
    start: I64  # (V,) where each begins
    sides: I64  # (V, 2) h, w
    K: F64  # (V, 3, 3)
    T: F64  # (V, 3, 4) world to camera
    levels: F32  # (V, 3, 2) gain and offset, BGR


def images_of(views: Sequence[TextureView], levels: F32, fields: Sequence[F32] = ()) -> Images:
    """The views, times their ``fields`` (rows, cols, 4) where there are some."""
    sides = np.array([v.bgra.shape[:2] for v in views], np.int64).reshape(-1, 2)
    ends = np.cumsum(4 * sides[:, 0] * sides[:, 1])
    pixels = np.empty(int(ends[-1]) if len(ends) else 0, np.uint8)
    for n, (view, end) in enumerate(zip(views, ends, strict=True)):
        bgra: Array = view.bgra
        if fields:
            factor = cv2.resize(fields[n], bgra.shape[1::-1], interpolation=cv2.INTER_LINEAR)
            bgra = cv2.multiply(bgra, factor, dtype=cv2.CV_8U)
        pixels[end - bgra.size : end] = bgra.ravel()
    K = np.array([v.K for v in views], np.float64).reshape(-1, 3, 3)
    T = np.array([np.linalg.inv(v.T_world_camera)[:3] for v in views]).reshape(-1, 3, 4)
    return Images(pixels, ends - 4 * sides[:, 0] * sides[:, 1], sides, K, T, levels)


class Palette(NamedTuple):
    """Images and weights that the texels are mixed from."""

    images: Images
    fade_view: I32  # (V, B)
    fade_share: F32  # (V, B)
    rgb: U8  # (V, 3) where no view has colour


class Painted(NamedTuple):
    """A mesh with its views, for compiled functions."""

    vertices: F64  # (V, 3)
    faces: I32  # (F, 3)
    uv: F64  # (F, 3, 2) texels
    label: I32  # (F,) the view of each triangle
    seen: I32  # (F, CANDIDATES) the views that see it


def paint(
    mesh: Mesh, layout: Layout, found: TriangleViews, label: I32, neighbours: I32, palette: Palette
) -> U8:
    """(h, w, 3) RGB atlas: each texel the mix of the views that fade there; around each chart its
    views go on, so that a viewer's mean of four texels shows no line where charts meet, and beyond
    its colours, so that smaller images of the atlas show none either."""
    w, h = layout.size_px
    image = np.zeros((h, w, 3), np.uint8)
    done = np.zeros((h, w), np.bool_)
    chart = layout.chart
    is_border = ((neighbours < 0) | (chart[neighbours] != chart[:, None])).any(axis=1)
    vertices = np.ascontiguousarray(mesh.vertices_m, np.float64)
    surface = Painted(vertices, mesh.faces, layout.uv_px, label, found.view)
    for faces, margin_px in (
        (np.arange(len(label)), 0.0), (np.flatnonzero(is_border), MARGIN_PX),
    ):  # fmt: skip
        parallel_for(_paint, h, faces, margin_px, surface, palette, image, done)
    fill(image, done)
    return image


def fill(image: U8, done: Bool) -> None:
    """Give texels that are not ``done`` the mean of those around that are.

    By ever smaller images (pull-push, Gortler et al. 1996, doi:10.1145/237170.237200).
    """
    if done.all() or done.size == 1:
        return
    small, known = _halved(image, done)
    fill(small, known)
    _take(small, image, done)


@njit(cache=True, nogil=True)
def _halved(image: U8, done: Bool) -> tuple[U8, Bool]:  # pragma: no cover - compiled
    """The means of two by two texels, of those that are ``done``, and where there is one."""
    h, w = done.shape
    small = np.zeros(((h + 1) // 2, (w + 1) // 2, 3), np.uint8)
    known = np.zeros(small.shape[:2], np.bool_)
    for row in range(small.shape[0]):
        for col in range(small.shape[1]):
            total, count = np.zeros(3), 0
            for i in range(2 * row, min(2 * row + 2, h)):
                for j in range(2 * col, min(2 * col + 2, w)):
                    if done[i, j]:
                        count += 1
                        for k in range(3):
                            total[k] += image[i, j, k]
            if count:
                known[row, col] = True
                for k in range(3):
                    small[row, col, k] = np.uint8(total[k] / count + 0.5)
    return small, known


@njit(cache=True, nogil=True)
def _take(small: U8, image: U8, done: Bool) -> None:  # pragma: no cover - compiled
    for row in range(done.shape[0]):
        for col in range(done.shape[1]):
            if not done[row, col]:
                for k in range(3):
                    image[row, col, k] = small[row // 2, col // 2, k]


@njit(cache=True, nogil=True, error_model="numpy")
def sample(
    images: Images, number: int, u: float, v: float, out: F64
) -> float:  # pragma: no cover - compiled
    """Bilinear colour of a view into ``out`` (3,), weighted by alpha; the alpha 0 to 1 there."""
    out[0] = out[1] = out[2] = 0.0
    h, w = images.sides[number, 0], images.sides[number, 1]
    if not (0.0 <= u <= w - 1.0 and 0.0 <= v <= h - 1.0):
        return 0.0
    i, j = min(int(v), h - 2), min(int(u), w - 2)
    a, b = v - i, u - j
    alpha, pixels = 0.0, images.pixels
    for di in range(2):
        for dj in range(2):
            at = images.start[number] + 4 * ((i + di) * w + j + dj)
            share = (a if di else 1.0 - a) * (b if dj else 1.0 - b) * pixels[at + 3] / 255.0
            alpha += share
            for c in range(3):
                out[c] += share * pixels[at + c]
    if alpha > 1e-3:
        for c in range(3):
            out[c] /= alpha
    return alpha


@njit(cache=True, nogil=True, error_model="numpy")
def add_view(
    images: Images, number: int, x: float, y: float, z: float, weight: float, colour: F64, out: F64
) -> float:  # pragma: no cover - compiled
    """Add a view's levelled colour of a place, weighted, to ``out`` (3,); the weight added.

    ``colour`` (3,) is room for it.
    """
    u, v, _ = pixel_of(images.K[number], images.T[number], x, y, z)
    weight *= sample(images, number, u, v, colour)
    for c in range(3):
        levels = images.levels[number, c]
        out[c] += weight * (levels[0] * colour[c] + levels[1])
    return weight


class _Mixed(NamedTuple):
    """The views that are mixed in one triangle; room for a texel's colours."""

    views: I32  # (3 B + 1,) each once
    shares: F64  # (3 B + 1, 3) of these views at the corners
    colour: F64  # (3,)
    total: F64  # (3,)


@njit(cache=True, nogil=True)
def _gather(
    f: int, surface: Painted, palette: Palette, mixed: _Mixed
) -> int:  # pragma: no cover - compiled
    """Find the views that are mixed in triangle ``f``; how many."""
    blended, count = palette.fade_view.shape[1], 0
    for n in range(len(mixed.views)):
        vertex = surface.faces[f, min(n // blended, 2)]
        is_own = n == 3 * blended
        view = surface.label[f] if is_own else palette.fade_view[vertex, n % blended]
        for one in surface.seen[f]:
            if one == view and view >= 0:
                slot = 0
                while slot < count and mixed.views[slot] != view:
                    slot += 1
                if slot == count:
                    mixed.views[slot], mixed.shares[slot] = view, 0.0
                    count += 1
                if is_own:
                    mixed.shares[slot] += 1e-2  # should no other show anything
                else:
                    mixed.shares[slot, n // blended] += palette.fade_share[vertex, n % blended]
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _texel(
    f: int, a: float, b: float, c: float, surface: Painted, palette: Palette, mixed: _Mixed,
    count: int, out: U8,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """The colour of the place with weights a, b, c of the corners of triangle ``f``."""
    p, q, r = surface.faces[f, 0], surface.faces[f, 1], surface.faces[f, 2]
    one, two, three = surface.vertices[p], surface.vertices[q], surface.vertices[r]
    x = a * one[0] + b * two[0] + c * three[0]
    y = a * one[1] + b * two[1] + c * three[1]
    z = a * one[2] + b * two[2] + c * three[2]
    mixed.total[:] = whole = 0.0
    for n in range(count):
        share = a * mixed.shares[n, 0] + b * mixed.shares[n, 1] + c * mixed.shares[n, 2]
        if share >= 1e-2:
            view = mixed.views[n]
            whole += add_view(palette.images, view, x, y, z, share, mixed.colour, mixed.total)
    rgb = palette.rgb
    for k in range(3):
        if whole > 1e-3:
            value = mixed.total[2 - k] / whole
        else:
            value = a * rgb[p, k] + b * rgb[q, k] + c * rgb[r, k]
        out[k] = np.uint8(min(max(value + 0.5, 0.0), 255.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _on_longest_edge(
    uv: F64, x: float, y: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Weights of the corners (3, 2) for the place on the longest edge that is next to (x, y)."""
    longest, first = -1.0, 0
    for k in range(3):
        length = (uv[(k + 1) % 3, 0] - uv[k, 0]) ** 2 + (uv[(k + 1) % 3, 1] - uv[k, 1]) ** 2
        if length > longest:
            longest, first = length, k
    p, q = uv[first], uv[(first + 1) % 3]
    along = ((x - p[0]) * (q[0] - p[0]) + (y - p[1]) * (q[1] - p[1])) / longest
    along = min(max(along, 0.0), 1.0)
    if first == 0:
        return 1.0 - along, along, 0.0
    if first == 1:
        return 0.0, 1.0 - along, along
    return along, 0.0, 1.0 - along


@njit(cache=True, nogil=True, error_model="numpy")
def _paint(
    begin: int, end: int, painted: I64, margin: float, surface: Painted, palette: Palette,
    image: U8, done: Bool,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Fill the texels of some rows whose centres lie in the ``painted`` triangles; with a
    ``margin`` those that are not ``done`` so near to one."""
    width = done.shape[1]
    vertices, faces, T = surface.vertices, surface.faces, palette.images.T
    most = 3 * palette.fade_view.shape[1] + 1
    mixed = _Mixed(np.empty(most, np.int32), np.empty((most, 3)), np.empty(3), np.empty(3))
    depth, least = np.empty(3), np.empty(3)
    for f in painted:
        uv, own = surface.uv[f], surface.label[f]
        ax, ay, bx, by, cx, cy = uv[0, 0], uv[0, 1], uv[1, 0], uv[1, 1], uv[2, 0], uv[2, 1]
        y0 = max(begin, int(np.ceil(min(ay, by, cy) - margin - 0.5)))
        y1 = min(end - 1, int(np.floor(max(ay, by, cy) + margin - 0.5)))
        if y0 > y1:
            continue
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        for k in range(3):  # depths in the own view, for a true perspective inside
            p = faces[f, k]
            depth[k] = 1.0
            if own >= 0:
                depth[k] = T[own, 2, 3]
                for d in range(3):
                    depth[k] += T[own, 2, d] * vertices[p, d]
        least[:] = -1e-9
        if margin > 0.0 and area != 0.0:
            reach = margin / abs(area)
            least[0] = -reach * np.hypot(cx - bx, cy - by)
            least[1] = -reach * np.hypot(ax - cx, ay - cy)
            least[2] = -reach * np.hypot(bx - ax, by - ay)
        x0 = max(0, int(np.ceil(min(ax, bx, cx) - margin - 0.5)))
        x1 = min(width - 1, int(np.floor(max(ax, bx, cx) + margin - 0.5)))
        count = _gather(f, surface, palette, mixed)
        for row in range(y0, y1 + 1):
            for col in range(x0, x1 + 1):
                if margin > 0.0 and done[row, col]:
                    continue
                a = b = c = 1.0 / 3.0
                if area != 0.0:
                    px, py = col + 0.5 - ax, row + 0.5 - ay
                    b = (px * (cy - ay) - (cx - ax) * py) / area
                    c = ((bx - ax) * py - px * (by - ay)) / area
                    a = 1.0 - b - c
                elif margin == 0.0:
                    continue
                if a < least[0] or b < least[1] or c < least[2]:
                    continue
                if min(a, b, c) < MIN_WEIGHT:
                    a, b, c = _on_longest_edge(uv, col + 0.5, row + 0.5)
                a, b, c = a / depth[0], b / depth[1], c / depth[2]
                whole = a + b + c
                _texel(
                    f, a / whole, b / whole, c / whole, surface, palette, mixed, count,
                    image[row, col],
                )  # fmt: skip
                done[row, col] = True
