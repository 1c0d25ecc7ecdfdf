"""True orthophoto: each place of a surface model from the view that looks at it most steeply.

Views that a higher part of the surface hides, or nearly, are left out. The views' exposures are
levelled, as a whole and from part to part of an image, and then those whose colour differs from
most others left out (:func:`recon.surface.texture_views.consistent`). Neighbours show one view
where that costs little resolution. What differs between views passes from one to the other around
a seam; details do so within a cell of the surface model. An object is shown by one view as far as
that sees it, so that seams run around buildings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numba import njit

from recon.image_quality import sharpness
from recon.mapping.free_space import pixel_of
from recon.parallel import parallel_for
from recon.surface.raster import Grid, Raster, highest_lowest
from recon.surface.texture_atlas import Images, add_view, images_of, sample
from recon.surface.texture_views import TextureView, TriangleViews, consistent, insert
from recon.surface.texturing import choose, faded_steps, levels
from recon.types import F32, F64, I32, U8, Bool

CLEAR_M = 0.3
"""A surface this far above the line to a camera hides a place."""

MARGIN_CELLS = 2
"""So far around a higher part a view is hidden too, as its edge in the image may lie there; not so
near the place itself, which may stand at a wall."""

STEP_M = 0.5
"""Neighbours whose heights differ by more from the nearest cell's are not interpolated."""

EDGE_CELLS = 1.2
"""Sigma over which the outlines of what stands above its surroundings are smoothed."""

EDGE_PX = 1.0
ROUNDS = 4
"""Of neighbours that agree on a view; more take longer and save few seams."""

DETAIL_CELLS, FADE_CELLS = 1.5, 10.0
"""Sigma of the two bands in which views pass into each other, and of the way from one to the other:
poses and heights are good to less than the first."""

STEPS = 17
"""Calls of ``progress`` in all."""

SHARP_REACH = 3
"""Views before and after whose sharpness a view's is compared with."""


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """A surface model with its cells' places in the frame of the views."""

    raster: Raster
    places_m: F64  # (rows, cols, 3) world; NaN heights are unknown
    eyes_m: F64  # (V, 3) the views' centres in the raster's own coordinates
    objects: I32 | None = None  # (rows, cols) numbers of what stands on the ground, 0 elsewhere


def orthophoto(
    terrain: Terrain,
    views: Sequence[TextureView],
    grid: Grid,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[U8, Bool]:
    """(rows, cols, 3) RGB on ``grid``, and the cells with a height.

    Cells that no view shows take the colour of the surface model. ``progress`` is called STEPS
    times.
    """
    found = _sightings(terrain, views, progress)
    progress("painting the orthophoto")
    gains, places = levels(found, len(views)), terrain.places_m.reshape(-1, 3)
    fields, found = faded_steps(places, np.ones(len(places)), views, found, gains)
    found = consistent(found)
    label = chosen_views(found, terrain.raster.grid.shape)
    if terrain.objects is not None:
        label = one_view_each(found, terrain.objects.ravel(), label)
    fade = faded_seams(found, label, terrain.raster.grid.shape)
    label = label.reshape(terrain.raster.grid.shape)
    rgb = np.zeros((*grid.shape, 3), np.uint8)
    known = np.zeros(grid.shape, np.bool_)
    old = terrain.raster.grid
    to_cell = (
        (grid.west_m - old.west_m + 0.5 * grid.cell_m) / old.cell_m - 0.5,
        (old.north_m - grid.north_m + 0.5 * grid.cell_m) / old.cell_m - 0.5,
        grid.cell_m / old.cell_m,
    )
    parallel_for(
        _paint, len(rgb), np.ascontiguousarray(terrain.places_m), _axes(terrain.places_m),
        terrain.raster.height_m, terrain.raster.rgb, np.ascontiguousarray(label),
        fade, images_of(views, gains, fields), to_cell, rgb, known,
    )  # fmt: skip
    return rgb, known


def _sightings(
    terrain: Terrain,
    views: Sequence[TextureView],
    progress: Callable[[str], None],
) -> TriangleViews:
    """The views of each cell, the best first: pixels per metre times the cosine to the vertical,
    less where an image is blurred."""
    raster, images = terrain.raster, images_of(views, np.zeros((0, 3, 2), np.float32))
    rows, cols = raster.grid.shape
    out = TriangleViews.none(rows * cols)
    eyes = np.column_stack([raster.grid.pixels(terrain.eyes_m[:, :2]), terrain.eyes_m[:, 2]])
    centres = np.array([v.T_world_camera[:3, 3] for v in views]).reshape(-1, 3)
    highest = float(np.nanmax(raster.height_m, initial=-np.inf))
    places, sharp = np.ascontiguousarray(terrain.places_m), _sharpness(views)
    around = highest_lowest(raster.height_m, MARGIN_CELLS)[0]
    edges = [rows * n // (STEPS - 1) for n in range(STEPS)]
    for first, end in pairwise(edges):
        progress("choosing views for the orthophoto")
        parallel_for(
            _look, end - first, first, places, raster.height_m, around, highest, eyes, centres,
            sharp, images, out.view, out.px_per_m, out.bgr,
        )  # fmt: skip
    return out


def chosen_views(found: TriangleViews, shape: tuple[int, int]) -> I32:
    """(N,) the view of each cell of a raster of this shape, the same for neighbours where that
    costs little resolution; -1 where none sees it."""
    seen = np.flatnonzero(found.view[:, 0] >= 0)
    number = np.full(len(found.view), -1, np.int32)
    number[seen] = np.arange(len(seen))
    number = np.pad(number.reshape(shape), 1, constant_values=-1)
    around = number[:-2, 1:-1], number[2:, 1:-1], number[1:-1, :-2], number[1:-1, 2:]
    neighbours = np.column_stack([one.ravel()[seen] for one in around])
    some = TriangleViews(found.view[seen], found.px_per_m[seen], found.bgr[seen])
    label = np.full(len(found.view), -1, np.int32)
    label[seen] = some.view[np.arange(len(seen)), choose(some, neighbours, ROUNDS)]
    return label


def faded_seams(found: TriangleViews, label: I32, shape: tuple[int, int]) -> F32:
    """(rows, cols, 3) what is added to the colour (BGR) of each cell's view, ``label`` (N,), so
    that views pass into each other: what differs over DETAIL_CELLS, within FADE_CELLS of a seam.

    Two bands as of Burt and Adelson 1983 (doi:10.1145/245.247), of the differences between views,
    whose fine band stays that of one view.
    """
    mean = found.mean_bgr()
    total, weight = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 1), np.float32)
    own = np.zeros((*shape, 3), np.float32)
    for number, cell, slot in found.by_view():
        r, c = np.divmod(cell, shape[1])
        box = slice(r.min(), r.max() + 1), slice(c.min(), c.max() + 1)
        r, c = r - box[0].start, c - box[1].start
        sees = np.zeros((box[0].stop - box[0].start, box[1].stop - box[1].start, 1), np.float32)
        off, shows = np.zeros((*sees.shape[:2], 3), np.float32), np.zeros_like(sees)
        sees[r, c], off[r, c] = 1.0, found.bgr[cell, slot] - mean[cell]
        shows[r, c, 0] = label[cell] == number
        coarse = _smooth(off, DETAIL_CELLS) / np.maximum(_smooth(sees, DETAIL_CELLS), 1e-6)
        inside = np.maximum(2.0 * _smooth(sees, FADE_CELLS) - 1.0, 0.0)  # not to the view's edge
        share = sees * (_smooth(shows, FADE_CELLS) * inside + 1e-3 * shows)
        total[box] += share * coarse
        weight[box] += share
        own[box] += shows * coarse
    return np.asarray(total / np.maximum(weight, 1e-9) - own, np.float32)


def _smooth(image: F32, sigma: float) -> F32:
    smooth = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(smooth.reshape(image.shape), np.float32)


def one_view_each(found: TriangleViews, objects: I32, label: I32) -> I32:
    """(N,) the view of each cell, its ``label`` (N,), but of the cells of one object (N,) as far as
    possible the same: no seam then runs across a roof."""
    label = label.copy()
    cells = np.flatnonzero(objects)
    views, owner = found.view[cells], objects[cells].astype(np.int64)
    is_seen = views >= 0
    if not is_seen.any():
        return label
    number = int(views.max()) + 1
    keys, pair = np.unique((owner[:, None] * number + views)[is_seen], return_inverse=True)
    total = np.bincount(pair, found.px_per_m[cells][is_seen])
    best = np.full(int(owner.max()) + 1, -1, np.int32)
    rising = np.argsort(total)
    best[keys[rising] // number] = keys[rising] % number  # the last one stays
    chosen = best[owner]
    shown = (views == chosen[:, None]).any(axis=1)
    label[cells[shown]] = chosen[shown]
    return label


def _sharpness(views: Sequence[TextureView]) -> F64:
    """(V,) at most 1: each view's sharpness over the median of those before and after."""
    own = np.array(
        [sharpness(np.asarray(cv2.cvtColor(v.bgra, cv2.COLOR_BGRA2GRAY), np.uint8)) for v in views]
    )
    around = [
        np.nanmedian(own[max(0, n - SHARP_REACH) : n + SHARP_REACH + 1])
        if np.isfinite(own[n]) else np.nan for n in range(len(own))
    ]  # fmt: skip
    return np.asarray(np.nan_to_num(np.minimum(own / np.array(around), 1.0), nan=1.0))


@njit(cache=True, nogil=True)
def _look(
    begin: int, end: int, first: int, places: F64, height: F32, around: F32, highest: float,
    eyes: F64, centres: F64, sharp: F64, images: Images, view: I32, px: F32, bgr: F32,
) -> None:  # fmt: skip
    """Fill the sightings of rows of cells, counted from the row ``first``."""
    cols = height.shape[1]
    colour = np.empty(3)
    for r in range(first + begin, first + end):
        for number in range(len(images.K)):
            h, w = images.sides[number, 0], images.sides[number, 1]
            eye, centre = (eyes[number, 0], eyes[number, 1], eyes[number, 2]), centres[number]
            for c in range(cols):
                if np.isnan(height[r, c]):
                    continue
                x, y, z = places[r, c, 0], places[r, c, 1], places[r, c, 2]
                u, v, depth = pixel_of(images.K[number], images.T[number], x, y, z)
                if not (EDGE_PX <= u <= w - 1 - EDGE_PX and EDGE_PX <= v <= h - 1 - EDGE_PX):
                    continue
                if sample(images, number, u, v, colour) < 0.99:
                    continue
                if _is_hidden(height, around, highest, r, c, eye):
                    continue
                n = r * cols + c
                east, north, up = x - centre[0], y - centre[1], z - centre[2]
                score = images.K[number, 0, 0] / depth * abs(up) * sharp[number]
                score /= np.sqrt(east**2 + north**2 + up**2)
                insert(view[n], px[n], bgr[n], number, np.float32(score), colour)


@njit(cache=True, nogil=True)
def _is_hidden(
    height: F32, around: F32, highest: float, r: int, c: int, eye: tuple[float, float, float]
) -> bool:
    """Whether a surface hides a cell from the eye (column, row, height)."""
    dc, dr = eye[0] - c, eye[1] - r
    steps = int(max(abs(dc), abs(dr)))
    for s in range(1, steps + 1):
        share = s / max(abs(dc), abs(dr))
        z = height[r, c] + share * (eye[2] - height[r, c])
        row, col = round(r + share * dr), round(c + share * dc)
        if z > highest or not (0 <= row < height.shape[0] and 0 <= col < height.shape[1]):
            return False
        top = around[row, col] if s > MARGIN_CELLS else height[row, col]
        if top > z + CLEAR_M:
            return True
    return False


@njit(cache=True, nogil=True)
def _paint(
    begin: int, end: int, places: F64, axes: F64, height: F32, fallback: U8, label: I32,
    fade: F32, images: Images, to_cell: tuple[float, float, float], rgb: U8, known: Bool,
) -> None:  # fmt: skip
    """Fill rows of ``rgb`` and ``known``; their cells are the model's by offset and scale."""
    rows, cols = height.shape
    share, place, colour, mixed = np.empty(4), np.empty(3), np.empty(3), np.empty(3)
    for i in range(begin, end):
        y = min(max(to_cell[1] + i * to_cell[2], 0.0), rows - 1.0)
        r = min(int(y), rows - 2)
        for j in range(rgb.shape[1]):
            x = min(max(to_cell[0] + j * to_cell[2], 0.0), cols - 1.0)
            c = min(int(x), cols - 2)
            a, b = y - r, x - c
            share[0], share[1] = (1.0 - a) * (1.0 - b), (1.0 - a) * b
            share[2], share[3] = a * (1.0 - b), a * b
            near = _one_surface(height, r, c, a, b, share)
            if near < 0:
                continue
            known[i, j] = True
            _place(places, axes, r, c, near, a, b, share, place)
            total = _mix(place, label, fade, r, c, share, images, colour, mixed)
            for k in range(3):
                value = 0.0
                if total > 1e-3:
                    value = mixed[2 - k] / total
                else:
                    for n in range(4):
                        value += share[n] * fallback[r + n // 2, c + n % 2, k]
                rgb[i, j, k] = np.uint8(min(max(value + 0.5, 0.0), 255.0))


def _axes(places_m: F64) -> F64:
    """(2, 2) metres east and north from one row of cells to the next, and from column to column."""
    steps = (np.diff(places_m[..., :2], axis=axis).reshape(-1, 2) for axis in (0, 1))
    known = [step[np.isfinite(step).all(axis=1)] for step in steps]
    return np.array([np.median(one, axis=0) if len(one) else np.zeros(2) for one in known])


@njit(cache=True, nogil=True)
def _one_surface(height: F32, r: int, c: int, down: float, right: float, share: F64) -> int:
    """The cell of four that has the largest share of those of one surface, whose shares become 1
    together, the others' 0. -1 where most is unknown.

    At a step it is the surface that most cells around are of, so an edge runs across cells, not
    around them.
    """
    high, low, unknown = -np.inf, np.inf, 0.0
    for n in range(4):
        own = height[r + n // 2, c + n % 2]
        if np.isnan(own):
            unknown += share[n]
        else:
            high, low = max(high, own), min(low, own)
    if unknown > 0.5 or high < low:
        return -1
    middle, is_upper = low - 1.0, True
    if high - low > STEP_M:
        middle = 0.5 * (high + low)
        is_upper = _is_upper(height, r + down, c + right, middle)
    best = -1
    for n in range(4):
        own = height[r + n // 2, c + n % 2]
        if (own > middle) != is_upper or np.isnan(own):
            share[n] = 0.0
        elif best < 0 or share[n] > share[best]:
            best = n
    own, total = height[r + best // 2, c + best % 2], 0.0
    share[best] = max(share[best], 1e-9)
    for n in range(4):
        if not abs(height[r + n // 2, c + n % 2] - own) <= STEP_M:
            share[n] = 0.0
        total += share[n]
    share /= total
    return best


@njit(cache=True, nogil=True)
def _is_upper(height: F32, row: float, col: float, middle: float) -> bool:
    """Whether most cells around a place, by a Gaussian of EDGE_CELLS, are above a height."""
    vote, reach = 0.0, int(np.ceil(2.0 * EDGE_CELLS))
    for i in range(max(int(row) - reach + 1, 0), min(int(row) + reach + 1, height.shape[0])):
        for j in range(max(int(col) - reach + 1, 0), min(int(col) + reach + 1, height.shape[1])):
            if not np.isnan(height[i, j]):
                weight = np.exp(-0.5 * ((row - i) ** 2 + (col - j) ** 2) / EDGE_CELLS**2)
                vote += weight if height[i, j] > middle else -weight
    return vote > 0.0


@njit(cache=True, nogil=True)
def _place(
    places: F64, axes: F64, r: int, c: int, near: int, down: float, right: float, share: F64,
    out: F64,
) -> None:  # fmt: skip
    """World place, so many cells down and right of the first of four; the heights of those with a
    share count."""
    row, col = r + near // 2, c + near % 2
    for k in range(2):
        out[k] = places[row, col, k]
        out[k] += (down - near // 2) * axes[0, k] + (right - near % 2) * axes[1, k]
    out[2] = total = 0.0
    for n in range(4):
        if share[n] > 0.0:
            total += share[n]
            out[2] += share[n] * places[r + n // 2, c + n % 2, 2]
    out[2] /= total


@njit(cache=True, nogil=True)
def _mix(
    place: F64, label: I32, fade: F32, r: int, c: int, share: F64, images: Images, colour: F64,
    mixed: F64,
) -> float:  # fmt: skip
    """Mean colour (times its weight) of a place in the views of four cells; the weight."""
    mixed[:] = 0.0
    total = 0.0
    for n in range(4):
        view = label[r + n // 2, c + n % 2]
        weight = share[n]
        is_repeated = False
        for m in range(4):
            if m != n and label[r + m // 2, c + m % 2] == view:
                is_repeated |= m < n
                weight += share[m]
        if view < 0 or is_repeated or weight < 1e-3:
            continue
        total += add_view(images, view, place[0], place[1], place[2], weight, colour, mixed)
    for n in range(4):
        for k in range(3):
            mixed[k] += total * share[n] * fade[r + n // 2, c + n % 2, k]
    return total
