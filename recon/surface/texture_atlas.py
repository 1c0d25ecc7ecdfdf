"""Charts of one view each, packed into one image and painted from the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse import csgraph

from recon.mapping.free_space import pixel_of
from recon.surface.meshing import Mesh
from recon.surface.texture_views import TextureView, TriangleViews, doubled_area
from recon.types import F32, F64, I32, I64, U8, Bool

BORDER_PX = 2
"""Texels around a chart that repeat its colours, for filtering and the first mip levels."""

MARGIN_PX = 1.5
"""Texels so far from a chart are painted as if it went on: four around a place at its edge, and all
of a triangle so narrow that no texel's centre lies in it."""

MIN_WEIGHT = -2.0
"""Of a corner, for a place beyond the edge opposite: farther out a sliver goes on along its longest
edge, as its own plane leads anywhere."""

MAX_SCALE, MIN_SCALE = 2.0, 1 / 64
BAND_ROWS = 512
"""Rows of the atlas whose borders are made at a time."""

HEIGHT_STEP = 1.25
"""Charts whose heights differ by no more than this factor may share a shelf."""

CELL_PX = 4
"""Side of the square that holds a triangle which no view sees."""


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

    The mesh needs ``rgb``. A chart is a connected piece of one label, as the view sees it. Charts
    are packed in shelves by height, those of like brightness next to each other; when they do not
    fit, all are scaled down, to MIN_SCALE at least: their borders and triangles without a view keep
    their size, and may need a larger atlas.
    """
    assert mesh.rgb is not None
    chart = _charts(label, neighbours)
    uv = _seen_uv(mesh, views, label)
    brightness = mesh.rgb[mesh.faces].mean(axis=(1, 2))
    lone = np.flatnonzero(label < 0)
    lone = lone[np.argsort(brightness[lone], kind="stable")]
    scale = _scale_for(uv[label >= 0])
    count = np.bincount(chart[chart >= 0])
    of_chart = np.append(np.bincount(chart[chart >= 0], brightness[chart >= 0]) / count, 0.0)
    while True:
        low, size = _boxes(uv * scale, chart)
        columns = max(1, int(np.sqrt(len(lone))))
        block = np.array([[columns, -(-len(lone) // columns)]], np.int64) * CELL_PX
        place, (w, h) = pack(np.concatenate([size, block]), of_chart)
        if max(w, h) <= largest_px or scale < MIN_SCALE:
            break
        scale *= 0.98 * largest_px / max(w, h)
    out = uv * scale
    seen = label >= 0
    shift = place[:-1] + BORDER_PX - low
    out[seen] += shift[chart[seen], None]
    n = np.arange(len(lone))
    cell = place[-1] + CELL_PX * np.column_stack([n % columns, n // columns])
    out[lone] = cell[:, None] + np.array([[0.5, 0.5], [3.5, 0.5], [0.5, 3.5]])
    number = chart.copy()
    number[lone] = len(size) + n
    return Layout(out, number.astype(np.int32), (int(w), int(h)), scale)


def _scale_for(uv: F64) -> float:
    """1, or up to MAX_SCALE where a middling triangle would cover fewer than four texels."""
    if not len(uv):
        return 1.0
    area = 0.5 * float(np.median(doubled_area(uv)))
    return float(np.clip(np.sqrt(4.0 / max(area, 1e-9)), 1.0, MAX_SCALE))


def _charts(label: I32, neighbours: I32) -> I32:
    """(F,) number of the connected piece of one label; -1 for triangles without a view."""
    f, e = np.nonzero(neighbours >= 0)
    g = neighbours[f, e]
    same = (label[f] == label[g]) & (label[f] >= 0)
    count = len(label)
    graph = sparse.csr_matrix(
        (np.ones(int(same.sum()), np.int8), (f[same], g[same])), shape=(count, count)
    )
    piece = csgraph.connected_components(graph, directed=False)[1]
    out = np.full(count, -1, np.int32)
    seen = label >= 0
    if seen.any():
        out[seen] = np.unique(piece[seen], return_inverse=True)[1]
    return out


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
    seen = chart >= 0
    for corner in range(3):
        np.minimum.at(low, chart[seen], uv[seen, corner])
        np.maximum.at(high, chart[seen], uv[seen, corner])
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


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """Images and weights that the texels are mixed from."""

    views: Sequence[TextureView]
    levels: F32  # (views, 3, 2) gain and offset, BGR
    fade_view: I32  # (V, B)
    fade_share: F32  # (V, B)
    rgb: U8  # (V, 3) where no view has colour


def paint(
    mesh: Mesh, layout: Layout, found: TriangleViews, label: I32, neighbours: I32, palette: Palette
) -> U8:
    """(h, w, 3) RGB atlas: each texel the mix of the views that fade there; around each chart its
    views go on, so that a viewer's mean of four texels shows no line where charts meet."""
    w, h = layout.size_px
    image = np.zeros((h, w, 3), np.uint8)
    done = np.zeros((h, w), np.bool_)
    views = palette.views
    pixels, start, sides = flat(views)
    chart = layout.chart
    is_open = (neighbours < 0) | (chart[neighbours] != chart[:, None])
    is_border = (label >= 0) & is_open.any(axis=1)
    for faces, margin_px in (
        (np.arange(len(label)), 0.0), (np.flatnonzero(is_border), MARGIN_PX),
    ):  # fmt: skip
        _paint(
            faces, margin_px, np.ascontiguousarray(mesh.vertices_m, np.float64), mesh.faces,
            layout.uv_px, label, found.view, palette.fade_view, palette.fade_share, palette.rgb,
            pixels, start, sides, *cameras(views), palette.levels, image, done,
        )  # fmt: skip
    return bordered(image, done)


def cameras(views: Sequence[TextureView]) -> tuple[F64, F64]:
    """(V, 3, 3) intrinsics and (V, 3, 4) world to camera."""
    K = np.array([v.K for v in views], np.float64).reshape(-1, 3, 3)
    T = np.array([np.linalg.inv(v.T_world_camera)[:3] for v in views]).reshape(-1, 3, 4)
    return K, T


def flat(views: Sequence[TextureView]) -> tuple[U8, I64, I64]:
    """All images in one array, where each begins, and their (h, w)."""
    sides = np.array([v.bgra.shape[:2] for v in views], np.int64).reshape(-1, 2)
    start = np.concatenate([[0], np.cumsum(4 * sides[:, 0] * sides[:, 1])]).astype(np.int64)
    pixels = np.empty(int(start[-1]), np.uint8)
    for n, view in enumerate(views):
        pixels[start[n] : start[n + 1]] = view.bgra.ravel()
    return pixels, start, sides


def bordered(image: U8, done: Bool) -> U8:
    """The charts' colours carried past their edges, until no texel is without one."""
    out, reach = np.empty_like(image), BORDER_PX + 1
    for top in range(0, len(image), BAND_ROWS):  # in single precision an atlas takes a gigabyte
        first, end = max(top - reach, 0), top + BAND_ROWS
        whole = _carried(image[first : end + reach], done[first : end + reach], reach)
        out[top:end] = whole[top - first : end - first]
    return out


def _carried(image: U8, done: Bool, steps: int) -> U8:
    """Near a chart the mean of what is next to it; farther off that of ever larger squares: a
    black gap would darken the coarse mip levels."""
    reached = done.copy()
    out = image.astype(np.float32)
    for _ in range(steps):
        weight = reached.astype(np.float32)
        total = cv2.boxFilter(weight, -1, (3, 3), normalize=False)
        new = ~reached & (total > 0.5)
        sums = cv2.boxFilter(out * weight[..., None], -1, (3, 3), normalize=False)
        out[new] = sums[new] / total[new, None]
        reached |= new
    _fill_gaps(out, reached)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


def _fill_gaps(colour: F32, known: Bool) -> None:
    """Give each texel of ``colour`` (h, w, 3) that is not ``known`` the mean of the known ones in
    the smallest square of a pyramid of halves that holds some."""
    h, w = known.shape
    if known.all() or not known.any():
        return
    half = (-(-w // 2), -(-h // 2))
    padded = cv2.copyMakeBorder(
        np.dstack([colour * known[..., None], known.astype(np.float32)]),
        0, 2 * half[1] - h, 0, 2 * half[0] - w, cv2.BORDER_CONSTANT, value=0,
    )  # fmt: skip
    mean = cv2.resize(padded, half, interpolation=cv2.INTER_AREA)
    seen = mean[..., 3] > 0
    coarse = mean[..., :3] / np.maximum(mean[..., 3:], 1e-9)
    _fill_gaps(coarse, seen)
    row, column = np.nonzero(~known)
    colour[row, column] = coarse[row // 2, column // 2]


@njit(cache=True, nogil=True)
def sample(
    pixels: U8, start: int, h: int, w: int, u: float, v: float, out: F64
) -> float:  # pragma: no cover - compiled
    """Bilinear colour into ``out`` (3,), weighted by alpha; the alpha 0 to 1 found there."""
    out[0] = out[1] = out[2] = 0.0
    if not (0.0 <= u <= w - 1.0 and 0.0 <= v <= h - 1.0):
        return 0.0
    i, j = min(int(v), h - 2), min(int(u), w - 2)
    a, b = v - i, u - j
    alpha = 0.0
    for di in range(2):
        for dj in range(2):
            at = start + 4 * ((i + di) * w + j + dj)
            share = (a if di else 1.0 - a) * (b if dj else 1.0 - b) * pixels[at + 3] / 255.0
            alpha += share
            for c in range(3):
                out[c] += share * pixels[at + c]
    if alpha > 1e-3:
        for c in range(3):
            out[c] /= alpha
    return alpha


@njit(cache=True, nogil=True)
def _mix(
    x: float, y: float, z: float, ids: I32, shares: F64, seen: I32, pixels: U8, start: I64,
    sides: I64, K: F64, T: F64, levels: F32, colour: F64, out: F64,
) -> float:  # fmt: skip  # pragma: no cover - compiled
    """Add the views' colours of a place, weighted, into ``out`` (3,); the weight added."""
    total = 0.0
    for n in range(len(ids)):
        v = ids[n]
        if v < 0 or shares[n] < 0.01:
            continue
        visible = False
        for k in range(len(seen)):
            visible |= seen[k] == v
        if not visible:
            continue
        px, py, _ = pixel_of(K[v], T[v], x, y, z)
        alpha = sample(pixels, start[v], sides[v, 0], sides[v, 1], px, py, colour)
        weight = shares[n] * alpha
        total += weight
        for c in range(3):
            out[c] += weight * (levels[v, c, 0] * colour[c] + levels[v, c, 1])
    return total


@njit(cache=True, nogil=True)
def _texel(
    f: int, a: float, b: float, c: float, vertices: F64, faces: I32, seen: I32, fade_share: F32,
    rgb: U8, pixels: U8, start: I64, sides: I64, K: F64, T: F64, levels: F32, ids: I32,
    shares: F64, colour: F64, mixed: F64, out: U8,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """The colour of the place with weights a, b, c of the corners of triangle ``f``."""
    blended = fade_share.shape[1]
    p, q, r = faces[f, 0], faces[f, 1], faces[f, 2]
    for j in range(blended):
        shares[j] = a * fade_share[p, j]
        shares[blended + j] = b * fade_share[q, j]
        shares[2 * blended + j] = c * fade_share[r, j]
    shares[3 * blended] = 1e-2  # the own view, should no other show anything
    x = a * vertices[p, 0] + b * vertices[q, 0] + c * vertices[r, 0]
    y = a * vertices[p, 1] + b * vertices[q, 1] + c * vertices[r, 1]
    z = a * vertices[p, 2] + b * vertices[q, 2] + c * vertices[r, 2]
    mixed[0] = mixed[1] = mixed[2] = 0.0
    total = _mix(x, y, z, ids, shares, seen[f], pixels, start, sides, K, T, levels, colour, mixed)
    for k in range(3):
        if total > 1e-3:
            value = mixed[2 - k] / total
        else:
            value = a * rgb[p, k] + b * rgb[q, k] + c * rgb[r, k]
        out[k] = np.uint8(min(max(value + 0.5, 0.0), 255.0))


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _paint(
    painted: I64, margin: float, vertices: F64, faces: I32, uv: F64, label: I32, seen: I32,
    fade_view: I32, fade_share: F32, rgb: U8, pixels: U8, start: I64, sides: I64, K: F64, T: F64,
    levels: F32, image: U8, done: Bool,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Fill the texels whose centres lie in the ``painted`` triangles; with a ``margin`` those that
    are not ``done`` so near to one."""
    height, width = done.shape
    blended = fade_view.shape[1]
    ids = np.empty(3 * blended + 1, np.int32)
    shares = np.empty(3 * blended + 1)
    mixed, colour, depth, least = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for f in painted:
        ax, ay, bx, by = uv[f, 0, 0], uv[f, 0, 1], uv[f, 1, 0], uv[f, 1, 1]
        cx, cy = uv[f, 2, 0], uv[f, 2, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        own = label[f]
        for k in range(3):  # depths in the own view, for a true perspective inside
            p = faces[f, k]
            depth[k] = 1.0
            if own >= 0:
                depth[k] = T[own, 2, 3]
                for d in range(3):
                    depth[k] += T[own, 2, d] * vertices[p, d]
            for j in range(blended):
                ids[k * blended + j] = fade_view[p, j]
        ids[3 * blended] = own
        least[:] = -1e-9 if own >= 0 else -0.5  # squares of unseen triangles are filled whole
        if margin > 0.0 and area != 0.0:
            reach = margin / abs(area)
            least[0] = -reach * np.hypot(cx - bx, cy - by)
            least[1] = -reach * np.hypot(ax - cx, ay - cy)
            least[2] = -reach * np.hypot(bx - ax, by - ay)
        y0 = max(0, int(np.ceil(min(ay, by, cy) - margin - 0.5)))
        y1 = min(height - 1, int(np.floor(max(ay, by, cy) + margin - 0.5)))
        x0 = max(0, int(np.ceil(min(ax, bx, cx) - margin - 0.5)))
        x1 = min(width - 1, int(np.floor(max(ax, bx, cx) + margin - 0.5)))
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
                    a, b, c = _on_longest_edge(uv[f], col + 0.5, row + 0.5)
                a, b, c = a / depth[0], b / depth[1], c / depth[2]
                whole = a + b + c
                _texel(
                    f, a / whole, b / whole, c / whole, vertices, faces, seen, fade_share, rgb,
                    pixels, start, sides, K, T, levels, ids, shares, colour, mixed,
                    image[row, col],
                )  # fmt: skip
                done[row, col] = True
