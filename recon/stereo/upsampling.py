"""Disparity at the resolution of a guidance image: joint bilateral upsampling (Eq. 2).

Kopf et al., https://doi.org/10.1145/1276377.1276497. The taps lie on the coarse grid, the
range kernel compares the guide at the fine pixel with the guide at the tap.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from recon.parallel import parallel_for
from recon.stereo.matching_cost import plain
from recon.types import F32, I32, U8, DisparityMap

SPATIAL_SIGMA = 15.0 / (2704 / 320)  # coarse pixels
RANGE_SIGMA = 15.0  # gray levels of the Euclidean distance of the colours
DIAMETER = 10  # coarse pixels: the window is the nearest 10 x 10; a multiple of GROUP
"""The paper's "filter 15, diameter 10", of its frame of 2704 px above views of 320, mapped so that
any guide size gives one look."""

MIN_SUPPORT = 0.5  # share of the weight that must fall on known taps
COLOUR_SCALE = float(np.sqrt(0.5 * np.log2(np.e)) / RANGE_SIGMA)

RANGE_FLOOR = -20.0
"""log2 of the least range weight, so that a pixel like none of its taps takes their mean."""

MIN_CONFIDENCE = 1e-3  # the least weight of a known tap

FARTHEST = -40.0
OUTSIDE = -60.0
"""log2 of the least spatial weight along one axis, and of that of a tap outside the coarse
image: nothing next to the nearest tap, and no sum leaves the range of :func:`_exp2`."""

TILE = 64
GROUP = 5
BAND = 16
CHANNELS = 6
TAP_RUN = GROUP * CHANNELS * TILE
"""Fine pixels and taps of one run of the compiled loop, rows at most that share their taps
while these lie in the nearest cache; values that a tap brings; floats of a run of taps."""


def upsample(coarse: DisparityMap, guide: U8) -> DisparityMap:
    """``coarse`` (h, w) at the size of ``guide`` (H, W, 3) uint8; the values are not rescaled.

    Unknown taps carry no weight; a fine pixel is unknown (NaN) when less than
    ``MIN_SUPPORT`` of its weight falls on known ones. Raises ValueError for bad shapes.
    """
    check_guide(coarse, guide)
    shape = (guide.shape[0], guide.shape[1])
    h, w = coarse.px.shape
    base_y, spatial_y = window(h, shape[0])
    base_x, spatial_x = window(w, shape[1])
    pad = -shape[1] % TILE
    out, sure = np.empty((2, *shape), np.float32)
    parallel_for(
        _bilateral,
        -(-shape[1] // TILE),
        _taps(coarse, guide),
        plain(guide),
        np.pad(base_x, (0, pad), mode="edge"),
        base_y,
        np.pad(spatial_x, ((0, pad), (0, 0)), constant_values=OUTSIDE),
        np.ascontiguousarray(spatial_y.T),
        out,
        sure,
    )
    return DisparityMap(out, sure)


def window(taps: int, fine: int) -> tuple[I32, F32]:
    """First tap of each fine pixel along one axis (fine,) and log2 of s (fine, diameter)."""
    q = (np.arange(fine) + 0.5) * (taps / fine) - 0.5
    first = np.ceil(q - DIAMETER / 2).astype(np.int32)
    distance = first[:, None] + np.arange(DIAMETER) - q[:, None]
    spatial = -0.5 * np.log2(np.e) * (distance / SPATIAL_SIGMA) ** 2
    return first, np.maximum(spatial, FARTHEST).astype(np.float32)


def _taps(coarse: DisparityMap, guide: U8) -> F32:
    """Colour (3), confidence * disparity, confidence and known, as (h, 6, w) float32."""
    h, w = coarse.px.shape
    taps = np.empty((h, CHANNELS, w), np.float32)
    colour = guide_at_taps(guide, (h, w))
    _fill_taps(plain(coarse.px), plain(coarse.confidence), colour, taps)
    return taps


@njit(cache=True, nogil=True)
def _fill_taps(px: Any, confidence: Any, colour: Any, taps: Any) -> None:
    for v in range(px.shape[0]):
        for u in range(px.shape[1]):
            known = not np.isnan(px[v, u])
            c = max(confidence[v, u], np.float32(MIN_CONFIDENCE)) if known else np.float32(0)
            for channel in range(3):
                taps[v, channel, u] = np.float32(COLOUR_SCALE) * np.float32(colour[v, u, channel])
            taps[v, 3, u] = c * px[v, u] if known else np.float32(0)
            taps[v, 4, u] = c
            taps[v, 5, u] = np.float32(known)


def check_guide(coarse: DisparityMap, guide: U8) -> None:
    """Raises ValueError when the shapes do not fit the contract of :func:`upsample`."""
    if guide.ndim != 3 or guide.shape[2] != 3 or guide.dtype != np.uint8:
        raise ValueError(f"the guide must be (H, W, 3) uint8, not {guide.shape} {guide.dtype}")
    if coarse.px.ndim != 2 or coarse.px.shape != coarse.confidence.shape:
        raise ValueError(f"bad disparity {coarse.px.shape}, {coarse.confidence.shape}")
    if any(a < b for a, b in zip(guide.shape, coarse.px.shape, strict=False)):
        raise ValueError(f"guide {guide.shape[:2]} is smaller than disparity {coarse.px.shape}")


def guide_at_taps(guide: U8, shape: tuple[int, int]) -> U8:
    """The guide at the coarse grid, (h, w, 3) uint8: the mean of what each tap covers."""
    height, width = shape
    return np.asarray(cv2.resize(guide, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


@intrinsic
def _as_float(typingctx: Any, bits: Any) -> Any:
    """The float32 with these 32 bits."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(types.float32))

    return types.float32(types.int32), codegen


@intrinsic
def _as_bits(typingctx: Any, value: Any) -> Any:
    """The 32 bits of a float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(types.int32))

    return types.int32(types.float32), codegen


@njit(inline="always")
def _exp2(e: Any) -> Any:
    """2 to the power e for -126 <= e <= 0, relative error below 8e-5; no branch, no table."""
    shifted = e + np.float32(12582912.0)  # 1.5 * 2**23 leaves the rounded e in the low bits
    f = e - (shifted - np.float32(12582912.0))
    power = np.float32(0.05517148) * f + np.float32(0.24261111)
    power = power * f + np.float32(0.693261)
    power = power * f + np.float32(0.99992806)
    return _as_float(np.int32(_as_bits(power) + np.int32(_as_bits(shifted) << np.int32(23))))


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _add_taps(tap: Any, near: Any, spatial: Any, colours: Any, totals: Any) -> None:
    """Add GROUP neighbouring taps of one coarse row to the sums of some runs of fine pixels. Flat
    arrays and constant offsets, so that the compiler sees that nothing overlaps."""
    for row in range(spatial.shape[0]):
        s = spatial[row]
        colour = colours[row]
        sums = totals[row]
        for x in range(TILE):
            b, g, r = colour[x], colour[TILE + x], colour[2 * TILE + x]
            everything, known = sums[x], sums[TILE + x]
            weight, value = sums[2 * TILE + x], sums[3 * TILE + x]
            for n in range(GROUP):
                db = b - tap[(CHANNELS * n) * TILE + x]
                dg = g - tap[(CHANNELS * n + 1) * TILE + x]
                dr = r - tap[(CHANNELS * n + 2) * TILE + x]
                tonal = max(-(db * db + dg * dg + dr * dr), np.float32(RANGE_FLOOR))
                w = _exp2(tonal + (near[n * TILE + x] + s))
                value += w * tap[(CHANNELS * n + 3) * TILE + x]
                weight += w * tap[(CHANNELS * n + 4) * TILE + x]
                known += w * tap[(CHANNELS * n + 5) * TILE + x]
                everything += w
            sums[x] = everything
            sums[TILE + x] = known
            sums[2 * TILE + x] = weight
            sums[3 * TILE + x] = value


@njit(cache=True, nogil=True)
def _aligned(size: int) -> Any:
    """``size`` float32 that start on a cache line: a load across two lines takes twice as long."""
    memory = np.empty(size + 16, np.float32)
    start = (-memory.ctypes.data % 64) // 4
    return memory[start : start + size]


@njit(cache=True, nogil=True)
def _spread(row: Any, index: Any, tap: Any) -> None:
    """Lay the taps of one coarse row next to each fine pixel: (group, [tap, channel, pixel])."""
    for k in range(index.shape[0]):
        column = index[k]
        out = tap[k // GROUP]
        for channel in range(CHANNELS):
            source = row[channel]
            start = (CHANNELS * (k % GROUP) + channel) * TILE
            for x in range(TILE):
                out[start + x] = source[column[x]]


@njit(cache=True, nogil=True)
def _columns(base: Any, spatial: Any, first: int, width: int, index: Any, near: Any) -> None:
    """Coarse column of each (tap, pixel) of a tile, and log2 of its spatial weight."""
    for k in range(index.shape[0]):
        for x in range(TILE):
            i = base[first + x] + k
            index[k, x] = min(max(i, 0), width - 1)
            near[k // GROUP, k % GROUP * TILE + x] = (
                spatial[first + x, k] if i == index[k, x] else OUTSIDE
            )


@njit(cache=True, nogil=True)
def _load_colour(guide: Any, colour: Any) -> None:
    """The scaled colours of a run of fine pixels: (channel, pixel), flat."""
    for x in range(guide.shape[0]):
        for channel in range(3):
            colour[channel * TILE + x] = np.float32(COLOUR_SCALE) * np.float32(guide[x, channel])


@njit(cache=True, nogil=True)
def _finish(sums: Any, out: Any, sure: Any) -> None:
    """Eq. 2's division by K_p for one run of fine pixels."""
    for x in range(out.shape[0]):
        everything, weight = sums[x], sums[2 * TILE + x]
        good = sums[TILE + x] > np.float32(MIN_SUPPORT) * everything
        out[x] = sums[3 * TILE + x] / weight if good else np.float32(np.nan)
        sure[x] = weight / everything if good else np.float32(0)


@njit(cache=True, nogil=True)
def _bilateral(
    begin: int,
    end: int,
    taps: Any,
    guide: Any,
    base_x: Any,
    base_y: Any,
    spatial_x: Any,
    spatial_y: Any,
    out: Any,
    sure: Any,
) -> None:
    """Tiles of fine columns in parallel; each goes down the rows with its spread taps at hand."""
    h = taps.shape[0]
    height, width = out.shape
    reach = spatial_y.shape[0]
    groups = spatial_x.shape[1] // GROUP
    for tile in range(begin, end):
        ring = _aligned(reach * groups * TAP_RUN).reshape((reach, groups, TAP_RUN))
        ready = np.full(reach, -1, np.int64)
        first = tile * TILE
        last = min(first + TILE, width)
        near = _aligned(groups * GROUP * TILE).reshape((groups, GROUP * TILE))
        index = np.empty((groups * GROUP, TILE), np.uint32)
        _columns(base_x, spatial_x, first, taps.shape[2], index, near)
        colour = _aligned(BAND * 3 * TILE).reshape((BAND, 3 * TILE))
        colour[:] = np.float32(0)
        sums = _aligned(BAND * 4 * TILE).reshape((BAND, 4 * TILE))
        top = 0
        while top < height:
            rows = 1
            while rows < BAND and top + rows < height and base_y[top + rows] == base_y[top]:
                rows += 1
            for y in range(rows):
                sums[y, :] = np.float32(0)
                _load_colour(guide[top + y, first:last], colour[y])
            for k in range(reach):
                j = base_y[top] + k
                if 0 <= j < h:
                    if ready[j % reach] != j:
                        _spread(taps[j], index, ring[j % reach])
                        ready[j % reach] = j
                    for group in range(groups):
                        tap = ring[j % reach, group]
                        _add_taps(tap, near[group], spatial_y[k, top : top + rows], colour, sums)
            for y in range(rows):
                v = top + y
                _finish(sums[y], out[v, first:last], sure[v, first:last])
            top += rows
