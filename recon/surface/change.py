"""Changes between two surface models of one place, with their sigmas.

The difference of each cell is a mean over its neighbourhood, as in M3C2 with the vertical as its
normal (Lague et al. 2013, doi:10.1016/j.isprsjprs.2013.04.009). The low-frequency difference left
by the two flights' bending is estimated robustly and subtracted. The sigma of a mean is what the
surfaces' own sigmas say, times what most of the site shows: the empirical null of Efron 2004
(doi:10.1198/016214504000000089), so correlated errors count. Steps that two surveys place some
cells apart are not a change: an object stands out of all heights that the other date has around it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist

import cv2
import numpy as np
from numba import njit
from scipy import ndimage

from recon.surface.raster import Grid, Raster, fill_holes, highest_lowest
from recon.types import F32, F64, I32, I64, U8, Bool

BEND_CELLS, BEND_ROUNDS = 8, 8
"""Blocks per length over which flights bend, and iterations of the robust mean."""

NOISE_REACH = 1.5
"""Sigmas by which noise alone raises the highest nearby cell above a cell."""


MIN_PLACES = 50
"""Smallest objects that fit on ground whose errors are judged by themselves."""


@dataclass(frozen=True, slots=True)
class ChangeConfig:
    windows: tuple[int, ...] = (3, 5)  # cells of a side, over which heights are averaged
    level_sigmas: float = 2.58  # 99 %: a cell belongs to a change
    false_alarm: float = 0.05  # chance that ground without change shows any object
    core_sigmas: float = 4.0
    min_core_cells: int = 3  # beyond core_sigmas, of every object
    min_core_share: float = 0.3  # of an object's cells
    min_area_m2: float = 0.5
    min_height_m: float = 0.15
    edge_cells: int = 3  # that a step may lie aside, by matching windows and by what is hidden
    min_known: float = 0.95  # share of the ground around an object that both surfaces have or hide
    local_m: float = 8.0  # of blocks that may scatter more than others
    bend_m: float = 10.0  # length over which flights bend, 1 sigma
    block_m: float = 4.0  # of blocks whose medians show the rest of it


@dataclass(frozen=True, slots=True)
class Body:
    """One connected change."""

    label: int  # its cells in Change.labels
    area_m2: float
    volume_m3: float  # positive: added
    sigma_m3: float
    mean_m: float
    peak_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """The difference of two surfaces on one grid."""

    grid: Grid
    height_m: F32  # (rows, cols) after less before, mean of the neighbourhood; NaN: not in both
    sigma_m: F32  # (rows, cols)
    labels: I32  # (rows, cols) 0: no change, else the number of a body
    bodies: tuple[Body, ...]
    alignment_m: float  # sigma of the height that the cells of an object share


def mean_surface(xyz_m: F64, rgb: U8, sigma_m: F32, grid: Grid) -> Raster:
    """Mean height of the points (N, 3) in each cell, each by the inverse of its variance.

    Unlike the upper surface it has no bias at the rim of an object: a cell that a roof covers by
    half counts half. Its sigma holds the scatter of its points as well.
    """
    inside = grid.holds(xyz_m[:, :2])
    rows, cols = grid.cells(xyz_m[inside, :2])
    cell, count = rows * grid.shape[1] + cols, grid.shape[0] * grid.shape[1]
    weight = 1.0 / np.maximum(sigma_m[inside].astype(np.float64), 1e-6) ** 2
    z = xyz_m[inside, 2].astype(np.float64)
    middle = float(np.median(z)) if len(z) else 0.0

    def total(values: F64) -> F64:
        return np.asarray(np.bincount(cell, weight * values, count), np.float64)

    sums = np.maximum(total(np.ones(len(z))), 1e-300)
    mean = total(z - middle) / sums
    scatter = np.maximum(total((z - middle) ** 2) / sums - mean**2, 0.0)
    known = np.bincount(cell, minlength=count) > 0
    layers = (mean + middle, np.sqrt(1.0 / sums + scatter))
    height, sigma = (np.where(known, x, np.nan).astype(np.float32) for x in layers)
    colour = np.stack([total(rgb[inside, k].astype(np.float64)) / sums for k in range(3)], axis=1)
    shown = np.where(known[:, None], np.clip(np.rint(colour), 0, 255), 0).astype(np.uint8)
    shape = grid.shape
    return Raster(grid, height.reshape(shape), sigma.reshape(shape), shown.reshape(*shape, 3))


def level_filled(raster: Raster, cells: int) -> Raster:
    """The surface with its holes up to ``cells`` wide filled, next to steps only between two level
    cells.

    Other ground next to a step is unknown because it is hidden, or because stereo mixed both
    heights there: a mean of the two would make whatever stands wider. A step rises by more than 45
    degrees over the ``cells`` around.
    """
    filled = fill_holes(raster, cells)
    high, low = highest_lowest(raster.height_m, cells)
    is_step = ~raster.known & (high - low > 2 * cells * raster.grid.cell_m)
    height, sigma = (
        np.where(is_step, np.float32(np.nan), x) for x in (filled.height_m, filled.sigma_m)
    )
    own = raster.height_m, raster.sigma_m, raster.rgb
    _bridge(np.argwhere(is_step), cells, raster.grid.cell_m, *own, height, sigma, filled.rgb)
    return replace(filled, height_m=height, sigma_m=sigma)


@njit(cache=True, nogil=True)
def _bridge(
    holes: I64, cells: int, cell_m: float, height: F32, sigma: F32, rgb: U8,
    to_height: F32, to_sigma: F32, to_rgb: U8,
) -> None:  # fmt: skip
    """Fill those of the ``holes`` (N, 2) that lie across a gap of at most ``cells`` between two
    cells that rise by at most 45 degrees from one to the other, of several the narrowest gap."""
    rows, cols = height.shape
    for r, c in holes:
        best = cells + 2
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            a = b = 0
            for n in range(1, cells + 1):
                u, v = r - n * dr, c - n * dc
                if a == 0 and 0 <= u < rows and 0 <= v < cols and np.isfinite(height[u, v]):
                    a = n
                u, v = r + n * dr, c + n * dc
                if b == 0 and 0 <= u < rows and 0 <= v < cols and np.isfinite(height[u, v]):
                    b = n
            if a == 0 or b == 0 or a + b >= best:
                continue
            i, j, k, m = r - a * dr, c - a * dc, r + b * dr, c + b * dc
            if abs(height[i, j] - height[k, m]) > (a + b) * cell_m:
                continue
            best, near = a + b, a / (a + b)
            to_height[r, c] = height[i, j] + near * (height[k, m] - height[i, j])
            to_sigma[r, c] = sigma[i, j] + sigma[k, m]
            for n in range(3):
                to_rgb[r, c, n] = np.rint(0.5 * (float(rgb[i, j, n]) + float(rgb[k, m, n])))


def change_between(
    before: Raster,
    after: Raster,
    config: ChangeConfig | None = None,
    ground_m2: float | None = None,
) -> Change:
    """The change from ``before`` to ``after``, two rasters of one grid.

    ``ground_m2`` is the ground among which objects are judged, where these are a tile of more.
    """
    config = config or ChangeConfig()
    cell_m = before.grid.cell_m
    bend = bending(after.height_m - before.height_m, cell_m, config.bend_m)
    heights = (before.height_m + bend, after.height_m)
    d = heights[1] - heights[0]
    own = before.sigma_m**2 + after.sigma_m**2
    labels = np.zeros(d.shape, np.int32)
    relief = _relief(heights, 2 * config.edge_cells)
    scales = [_scale(heights, d, own, relief, w, cell_m, config) for w in config.windows]
    for sign in (1.0, -1.0):
        _add_labels(labels, d, scales, sign, cell_m, config)
    left = left_over_m(d, cell_m, config.block_m)
    errors = SumErrors(scales[0].sigma, scales[0].window, scatter_of_means(d), left)
    if ground_m2 is None:
        ground_m2 = np.count_nonzero(np.isfinite(d)) * cell_m**2
    bodies = _bodies(d, errors, labels, cell_m, config, ground_m2)
    return Change(before.grid, scales[0].mean, scales[0].sigma, labels, bodies, left)


def sigmas_of_any(chance: float, places: float) -> float:
    """Sigmas that errors alone exceed with a ``chance``, at any of so many independent places.

    Sidak 1967 (doi:10.1080/01621459.1967.10482935), both signs.
    """
    one = -math.expm1(math.log1p(-chance) / max(places, 1.0))
    return -NormalDist().inv_cdf(one / 2.0)


def bending(d: F32, cell_m: float, length_m: float) -> F32:
    """(rows, cols) the robust mean of a difference over ``length_m`` (1 sigma) about each cell.

    Outliers lose all weight (Geman and McClure), so the mean ignores changes.
    """
    known = np.isfinite(d)
    if not known.any():
        return np.zeros_like(d)
    step = max(1, round(length_m / BEND_CELLS / cell_m))
    size = (-(-d.shape[1] // step), -(-d.shape[0] // step))
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.where(known, d, np.float32(0)), size, interpolation=cv2.INTER_AREA)
    block = total / np.maximum(share, 1e-6)
    middle = float(np.median(d[known]))
    field = np.full(block.shape, middle, np.float32)

    def blurred(x: F32) -> F32:
        return np.asarray(
            cv2.GaussianBlur(x, (0, 0), BEND_CELLS, borderType=cv2.BORDER_CONSTANT), np.float32
        )

    for _ in range(BEND_ROUNDS):
        off = block - field
        spread = max(float(np.median(np.abs(off[share > 0.5]))) / 0.6745, 1e-3)
        weight = share / (1.0 + (off / (2.0 * spread)) ** 2) ** 2
        field = (blurred(weight * block) + 1e-3 * middle) / (blurred(weight) + 1e-3)
    rows, cols = d.shape
    return np.asarray(cv2.resize(field, (cols, rows), interpolation=cv2.INTER_LINEAR), np.float32)


def left_over_m(d: F32, cell_m: float, block_m: float) -> float:
    """Remaining misalignment in m: robust spread of the medians of blocks of a difference."""
    step = max(1, round(block_m / cell_m))
    middles = []
    for r in range(0, d.shape[0], step):
        for c in range(0, d.shape[1], step):
            block = d[r : r + step, c : c + step]
            if np.isfinite(block).mean() > 0.5:
                middles.append(float(np.nanmedian(block)))
    if len(middles) < 5:
        return 0.0
    return _robust(np.array(middles))


@dataclass(frozen=True, slots=True, eq=False)
class _Scale:
    """Two surfaces and their difference, averaged over one window; NaN where not in both."""

    window: int  # cells
    heights: tuple[F32, F32]
    mean: F32
    sigma: F32


@dataclass(frozen=True, slots=True, eq=False)
class SumErrors:
    """What the sum of a difference over an object's cells errs by.

    Errors of neighbouring cells are correlated, so ``scatter`` of means over a square of the
    object's size, by its side in cells, says how far they average out.
    """

    sigma: F32  # (rows, cols) of a mean over a window
    window: int  # cells of its side
    scatter: Callable[[int], float]
    left_m: float  # sigma of the height that the cells of an object share

    def of_sum(self, cells: Bool) -> float:
        """Sigma of the sum over ``cells``, in cells times metres."""
        count = float(np.count_nonzero(cells))
        sigma = float(np.sqrt(np.mean(self.sigma[cells].astype(np.float64) ** 2)))
        side = max(round(np.sqrt(count)), self.window)
        shrunk = self.scatter(side) / max(self.scatter(self.window), 1e-9)
        return count * max(sigma * shrunk, self.left_m)


def scatter_of_means(d: F32) -> Callable[[int], float]:
    """Robust spread of a difference's means over squares, by their side in cells."""
    known = np.isfinite(d)

    @cache
    def spread(side: int) -> float:
        return _robust(_mean(d, min(side, *d.shape))[known])

    return spread


def _robust(x: F32) -> float:
    """Standard deviation about 0 by the median; 1 for nothing."""
    return float(np.median(np.abs(x))) / 0.6745 if x.size else 1.0


def _scale(
    heights: tuple[F32, F32], d: F32, own: F32, relief: F32, window: int, cell_m: float,
    config: ChangeConfig,
) -> _Scale:  # fmt: skip
    known = np.isfinite(d)
    mean, said = (
        np.where(known, x, np.float32(np.nan))
        for x in (_mean(d, window), np.sqrt(_mean(own, window)))
    )
    ratio, lag = mean / said, 2 * config.edge_cells
    enough = round(MIN_PLACES * config.min_area_m2 / cell_m**2)
    more = np.maximum(
        _more_in_blocks(ratio, max(1, round(config.local_m / cell_m)), lag),
        _more_at_steps(ratio, relief, lag, enough),
    )
    sigma = said * _robust(ratio[known]) * more
    return _Scale(window, (_mean(heights[0], window), _mean(heights[1], window)), mean, sigma)


def _relief(heights: tuple[F32, F32], reach: int) -> F32:
    """(rows, cols) m that both surfaces rise and fall by within ``reach`` cells; 0 where unknown.

    An object that only one of them has is no relief.
    """
    one, two = (high - low for high, low in (highest_lowest(h, reach) for h in heights))
    return np.asarray(np.maximum(np.minimum(one, two), np.float32(0)), np.float32)


def _more_at_steps(ratio: F32, relief: F32, lag: int, enough: int) -> F32:
    """(rows, cols) by how much a ratio scatters more at steps than on usual ground.

    Stereo errs more there. Cells whose relief is alike, by octaves above the median, are one class
    with a null of its own (Efron 2008, doi:10.1214/07-AOAS141): the quantile of 90 % of differences
    ``lag`` cells apart, as errors at steps have long tails. A class of fewer than ``enough`` cells
    takes the factor of that below.
    """
    known = np.isfinite(ratio)
    if not known.any():
        return np.ones(ratio.shape, np.float32)
    octave = np.log2(np.maximum(relief, 1e-6) / max(float(np.median(relief[known])), 1e-6))
    classes = np.where(known, np.maximum(np.floor(octave), 0.0), -1.0).astype(np.int64)
    factors = [1.0]
    usual = 1.0
    for k in range(int(classes.max()) + 1):
        some = np.abs(_steps(np.where(classes == k, ratio, np.float32(np.nan)), lag))
        if len(some) < 2 * enough:
            factors.append(factors[-1])
            continue
        spread = float(np.quantile(some, 0.9))
        usual = max(spread, 1e-9) if k == 0 else usual
        factors.append(max(1.0, spread / usual))
    return np.asarray(np.array(factors, np.float32)[classes + 1])


def _more_in_blocks(ratio: F32, step: int, lag: int) -> F32:
    """(rows, cols) by how much a ratio scatters more in a block than on the whole.

    Blocks of ``step`` cells overlap by half; the one that scatters most counts. Each is compared
    with all by differences ``lag`` cells apart, of which outlines of objects in it touch few.
    """
    usual = max(_robust(_steps(ratio, lag)), 1e-9)
    more = np.ones(ratio.shape, np.float32)
    half = max(1, step // 2)
    for r in range(0, ratio.shape[0], half):
        for c in range(0, ratio.shape[1], half):
            block = slice(r, r + step), slice(c, c + step)
            some = _steps(ratio[block], lag)
            if len(some) > step:
                more[block] = np.maximum(more[block], _robust(some) / usual)
    return more


def _steps(x: F32, lag: int) -> F32:
    """The known differences of cells ``lag`` apart, along rows and along columns."""
    steps = np.concatenate([(x[lag:] - x[:-lag]).ravel(), (x[:, lag:] - x[:, :-lag]).ravel()])
    return np.asarray(steps[np.isfinite(steps)], np.float32)


def _mean(x: F32, window: int) -> F32:
    """Mean of the known cells in the window about each cell; NaN without any."""
    known = np.isfinite(x)
    size, border = (window, window), cv2.BORDER_CONSTANT
    middle = float(np.median(x[known])) if known.any() else 0.0
    total, count = (
        cv2.boxFilter(layer.astype(np.float64), -1, size, normalize=False, borderType=border)
        for layer in (np.where(known, x - middle, 0.0), known)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(count > 0.5, total / count + middle, np.nan), np.float32)


def _add_labels(
    labels: I32, d: F32, scales: Sequence[_Scale], sign: float, cell_m: float, config: ChangeConfig
) -> None:  # fmt: skip
    """Number the cells of each change of one sign: connected, with a core."""
    core = np.zeros(labels.shape, np.bool_)
    for scale in scales:
        low, high = scale.heights if sign > 0 else scale.heights[::-1]
        top = highest_lowest(low, config.edge_cells)[0] - NOISE_REACH * scale.sigma
        above = high - np.fmax(low, top)
        with np.errstate(invalid="ignore"):
            core |= above > np.maximum(config.core_sigmas * scale.sigma, config.min_height_m)
    typical = cv2.medianBlur(np.nan_to_num(sign * d, nan=0.0), 3)  # keeps outlines, not noise
    with np.errstate(invalid="ignore"):
        member = core | (typical > config.level_sigmas * scales[0].sigma)
    number, found = cv2.connectedComponents(member.astype(np.uint8), connectivity=4)
    cores = np.bincount(found[core], minlength=number)
    cells = np.bincount(found.ravel(), minlength=number)
    enough = np.maximum(config.min_core_cells, config.min_core_share * cells)
    good = (cores >= enough) & (cells * cell_m**2 >= config.min_area_m2)
    good[0] = False
    numbers = np.zeros(number, np.int32)
    numbers[good] = labels.max() + 1 + np.arange(int(good.sum()))
    new = numbers[found]
    labels[new > 0] = new[new > 0]


def of_tile(change: Change, rows: slice, cols: slice, reach: int) -> Change:
    """A change with the objects of these rows and columns only, the others being its neighbours'.

    An object of at most ``reach`` cells in extent is theirs whole where its first cell is. Each
    tile counts its own cells of a larger one. The cells around must reach as far.
    """
    labels, bodies = np.zeros_like(change.labels), []
    boxes = ndimage.find_objects(change.labels)
    for body in change.bodies:
        box = boxes[body.label - 1]
        inside = change.labels[box] == body.label
        r, c = np.nonzero(inside)
        r, c = r + box[0].start, c + box[1].start
        own = (r >= rows.start) & (r < rows.stop) & (c >= cols.start) & (c < cols.stop)
        if max(inside.shape) <= reach:
            own[:] = own[0]  # the first in row order
        if not own.any():
            continue
        labels[r[own], c[own]] = body.label
        heights = np.nan_to_num(change.height_m[r, c])
        share = float(heights[own].sum() / heights.sum()) if not own.all() else 1.0
        bodies.append(
            replace(
                body, area_m2=body.area_m2 * float(own.mean()), volume_m3=body.volume_m3 * share,
                sigma_m3=body.sigma_m3 * abs(share),
            )
        )  # fmt: skip
    return replace(change, labels=labels, bodies=tuple(bodies))


def _bodies(
    d: F32, errors: SumErrors, labels: I32, cell_m: float, config: ChangeConfig, ground_m2: float
) -> tuple[Body, ...]:
    """The changes that are significant on ground of this size; the others leave ``labels``.

    An object may lie anywhere, so its mean height is judged among as many places as the compared
    ground has for the smallest object: more than there are independent ones.
    """
    places = ground_m2 / config.min_area_m2
    level = sigmas_of_any(config.false_alarm, places)
    found = (
        _body(d, errors, labels, label, cell_m, config, level)
        for label in range(1, int(labels.max(initial=0)) + 1)
    )
    bodies = tuple(body for body in found if body is not None)
    labels[~np.isin(labels, [body.label for body in bodies])] = 0
    return bodies


def _body(
    d: F32, errors: SumErrors, labels: I32, label: int, cell_m: float, config: ChangeConfig,
    level: float,
) -> Body | None:  # fmt: skip
    """Area and volume of a change above the ground around it; None if below ``level`` sigmas.

    At the rim of what both flights saw, where few views reach, nothing is a change: the ground
    around it must be known, but for strips that it may hide itself. The rim that stereo smears
    belongs to the volume. Sigma also holds one cell all along the outline, as matching windows make
    what stands wider.
    """
    rim = config.edge_cells
    rows, cols = np.nonzero(labels == label)
    window = tuple(slice(max(x.min() - 4 * rim, 0), x.max() + 4 * rim + 1) for x in (rows, cols))
    d, labels, errors = d[window], labels[window], replace(errors, sigma=errors.sigma[window])
    inside = labels == label
    surround = _grown(inside, 2 * rim) & ~inside
    if np.mean(~_open(~np.isfinite(d))[surround]) < config.min_known:
        return None
    grown = _grown(inside, rim) & np.isfinite(d) & ((labels == 0) | inside)
    around = _grown(inside, 4 * rim) & ~_grown(labels > 0, rim) & np.isfinite(d)
    ground = float(np.median(d[around])) if np.count_nonzero(around) > 8 * rim else 0.0
    own = inside & np.isfinite(d)
    heights = d[own].astype(np.float64) - ground
    volume = float(np.sum(d[grown], dtype=np.float64) - ground * np.count_nonzero(grown))
    if np.sign(volume) * heights.sum() < level * errors.of_sum(own):
        return None
    border = inside & _grown(~inside, 1) & np.isfinite(d)
    outline = float(np.abs(d[border] - ground).sum())
    return Body(
        label, float(inside.sum()) * cell_m**2, volume * cell_m**2,
        float(np.hypot(errors.of_sum(grown), outline)) * cell_m**2, float(heights.mean()),
        float(heights[np.argmax(np.abs(heights))]),
    )  # fmt: skip


def _open(unknown: Bool) -> Bool:
    """The unknown cells that are connected with the border of the window."""
    _, found = cv2.connectedComponents(unknown.astype(np.uint8), connectivity=8)
    border = np.concatenate([found[0], found[-1], found[:, 0], found[:, -1]])
    return unknown & np.isin(found, border)


def _grown(cells: Bool, by: int) -> Bool:
    square = np.ones((2 * by + 1, 2 * by + 1), np.uint8)
    return np.asarray(cv2.dilate(cells.astype(np.uint8), square) > 0)


@dataclass(frozen=True, slots=True)
class Volumes:
    """Earth moved, in cubic metres, each with its sigma."""

    cut: tuple[float, float]
    fill: tuple[float, float]
    net: tuple[float, float]


def volumes(bodies: Sequence[Body], alignment_m: float) -> Volumes:
    """Sums over the bodies; errors of single bodies are independent, the alignment's is shared."""
    area = np.array([b.area_m2 for b in bodies])
    volume = np.array([b.volume_m3 for b in bodies])
    sigma = np.array([b.sigma_m3 for b in bodies])
    shared = alignment_m * area
    own = np.sqrt(np.maximum(sigma**2 - shared**2, 0.0))

    def part(chosen: Bool, sign: F64) -> tuple[float, float]:
        spread = np.hypot(np.sqrt(np.sum(own[chosen] ** 2)), np.sum((sign * shared)[chosen]))
        return float(np.sum((sign * volume)[chosen])), float(spread)

    one = np.ones(len(volume))
    return Volumes(part(volume < 0, -one), part(volume > 0, one), part(volume != 0, one))


def outlines(change: Change, label: int) -> list[list[F64]]:
    """Polygons of a body: of each the outer ring, then its holes, (N, 2) map metres, closed."""
    inside = (change.labels == label).astype(np.uint8)
    rows, cols = np.nonzero(inside)
    low = np.array([cols.min(), rows.min()])
    part = inside[rows.min() : rows.max() + 1, cols.min() : cols.max() + 1]
    # On four times the cells, outlines through pixel centres enclose the cells' own area better.
    fine = cv2.resize(part, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    rings, tree = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    out: dict[int, list[F64]] = {}
    for k, ring in enumerate(rings):
        place = (ring[:, 0].astype(np.float64) + 0.5) / 4.0 + low
        grid = change.grid
        xy = np.column_stack(
            [grid.west_m + place[:, 0] * grid.cell_m, grid.north_m - place[:, 1] * grid.cell_m]
        )
        outer = int(tree[0][k][3])
        if len(xy) >= 3:
            out.setdefault(k if outer < 0 else outer, []).append(np.vstack([xy, xy[:1]]))
    return list(out.values())
