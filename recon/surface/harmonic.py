"""Unknown cells of a height raster from the known ones around them, without facets or steps.

The heights between are harmonic: each is the mean of its neighbours, so that a slope stays a slope.
They are solved for on coarse cells; next to known cells the remaining difference is faded out.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from recon.types import F32, F64, I64, Bool

WORKING_CELL_M = 0.5
MAX_COARSE_CELLS = 300_000
"""Unknowns of one system; with more, coarse cells are larger."""

FADE_M = 1.0
"""Over this distance a difference to the known heights fades out."""

TIE = 1e-6
"""Weight of the nearest known height, which alone holds cells that touch none."""


def between(values: F32, fixed: Bool, wanted: Bool, cell_m: float) -> F32:
    """``values`` (rows, cols) or (rows, cols, channels) with the ``wanted`` cells filled from the
    ``fixed`` ones.

    Cells that are neither take no part. Without fixed cells nothing is filled.
    """
    out: F32 = values.copy()
    wanted = wanted & ~fixed
    if not fixed.any() or not wanted.any():
        return out
    shrink = max(1, round(WORKING_CELL_M / cell_m))
    shrink = max(shrink, math.ceil(math.sqrt(wanted.sum() / MAX_COARSE_CELLS)))
    channels = np.moveaxis(values.reshape(*fixed.shape, -1), 2, 0)
    count = _blocks(fixed, shrink)
    is_known = count > 0
    coarse = np.stack([_blocks(np.where(fixed, one, 0.0), shrink) for one in channels])
    coarse = np.divide(coarse, count, out=np.zeros_like(coarse), where=is_known)
    is_asked = (_blocks(wanted, shrink) > 0) & ~is_known
    distance, near = ndimage.distance_transform_edt(~fixed, return_indices=True)
    coarse[:, is_asked] = _solved(coarse, is_known, is_asked)
    there = near[:, wanted]
    places = np.concatenate([np.nonzero(wanted), there], axis=1)
    smooth, at_fixed = np.split(_interpolated(coarse, is_known | is_asked, places, shrink), 2, 1)
    fade = np.exp(-distance[wanted] * cell_m / FADE_M)
    filled = smooth + (channels[:, there[0], there[1]] - at_fixed) * fade
    out[wanted] = filled.T.reshape(out[wanted].shape)
    return out


def _blocks(values: F32 | Bool, shrink: int) -> F64:
    rows, cols = values.shape
    padded = np.pad(values.astype(np.float64), ((0, -rows % shrink), (0, -cols % shrink)))
    return np.asarray(
        padded.reshape(padded.shape[0] // shrink, shrink, -1, shrink).sum(axis=(1, 3))
    )


def _solved(coarse: F64, is_known: Bool, is_asked: Bool) -> F64:
    """Values of the asked cells in each channel of ``coarse`` (K, rows, cols): each the mean of its
    neighbours that are known or asked."""
    number: I64 = np.full(is_asked.shape, -1, np.int64)
    number[is_asked] = np.arange(is_asked.sum())
    near = ndimage.distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    right = TIE * coarse[:, near[0], near[1]][:, is_asked].T
    diagonal = np.full(len(right), TIE)
    rows, cols = [], []
    for axis in (0, 1):
        ahead = [slice(None), slice(None)]
        behind = [slice(None), slice(None)]
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        for one, two in ((tuple(behind), tuple(ahead)), (tuple(ahead), tuple(behind))):
            own, other = number[one].ravel(), number[two].ravel()
            known = is_known[two].ravel()
            joined = (own >= 0) & (other >= 0)
            held = (own >= 0) & known
            diagonal[own[joined | held]] += 1.0  # no cell has two neighbours on one side
            right[own[held]] += coarse[:, two[0], two[1]].reshape(len(coarse), -1)[:, held].T
            rows.append(own[joined])
            cols.append(other[joined])
    r, c = np.concatenate(rows), np.concatenate(cols)
    size = (len(right), len(right))
    A = sparse.diags(diagonal).tocsc() - sparse.csc_matrix((np.ones(len(r)), (r, c)), size)
    return np.asarray(splu(A.tocsc()).solve(right).T) if len(right) else right.T


def _interpolated(coarse: F64, is_there: Bool, places: I64, shrink: int) -> F64:
    """Coarse values (K, N) at ``places`` (2, N) between the middles of their cells, of those that
    are there alone."""
    at = (places + 0.5) / shrink - 0.5
    low = coarse[:, is_there].mean(axis=1)
    value = [
        ndimage.map_coordinates(np.where(is_there, one - middle, 0.0), at, order=1, mode="nearest")
        for one, middle in zip(coarse, low, strict=True)
    ]
    weight = ndimage.map_coordinates(is_there.astype(np.float64), at, order=1, mode="nearest")
    return np.asarray(value / np.maximum(weight, 1e-6) + low[:, None])
