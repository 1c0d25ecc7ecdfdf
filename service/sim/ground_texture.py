"""The scene's colours: an image from above for ground and roofs, solid colours for the rest.

The image from above is made once per flight, at a texel a little finer than the camera's
pixel on the ground, with sun and shadows in it, and reduced to a pyramid so that rendering
does not flicker.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from recon.parallel import parallel_for
from recon.surface.triangle_grid import first_hit
from recon.types import F32, F64, U8
from service.errors import InputError
from service.sim import shapes
from service.sim.noise import fractal2, hash01, smoothstep, value2, value3
from service.sim.scene import ASPHALT, DIRT, Scene
from service.sim.shapes import (
    BASE,
    COS,
    EAVE,
    GABLED,
    HALF_L,
    HALF_W,
    KIND,
    PLAIN,
    RIDGE,
    SEED,
    SIN,
    TOP_B,
    VEHICLE,
    WALL_B,
    X,
    Y,
)

LIGHT_STEP_M = 0.25
AMBIENT, SUN_STRENGTH = 0.46, 0.72
PAINT = 3


@dataclass(frozen=True, slots=True, eq=False)
class GroundTexture:
    """The view from straight above, as a pyramid of ever coarser levels in one array."""

    bgr: U8  # (total texels, 3), level after level, rows from south to north
    levels: npt.NDArray[np.int64]  # (L, 3) offset, rows, columns
    x0: float
    y0: float
    texel_m: float
    sun: F64  # (3,) unit vector towards the sun


def sun_direction() -> F64:
    """(3,) unit vector towards the sun: 48 degrees up, 145 from north over east."""
    e, a = np.radians((48.0, 145.0))
    return np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])


def make(scene: Scene, texel_m: float, mosaic: U8 | None = None) -> GroundTexture:
    """The image of ``scene``; ``mosaic`` (H, W, 3), of any size, replaces the drawn ground."""
    sun = sun_direction()
    size = tuple(max(4, int(np.ceil(s / texel_m))) for s in scene.area.size_m)
    cover = _cover(scene, size, texel_m)
    which = _which_block(scene, size, texel_m)
    light = _light(scene, sun)
    out = np.empty((size[1], size[0], 3), np.uint8)
    base: U8 = np.zeros((1, 1, 3), np.uint8)
    if mosaic is not None:
        base = np.asarray(cv2.resize(mosaic, size, interpolation=cv2.INTER_CUBIC), np.uint8)
    parallel_for(
        _colour, len(out), out, base, cover, which, scene.blocks, light, scene.terrain.z_m,
        scene.area.x0, scene.area.y0, texel_m, scene.terrain.step_m, sun, scene.seed,
    )  # fmt: skip
    flat, levels = _pyramid(out)
    return GroundTexture(flat, levels, scene.area.x0, scene.area.y0, texel_m, sun)


def _texels(scene: Scene, points: F64, texel_m: float) -> npt.NDArray[np.int32]:
    """Points (N, 2) in texels with four binary digits after the point, as OpenCV draws them."""
    low = np.array([scene.area.x0, scene.area.y0])
    return np.asarray(np.round(((points - low) / texel_m - 0.5) * 16), np.int32)


def _cover(scene: Scene, size: tuple[int, ...], texel_m: float) -> U8:
    """(H, W) 0 land, ASPHALT, DIRT or PAINT."""
    out = np.zeros((size[1], size[0]), np.uint8)
    for surface in (DIRT, ASPHALT):
        for road in scene.roads:
            if road.surface == surface:
                line = _texels(scene, road.line, texel_m)
                width = max(1, round(road.width_m / texel_m))
                cv2.polylines(out, [line], False, surface, width, cv2.LINE_8, 4)
    for road in scene.roads:
        if road.surface == ASPHALT:
            for k in range(0, len(road.line) - 4, 5):  # dashes of 4 m every 10 m
                dash = _texels(scene, road.line[k : k + 3], texel_m)
                width = max(1, round(0.14 / texel_m))
                cv2.polylines(out, [dash], False, PAINT, width, cv2.LINE_8, 4)
    return out


def _which_block(scene: Scene, size: tuple[int, ...], texel_m: float) -> npt.NDArray[np.uint16]:
    """(H, W) 1 + row of the highest block over each texel, 0 for ground."""
    out = np.zeros((size[1], size[0]), np.uint16)
    for k, block in enumerate(scene.blocks):
        if block[TOP_B : TOP_B + 3].any():  # trunks stay under their crowns
            corners = _texels(scene, shapes.footprint(block), texel_m)
            cv2.fillPoly(out, [corners], k + 1, cv2.LINE_8, 4)
    return out


def _light(scene: Scene, sun: F64) -> F32:
    """(h, w) share of the sun that reaches ground and roofs, every LIGHT_STEP_M."""
    size = [int(np.ceil(s / LIGHT_STEP_M)) for s in scene.area.size_m]
    which = _which_block(scene, tuple(size), LIGHT_STEP_M)
    x = scene.area.x0 + (np.arange(size[0]) + 0.5) * LIGHT_STEP_M
    y = scene.area.y0 + (np.arange(size[1]) + 0.5) * LIGHT_STEP_M
    gx, gy = np.meshgrid(x, y)
    z = scene.terrain.height(gx.ravel(), gy.ravel()).reshape(gx.shape)
    out = np.empty(gx.shape, np.float32)
    parallel_for(_shadow, len(gx), scene.grid.arrays(), gx, gy, z, which, scene.blocks, sun, out)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.7), np.float32)


def _pyramid(image: U8) -> tuple[U8, npt.NDArray[np.int64]]:
    """(all levels flattened, their offsets and sizes); each level halves the one before."""
    parts, table, offset = [], [], 0
    while True:
        parts.append(image.reshape(-1, 3))
        table.append([offset, image.shape[0], image.shape[1]])
        offset += image.shape[0] * image.shape[1]
        if min(image.shape[:2]) < 8:
            return np.concatenate(parts), np.array(table, np.int64)
        half = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
        shape = (half.shape[1] // 2, half.shape[0] // 2)
        image = np.asarray(cv2.resize(half, shape, interpolation=cv2.INTER_AREA), np.uint8)


@njit(cache=True, nogil=True)
def _local(block, x, y):  # type: ignore[no-untyped-def]
    """(along, across) of a position in a block's own axes."""
    dx, dy = x - block[X], y - block[Y]
    return dx * block[COS] + dy * block[SIN], -dx * block[SIN] + dy * block[COS]


@njit(cache=True, nogil=True)
def _shadow(begin, end, grid, gx, gy, z, which, blocks, sun, out):  # type: ignore[no-untyped-def]
    for j in range(begin, end):
        for i in range(gx.shape[1]):
            x, y, top = gx[j, i], gy[j, i], z[j, i]
            if which[j, i] > 0:
                block = blocks[which[j, i] - 1]
                top = block[EAVE]
                if block[KIND] == GABLED:
                    _, v = _local(block, x, y)
                    rise = 1.0 - min(1.0, abs(v) / block[HALF_W])
                    top = block[EAVE] + (block[RIDGE] - block[EAVE]) * rise
            lit = 0.0
            for n in range(4):
                ax = 0.02 * (hash01(i, j, 2 * n) - 0.5)
                ay = 0.02 * (hash01(i, j, 2 * n + 1) - 0.5)
                _, m = first_hit(grid, x, y, top + 0.08, sun[0] + ax, sun[1] + ay, sun[2])
                lit += 0.25 if m < 0 else 0.0
            out[j, i] = lit


@njit(cache=True, nogil=True)
def _land(x, y, seed):  # type: ignore[no-untyped-def]
    """(b, g, r) of open ground: a patchwork of meadow, crops, bare soil and rough grass."""
    wx = x + 5.0 * fractal2(x, y, 30.0, 2, 0.5, seed + 501)
    wy = y + 5.0 * fractal2(x, y, 30.0, 2, 0.5, seed + 502)
    size = 46.0
    i, j = int(wx // size), int(wy // size)
    nearest, second, ci, cj = 1e18, 1e18, 0, 0
    for n in range(j - 1, j + 2):
        for m in range(i - 1, i + 2):
            px = (m + 0.15 + 0.7 * hash01(m, n, seed + 503)) * size
            py = (n + 0.15 + 0.7 * hash01(m, n, seed + 504)) * size
            d = (px - wx) ** 2 + (py - wy) ** 2
            if d < nearest:
                nearest, second, ci, cj = d, nearest, m, n
            elif d < second:
                second = d
    kind = hash01(ci, cj, seed + 505)
    tone = 0.88 + 0.24 * hash01(ci, cj, seed + 506)
    broad = fractal2(x, y, 14.0, 3, 0.6, seed + 507)
    patch = fractal2(x, y, 2.4, 3, 0.7, seed + 508)
    fine = fractal2(x, y, 0.42, 4, 0.9, seed + 509)
    b, g, r = 70.0, 112.0, 98.0  # meadow
    if kind < 0.22:  # crops in rows, uneven and gappy
        turn = 6.2831853 * hash01(ci, cj, seed + 510)
        s = x * np.cos(turn) + y * np.sin(turn) + 0.25 * patch
        row = 0.5 + 0.5 * np.sin(6.2831853 * s / 0.95)
        cropped = row * smoothstep(-0.9, 0.5, patch + 0.6 * broad)
        b, g, r = 78.0 - 26.0 * cropped, 108.0 + 8.0 * cropped, 128.0 - 52.0 * cropped
    elif kind < 0.40:  # bare soil
        b, g, r = 84.0, 110.0, 136.0
    elif kind < 0.62:  # dry grass
        b, g, r = 84.0, 136.0, 142.0
    edge = smoothstep(0.4, 2.2, np.sqrt(second) - np.sqrt(nearest))
    b, g, r = 56.0 + edge * (b - 56.0), 96.0 + edge * (g - 96.0), 84.0 + edge * (r - 84.0)
    bald = smoothstep(0.75, 1.3, patch + 0.5 * broad)
    b, g, r = b + bald * (96.0 - b), g + bald * (124.0 - g), r + bald * (146.0 - r)
    tuft = 1.0 - 0.45 * smoothstep(0.55, 1.3, fine) * smoothstep(-0.4, 0.6, -patch)
    shade = tone * tuft * (1.0 + 0.10 * broad + 0.14 * patch + 0.24 * fine)
    if hash01(int(x // 0.22), int(y // 0.22), seed + 511) > 0.996:  # stones and flowers
        shade *= 1.4
    return b * shade, g * shade, r * (shade + 0.04 * patch)


@njit(cache=True, nogil=True)
def _road(x, y, cover, seed):  # type: ignore[no-untyped-def]
    """(b, g, r) of asphalt, paint or a dirt track."""
    broad = fractal2(x, y, 5.0, 3, 0.7, seed + 601)
    fine = fractal2(x, y, 0.3, 4, 0.95, seed + 602)
    if cover == DIRT:
        shade = 1.0 + 0.15 * broad + 0.2 * fine
        return 108.0 * shade, 138.0 * shade, 160.0 * shade
    crack = abs(fractal2(x, y, 1.9, 2, 0.6, seed + 603))
    dark = 0.72 if crack < 0.035 else 1.0
    repaired = 0.8 if value2(x / 4.1, y / 4.1, seed + 604) > 0.78 else 1.0
    shade = dark * repaired * (1.0 + 0.12 * broad + 0.18 * fine)
    if cover == PAINT and fine < 0.6:
        return 205.0 * shade, 210.0 * shade, 210.0 * shade
    return 104.0 * shade, 102.0 * shade, 100.0 * shade


@njit(cache=True, nogil=True)
def _top(block, x, y, u, v):  # type: ignore[no-untyped-def]
    """(b, g, r) of a block's top: tiles, gravel or paint."""
    seed = int(block[SEED])
    shade = 1.0
    if block[KIND] == GABLED:
        course = int(v // 0.42)
        tile = int((u + 0.15 * (course % 2)) // 0.34)
        shade = 0.78 + 0.42 * hash01(course, tile, seed)
        if v % 0.42 < 0.07:
            shade *= 0.7
        shade *= 1.0 + 0.22 * fractal2(x, y, 2.2, 3, 0.7, seed + 1)
        panel = hash01(seed, 1, 2) < 0.3 and 0.8 < v < block[HALF_W] - 0.9
        if panel and abs(u) < 0.55 * block[HALF_L]:  # solar panels on one slope
            frame = u % 1.05 < 0.06 or v % 1.65 < 0.06
            k = 1.0 + 0.2 * hash01(int(u // 1.05), int(v // 1.65), seed + 9)
            return (150.0, 150.0, 150.0) if frame else (92.0 * k, 58.0 * k, 44.0 * k)
    elif block[KIND] == VEHICLE:
        shade = 1.0 + 0.1 * fractal2(x, y, 0.6, 2, 0.7, seed)
    else:
        shade = 1.0 + 0.2 * fractal2(x, y, 3.0, 4, 0.75, seed)
        shade *= 1.0 + 0.16 * fractal2(x, y, 0.3, 2, 0.8, seed + 1)
        rim = min(block[HALF_L] - abs(u), block[HALF_W] - abs(v))
        if rim < 0.3 and block[KIND] != PLAIN:
            shade *= 1.35
        elif hash01(int(u // 2.3), int(v // 2.3), seed + 2) > 0.9 and block[KIND] != PLAIN:
            shade *= 0.55  # vents and hatches
    return block[TOP_B] * shade, block[TOP_B + 1] * shade, block[TOP_B + 2] * shade


@njit(cache=True, nogil=True)
def _height(z, u, v):  # type: ignore[no-untyped-def]
    """Bilinear height of the terrain's grid at grid position (u, v), clamped."""
    u = min(max(u, 0.0), z.shape[1] - 1.001)
    v = min(max(v, 0.0), z.shape[0] - 1.001)
    i, j = int(u), int(v)
    fu, fv = u - i, v - j
    low = z[j, i] + fu * (z[j, i + 1] - z[j, i])
    return low + fv * (z[j + 1, i] + fu * (z[j + 1, i + 1] - z[j + 1, i]) - low)


@njit(cache=True, nogil=True)
def _facing(z, u, v, step_m, sun):  # type: ignore[no-untyped-def]
    """Cosine between the smoothed ground's normal and the sun."""
    gx = (_height(z, u + 1.0, v) - _height(z, u - 1.0, v)) / (2.0 * step_m)
    gy = (_height(z, u, v + 1.0) - _height(z, u, v - 1.0)) / (2.0 * step_m)
    return max(0.0, (sun[2] - gx * sun[0] - gy * sun[1]) / np.sqrt(1.0 + gx * gx + gy * gy))


@njit(cache=True, nogil=True)
def _roof_facing(block, v, sun):  # type: ignore[no-untyped-def]
    """Cosine between a block's top and the sun."""
    if block[KIND] != GABLED:
        return sun[2]
    rise = (block[RIDGE] - block[EAVE]) / block[HALF_W]
    side = 1.0 if v > 0 else -1.0
    across = -block[SIN] * sun[0] + block[COS] * sun[1]
    return max(0.0, (sun[2] + side * rise * across) / np.sqrt(1.0 + rise * rise))


@njit(cache=True, nogil=True)
def _colour(  # type: ignore[no-untyped-def]
    begin, end, out, base, cover, which, blocks, light, z, x0, y0, texel_m, step_m, sun, seed
):
    photo = base.shape[0] > 1
    for row in range(begin, end):
        for col in range(out.shape[1]):
            x, y = x0 + (col + 0.5) * texel_m, y0 + (row + 0.5) * texel_m
            lit = _height(light, (x - x0) / LIGHT_STEP_M - 0.5, (y - y0) / LIGHT_STEP_M - 0.5)
            k = which[row, col]
            if k > 0:
                u, v = _local(blocks[k - 1], x, y)
                b, g, r = _top(blocks[k - 1], x, y, u, v)
                bright = AMBIENT + SUN_STRENGTH * lit * _roof_facing(blocks[k - 1], v, sun)
            elif photo:  # the photograph has its own sun
                b, g, r = 1.0 * base[row, col, 0], 1.0 * base[row, col, 1], 1.0 * base[row, col, 2]
                bright = 0.55 + 0.45 * lit
            else:
                if cover[row, col] > 0:
                    b, g, r = _road(x, y, cover[row, col], seed)
                else:
                    b, g, r = _land(x, y, seed)
                facing = _facing(z, (x - x0) / step_m, (y - y0) / step_m, step_m, sun)
                bright = AMBIENT + SUN_STRENGTH * facing * lit
            out[row, col, 0] = min(255.0, b * bright)
            out[row, col, 1] = min(255.0, g * bright)
            out[row, col, 2] = min(255.0, r * bright)


@njit(cache=True, nogil=True)
def wall_colour(block, x, y, z, nx, ny, footprint_m):  # type: ignore[no-untyped-def]
    """(b, g, r) of a wall: plaster with windows; detail finer than the pixel is left out."""
    seed = int(block[SEED])
    shade = 1.0 + 0.12 * fractal2(x + y, z + 0.3 * x, 1.6, 3, 0.7, seed + 3)
    if footprint_m < 0.25:
        shade += 0.10 * fractal2(x - y, z, 0.3, 2, 0.8, seed + 4)
    b, g, r = block[WALL_B] * shade, block[WALL_B + 1] * shade, block[WALL_B + 2] * shade
    if block[KIND] == PLAIN or block[KIND] == VEHICLE:
        return b, g, r
    u, v = _local(block, x, y)
    across = abs(-nx * block[SIN] + ny * block[COS])  # 1 for the long walls
    s = u if across > 0.5 else v
    side = int(across > 0.5) + 2 * int(nx + ny > 0)
    cell, floor = int(s // 2.4), int((z - block[BASE] - 0.6) // 2.8)
    cs, cz = s - 2.4 * cell, z - block[BASE] - 0.6 - 2.8 * floor
    if z < block[EAVE] - 0.5 and hash01(cell, floor + 50 * side, seed) < 0.7:
        if 0.7 < cs < 1.8 and 0.9 < cz < 2.2:
            k = 0.6 + 0.8 * hash01(cell, floor, seed + 5)
            return 78.0 * k, 66.0 * k, 58.0 * k
        if 0.6 < cs < 1.9 and 0.8 < cz < 2.3:
            return 200.0, 202.0, 204.0
    return b, g, r


@njit(cache=True, nogil=True)
def crown_shade(x, y, z, seed, footprint_m):  # type: ignore[no-untyped-def]
    """Brightness of leaves at a point of a crown, about 1."""
    shade = 1.0 + 0.5 * (2.0 * value3(x / 0.8, y / 0.8, z / 0.8, seed) - 1.0)
    shade += 0.5 * (2.0 * value3(x / 0.33, y / 0.33, z / 0.33, seed + 1) - 1.0)
    if footprint_m < 0.2:
        shade += 0.35 * (2.0 * value3(x / 0.14, y / 0.14, z / 0.14, seed + 2) - 1.0)
    return max(0.25, shade)


SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
FEATHER = 0.08  # of a photograph's side that fades into its neighbour


def patchwork(folder: Path, size: tuple[int, int], seed: int) -> U8:
    """(H, W, 3) image of ``size`` (W, H): photographs side by side at their own resolution.

    They are shuffled, flipped and brought to the same mean brightness, and fade into each
    other. InputError when the folder contains no readable photograph.
    """
    if not folder.is_dir():
        raise InputError(f"photos {folder}: no such folder")
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    rng = np.random.default_rng(seed + 2)
    photos = _photos([paths[i] for i in rng.permutation(len(paths))], folder)
    W, H = size
    out = np.zeros((H, W, 3), np.uint8)
    step = [int(s * (1 - FEATHER)) for s in photos[0].shape[1::-1]]
    count = 0
    for y in range(0, H, step[1]):
        for x in range(0, W, step[0]):
            flips = rng.integers(0, 2, 2)
            photo = photos[count % len(photos)][:: 1 - 2 * int(flips[0]), :: 1 - 2 * int(flips[1])]
            _lay(out, photo, x, y)
            count += 1
    return out


def _photos(paths: list[Path], folder: Path) -> list[U8]:
    """The readable photographs of a folder, all cut to one size and mean brightness."""
    read = (cv2.imread(str(path), cv2.IMREAD_COLOR) for path in paths[:24])
    found = [i for i in read if i is not None and min(i.shape[:2]) >= 64]
    if not found:
        raise InputError(f"photos {folder}: no readable photograph (jpg, png or tif)")
    h, w = (min(i.shape[axis] for i in found) for axis in (0, 1))
    mean = float(np.mean([i.mean() for i in found]))
    return [
        np.asarray(cv2.convertScaleAbs(i[:h, :w], alpha=mean / max(float(i.mean()), 1.0)), np.uint8)
        for i in found
    ]


def _ramp(length: int, fade: int) -> F32:
    """(length,) weight that rises over the first ``fade`` entries."""
    return np.minimum(1.0, (np.arange(length, dtype=np.float32) + 0.5) / max(fade, 1))


def _lay(out: U8, photo: U8, x: int, y: int) -> None:
    """Put a photograph with its corner at (x, y), fading in over what lies there."""
    h, w = min(photo.shape[0], out.shape[0] - y), min(photo.shape[1], out.shape[1] - x)
    fade_x = int(FEATHER * photo.shape[1]) if x else 0
    fade_y = int(FEATHER * photo.shape[0]) if y else 0
    weight = _ramp(h, fade_y)[:, None] * _ramp(w, fade_x)[None, :]
    there = out[y : y + h, x : x + w]
    mixed = there + weight[..., None] * (photo[:h, :w].astype(np.float32) - there)
    out[y : y + h, x : x + w] = np.round(mixed)
