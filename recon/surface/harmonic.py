"""Unknown cells of a height raster from the known ones around them, without facets or steps.

The heights between are harmonic: each is the mean of its neighbours, so that a slope stays a slope.
They are solved for on coarse cells; next to known cells the remaining difference is faded out.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from recon.types import F32, F64, I64, Bool

WORKING_CELL_M = 0.5
MAX_COARSE_CELLS = 300_000
"""Unknowns of one system; with more, coarse cells are larger."""

FADE_M = 1.0
"""Over this distance a difference to the known heights fades out."""

TIE = 1e-6
"""Weight of the nearest known height, which alone holds cells that touch none."""


def between(height_m: F32, fixed: Bool, wanted: Bool, cell_m: float) -> F32:
    """``height_m`` (rows, cols) with the ``wanted`` cells filled from the ``fixed`` ones.

    Cells that are neither take no part. Without fixed cells nothing is filled.
    """
    out: F32 = height_m.copy()
    wanted = wanted & ~fixed
    if not fixed.any() or not wanted.any():
        return out
    shrink = max(1, round(WORKING_CELL_M / cell_m))
    shrink = max(shrink, math.ceil(math.sqrt(wanted.sum() / MAX_COARSE_CELLS)))
    total, count = _blocks(np.where(fixed, height_m, 0.0), shrink), _blocks(fixed, shrink)
    is_known = count > 0
    coarse = np.divide(total, count, out=np.zeros_like(total), where=is_known)
    is_asked = (_blocks(wanted, shrink) > 0) & ~is_known
    distance, near = ndimage.distance_transform_edt(~fixed, return_indices=True)
    nearest = height_m[tuple(near)]
    coarse[is_asked] = _solved(coarse, is_known, is_asked)
    rows, cols = np.nonzero(wanted)
    smooth = _interpolated(coarse, is_known | is_asked, rows, cols, shrink)
    there = near[0][wanted], near[1][wanted]
    at_fixed = _interpolated(coarse, is_known | is_asked, *there, shrink)
    fade = np.exp(-distance[wanted] * cell_m / FADE_M)
    out[wanted] = smooth + (nearest[wanted] - at_fixed) * fade
    return out


def _blocks(values: F32 | Bool, shrink: int) -> F64:
    rows, cols = values.shape
    padded = np.pad(values.astype(np.float64), ((0, -rows % shrink), (0, -cols % shrink)))
    return np.asarray(
        padded.reshape(padded.shape[0] // shrink, shrink, -1, shrink).sum(axis=(1, 3))
    )


def _solved(coarse: F64, is_known: Bool, is_asked: Bool) -> F64:
    """Heights of the asked cells: each the mean of its neighbours that are known or asked."""
    number: I64 = np.full(coarse.shape, -1, np.int64)
    number[is_asked] = np.arange(is_asked.sum())
    near = ndimage.distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    right = TIE * coarse[tuple(near)][is_asked]
    diagonal = np.full(len(right), TIE)
    rows, cols = [], []
    for axis in (0, 1):
        ahead = [slice(None), slice(None)]
        behind = [slice(None), slice(None)]
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        for one, two in ((tuple(behind), tuple(ahead)), (tuple(ahead), tuple(behind))):
            own, other = number[one].ravel(), number[two].ravel()
            known, height = is_known[two].ravel(), coarse[two].ravel()
            joined = (own >= 0) & (other >= 0)
            held = (own >= 0) & known
            np.add.at(diagonal, own[joined | held], 1.0)
            np.add.at(right, own[held], height[held])
            rows.append(own[joined])
            cols.append(other[joined])
    r, c = np.concatenate(rows), np.concatenate(cols)
    size = (len(right), len(right))
    A = sparse.diags(diagonal).tocsc() - sparse.csc_matrix((np.ones(len(r)), (r, c)), size)
    return np.asarray(spsolve(A, right))


def _interpolated(
    coarse: F64, is_there: Bool, rows: I64, cols: I64,
    shrink: int,
) -> F64:  # fmt: skip
    """Coarse heights between the middles of their cells, of those that are there alone."""
    low = float(coarse[is_there].mean())
    at = np.stack([(rows + 0.5) / shrink - 0.5, (cols + 0.5) / shrink - 0.5])
    value, weight = (
        ndimage.map_coordinates(one, at, order=1, mode="nearest")
        for one in (np.where(is_there, coarse - low, 0.0), is_there.astype(np.float64))
    )
    return np.asarray(value / np.maximum(weight, 1e-6) + low)
