"""Pictures brought to one exposure, and how views fade into each other across seams."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from recon.surface.texture_views import Sightings
from recon.types import F32, F64

I32 = npt.NDArray[np.int32]

HUBER_LEVELS = 8.0
ROUNDS = 5
MOST_SAMPLES = 300_000
PULL = 0.004
"""Weight of gain 1 and offset 0 for each view, as a share of its observations."""

FADE_RINGS = 4
"""Across how many rings of triangles on each side of a seam the views fade."""

BLENDED_VIEWS = 3


def levels(found: Sightings, views: int) -> F32:
    """(views, 3, 2) gain and offset per channel (BGR) that make views agree where they overlap.

    Least squares over triangles that two views see, ``g_a I_a + o_a = g_b I_b + o_b``, with
    Huber weights, a mean gain of 1 and offset of 0, and a light pull of each view to these;
    a view alone keeps its colours.
    """
    a, b, colour_a, colour_b = _pairs(found)
    out = np.zeros((views, 3, 2), np.float32)
    out[..., 0] = 1.0
    if not len(a):
        return out
    for channel in range(3):
        solved = _solve(a, b, colour_a[:, channel], colour_b[:, channel], views)
        out[:, channel] = solved
    return out


def _pairs(found: Sightings) -> tuple[I32, I32, F64, F64]:
    """Views a and b of one triangle and its colours in both: the finest with each other."""
    parts = []
    for k in range(1, found.view.shape[1]):
        rows = np.flatnonzero(found.view[:, k] >= 0)
        rows = rows[:: max(1, -(-len(rows) // (MOST_SAMPLES // (found.view.shape[1] - 1))))]
        parts.append((rows, k))
    a = np.concatenate([found.view[rows, 0] for rows, _ in parts])
    b = np.concatenate([found.view[rows, k] for rows, k in parts])
    colour_a = np.concatenate([found.bgr[rows, 0] for rows, _ in parts]).astype(np.float64)
    colour_b = np.concatenate([found.bgr[rows, k] for rows, k in parts]).astype(np.float64)
    fair = (np.minimum(colour_a, colour_b).min(axis=1) > 3.0) & (
        np.maximum(colour_a, colour_b).max(axis=1) < 252.0
    )  # neither black nor burnt out
    return a[fair], b[fair], colour_a[fair], colour_b[fair]


def _solve(a: I32, b: I32, colour_a: F64, colour_b: F64, views: int) -> F64:
    """(views, 2) gain and offset of one channel."""
    n = len(a)
    row = np.tile(np.arange(n), 4)
    column = np.concatenate([2 * a, 2 * a + 1, 2 * b, 2 * b + 1])
    scale = 128.0  # so that gain and offset weigh alike
    value = np.concatenate([colour_a, np.full(n, scale), -colour_b, np.full(n, -scale)])
    A = sparse.csr_matrix((value, (row, column)), shape=(n, 2 * views))
    seen = np.bincount(np.concatenate([a, b]), minlength=views).astype(np.float64)
    pull = np.repeat(PULL * np.maximum(seen, 1.0) * scale**2, 2)
    # The mean gain is 1 and the mean offset 0, or noise would draw all of them to black.
    mean = np.kron(seen / seen.sum(), np.eye(2))
    fixed = 1e3 * n * scale**2 * (mean.T @ mean)
    start = np.tile([1.0, 0.0], views)
    x = start.copy()
    weight = np.ones(n)
    for _ in range(ROUNDS):
        N = (A.T @ sparse.diags(weight) @ A).toarray() + np.diag(pull) + fixed
        x = np.linalg.solve(N, pull * start + fixed @ start)
        off = np.abs(A @ x)
        weight = HUBER_LEVELS / np.maximum(off, HUBER_LEVELS)
    return np.column_stack([x[::2], scale * x[1::2]])


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
