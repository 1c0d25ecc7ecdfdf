"""Noise without repetition: hashed lattice values, smoothly interpolated, in many octaves.

Everything is a pure function of position and seed, so a flight is the same on every machine.
"""

from __future__ import annotations

from numba import njit

MASK = 0xFFFFFFFF


@njit(cache=True, nogil=True)
def hash32(i, j, k):  # type: ignore[no-untyped-def]
    """32 bits that three integers decide."""
    h = ((i & MASK) * 0x8DA6B343) & MASK
    h = (h ^ (((j & MASK) * 0xD8163841) & MASK)) & MASK
    h = (h ^ (((k & MASK) * 0xCB1AB31F) & MASK)) & MASK
    h = ((h ^ (h >> 16)) * 0x7FEB352D) & MASK
    h = ((h ^ (h >> 15)) * 0x846CA68B) & MASK
    return h ^ (h >> 16)


@njit(cache=True, nogil=True)
def hash01(i, j, k):  # type: ignore[no-untyped-def]
    """A number in [0, 1) that three integers decide."""
    return hash32(i, j, k) / 4294967296.0


@njit(cache=True, nogil=True)
def normal(i, j, k):  # type: ignore[no-untyped-def]
    """A number with mean 0 and variance 1: four bytes summed, near enough Gaussian."""
    h = hash32(i, j, k)
    total = (h & 255) + ((h >> 8) & 255) + ((h >> 16) & 255) + (h >> 24)
    return (total - 510.0) / 147.8


@njit(cache=True, nogil=True)
def value2(x, y, seed):  # type: ignore[no-untyped-def]
    """Smooth noise in [0, 1] over the plane, one lattice cell per unit."""
    i, j = int(x // 1.0), int(y // 1.0)
    fx, fy = x - i, y - j
    ux = fx * fx * fx * (fx * (fx * 6.0 - 15.0) + 10.0)
    uy = fy * fy * fy * (fy * (fy * 6.0 - 15.0) + 10.0)
    a, b = hash01(i, j, seed), hash01(i + 1, j, seed)
    c, d = hash01(i, j + 1, seed), hash01(i + 1, j + 1, seed)
    low = a + ux * (b - a)
    return low + uy * (c + ux * (d - c) - low)


@njit(cache=True, nogil=True)
def value3(x, y, z, seed):  # type: ignore[no-untyped-def]
    """Smooth noise in [0, 1] in space."""
    k = int(z // 1.0)
    f = z - k
    u = f * f * f * (f * (f * 6.0 - 15.0) + 10.0)
    low = value2(x, y, seed + 7919 * k)
    return low + u * (value2(x, y, seed + 7919 * (k + 1)) - low)


@njit(cache=True, nogil=True)
def fractal2(x, y, size_m, octaves, fall, seed):  # type: ignore[no-untyped-def]
    """Octaves of :func:`value2` from ``size_m`` downwards, mean 0, roughly within -1 to 1.

    Each octave is half the size, ``fall`` times the strength, and turned, so that the lattice
    does not show.
    """
    x, y = x / size_m, y / size_m
    total, strength, whole = 0.0, 1.0, 0.0
    for n in range(octaves):
        total += strength * (2.0 * value2(x, y, seed + 101 * n) - 1.0)
        whole += strength * strength
        strength *= fall
        x, y = 1.62 * x - 1.18 * y + 3.7, 1.18 * x + 1.62 * y - 5.1
    return total / (whole**0.5)


@njit(cache=True, nogil=True)
def smoothstep(low, high, x):  # type: ignore[no-untyped-def]
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)
