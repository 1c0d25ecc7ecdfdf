"""Which pixels are known, as bytes: an adaptive binary range coder with a 12-pixel context.

Each pixel's probability is learnt per context of neighbours that were coded before it, so
that ragged outlines cost a fraction of what zlib makes of the bits. See ``docs/wire.md``.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from recon.types import U8, Bool

CONTEXT = np.array(
    [
        [0, -1],
        [0, -2],
        [0, -3],
        [-1, -2],
        [-1, -1],
        [-1, 0],
        [-1, 1],
        [-1, 2],
        [-2, -1],
        [-2, 0],
        [-2, 1],
        [-3, 0],
    ],
    np.int64,
)
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
def _encode(padded: U8, h: int, w: int) -> tuple[U8, int]:
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
                if low > 0xFFFFFFFF:  # the carry runs back through bytes written
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
def _decode(data: U8, padded: U8, h: int, w: int) -> None:
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


def encode(known: Bool) -> bytes:
    """The section for a mask (h, w); zeros at its end are left out."""
    h, w = known.shape
    out, size = _encode(np.pad(known.astype(np.uint8), _MARGIN), h, w)
    return bytes(out[:size].tobytes().rstrip(b"\0"))


def decode(data: bytes, w: int, h: int) -> Bool:
    """(h, w) mask; any bytes give one."""
    padded = np.zeros((h + 2 * _MARGIN, w + 2 * _MARGIN), np.uint8)
    _decode(np.frombuffer(data, np.uint8), padded, h, w)
    return padded[_MARGIN : _MARGIN + h, _MARGIN : _MARGIN + w] > 0
