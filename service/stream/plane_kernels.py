"""Compiled pixel loops of :mod:`service.stream.planes`."""

from __future__ import annotations

import numba
import numpy as np

from recon.types import F32, U8, Bool


@numba.njit(cache=True, nogil=True)
def reduce(
    depth: F32, sigma: F32, views: U8, bgr: U8, known: Bool, factor: int, spread: float
) -> tuple[F32, F32, U8, U8, Bool]:
    """Depth, sigma, views, colour and mask at 1/factor of the size.

    Inverse depth is averaged; where it varies within a block by more than ``spread`` of its
    mean (rms), the middle pixel is used. A block is known when a quarter of it is.
    """
    h, w = depth.shape
    rows, columns = -(-h // factor), -(-w // factor)
    out_depth = np.ones((rows, columns), np.float32)
    out_sigma = np.zeros((rows, columns), np.float32)
    out_views = np.ones((rows, columns), np.uint8)
    out_bgr = np.zeros((rows, columns, 3), np.uint8)
    out_known = np.zeros((rows, columns), np.bool_)
    for row in range(rows):
        top, bottom = row * factor, min(h, (row + 1) * factor)
        for column in range(columns):
            left, right = column * factor, min(w, (column + 1) * factor)
            count, total, squares, sigmas, seen = 0, 0.0, 0.0, 0.0, 0
            blue, green, red = 0, 0, 0
            for v in range(top, bottom):
                for u in range(left, right):
                    if known[v, u]:
                        inverse = 1.0 / np.float64(depth[v, u])
                        count += 1
                        total += inverse
                        squares += inverse * inverse
                        sigmas += sigma[v, u]
                        seen += views[v, u]
                        blue += bgr[v, u, 0]
                        green += bgr[v, u, 1]
                        red += bgr[v, u, 2]
            if 4 * count < factor * factor:
                continue
            mean = total / count
            middle_v, middle_u = min(top + factor // 2, h - 1), min(left + factor // 2, w - 1)
            torn = squares / count - mean * mean > (spread * mean) ** 2
            if torn and known[middle_v, middle_u]:
                mean = 1.0 / np.float64(depth[middle_v, middle_u])
            out_known[row, column] = True
            out_depth[row, column] = 1.0 / mean
            out_sigma[row, column] = sigmas / count
            out_views[row, column] = (seen + count // 2) // count
            out_bgr[row, column, 0] = (blue + count // 2) // count
            out_bgr[row, column, 1] = (green + count // 2) // count
            out_bgr[row, column, 2] = (red + count // 2) // count
    return out_depth, out_sigma, out_views, out_bgr, out_known


@numba.njit(cache=True, nogil=True)
def calm(bgr: U8, known: Bool, block: int) -> U8:
    """The image with unknown pixels set to the mean of the known ones in their block; blocks
    without any repeat the previous mean."""
    h, w = known.shape
    out = np.empty((h, w, 3), np.uint8)
    mean = np.full(3, 128, np.int64)
    for top in range(0, h, block):
        bottom = min(h, top + block)
        for left in range(0, w, block):
            right = min(w, left + block)
            count, blue, green, red = 0, 0, 0, 0
            for v in range(top, bottom):
                for u in range(left, right):
                    if known[v, u]:
                        count += 1
                        blue += bgr[v, u, 0]
                        green += bgr[v, u, 1]
                        red += bgr[v, u, 2]
            if count:
                mean[0] = (blue + count // 2) // count
                mean[1] = (green + count // 2) // count
                mean[2] = (red + count // 2) // count
            for v in range(top, bottom):
                for u in range(left, right):
                    for k in range(3):
                        out[v, u, k] = bgr[v, u, k] if known[v, u] else mean[k]
    return out
