"""Compiled loops over a keyframe's planes: lossless coding of its mask, and of its depth codes with
the holes of that mask; planes made smaller, and colour without edges at holes.

The mask is coded by an adaptive binary range coder: the probability of each pixel is learnt per
context of 12 previously coded neighbours, which codes ragged outlines far better than zlib.

Depth codes: each known pixel is predicted from up to ten known, previously coded neighbours, with
weights fitted to the image; unknown pixels cost nothing. JPEG-LS has no notion of holes, and its
three-neighbour predictor triples the variance of noise. The section is nine int16 weights
(little-endian, 4096 is one) and a zlib stream (Huffman only).

The bytes are specified in ``docs/wire.md``.
"""

from __future__ import annotations

import zlib
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from recon.types import F32, F64, I64, U8, U16, Bool

CONTEXT = np.array(
    [[0, -1], [0, -2], [0, -3], [-1, -2], [-1, -1], [-1, 0], [-1, 1], [-1, 2], [-2, -1], [-2, 0],
     [-2, 1], [-3, 0]], np.int64,
)  # fmt: skip
"""(row, column) to the neighbours; the k-th is bit k of the context. Outside is unknown."""
PROBABILITY_BITS = 12
RATE = 4
_TOP = 1 << 24
_MARGIN = 3


@numba.njit(cache=True, nogil=True, inline="always")
def _context(padded: U8, v: int, u: int) -> Any:
    context = 0
    for k in range(CONTEXT.shape[0]):
        bit = padded[v + _MARGIN + CONTEXT[k, 0], u + _MARGIN + CONTEXT[k, 1]]
        context |= np.int64(bit) << k
    return context


@numba.njit(cache=True, nogil=True)
def _encode_bits(padded: U8, h: int, w: int) -> tuple[U8, int]:
    out = np.zeros(h * w // 4 + 64 + h * w, np.uint8)
    chances = np.full(1 << CONTEXT.shape[0], 1 << (PROBABILITY_BITS - 1), np.int64)
    low, span = np.int64(0), np.int64(0xFFFFFFFF)
    at = 0
    for v in range(h):
        for u in range(w):
            context = _context(padded, v, u)
            chance = chances[context]
            bound = (span >> PROBABILITY_BITS) * chance
            if padded[v + _MARGIN, u + _MARGIN]:
                low += bound
                span -= bound
                chances[context] = chance - (chance >> RATE)
                if low > 0xFFFFFFFF:  # propagate the carry through written bytes
                    low &= 0xFFFFFFFF
                    k = at - 1
                    while out[k] == 255:
                        out[k] = 0
                        k -= 1
                    out[k] += 1
            else:
                span = bound
                chances[context] = chance + (((1 << PROBABILITY_BITS) - chance) >> RATE)
            while span < _TOP:
                out[at] = low >> 24
                at += 1
                low = (low << 8) & 0xFFFFFFFF
                span <<= 8
    for _ in range(4):
        out[at] = low >> 24
        at += 1
        low = (low << 8) & 0xFFFFFFFF
    return out, at


@numba.njit(cache=True, nogil=True)
def _decode_bits(data: U8, padded: U8, h: int, w: int) -> None:
    chances = np.full(1 << CONTEXT.shape[0], 1 << (PROBABILITY_BITS - 1), np.int64)
    span = np.int64(0xFFFFFFFF)
    code = np.int64(0)
    at = 0
    for _ in range(4):
        code = code << 8 | (np.int64(data[at]) if at < data.size else 0)
        at += 1
    for v in range(h):
        for u in range(w):
            context = _context(padded, v, u)
            chance = chances[context]
            bound = (span >> PROBABILITY_BITS) * chance
            if code >= bound:
                code -= bound
                span -= bound
                chances[context] = chance - (chance >> RATE)
                padded[v + _MARGIN, u + _MARGIN] = 1
            else:
                span = bound
                chances[context] = chance + (((1 << PROBABILITY_BITS) - chance) >> RATE)
            while span < _TOP:
                code = (code << 8 | (np.int64(data[at]) if at < data.size else 0)) & 0xFFFFFFFF
                at += 1
                span <<= 8


def encode_mask(known: Bool) -> bytes:
    """The section for a mask (h, w), without trailing zeros; empty when all pixels are known."""
    if known.all():
        return b""
    h, w = known.shape
    out, size = _encode_bits(np.pad(known.astype(np.uint8), _MARGIN), h, w)
    return bytes(out[:size].tobytes().rstrip(b"\0"))


def decode_mask(data: bytes, w: int, h: int) -> Bool:
    """(h, w) mask; accepts any bytes."""
    if not data:
        return np.ones((h, w), np.bool_)
    padded = np.zeros((h + 2 * _MARGIN, w + 2 * _MARGIN), np.uint8)
    _decode_bits(np.frombuffer(data, np.uint8), padded, h, w)
    return padded[_MARGIN : _MARGIN + h, _MARGIN : _MARGIN + w] > 0


NEIGHBOURS = np.array(
    [
        [0, -1],  # west: the base that the others are compared with
        [-1, 0],
        [-1, -1],
        [-1, 1],
        [0, -2],
        [-2, 0],
        [-2, -1],
        [-2, 1],
        [-1, 2],
        [-1, -2],
    ],
    np.int64,
)
"""(row, column) from the pixel to its neighbours, in the order of the weights."""
WEIGHTS = len(NEIGHBOURS) - 1
SHIFT = 12
ESCAPE = 255
_PLANE = np.array([1.0, -1.0, 0, 0, 0, 0, 0, 0, 0])
"""Weights of plane prediction, W + N - NW: the prior of the fit."""
_PRIOR = 20.0
FIT_PIXELS = 2_500  # approximate number of known pixels in the fit


MARGIN = 2  # margin of unknown pixels around the plane, so that every neighbour exists


@numba.njit(cache=True, nogil=True, inline="always")
def _base(c: Any, k: Any, i: int, row: int, last: Any) -> Any:
    """The first known of W, N, NE, NW; otherwise the pixel coded last."""
    if k[i - 1] != 0:
        return c[i - 1]
    if k[i - row] != 0:
        return c[i - row]
    if k[i - row + 1] != 0:
        return c[i - row + 1]
    if k[i - row - 1] != 0:
        return c[i - row - 1]
    return last


@numba.njit(cache=True, nogil=True, inline="always")
def _guess(c: I64, k: I64, i: int, row: int, base: int, w: I64) -> Any:
    """The prediction of pixel ``i``, 0 to 65535."""
    total = 1 << (SHIFT - 1)
    for j in range(WEIGHTS):
        at = i + NEIGHBOURS[j + 1, 0] * row + NEIGHBOURS[j + 1, 1]
        total += w[j] * (c[at] - base) * k[at]
    return min(max(base + (total >> SHIFT), 0), 65535)


@numba.njit(cache=True, nogil=True)
def _normal_equations(c: I64, k: I64, size: tuple[int, int], step: int) -> tuple[F64, F64]:
    """Weighted sums of the fit over every ``step``-th pixel; smooth surroundings weigh more. The
    sums are the lower triangle of a symmetric matrix."""
    h, w = size
    row = w + 2 * MARGIN
    A = np.zeros((9, 9))
    b = np.zeros(9)
    x = np.zeros(9)
    for v in range(h):
        for u in range((v * 7) % step, w, step):
            i = (v + MARGIN) * row + u + MARGIN
            if k[i] == 0 or k[i - 1] == 0:
                continue
            base = c[i - 1]
            for j in range(9):
                at = i + NEIGHBOURS[j + 1, 0] * row + NEIGHBOURS[j + 1, 1]
                x[j] = (c[at] - base) * k[at]
            unrest = 2.0 + abs(x[0]) + abs(x[1]) + abs(x[2]) + abs(x[3])
            weight = 1.0 / (unrest * unrest)
            for j in range(9):
                b[j] += weight * x[j] * (c[i] - base)
                for m in range(j + 1):
                    A[j, m] += weight * x[j] * x[m]
    return A, b


@numba.njit(cache=True, nogil=True)
def _residuals(c: F64, k: F64, size: tuple[int, int], weights: I64) -> U16:
    """Zigzag residuals of the known pixels in scan order. The predictions of a row are computed at
    once in float64, where these integers are exact."""
    h, w = size
    row = w + 2 * MARGIN
    f = weights.astype(np.float64)
    base = np.zeros(w)
    guess = np.zeros(w)
    zigzag = np.zeros(w, np.uint16)
    out = np.empty(h * w, np.uint16)
    last = 0.0
    at = 0
    for v in range(h):
        start = (v + MARGIN) * row + MARGIN
        if not k[start : start + w].any():
            continue
        # Slices keep the compiler from checking every index for being negative.
        known, code = k[start : start + w], c[start : start + w]
        west_known, west = k[start - 1 : start - 1 + w], c[start - 1 : start - 1 + w]
        for u in range(w):
            if known[u]:
                base[u] = west[u] if west_known[u] else _base(c, k, start + u, row, last)
                last = code[u]
        _guess_row(c, k, start, row, base, f, guess)
        for u in range(w):
            r = ((np.int32(code[u] - guess[u]) + 32768) & 0xFFFF) - 32768
            zigzag[u] = (r << 1) ^ (r >> 31)
        for u in range(w):
            if known[u]:
                out[at] = zigzag[u]
                at += 1
    return out[:at]


@numba.njit(cache=True, nogil=True)
def _guess_row(c: F64, k: F64, start: int, row: int, base: F64, f: F64, guess: F64) -> None:
    """Fill ``guess`` for the row of pixels that begins at ``start``."""
    w = base.size
    total = np.full(w, 2048.0)
    for j in range(9):
        at = start + NEIGHBOURS[j + 1, 0] * row + NEIGHBOURS[j + 1, 1]
        near, there = c[at : at + w], k[at : at + w]
        weight = f[j]
        for u in range(w):
            total[u] += weight * (near[u] - base[u]) * there[u]
    for u in range(w):
        guess[u] = min(max(base[u] + np.floor(total[u] / 4096.0), 0.0), 65535.0)


@numba.njit(cache=True, nogil=True)
def _restore(residuals: U16, c: I64, k: I64, size: tuple[int, int], weights: I64) -> None:
    """Fill ``c`` from zigzag residuals."""
    h, w = size
    row = w + 2 * MARGIN
    last = 0
    at = 0
    for v in range(h):
        start = (v + MARGIN) * row + MARGIN
        for i in range(start, start + w):
            if k[i]:
                guess = _guess(c, k, i, row, _base(c, k, i, row, last), weights)
                z = np.int64(residuals[at])
                r = -((z + 1) >> 1) if z & 1 else z >> 1
                last = (guess + r) & 0xFFFF
                c[i] = last
                at += 1


def _padded(plane: npt.NDArray[np.generic]) -> I64:
    return np.pad(plane.astype(np.int64), MARGIN).reshape(-1)


def fit(c: I64, k: I64, size: tuple[int, int]) -> I64:
    """(9,) weights, 4096 is one, that predict the padded codes best; least squares about a
    plane."""
    step = max(1, round(k.sum() / FIT_PIXELS))
    A, b = _normal_equations(c, k, size, step)
    A += np.tril(A, -1).T + _PRIOR * np.eye(WEIGHTS)
    weights = np.linalg.solve(A, b + _PRIOR * _PLANE)
    return np.asarray(np.rint(np.clip(weights, -7.9, 7.9) * (1 << SHIFT)), np.int64)


def encode_codes(codes: U16, known: Bool) -> bytes:
    """The section for ``codes`` (h, w) at the ``known`` pixels."""
    size = known.shape[0], known.shape[1]
    c, k = _padded(codes), _padded(known)
    weights = fit(c, k, size)
    residuals = _residuals(c.astype(np.float64), k.astype(np.float64), size, weights)
    symbols = np.minimum(residuals, ESCAPE).astype(np.uint8)
    escaped = residuals[residuals >= ESCAPE].astype("<u2")
    packer = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_HUFFMAN_ONLY)
    packed = packer.compress(symbols.tobytes() + escaped.tobytes()) + packer.flush()
    return weights.astype("<i2").tobytes() + packed


def decode_codes(data: bytes, known: Bool) -> U16 | None:
    """(h, w) codes, zero where unknown; None for invalid bytes."""
    count = int(np.count_nonzero(known))
    if len(data) < 2 * WEIGHTS:
        return None
    try:
        raw = zlib.decompressobj().decompress(data[2 * WEIGHTS :], 3 * count + 1)
    except zlib.error:
        return None
    symbols: U8 = np.frombuffer(raw[:count], np.uint8)
    escapes = symbols == ESCAPE
    if len(raw) != count + 2 * int(np.count_nonzero(escapes)):
        return None
    residuals = symbols.astype(np.uint16)
    residuals[escapes] = np.frombuffer(raw[count:], "<u2")
    weights = np.frombuffer(data[: 2 * WEIGHTS], "<i2").astype(np.int64)
    h, w = known.shape
    codes = np.zeros((h + 2 * MARGIN) * (w + 2 * MARGIN), np.int64)
    _restore(residuals, codes, _padded(known), (h, w), weights)
    plane = codes.reshape(h + 2 * MARGIN, w + 2 * MARGIN)[MARGIN:-MARGIN, MARGIN:-MARGIN]
    return plane.astype(np.uint16)


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
