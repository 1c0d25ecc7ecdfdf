"""Changes between two surface models of one place, with their sigmas.

The difference of each cell is a mean over its neighbourhood; its sigma follows from the scatter
of the differences there, from the cells' own sigmas and from the alignment. That is M3C2 with the
vertical as its normal (Lague et al. 2013, doi:10.1016/j.isprsjprs.2013.04.009, Eq. 1). Steps that
two surveys place a cell apart are no change: an object's core must stand out of the range of
heights that the other date has around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from recon.surface.raster import Grid, Raster
from recon.types import F32, F64, U8, Bool

I32 = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class ChangeConfig:
    """Limits of what counts as a change."""

    window: int = 3  # cells of a side, over which a difference is averaged
    correlated_cells: float = 6.0  # cells whose errors stereo makes alike
    level_sigmas: float = 1.96  # 95 %: a cell belongs to a change
    core_sigmas: float = 3.5  # some cells of every object
    min_core_cells: int = 3
    min_area_m2: float = 0.5
    min_height_m: float = 0.15
    block_m: float = 8.0  # of blocks whose medians show what the alignment left

    def __post_init__(self) -> None:
        """Raise ValueError when a parameter makes no sense."""
        if self.window < 1 or self.window % 2 == 0 or self.min_core_cells < 1:
            raise ValueError("window must be odd, min_core_cells at least 1")
        if not 0 < self.level_sigmas <= self.core_sigmas:
            raise ValueError("level_sigmas must be positive, core_sigmas no less")


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
    alignment_m: float  # sigma of the height that all cells share

    @property
    def compared_m2(self) -> float:
        """Ground that both surfaces have."""
        return float(np.isfinite(self.height_m).sum()) * self.grid.cell_m**2


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


def change_between(
    before: Raster, after: Raster, alignment_m: float, config: ChangeConfig | None = None
) -> Change:
    """The change from ``before`` to ``after``, two rasters of one grid.

    ``alignment_m`` is the sigma of the height between them; what the two show of it themselves
    counts where it is larger. Raises ValueError for different grids.
    """
    config = config or ChangeConfig()
    if before.grid != after.grid:
        raise ValueError("both surfaces must lie on one grid")
    d = (after.height_m - before.height_m).astype(np.float32)
    left = max(alignment_m, left_over_m(d, before.grid.cell_m, config.block_m))
    mean, variance, count = _moments(d, config.window)
    own = _moments(before.sigma_m**2 + after.sigma_m**2, config.window)[0]
    cells = np.maximum(count / config.correlated_cells, 1.0)
    sigma = np.sqrt(np.maximum(variance, own) / cells + left**2).astype(np.float32)
    known = np.isfinite(d)
    mean, sigma = (np.where(known, x, np.float32(np.nan)) for x in (mean, sigma))
    labels = _labels(d, mean, sigma, before, after, config)
    bodies = _bodies(d, sigma, labels, left, before.grid.cell_m, config)
    return Change(before.grid, mean, sigma, labels, tuple(bodies), left)


def left_over_m(d: F32, cell_m: float, block_m: float) -> float:
    """Robust spread of the medians of blocks of a difference: what an alignment left, m."""
    step = max(1, round(block_m / cell_m))
    middles = []
    for r in range(0, d.shape[0], step):
        for c in range(0, d.shape[1], step):
            block = d[r : r + step, c : c + step]
            if np.isfinite(block).mean() > 0.5:
                middles.append(float(np.nanmedian(block)))
    if len(middles) < 5:
        return 0.0
    return float(np.median(np.abs(middles)) / 0.6745)


def _moments(x: F32, window: int) -> tuple[F32, F32, F32]:
    """Mean, variance and number of the known cells in the window about each cell."""
    known = np.isfinite(x)
    size, border = (window, window), cv2.BORDER_CONSTANT
    box = [
        cv2.boxFilter(layer.astype(np.float64), -1, size, normalize=False, borderType=border)
        for layer in (known, np.where(known, x, 0.0), np.where(known, x, 0.0) ** 2)
    ]
    count = np.maximum(box[0], 1.0)
    mean = box[1] / count
    variance = np.maximum(box[2] / count - mean**2, 0.0) * count / np.maximum(count - 1.0, 1.0)
    return mean.astype(np.float32), variance.astype(np.float32), box[0].astype(np.float32)


def _labels(
    d: F32, mean: F32, sigma: F32, before: Raster, after: Raster, config: ChangeConfig
) -> I32:
    """Cells of each change, numbered from 1: connected, of one sign, with a core."""
    out = np.zeros(d.shape, np.int32)
    count = 0
    for sign in (1.0, -1.0):
        high, low = (after, before) if sign > 0 else (before, after)
        standing = np.nan_to_num(sign * np.nan_to_num(mean, nan=0.0))
        size = np.nan_to_num(standing / sigma, nan=0.0)
        # The core stands out of all that the other date has within a cell.
        above = high.height_m - _highest(low.height_m)
        core = (size > config.core_sigmas) & (standing > config.min_height_m)
        core &= np.nan_to_num(above, nan=-1.0) > config.level_sigmas * np.nan_to_num(sigma, nan=1.0)
        member = (np.nan_to_num(sign * d, nan=0.0) > config.level_sigmas * np.nan_to_num(
            sigma, nan=np.inf)) | core  # fmt: skip
        number, found = cv2.connectedComponents(member.astype(np.uint8), connectivity=4)
        cores = np.bincount(found[core], minlength=number)
        cells = np.bincount(found.ravel(), minlength=number)
        good = (cores >= config.min_core_cells) & (
            cells * before.grid.cell_m**2 >= config.min_area_m2
        )
        good[0] = False
        numbers = np.zeros(number, np.int32)
        numbers[good] = count + 1 + np.arange(int(good.sum()))
        count += int(good.sum())
        out = np.where(numbers[found] > 0, numbers[found], out)
    return out


def _highest(height_m: F32) -> F32:
    """Highest known height within a cell of each."""
    filled = np.where(np.isfinite(height_m), height_m, np.float32(-1e6)).astype(np.float32)
    return np.asarray(cv2.dilate(filled, np.ones((3, 3), np.uint8)), np.float32)


def _bodies(
    d: F32, sigma: F32, labels: I32, left_m: float, cell_m: float, config: ChangeConfig
) -> list[Body]:
    """Area and volume of each change; its rim, where the mean falls off, belongs to the volume."""
    out = []
    for label in range(1, int(labels.max(initial=0)) + 1):
        inside = labels == label
        rim = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rim &= np.isfinite(d) & ((labels == 0) | inside)
        heights = d[inside & np.isfinite(d)].astype(np.float64)
        volume = float(np.sum(d[rim], dtype=np.float64)) * cell_m**2
        noise = np.maximum(sigma[rim].astype(np.float64) ** 2 - left_m**2, 0.0)
        independent = float(np.sqrt(np.sum(noise))) * config.window * cell_m**2
        shared = left_m * float(rim.sum()) * cell_m**2
        peak = heights[np.argmax(np.abs(heights))]
        out.append(
            Body(
                label, float(inside.sum()) * cell_m**2, volume,
                float(np.hypot(independent, shared)), float(heights.mean()), float(peak),
            )
        )  # fmt: skip
    return out


@dataclass(frozen=True, slots=True)
class Volumes:
    """Earth moved, in cubic metres, each with its sigma."""

    cut: tuple[float, float]
    fill: tuple[float, float]
    net: tuple[float, float]


def volumes(change: Change) -> Volumes:
    """Sums over the bodies; errors of single bodies are independent, the alignment's is shared."""
    area = np.array([b.area_m2 for b in change.bodies])
    volume = np.array([b.volume_m3 for b in change.bodies])
    sigma = np.array([b.sigma_m3 for b in change.bodies])
    shared = change.alignment_m * area
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
