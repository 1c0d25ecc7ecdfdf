"""Compiled kernels of patch matching; :mod:`recon.tracking.matching` is the edge.

A template is a patch of image a resampled onto image b's pixel grid, made zero-mean and of
unit length, so that the zero-mean SSD of two patches, each divided by its own contrast, is
``2 (1 - score)`` with ``score`` their correlation. Images are (H, W) uint8, points (N, 2)
float64 pixels of their level; inverse warps are (N, 4) float64, rows of the 2x2 matrix that
takes an offset in b to an offset in a.

With ``fastmath`` a function that is compiled alone rounds otherwise than its copy in a caller, and
which of the two runs depends on what was cached. So callees are inlined.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

CHUNK = 32  # points per parallel work item
NO_SCORE = -2.0


@njit(inline="always", fastmath=True)
def _sample(image: Any, u: float, v: float, w: Any, radius: int, patch: Any) -> bool:
    """Fill ``patch`` (2 radius + 1 squared) with ``image`` about (u, v); False when outside."""
    H, W = image.shape
    w0, w1, w2, w3 = w[0], w[1], w[2], w[3]
    reach_u = (abs(w0) + abs(w1)) * radius
    reach_v = (abs(w2) + abs(w3)) * radius
    if not (u - reach_u >= 0 and u + reach_u < W - 1 and v - reach_v >= 0 and v + reach_v < H - 1):
        return False
    # Fixed point: places in 1/65536 px, weights in 1/2048, so that no pixel is converted.
    n = 2 * radius + 1
    flat, pitch = image.reshape(-1), np.uint64(W)
    step_u, step_v = np.int64(w0 * 65536), np.int64(w2 * 65536)
    for y in range(n):
        line = patch[y]
        pu = np.int64((u - w0 * radius + w1 * (y - radius)) * 65536)
        pv = np.int64((v - w2 * radius + w3 * (y - radius)) * 65536)
        for x in range(n):
            i = np.uint64(pv >> 16) * pitch + np.uint64(pu >> 16)
            j = i + pitch
            fu, fv = np.int32((pu >> 5) & 2047), np.int32((pv >> 5) & 2047)
            a, b = np.int32(flat[i]), np.int32(flat[i + np.uint64(1)])
            c, d = np.int32(flat[j]), np.int32(flat[j + np.uint64(1)])
            top, bottom = (a << 11) + fu * (b - a), (c << 11) + fu * (d - c)
            line[x] = np.float32((top << 11) + fv * (bottom - top)) * np.float32(2.0**-22)
            pu += step_u
            pv += step_v
    return True


@njit(inline="always", fastmath=True)
def _normalise(patch: Any, n: int) -> float:
    """Contrast (standard deviation, gray levels) of the n x n ``patch``, made zero-mean, unit."""
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


@njit(inline="always", fastmath=True)
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
                template[y, x], template[y, x + 1], template[y, x + 2], template[y, x + 3],
            )  # fmt: skip
            run = window[y * pitch + x :]
            for i in range(length):
                flat[i] += t0 * run[i] + t1 * run[i + 1] + t2 * run[i + 2] + t3 * run[i + 3]
    _divide_by_contrast(window, pitch, S, n, min_contrast, scores)
    # Centres whose patch leaves the image.
    for y in range(S):
        for x in range(S):
            if v0 + y < 0 or v0 + y + n > H or u0 + x < 0 or u0 + x + n > W:
                scores[y, x] = np.float32(NO_SCORE)


@njit(inline="always", fastmath=True)
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


@njit(inline="always", fastmath=True)
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


@njit(inline="always", fastmath=True)
def _vertex(line: Any, i: int, count: int) -> float:
    """Offset of a parabola's top from the peak ``line[i]``, -0.5 to 0.5."""
    if i == 0 or i == count - 1 or min(line[i - 1], line[i + 1]) <= -1.0:
        return 0.0
    bend = line[i - 1] - 2.0 * line[i] + line[i + 1]
    if bend > -1e-9:
        return 0.0
    return float(min(max(0.5 * (line[i - 1] - line[i + 1]) / bend, -0.5), 0.5))


@njit(cache=True, nogil=True, fastmath=True)
def search(
    begin: int, end: int, image_a: Any, image_b: Any, uv_a: Any, uv_b: Any,
    inverse_warp: Any, active: Any,
    reach: int, radius: int, min_contrast: float, uv_found: Any, score: Any, second: Any,
    contrast: Any,
) -> None:  # fmt: skip
    """Find each active point of a near ``uv_b`` in image b, to about a quarter of a pixel.

    Fills ``uv_found`` (N, 2), ``score`` (N,) (NO_SCORE when nothing could be compared) and
    ``second`` (N,), the score of the next separate peak in the window, and ``contrast`` (N,)
    of the patch of a.
    """
    N = uv_a.shape[0]
    H, W = image_b.shape
    n, S = 2 * radius + 1, 2 * reach + 1
    padded = (n + 3) // 4 * 4
    pitch = S + n - 1
    for chunk in range(begin, end):
        patch = np.zeros((n, padded), np.float32)
        window = np.zeros((S + n) * pitch + 4, np.float32)
        scores = np.zeros((S, pitch), np.float32)
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, N)):
            score[p], second[p], contrast[p] = NO_SCORE, NO_SCORE, 0.0
            cu, cv = int(np.floor(uv_b[p, 0] + 0.5)), int(np.floor(uv_b[p, 1] + 0.5))
            outside = cu < -reach or cv < -reach or cu >= W + reach or cv >= H + reach
            if not active[p] or outside:
                continue
            if not _sample(image_a, uv_a[p, 0], uv_a[p, 1], inverse_warp[p], radius, patch):
                continue
            contrast[p] = _normalise(patch, n)
            if contrast[p] < min_contrast:
                continue
            _scores(image_b, cu, cv, reach, radius, patch, min_contrast, window, scores)
            bx, by, score[p], second[p] = _peaks(scores, S)
            uv_found[p, 0] = cu - reach + bx + _vertex(scores[by], bx, S)
            uv_found[p, 1] = cv - reach + by + _vertex(scores[:, bx], by, S)


@njit(inline="always", fastmath=True)
def _cubic(f: float, weights: Any) -> None:
    """Fill ``weights`` (4,) of Catmull-Rom interpolation at the fraction ``f``."""
    weights[0] = ((-0.5 * f + 1.0) * f - 0.5) * f
    weights[1] = (1.5 * f - 2.5) * f * f + 1.0
    weights[2] = ((-1.5 * f + 2.0) * f + 0.5) * f
    weights[3] = (0.5 * f - 0.5) * f * f


@njit(inline="always", fastmath=True)
def _window(image: Any, u0: int, v0: int, pitch: int, window: Any) -> bool:
    """Fill flat ``window`` with the ``pitch`` squared pixels from (u0, v0); False when outside."""
    H, W = image.shape
    if not (u0 >= 0 and v0 >= 0 and u0 + pitch <= W and v0 + pitch <= H):
        return False
    for y in range(pitch):
        line = image[v0 + y]
        for x in range(pitch):
            window[y * pitch + x] = np.float32(line[u0 + x]) - np.float32(128)
    return True


@njit(inline="always", fastmath=True)
def _interpolate(window: Any, fu: float, fv: float, pitch: int, rows: Any, out: Any) -> None:
    """Fill flat ``out`` with ``window`` moved by the fraction (fu, fv), Catmull-Rom.

    All pixels have one fraction, so it is one separable filter over the flat window. The last
    three columns of each row run into the next row and mean nothing.
    """
    w = np.empty(4, np.float32)
    _cubic(fu, w)
    w0, w1, w2, w3 = w[0], w[1], w[2], w[3]
    for i in range(pitch * pitch - 3):
        rows[i] = w0 * window[i] + w1 * window[i + 1] + w2 * window[i + 2] + w3 * window[i + 3]
    _cubic(fv, w)
    w0, w1, w2, w3 = w[0], w[1], w[2], w[3]
    below, second, third = rows[pitch:], rows[2 * pitch :], rows[3 * pitch :]
    for i in range(pitch * (pitch - 3)):
        out[i] = w0 * rows[i] + w1 * below[i] + w2 * second[i] + w3 * third[i]


@njit(inline="always", fastmath=True)
def _template(large: Any, n: int, pitch: int, kernels: Any) -> float:
    """Fill kernels 0 to 2 of ``kernels`` (4, n * pitch) from ``large``; return its contrast.

    ``large`` (n + 2, pitch) holds the patch and a border of one. Kernel 0 is the template,
    zero-mean and unit; 1 and 2 combine its slopes so that their products with a patch are the
    Gauss-Newton step along u and v; they are free of constants and of the template itself, so
    brightness and contrast do not move the step. Kernel 3, given, is one inside the patch.
    Zero when the template has no two-dimensional texture. Flat runs: rows have one pitch.
    """
    patch, gx, gy, inside = kernels[0], kernels[1], kernels[2], kernels[3]
    size, area = n * pitch - 3, np.float32(n * n)  # the last three lie outside the patch
    flat = large.reshape(-1)
    up, left, middle = flat[1:], flat[pitch:], flat[pitch + 1 :]
    right, down = flat[pitch + 2 :], flat[2 * pitch + 1 :]
    total, squares = np.float32(0), np.float32(0)
    for i in range(size):
        patch[i] = inside[i] * (middle[i] - np.float32(128))
        total += patch[i]
        squares += patch[i] * patch[i]
    mean = total / area
    power = squares - total * mean
    if power < 1e-3:
        return 0.0
    scale = np.float32(1.0 / np.sqrt(power))
    half = np.float32(0.5) * scale
    mx, my, dx, dy = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for i in range(size):
        patch[i] = scale * (patch[i] - mean * inside[i])
        gx[i] = half * inside[i] * (right[i] - left[i])
        gy[i] = half * inside[i] * (down[i] - up[i])
        mx += gx[i]
        my += gy[i]
        dx += gx[i] * patch[i]
        dy += gy[i] * patch[i]
    mx, my = mx / area, my / area
    a, b, c = np.float32(0), np.float32(0), np.float32(0)
    for i in range(size):
        gx[i] -= mx * inside[i] + dx * patch[i]
        gy[i] -= my * inside[i] + dy * patch[i]
        a += gx[i] * gx[i]
        b += gy[i] * gy[i]
        c += gx[i] * gy[i]
    det = a * b - c * c
    if det <= np.float32(1e-4) * (a + b) * (a + b):
        return 0.0
    for i in range(size):
        along = (b * gx[i] - c * gy[i]) / det
        gy[i] = (a * gy[i] - c * gx[i]) / det
        gx[i] = along
    return float(np.sqrt(power) / n)


@njit(inline="always", fastmath=True)
def _compare(kernels: Any, other: Any, n: int, sums: Any) -> None:
    """Fill ``sums`` (4,): score, step along u, step along v, contrast of ``other``."""
    patch, gx, gy, inside = kernels[0], kernels[1], kernels[2], kernels[3]
    score, su, sv = np.float32(0), np.float32(0), np.float32(0)
    total, squares = np.float32(0), np.float32(0)
    for i in range(len(patch)):
        value = other[i]
        score += patch[i] * value
        su += gx[i] * value
        sv += gy[i] * value
        total += inside[i] * value
        squares += inside[i] * value * value
    power = max(squares - total * total / (n * n), np.float32(1e-3))
    length = np.sqrt(power)
    # The template itself has no part along its slopes, so the residual is minus the patch.
    sums[0], sums[1], sums[2] = score / length, -su / length, -sv / length
    sums[3] = length / n


@njit(cache=True, nogil=True, fastmath=True)
def refine(
    begin: int, end: int, image_a: Any, image_b: Any, uv_a: Any, inverse_warp: Any, active: Any,
    radius: int,
    iterations: int, uv_b: Any, score: Any, contrast_a: Any, contrast_b: Any,
) -> None:  # fmt: skip
    """Move ``uv_b`` (N, 2) to the sub-pixel minimum of the normalised zero-mean SSD, in place.

    Gauss-Newton with the template's slopes (constant normal matrix, Baker and Matthews 2004,
    doi:10.1023/B:VISI.0000011205.11775.fd). Fills ``score`` (NO_SCORE when it left the image,
    went further than 2 px or has no two-dimensional texture) and the contrast of both patches.
    """
    N = uv_a.shape[0]
    n = 2 * radius + 1
    pitch = n + 3
    for chunk in range(begin, end):
        large = np.zeros((n + 2, pitch), np.float32)
        kernels = np.zeros((4, n * pitch), np.float32)
        for y in range(n):
            kernels[3, y * pitch : y * pitch + n] = np.float32(1)
        window = np.empty(pitch * pitch, np.float32)
        rows, other = np.zeros(pitch * pitch, np.float32), np.empty(n * pitch, np.float32)
        sums = np.empty(4)
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, N)):
            score[p], contrast_a[p], contrast_b[p] = NO_SCORE, 0.0, 0.0
            if not active[p]:
                continue
            if not _sample(image_a, uv_a[p, 0], uv_a[p, 1], inverse_warp[p], radius + 1, large):
                continue
            contrast_a[p] = _template(large, n, pitch, kernels)
            if contrast_a[p] == 0.0:
                continue
            u, v = uv_b[p, 0], uv_b[p, 1]
            held_u, held_v = -1, -1
            for _ in range(iterations):
                u0, v0 = int(np.floor(u)), int(np.floor(v))
                if u0 != held_u or v0 != held_v:
                    corner_u, corner_v = u0 - radius - 1, v0 - radius - 1
                    if not _window(image_b, corner_u, corner_v, pitch, window):
                        score[p] = NO_SCORE
                        break
                    held_u, held_v = u0, v0
                _interpolate(window, u - u0, v - v0, pitch, rows, other)
                _compare(kernels, other, n, sums)
                score[p], contrast_b[p] = sums[0], sums[3]
                u += sums[1]
                v += sums[2]
                if abs(u - uv_b[p, 0]) > 2.0 or abs(v - uv_b[p, 1]) > 2.0:
                    score[p] = NO_SCORE
                    break
                if abs(sums[1]) < 0.02 and abs(sums[2]) < 0.02:
                    break
            uv_b[p, 0], uv_b[p, 1] = u, v
