"""Compiled kernel of the Harris corners; :mod:`recon.tracking.matching` is the edge."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True, fastmath=True)
def _window_products(image: Any, row0: int, row1: int, sums: Any) -> None:
    """Fill ``sums`` (3, rows, W) with Ix^2, Iy^2, Ix Iy under the binomial window w of Eq. 4."""
    H, W = image.shape
    rows = row1 - row0
    products = np.zeros((3, rows + 4, W), np.float32)
    for r in range(rows + 4):
        y = row0 - 2 + r
        if y < 1 or y >= H - 1:
            continue
        up, mid, down = image[y - 1], image[y], image[y + 1]
        for x in range(1, W - 1):
            a, c = np.float32(up[x - 1]), np.float32(up[x + 1])
            g, i = np.float32(down[x - 1]), np.float32(down[x + 1])
            d, f = np.float32(mid[x - 1]), np.float32(mid[x + 1])
            gx = np.float32(0.125) * (c - a + np.float32(2) * (f - d) + i - g)
            gy = np.float32(0.125) * (
                g - a + np.float32(2) * (np.float32(down[x]) - np.float32(up[x])) + i - c
            )
            products[0, r, x] = gx * gx
            products[1, r, x] = gy * gy
            products[2, r, x] = gx * gy
    line = np.zeros(W, np.float32)
    for k in range(3):
        for r in range(rows):
            p0, p1, p2, p3, p4 = (
                products[k, r],
                products[k, r + 1],
                products[k, r + 2],
                products[k, r + 3],
                products[k, r + 4],
            )
            for x in range(W):
                line[x] = p0[x] + p4[x] + np.float32(4) * (p1[x] + p3[x]) + np.float32(6) * p2[x]
            out = sums[k, r]
            for x in range(2, W - 2):
                out[x] = np.float32(1.0 / 256) * (
                    line[x - 2]
                    + line[x + 2]
                    + np.float32(4) * (line[x - 1] + line[x + 1])
                    + np.float32(6) * line[x]
                )


@njit(cache=True, nogil=True, fastmath=True, parallel=True)
def harris_cells(
    image: Any, mask: Any, columns: int, rows: int, margin: int, k: float, found: Any
) -> None:
    """Fill ``found`` (rows, columns, 3) with u, v and R of each cell's best local maximum.

    R is zero where the cell has none. ``mask`` is (H, W) uint8 or (0, 0) for none.
    """
    H, W = image.shape
    masked = mask.shape[0] == H
    kk = np.float32(k)
    for j in prange(rows):
        y0, y1 = max(H * j // rows, margin), min(H * (j + 1) // rows, H - margin)
        if y1 <= y0:
            continue
        sums = np.zeros((3, y1 - y0 + 2, W), np.float32)
        _window_products(image, y0 - 1, y1 + 1, sums)
        response = sums[0]
        for r in range(y1 - y0 + 2):
            for x in range(W):
                a, b, c = sums[0, r, x], sums[1, r, x], sums[2, r, x]
                # Eq. (5)
                response[r, x] = a * b - c * c - kk * (a + b) * (a + b)
        for i in range(columns):
            x0, x1 = max(W * i // columns, margin), min(W * (i + 1) // columns, W - margin)
            best, bx, by = np.float32(0), 0, 0
            for r in range(1, y1 - y0 + 1):
                for x in range(x0, x1):
                    if response[r, x] > best and (not masked or mask[y0 + r - 1, x] != 0):
                        best, bx, by = response[r, x], x, r
            # The maximum of the cell may be the flank of a corner in the next cell.
            peak = best > 0 and bx > 0 and bx < W - 1
            if peak:
                for dy in range(-1, 2):
                    for dx in range(-1, 2):
                        if response[by + dy, bx + dx] > best:
                            peak = False
            if peak:
                found[j, i, 0], found[j, i, 1], found[j, i, 2] = bx, y0 + by - 1, best
