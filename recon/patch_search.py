"""Compiled kernels of corner detection and patch matching; :mod:`recon.matching` is the edge.

A template is a patch of image a resampled onto image b's pixel grid, made zero-mean and of
unit length, so that the zero-mean SSD of two patches, each divided by its own contrast, is
``2 (1 - score)`` with ``score`` their correlation. Images are (H, W) uint8, points (N, 2)
float64 pixels of their level; inverse warps are (N, 4) float64, rows of the 2x2 matrix that
takes an offset in b to an offset in a.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

CHUNK = 32  # points per parallel work item
NO_SCORE = -2.0


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


@njit(cache=True, nogil=True, fastmath=True)
def _sample(image: Any, u: float, v: float, w: Any, radius: int, patch: Any) -> bool:
    """Fill ``patch`` (2 radius + 1 squared) with ``image`` about (u, v); False when outside."""
    H, W = image.shape
    reach_u = (abs(w[0]) + abs(w[1])) * radius
    reach_v = (abs(w[2]) + abs(w[3])) * radius
    if not (u - reach_u >= 0 and u + reach_u < W - 1 and v - reach_v >= 0 and v + reach_v < H - 1):
        return False
    for y in range(2 * radius + 1):
        for x in range(2 * radius + 1):
            pu = u + w[0] * (x - radius) + w[1] * (y - radius)
            pv = v + w[2] * (x - radius) + w[3] * (y - radius)
            iu, iv = int(pu), int(pv)
            fu, fv = np.float32(pu - iu), np.float32(pv - iv)
            a, b = np.float32(image[iv, iu]), np.float32(image[iv, iu + 1])
            c, d = np.float32(image[iv + 1, iu]), np.float32(image[iv + 1, iu + 1])
            top, bottom = a + fu * (b - a), c + fu * (d - c)
            patch[y, x] = top + fv * (bottom - top)
    return True


@njit(cache=True, nogil=True, fastmath=True)
def _normalise(patch: Any, n: int) -> float:
    """Contrast (standard deviation, grey levels) of the n x n ``patch``, made zero-mean, unit."""
    mean = 0.0
    for y in range(n):
        for x in range(n):
            mean += patch[y, x]
    mean /= n * n
    power = 0.0
    for y in range(n):
        for x in range(n):
            patch[y, x] -= np.float32(mean)
            power += patch[y, x] * patch[y, x]
    contrast = np.sqrt(power / (n * n))
    scale = np.float32(1.0 / np.sqrt(power)) if power > 1e-6 else np.float32(0)
    for y in range(n):
        for x in range(n):
            patch[y, x] *= scale
    return float(contrast)


@njit(cache=True, nogil=True, fastmath=True)
def _scores(
    image: Any, cu: int, cv: int, reach: int, radius: int, template: Any, min_contrast: float,
    window: Any, scores: Any,
) -> None:  # fmt: skip
    """Fill ``scores`` (S, pitch) for centres within ``reach`` of (cu, cv), S = 2 reach + 1.

    ``template`` is (n, n padded with zeros to a multiple of 4); ``window`` is scratch of at
    least (S + n) * pitch, with pitch >= S + n - 1. Centres whose patch leaves the image or
    has no contrast score NO_SCORE.
    """
    H, W = image.shape
    n, S, pitch = 2 * radius + 1, 2 * reach + 1, scores.shape[1]
    u0, v0 = cu - reach - radius, cv - reach - radius
    side = S + n - 1
    # Less 128, sums of squares stay exact in float32 up to a radius of 15.
    for y in range(side):
        row = image[min(max(v0 + y, 0), H - 1)]
        line = window[y * pitch : y * pitch + side]
        if u0 >= 0 and u0 + side <= W:
            for x in range(side):
                line[x] = np.float32(row[u0 + x]) - np.float32(128)
        else:
            for x in range(side):
                line[x] = np.float32(row[min(max(u0 + x, 0), W - 1)]) - np.float32(128)
    flat = scores.reshape(-1)
    length = (S - 1) * pitch + S
    flat[:length] = np.float32(0)
    # The correlation of all centres at once: one long run per four taps of the template.
    for y in range(n):
        for x in range(0, n, 4):
            t0, t1, t2, t3 = (
                template[y, x],
                template[y, x + 1],
                template[y, x + 2],
                template[y, x + 3],
            )
            run = window[y * pitch + x :]
            for i in range(length):
                flat[i] += t0 * run[i] + t1 * run[i + 1] + t2 * run[i + 2] + t3 * run[i + 3]
    _divide_by_contrast(window, pitch, S, n, min_contrast, scores)
    # Centres whose patch leaves the image.
    for y in range(S):
        for x in range(S):
            if v0 + y < 0 or v0 + y + n > H or u0 + x < 0 or u0 + x + n > W:
                scores[y, x] = np.float32(NO_SCORE)


@njit(cache=True, nogil=True, fastmath=True)
def _divide_by_contrast(
    window: Any, pitch: int, S: int, n: int, min_contrast: float, scores: Any
) -> None:
    """Divide every score by the length of the zero-mean patch under it, by running sums."""
    side = S + n - 1
    sums, squares = np.zeros(side, np.float32), np.zeros(side, np.float32)
    for y in range(n - 1):
        line = window[y * pitch : y * pitch + side]
        for x in range(side):
            sums[x] += line[x]
            squares[x] += line[x] * line[x]
    area = np.float32(1.0 / (n * n))
    floor = np.float32(min_contrast * min_contrast * n * n)
    for y in range(S):
        old, new = window[y * pitch :], window[(y + n - 1) * pitch :]
        for x in range(side):
            sums[x] += new[x]
            squares[x] += new[x] * new[x]
        s1, s2 = np.float32(0), np.float32(0)
        for x in range(n - 1):
            s1 += sums[x]
            s2 += squares[x]
        line = scores[y]
        for x in range(S):
            s1 += sums[x + n - 1]
            s2 += squares[x + n - 1]
            power = s2 - s1 * s1 * area
            line[x] = line[x] / np.sqrt(power) if power > floor else np.float32(NO_SCORE)
            s1 -= sums[x]
            s2 -= squares[x]
        for x in range(side):
            sums[x] -= old[x]
            squares[x] -= old[x] * old[x]


@njit(cache=True, nogil=True, fastmath=True)
def _peaks(scores: Any, S: int) -> tuple[int, int, float, float]:
    """Column, row and score of the best centre, and the score of the next separate peak."""
    best, bx, by = np.float32(NO_SCORE), 0, 0
    for y in range(S):
        for x in range(S):
            if scores[y, x] > best:
                best, bx, by = scores[y, x], x, y
    second = np.float32(NO_SCORE)
    for y in range(S):
        for x in range(S):
            s = scores[y, x]
            if s <= second or (abs(x - bx) <= 2 and abs(y - by) <= 2):
                continue
            top = True
            for ny in range(max(y - 1, 0), min(y + 2, S)):
                for nx in range(max(x - 1, 0), min(x + 2, S)):
                    if scores[ny, nx] > s:
                        top = False
            if top:
                second = s
    return bx, by, float(best), float(second)


@njit(cache=True, nogil=True, fastmath=True)
def _vertex(line: Any, i: int, count: int) -> float:
    """Offset of a parabola's top from the peak ``line[i]``, -0.5 to 0.5."""
    if i == 0 or i == count - 1 or min(line[i - 1], line[i + 1]) <= -1.0:
        return 0.0
    bend = line[i - 1] - 2.0 * line[i] + line[i + 1]
    if bend > -1e-9:
        return 0.0
    return float(min(max(0.5 * (line[i - 1] - line[i + 1]) / bend, -0.5), 0.5))


@njit(cache=True, nogil=True, fastmath=True, parallel=True)
def search(
    image_a: Any, image_b: Any, uv_a: Any, uv_b: Any, inverse_warp: Any, active: Any,
    reach: int, radius: int, min_contrast: float, uv_found: Any, score: Any, second: Any,
) -> None:  # fmt: skip
    """Find each active point of a near ``uv_b`` in image b, to about a quarter of a pixel.

    Fills ``uv_found`` (N, 2), ``score`` (N,) (NO_SCORE when nothing could be compared) and
    ``second`` (N,), the score of the next separate peak in the window.
    """
    N = uv_a.shape[0]
    H, W = image_b.shape
    n, S = 2 * radius + 1, 2 * reach + 1
    padded = (n + 3) // 4 * 4
    pitch = S + n - 1
    for chunk in prange((N + CHUNK - 1) // CHUNK):
        patch = np.zeros((n, padded), np.float32)
        window = np.zeros((S + n) * pitch + 4, np.float32)
        scores = np.zeros((S, pitch), np.float32)
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, N)):
            score[p], second[p] = NO_SCORE, NO_SCORE
            cu, cv = int(np.floor(uv_b[p, 0] + 0.5)), int(np.floor(uv_b[p, 1] + 0.5))
            outside = cu < -reach or cv < -reach or cu >= W + reach or cv >= H + reach
            if not active[p] or outside:
                continue
            if not _sample(image_a, uv_a[p, 0], uv_a[p, 1], inverse_warp[p], radius, patch):
                continue
            if _normalise(patch, n) < min_contrast:
                continue
            _scores(image_b, cu, cv, reach, radius, patch, min_contrast, window, scores)
            bx, by, score[p], second[p] = _peaks(scores, S)
            uv_found[p, 0] = cu - reach + bx + _vertex(scores[by], bx, S)
            uv_found[p, 1] = cv - reach + by + _vertex(scores[:, bx], by, S)


@njit(cache=True, nogil=True, fastmath=True)
def _cubic(f: float, weights: Any) -> None:
    """Fill ``weights`` (4,) of Catmull-Rom interpolation at the fraction ``f``."""
    weights[0] = ((-0.5 * f + 1.0) * f - 0.5) * f
    weights[1] = (1.5 * f - 2.5) * f * f + 1.0
    weights[2] = ((-1.5 * f + 2.0) * f + 0.5) * f
    weights[3] = (0.5 * f - 0.5) * f * f


@njit(cache=True, nogil=True, fastmath=True)
def _sample_cubic(image: Any, u: float, v: float, radius: int, rows: Any, patch: Any) -> bool:
    """Fill ``patch`` with ``image`` about (u, v), axes aligned; False when outside.

    Every pixel has the same fraction, so the interpolation is one separable filter.
    """
    H, W = image.shape
    n = 2 * radius + 1
    u0, v0 = int(np.floor(u)) - radius - 1, int(np.floor(v)) - radius - 1
    if not (u0 >= 0 and v0 >= 0 and u0 + n + 3 <= W and v0 + n + 3 <= H):
        return False
    wx, wy = np.empty(4, np.float32), np.empty(4, np.float32)
    _cubic(u - np.floor(u), wx)
    _cubic(v - np.floor(v), wy)
    for y in range(n + 3):
        line = image[v0 + y]
        for x in range(n):
            rows[y, x] = (
                wx[0] * np.float32(line[u0 + x])
                + wx[1] * np.float32(line[u0 + x + 1])
                + wx[2] * np.float32(line[u0 + x + 2])
                + wx[3] * np.float32(line[u0 + x + 3])
            )
    for y in range(n):
        for x in range(n):
            patch[y, x] = (
                wy[0] * rows[y, x]
                + wy[1] * rows[y + 1, x]
                + wy[2] * rows[y + 2, x]
                + wy[3] * rows[y + 3, x]
            )
    return True


@njit(cache=True, nogil=True, fastmath=True)
def _gradients(large: Any, n: int, patch: Any, gx: Any, gy: Any) -> None:
    """Fill the template and its slopes from ``large`` (n + 2 squared), free of gain and offset.

    ``patch`` becomes zero-mean and unit; both slopes are scaled with it and made orthogonal
    to it and to a constant, so a step along them changes neither brightness nor contrast.
    """
    for y in range(n):
        for x in range(n):
            patch[y, x] = large[y + 1, x + 1]
    contrast = max(_normalise(patch, n), 1e-3)
    scale = np.float32(0.5 / (contrast * n))
    mx, my, dx, dy = 0.0, 0.0, 0.0, 0.0
    for y in range(n):
        for x in range(n):
            gx[y, x] = scale * (large[y + 1, x + 2] - large[y + 1, x])
            gy[y, x] = scale * (large[y + 2, x + 1] - large[y, x + 1])
            mx += gx[y, x]
            my += gy[y, x]
            dx += gx[y, x] * patch[y, x]
            dy += gy[y, x] * patch[y, x]
    for y in range(n):
        for x in range(n):
            gx[y, x] -= np.float32(mx / (n * n) + dx * patch[y, x])
            gy[y, x] -= np.float32(my / (n * n) + dy * patch[y, x])


@njit(cache=True, nogil=True, fastmath=True, parallel=True)
def refine(
    image_a: Any, image_b: Any, uv_a: Any, inverse_warp: Any, active: Any, radius: int,
    iterations: int, uv_b: Any, score: Any, contrast: Any,
) -> None:  # fmt: skip
    """Move ``uv_b`` (N, 2) to the sub-pixel minimum of the normalised zero-mean SSD, in place.

    Gauss-Newton with the template's slopes (constant normal matrix, Baker and Matthews 2004,
    doi:10.1023/B:VISI.0000011205.11775.fd). Fills ``score`` (NO_SCORE when it left the image,
    diverged by more than 1.5 px or has no two-dimensional texture) and ``contrast`` of b.
    """
    N = uv_a.shape[0]
    n = 2 * radius + 1
    for chunk in prange((N + CHUNK - 1) // CHUNK):
        large = np.empty((n + 2, n + 2), np.float32)
        patch, other = np.empty((n, n), np.float32), np.empty((n, n), np.float32)
        gx, gy = np.empty((n, n), np.float32), np.empty((n, n), np.float32)
        rows = np.empty((n + 3, n), np.float32)
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, N)):
            score[p], contrast[p] = NO_SCORE, 0.0
            if not active[p]:
                continue
            if not _sample(image_a, uv_a[p, 0], uv_a[p, 1], inverse_warp[p], radius + 1, large):
                continue
            _gradients(large, n, patch, gx, gy)
            a, b, c = 0.0, 0.0, 0.0
            for y in range(n):
                for x in range(n):
                    a += gx[y, x] * gx[y, x]
                    b += gy[y, x] * gy[y, x]
                    c += gx[y, x] * gy[y, x]
            det = a * b - c * c
            if det <= 1e-4 * (a + b) * (a + b):
                continue
            u, v = uv_b[p, 0], uv_b[p, 1]
            for _ in range(iterations):
                if not _sample_cubic(image_b, u, v, radius, rows, other):
                    score[p] = NO_SCORE
                    break
                contrast[p] = _normalise(other, n)
                s, rx, ry = 0.0, 0.0, 0.0
                for y in range(n):
                    for x in range(n):
                        residual = patch[y, x] - other[y, x]
                        s += patch[y, x] * other[y, x]
                        rx += gx[y, x] * residual
                        ry += gy[y, x] * residual
                score[p] = s
                du, dv = (b * rx - c * ry) / det, (a * ry - c * rx) / det
                u += du
                v += dv
                if abs(u - uv_b[p, 0]) > 1.5 or abs(v - uv_b[p, 1]) > 1.5:
                    score[p] = NO_SCORE
                    break
                if abs(du) < 0.02 and abs(dv) < 0.02:
                    break
            uv_b[p, 0], uv_b[p, 1] = u, v
