"""A mesh textured from posed images: the finest view of each triangle, in one atlas.

The steps of Waechter, Moehrle and Goesele 2014, "Let There Be Color!"
(doi:10.1007/978-3-319-10602-1_54): visibility, photo-consistency, a Markov random field for
the view of each triangle, exposure levelling, seams. Levelling here is a gain and an offset
per view and channel; seams fade over a few triangles instead of a Poisson edit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy import sparse
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import cg

from recon.surface.meshing import Mesh, face_neighbours
from recon.surface.texture_atlas import Layout, Palette, images_of, lay_out, paint
from recon.surface.texture_views import (
    TextureView,
    TriangleViews,
    consistent,
    look,
    projected,
)
from recon.types import F32, F64, I32, U8, Bool

LARGEST_ATLAS_PX = 8192


@dataclass(frozen=True, slots=True, eq=False)
class Textured:
    """A mesh with its image, and the sources of the image."""

    mesh: Mesh  # uv set; vertices doubled where charts meet
    image: U8  # (h, w, 3) RGB
    seen_share: float  # of the surface's area
    views_used: int
    charts: int
    scale: float  # texels per pixel of the views


def texture(
    mesh: Mesh,
    views: Sequence[TextureView],
    largest_px: int = LARGEST_ATLAS_PX,
    progress: Callable[[str], None] = lambda _: None,
) -> Textured:
    """``mesh`` textured from ``views``; where none sees it, the mesh's own vertex colours.

    The mesh needs ``rgb``. Raises ValueError without it, or without triangles.
    """
    if mesh.rgb is None or not len(mesh.faces):
        raise ValueError("a mesh to be textured needs triangles and colours at its vertices")
    reported = [-1]

    def share(done: float) -> None:
        if int(10 * done) > reported[0]:
            reported[0] = int(10 * done)
            progress("which triangles each view sees")

    found = consistent(look(mesh, views, share))
    progress("choosing a view for each triangle")
    neighbours = face_neighbours(mesh.faces)
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    middle = (a + b + c) / 3.0
    slot = choose(by_angle(middle, views, found), neighbours)
    label = np.where(slot >= 0, found.view[np.arange(len(slot)), slot], -1).astype(np.int32)
    progress("levelling exposures")
    gains = levels(found, len(views))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    fields, found = faded_steps(middle, area, views, found, gains)
    fade_view, fade_share = fading(mesh.faces, label, len(mesh.vertices_m), len(views))
    progress("packing the atlas")
    rgb = spread_colours(mesh.faces, mesh.rgb, found, slot)
    mesh = replace(mesh, rgb=rgb)
    layout = lay_out(mesh, views, label, neighbours, largest_px)
    progress("painting {} x {} texels".format(*layout.size_px))
    palette = Palette(images_of(views, gains, fields), fade_view, fade_share, rgb)
    image = paint(mesh, layout, found, label, neighbours, palette)
    used = np.unique(label[label >= 0])
    charts = len(np.unique(layout.chart[label >= 0]))
    seen = float(area[label >= 0].sum() / max(area.sum(), 1e-12))
    return Textured(_split(mesh, layout), image, seen, len(used), charts, layout.scale)


def _split(mesh: Mesh, layout: Layout) -> Mesh:
    """The mesh with one vertex for each corner of each chart, and its uv."""
    chart = np.repeat(layout.chart.astype(np.int64), 3)
    key = chart * len(mesh.vertices_m) + mesh.faces.ravel()
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    vertex = mesh.faces.ravel()[first]
    uv = layout.uv_px.reshape(-1, 2)[first] / np.array(layout.size_px, np.float64)
    assert mesh.rgb is not None
    return Mesh(
        mesh.vertices_m[vertex],
        number.reshape(-1, 3).astype(np.int32),
        uv.astype(np.float32),
        mesh.rgb[vertex],
        None if mesh.measured is None else mesh.measured[vertex],
    )


OWN_WEIGHT = 3.0 / 20.0**2
"""Of a vertex's own colour next to those of the vertices around it: what views show fades by e in
twenty vertices (on a regular mesh the sum of the differences to neighbours is 3 h^2 times the
Laplacian)."""


def spread_colours(faces: I32, rgb: U8, found: TriangleViews, slot: I32) -> U8:
    """(V, 3) colours for triangles without a view: those of the seen ones around them, as
    :func:`between_seen`."""
    rows = np.flatnonzero(slot >= 0)
    shown = found.bgr[rows, slot[rows], ::-1]
    colour = rgb.astype(np.float64)
    corner = faces[rows].ravel()
    count = np.bincount(corner, minlength=len(rgb))
    is_seen = count > 0
    for k in range(3):
        total = np.bincount(corner, np.repeat(shown[:, k], 3), len(rgb))
        colour[is_seen, k] = total[is_seen] / count[is_seen]
    return between_seen(faces, colour, is_seen)


def between_seen(faces: I32, colour: F64, is_seen: Bool) -> U8:
    """(V, 3) colours of vertices, where they are not seen (V,) by those that are, and far from
    these by their own.

    Between seen ones they are harmonic, each the mean of those around it, so details of what is
    seen leave no streaks in what is not. A vertex's own colour is that of the upper surface above
    or below it: a roof's, on a wall.
    """
    colour = colour.copy()
    ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    one_way = sparse.csr_matrix((np.ones(faces.size), ends), (len(colour),) * 2)
    rest = np.flatnonzero(~is_seen)
    around = (one_way + one_way.T)[rest]
    A = sparse.diags(np.asarray(around.sum(axis=1)).ravel() + OWN_WEIGHT) - around[:, rest]
    wanted = around[:, is_seen] @ colour[is_seen] + OWN_WEIGHT * colour[rest]
    for k in range(3):
        colour[rest, k] = cg(A, wanted[:, k], colour[rest, k])[0]
    return np.asarray(np.clip(np.rint(colour), 0, 255), np.uint8)


def by_angle(middle_m: F64, views: Sequence[TextureView], found: TriangleViews) -> TriangleViews:
    """``found`` of triangles or cells with these middles (N, 3), with the resolution of pixels that
    all span the angle of the image's middle one; rows keep their order.

    Straight down from one height all images show level ground with the same pixels per metre. Those
    at an image's edge span less, but the lens is no finer there, and what looks there aslant is
    moved more by errors of height.
    """
    px_per_m = found.px_per_m.copy()
    for number, n, slot in found.by_view():
        T = views[number].T_world_camera
        ways = middle_m[n] - T[:3, 3]
        cosine = ways @ T[:3, 2] / np.maximum(np.linalg.norm(ways, axis=1), 1e-9)
        px_per_m[n, slot] *= np.maximum(cosine, 0.0) ** 1.5
    return replace(found, px_per_m=px_per_m)


PENALTY = 0.6
"""Cost of an edge between triangles of different views; all resolution lost costs 1."""

ITERATIONS = 100
DAMPING = 0.5
SETTLED = 1e-3
"""A triangle whose messages change by less has no more to say until its neighbours do."""


def choose(found: TriangleViews, neighbours: I32, iterations: int = ITERATIONS) -> I32:
    """(F,) the slot of ``found`` chosen for each triangle or cell, next to ``neighbours`` (F, E;
    -1: none); -1 where no view sees it."""
    is_seen = found.view >= 0  # views that were dropped leave their resolution behind
    best = np.where(is_seen, found.px_per_m, 1e-9).max(axis=1, keepdims=True)
    cost = np.where(is_seen, 1.0 - found.px_per_m / best, np.float32(1e6))
    return np.asarray(
        _propagated(found.view, cost.astype(np.float32), neighbours, PENALTY, iterations)
    )


@njit(cache=True, nogil=True)
def _propagated(view: I32, cost: F32, neighbours: I32, penalty: float, iterations: int) -> I32:
    """Slots after belief propagation and iterated conditional modes."""
    (faces, slots), edges = view.shape, neighbours.shape[1]
    back = np.full((faces, edges), -1, np.int32)  # which of the neighbour's edges leads here
    same = np.full((faces, edges, slots), -1, np.int32)  # own slot of each view of the neighbour
    for f in range(faces):
        for e in range(edges):
            g = neighbours[f, e]
            if g < 0:
                continue
            for d in range(edges):
                if neighbours[g, d] == f:
                    back[f, e] = d
            for j in range(slots):
                for k in range(slots):
                    if view[g, j] >= 0 and view[f, k] == view[g, j]:
                        same[f, e, j] = k
    message = np.zeros((faces, edges, slots), np.float32)  # to (f) over its edge e
    belief = np.empty(slots, np.float32)
    is_due = view[:, 0] >= 0
    for iteration in range(iterations):
        forward = iteration % 2 == 0
        for n in range(faces):
            f = n if forward else faces - 1 - n
            if not is_due[f]:
                continue
            is_due[f] = False
            for e in range(edges):
                g = neighbours[f, e]
                if g < 0 or view[g, 0] < 0:
                    continue
                least = np.float32(np.inf)
                for k in range(slots):
                    belief[k] = cost[f, k]
                    for d in range(edges):
                        if d != e:
                            belief[k] += message[f, d, k]
                    if view[f, k] >= 0 and belief[k] < least:
                        least = belief[k]
                for j in range(slots):
                    if view[g, j] < 0:
                        break
                    value, k = np.float32(penalty), same[f, e, j]
                    if k >= 0:
                        value = min(value, belief[k] - least)
                    change = (1.0 - DAMPING) * (value - message[g, back[f, e], j])
                    message[g, back[f, e], j] += change
                    if abs(change) > SETTLED:
                        is_due[f] = is_due[g] = True
    out = np.full(faces, -1, np.int32)
    for f in range(faces):
        best = np.float32(np.inf)
        for k in range(slots):
            total = cost[f, k]
            for e in range(edges):
                total += message[f, e, k]
            if view[f, k] >= 0 and total < best:
                best, out[f] = total, k
    _settle(view, cost, neighbours, penalty, out)
    return out


@njit(cache=True, nogil=True)
def _settle(view: I32, cost: F32, neighbours: I32, penalty: float, slot: I32) -> None:
    """Iterated conditional modes: each triangle takes the best view given its neighbours'."""
    faces, slots = view.shape
    for _ in range(20):
        changed = 0
        for f in range(faces):
            best, chosen = np.inf, slot[f]
            for k in range(slots):
                if view[f, k] < 0:
                    break
                total = float(cost[f, k])
                for e in range(neighbours.shape[1]):
                    g = neighbours[f, e]
                    if g >= 0 and slot[g] >= 0 and view[g, slot[g]] != view[f, k]:
                        total += penalty
                if total < best - 1e-6:
                    best, chosen = total, np.int32(k)
            if chosen != slot[f]:
                slot[f] = chosen
                changed += 1
        if changed == 0:
            return


HUBER_LEVELS = 8.0
ROUNDS = 10
MAX_SAMPLES = 300_000
SCALE = 128.0
"""Levels; so that gain and offset weigh alike."""

PULL = 0.004
"""Weight of each view's own colours against those of its pairs: more would leave steps where half
of a flight is under a cloud, or where it gets dark."""

UNCHANGED_LEVELS = 0.5
"""Most images have the flight's exposure. Those that differ by more count less for it: few odd
ones, as under a cloud, do not make all others brighter or darker."""

FIELD_CELLS, FIELD_SIGMA = 24, 1.7
"""Along the longer side of an image, of the field of its brightness, and how smooth that is."""

LARGEST_FACTOR = 2.0
"""Of that field: in what is all but black, a ratio of brightnesses says nothing."""

FADE_RINGS = 4
"""Rings of triangles on each side of a seam across which the views fade."""

BLENDED_VIEWS = 3


def levels(found: TriangleViews, views: int) -> F32:
    """(views, 3, 2) gain and offset per channel (BGR) that make views agree where they overlap.

    Least squares over triangles that two views see, ``g_a I_a + o_a = g_b I_b + o_b``, with
    Huber weights, and a light pull of each view to gain 1 and offset 0. Most views keep their
    brightness: by Huber weights, too, the mean gain is 1 and the mean offset 0. A view alone keeps
    its colours.
    """
    a, b, colour_a, colour_b = _pairs(found)
    out = np.zeros((views, 3, 2), np.float32)
    out[..., 0] = 1.0
    if not len(a):
        return out
    channels = [_Channel(a, b, colour_a[:, k], colour_b[:, k], views) for k in range(3)]
    trust = np.ones(views)
    for number in range(ROUNDS):
        limit = HUBER_LEVELS if number else np.inf  # the first round weighs all alike
        for one in channels:
            one.solve(limit, trust)
        # One weight for all channels: else the mean may be of some views' red and others' blue.
        change = np.sqrt(np.mean([one.squared_change() for one in channels], axis=0))
        trust = np.minimum(1.0, UNCHANGED_LEVELS / np.maximum(change, 1e-9))
    for k, one in enumerate(channels):
        out[:, k] = np.column_stack([one.x[::2], SCALE * one.x[1::2]])
    return out


def _pairs(found: TriangleViews) -> tuple[I32, I32, F64, F64]:
    """Views a and b of one triangle and its colours in both: the finest with each other."""
    parts = []
    for k in range(1, found.view.shape[1]):
        rows = np.flatnonzero(found.view[:, k] >= 0)
        rows = rows[:: max(1, -(-len(rows) // (MAX_SAMPLES // (found.view.shape[1] - 1))))]
        parts.append((rows, k))
    a = np.concatenate([found.view[rows, 0] for rows, _ in parts])
    b = np.concatenate([found.view[rows, k] for rows, k in parts])
    colour_a = np.concatenate([found.bgr[rows, 0] for rows, _ in parts]).astype(np.float64)
    colour_b = np.concatenate([found.bgr[rows, k] for rows, k in parts]).astype(np.float64)
    fair = (np.minimum(colour_a, colour_b).min(axis=1) > 3.0) & (
        np.maximum(colour_a, colour_b).max(axis=1) < 252.0
    )  # neither black nor burnt out
    return a[fair], b[fair], colour_a[fair], colour_b[fair]


class _Channel:
    """Gains, and offsets in SCALE levels, of one channel: ``x`` (2 views,), in turn."""

    def __init__(self, a: I32, b: I32, colour_a: F64, colour_b: F64, views: int) -> None:
        self._pairs = a, b, colour_a, colour_b
        both, colours = np.concatenate([a, b]), np.concatenate([colour_a, colour_b])
        seen, total, squares = (np.bincount(both, colours**k, minlength=views) for k in range(3))
        # Of each view, (2, 2): what the squared change of its own colours follows from.
        moments = np.array([[squares, SCALE * total], [SCALE * total, SCALE**2 * seen]])
        moments += 1e-6 * SCALE**2 * np.maximum(seen, 1) * np.eye(2)[..., None]
        self._seen, self._moments = seen, moments
        self._pull = PULL * sparse.block_diag(moments.transpose(2, 0, 1)).toarray()
        self._start = np.tile([1.0, 0.0], views)
        self.x = self._start

    def solve(self, limit: float, trust: F64) -> None:
        """Fit ``x`` by Huber's weights at the last one; views count for the mean by their
        ``trust`` (views,)."""
        weight = trust * self._seen
        N = np.zeros((len(self.x), len(self.x)))
        _add_pairs(*self._pairs, SCALE, self.x, limit, N)
        # Without a mean gain of 1 and offset of 0, noise would draw all of them to black.
        mean = np.kron(weight / weight.sum(), np.eye(2))
        fixed = 1e3 * len(self._pairs[0]) * SCALE**2 * (mean.T @ mean) + self._pull
        self.x = np.linalg.solve(N + fixed, fixed @ self._start)

    def squared_change(self) -> F64:
        """(views,) mean squared change of a view's own colours."""
        change = (self.x - self._start).reshape(-1, 2)
        squared = np.einsum("vi,ijv,vj->v", change, self._moments, change)
        return np.asarray(squared / np.maximum(self._seen, 1))


@njit(cache=True, nogil=True)
def _add_pairs(
    a: I32, b: I32, colour_a: F64, colour_b: F64, scale: float, x: F64, limit: float, N: F64
) -> None:
    """Add the normal equations of all pairs to N, by Huber's weights at the solution ``x``."""
    at, row = np.empty(4, np.int64), np.empty(4)
    for n in range(len(a)):
        at[0], at[1], at[2], at[3] = 2 * a[n], 2 * a[n] + 1, 2 * b[n], 2 * b[n] + 1
        row[0], row[1], row[2], row[3] = colour_a[n], scale, -colour_b[n], -scale
        off = 0.0
        for i in range(4):
            off += row[i] * x[at[i]]
        weight = 1.0 if abs(off) <= limit else limit / abs(off)
        for i in range(4):
            for j in range(4):
                N[at[i], at[j]] += weight * row[i] * row[j]


def levelled(found: TriangleViews, gains: F32) -> TriangleViews:
    """The same views with their colours after :func:`levels`."""
    none = np.array([[[1.0, 0.0]] * 3], np.float32)
    gain, offset = np.moveaxis(np.concatenate([gains, none])[found.view], -1, 0)
    return replace(found, bgr=found.bgr * gain + offset)


def faded_steps(
    middle_m: F64, area: F64, views: Sequence[TextureView], found: TriangleViews, gains: F32
) -> tuple[list[F32], TriangleViews]:
    """For each view (rows, cols, 4) factors over its image, before its gains (views, 3, 2), that
    take it to the mean of what all views of a place show after theirs; ``found`` after both.

    The places are those of ``found``: triangles or cells, with their middles (N, 3) and areas (N,).

    One gain for an image leaves steps where haze, a cloud's edge or the lens make it brighter in
    one part only. A factor is of surroundings as wide as FIELD_SIGMA, so details stay. Where no
    other view sees a place, it is 1.
    """
    mean = levelled(found, gains).mean_bgr()
    bgr, fields = found.bgr.copy(), list[F32]()
    for view in views:
        h, w = view.bgra.shape[:2]
        rows, cols = (max(2, round(FIELD_CELLS * side / max(h, w))) for side in (h, w))
        fields.append(np.ones((rows, cols, 4), np.float32))
    for number, f, slot in found.by_view():
        view, field = views[number], fields[number]
        (h, w), (rows, cols) = view.bgra.shape[:2], field.shape[:2]
        place = (projected(view, middle_m[f]) + 0.5) * [cols / w, rows / h]
        col, row = np.clip(place.astype(np.int64), 0, [cols - 1, rows - 1]).T
        weight = area[f] * found.px_per_m[f, slot] ** 2
        before_gain = (mean[f] - gains[number, :, 1]) / np.maximum(gains[number, :, 0], 1e-3)
        sums = [
            np.bincount(row * cols + col, weight * colour, rows * cols).reshape(rows, cols)
            for colour in (*before_gain.T, *found.bgr[f, slot].T)
        ]
        smooth = gaussian_filter(np.stack(sums, 2), (FIELD_SIGMA, FIELD_SIGMA, 0.0))
        wanted, own = smooth[..., :3], smooth[..., 3:]
        few = 1e-3 * max(float(own.max()), 1e-3)
        factor = (wanted + few) / (own + few)
        field[..., :3] = np.clip(factor, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR)
        bgr[f, slot] *= field[row, col, :3]
    return fields, levelled(replace(found, bgr=bgr), gains)


def fading(faces: I32, label: I32, vertices: int, views: int) -> tuple[I32, F32]:
    """Views (V, BLENDED_VIEWS) and their weights at each vertex, the strongest first.

    A vertex begins with the views of the triangles around it; averaging over neighbours
    FADE_RINGS times makes the weights run smoothly across a seam. Weights sum to 1; view -1
    has weight 0.
    """
    corner = faces.ravel()
    seen = np.repeat(label, 3) >= 0
    own = sparse.csr_matrix(
        (np.ones(int(seen.sum())), (corner[seen], np.repeat(label, 3)[seen])),
        shape=(vertices, max(views, 1)),
    )
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ones = np.ones(len(ends))
    A = sparse.csr_matrix((ones, (ends[:, 0], ends[:, 1])), shape=(vertices, vertices))
    A = ((A + A.T) > 0).astype(np.float64) + sparse.identity(vertices)
    weights = _rows_to_one(own)
    step = _rows_to_one(A.tocsr())
    for _ in range(FADE_RINGS):
        weights = step @ weights
    return _strongest(_rows_to_one(weights.tocsr()))


def _rows_to_one(matrix: sparse.csr_matrix) -> sparse.csr_matrix:
    total = np.asarray(matrix.sum(axis=1)).ravel()
    return sparse.diags(1.0 / np.maximum(total, 1e-12)) @ matrix


def _strongest(weights: sparse.csr_matrix) -> tuple[I32, F32]:
    """The BLENDED_VIEWS largest entries of each row, summing to 1."""
    rows = np.repeat(np.arange(weights.shape[0]), np.diff(weights.indptr))
    order = np.lexsort((weights.indices, -weights.data, rows))
    place = np.arange(len(order)) - weights.indptr[rows[order]]
    keep = place < BLENDED_VIEWS
    view = np.full((weights.shape[0], BLENDED_VIEWS), -1, np.int32)
    share = np.zeros(view.shape, np.float32)
    view[rows[order][keep], place[keep]] = weights.indices[order][keep]
    share[rows[order][keep], place[keep]] = weights.data[order][keep]
    share /= np.maximum(share.sum(axis=1, keepdims=True), np.float32(1e-12))
    return view, share
