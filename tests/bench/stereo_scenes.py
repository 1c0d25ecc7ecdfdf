"""Rendered stereo pairs with exact disparity: slanted, thin, repeated and weakly textured surfaces.

A surface is a plane, whose disparity is linear in the left image, with a texture and an outline
given in left pixels. So both views are exact: a right pixel's place on a plane has a closed form,
and the nearest surface that is not transparent there is seen. Pixels are means of ``SAMPLES``
squared rays; noise is added to each view on its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np

from recon.types import F32, F64, U8, Bool

SIZE = (480, 360)
"""Width and height of the rendered images."""

LABELS = 64
"""More than the largest disparity."""

SAMPLES = 2
NOISE = 1.5
"""Standard deviation of the noise of each view, in gray levels."""

TILE = 1024

Paint = Callable[[F64, F64], F64]
Outline = Callable[[F64, F64], Bool]


@dataclass(frozen=True, slots=True, eq=False)
class TruePair:
    """A rectified pair whose disparity is known."""

    name: str
    left: U8  # (h, w)
    right: U8  # (h, w)
    truth_px: F32  # (h, w), NaN = unknown
    visible: Bool  # (h, w) truth known and seen by both views
    labels: int


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A textured part of a plane; all places are pixels of the left view."""

    disparity: tuple[float, float, float]  # px at (0, 0), more per pixel right, more per pixel down
    paint: Paint  # gray levels
    inside: Outline | None = None  # everywhere

    def at_left(self, u: F64, v: F64) -> F64:
        """Disparity at left pixels."""
        d, along, down = self.disparity
        return d + along * u + down * v

    def seen_from_right(self, u: F64, v: F64) -> F64:
        """Column of the left view that right pixels see on the plane."""
        d, along, down = self.disparity
        return (u + d + down * v) / (1 - along)

    def covers(self, u: F64, v: F64) -> Bool:
        """Whether left pixels lie on the surface."""
        return np.ones(u.shape, np.bool_) if self.inside is None else self.inside(u, v)


def render(name: str, surfaces: list[Surface], rng: np.random.Generator) -> TruePair:
    """Both views of the surfaces, and the exact disparity of the left one."""
    width, height = SIZE
    fine = (np.arange(SAMPLES * width) + 0.5) / SAMPLES - 0.5
    u, v = np.meshgrid(fine, (np.arange(SAMPLES * height) + 0.5) / SAMPLES - 0.5)
    views = []
    for right in (False, True):
        gray, _ = _nearest(surfaces, u, v, right)
        mean = gray.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
        noisy = mean + rng.normal(0, NOISE, mean.shape)
        views.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    _, truth = _nearest(surfaces, u, v, right=False)
    partner = u - truth
    _, seen = _nearest(surfaces, partner, v, right=True)
    visible = (partner >= 0) & (np.abs(seen - truth) < 1e-6)
    return TruePair(name, views[0], views[1], truth.astype(np.float32), visible, LABELS)


def _nearest(surfaces: list[Surface], u: F64, v: F64, right: bool) -> tuple[F64, F64]:
    """Gray level and disparity of the nearest surface that pixels of a view see."""
    gray, nearest = np.zeros(u.shape), np.full(u.shape, -np.inf)
    for surface in surfaces:
        place = surface.seen_from_right(u, v) if right else u
        disparity = surface.at_left(place, v)
        front = surface.covers(place, v) & (disparity > nearest)
        gray[front] = surface.paint(place[front], v[front])
        nearest[front] = disparity[front]
    return gray, nearest


def mottled(rng: np.random.Generator, mean: float, contrast: float) -> Paint:
    """A part of :func:`_noise`, as of soil, leaves and stone."""
    tile = _noise()
    right, down = rng.uniform(0, TILE, 2)

    def paint(u: F64, v: F64) -> F64:
        x, y = u + right, v + down
        i, j = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
        a, b = x - i, y - j
        above = (1 - a) * tile[j % TILE, i % TILE] + a * tile[j % TILE, (i + 1) % TILE]
        j += 1
        below = (1 - a) * tile[j % TILE, i % TILE] + a * tile[j % TILE, (i + 1) % TILE]
        return np.asarray(mean + contrast * ((1 - b) * above + b * below), np.float64)

    return paint


@cache
def _noise() -> F64:
    """Noise of grains of one to sixteen pixels, mean 0 and deviation 1, that repeats endlessly."""
    rng = np.random.default_rng(1)
    tile = np.zeros((TILE, TILE))
    for grain in (1.2, 4.8, 19.2):
        layer: Any = np.tile(rng.normal(0, 1, (TILE, TILE)), (3, 3))
        layer = cv2.GaussianBlur(layer, (0, 0), grain)[TILE : 2 * TILE, TILE : 2 * TILE]
        tile += layer / layer.std()
    return np.asarray((tile - tile.mean()) / tile.std(), np.float64)


def roofs(rng: np.random.Generator) -> list[Surface]:
    """Houses with gabled roofs on a slope, seen from above."""
    ground = mottled(rng, 110, 28)
    surfaces = [Surface((9 + rng.uniform(0, 4), 0.01, rng.uniform(0.01, 0.03)), ground)]
    for _ in range(9):
        left, top = rng.uniform(30, 380), rng.uniform(5, 280)
        half, length = rng.uniform(18, 45), rng.uniform(40, 110)
        eaves, slope = rng.uniform(22, 38), rng.uniform(0.1, 0.4)
        ridge = left + half
        for sign in (1, -1):
            start = eaves - sign * slope * (left if sign > 0 else left + 2 * half)
            bounds = (left, ridge) if sign > 0 else (ridge, left + 2 * half)
            plane = (start, sign * slope, 0.0)
            paint = mottled(rng, rng.uniform(60, 190), rng.uniform(6, 22))
            surfaces.append(Surface(plane, paint, _box(*bounds, top, top + length)))
    return surfaces


def poles(rng: np.random.Generator) -> list[Surface]:
    """Posts, and wires that lean, of two to six pixels before a field."""
    surfaces = [Surface((8.0, 0.0, 0.04), mottled(rng, 120, 26))]
    for _ in range(10):
        u, wide = rng.uniform(40, 470), rng.uniform(2, 6)
        near, gray = rng.uniform(26, 50), rng.choice((40.0, 75.0, 190.0))
        paint = mottled(rng, gray, 10)
        surfaces.append(Surface((near, 0.0, 0.0), paint, _strip(u, 0.0, wide)))
    for _ in range(5):
        lean = rng.uniform(-0.8, 0.8)
        wire = _strip(rng.uniform(60, 420), lean, rng.uniform(2, 4))
        surfaces.append(Surface((rng.uniform(26, 50), 0.02, 0.0), mottled(rng, 60, 10), wire))
    return surfaces


def rows(rng: np.random.Generator) -> list[Surface]:
    """Crop rows on a slope and facades of equal windows, all with a little texture of their own."""
    surfaces = [Surface((6.0, 0.0, 0.05), _striped(rng, rng.uniform(9, 14), 1.0, 9))]
    for _ in range(4):
        left, top = rng.uniform(40, 360), rng.uniform(0, 240)
        wide, tall = rng.uniform(60, 120), rng.uniform(60, 110)
        paint = _striped(rng, rng.uniform(8, 16), rng.uniform(8, 16), 7)
        plane = (rng.uniform(28, 44), rng.uniform(-0.05, 0.05), 0.0)
        surfaces.append(Surface(plane, paint, _box(left, left + wide, top, top + tall)))
    return surfaces


def leaves(rng: np.random.Generator) -> list[Surface]:
    """A tree's leaves, each with its own lean, over grass."""
    surfaces = [Surface((7.0, 0.0, 0.01), mottled(rng, 105, 24))]
    for _ in range(48):
        centre = rng.uniform(60, 470), rng.uniform(0, 360)
        radii, turn = rng.uniform((8, 4), (24, 10)), rng.uniform(0, np.pi)
        along, down = rng.uniform(-0.25, 0.25, 2)
        near = rng.uniform(18, 52)
        plane = (near - along * centre[0] - down * centre[1], along, down)
        paint = mottled(rng, rng.uniform(50, 170), 14)
        surfaces.append(Surface(plane, paint, _ellipse(centre, radii, turn)))
    return surfaces


def pale(rng: np.random.Generator) -> list[Surface]:
    """Boxes of nearly one gray level on asphalt: contrasts of two to eight levels."""
    surfaces = [Surface((9.0, 0.015, 0.015), mottled(rng, 118, 5))]
    for _ in range(7):
        left, top = rng.uniform(30, 380), rng.uniform(0, 280)
        wide, tall = rng.uniform(35, 100), rng.uniform(35, 90)
        paint = mottled(rng, 118 + rng.uniform(-18, 18), rng.uniform(2.5, 8))
        plane = (rng.uniform(20, 46), 0.0, 0.0)
        surfaces.append(Surface(plane, paint, _box(left, left + wide, top, top + tall)))
    return surfaces


SCENES: dict[str, Callable[[np.random.Generator], list[Surface]]] = {
    "roofs": roofs,
    "poles": poles,
    "rows": rows,
    "leaves": leaves,
    "pale": pale,
}


def rendered(name: str, seed: int = 0) -> TruePair:
    """A scene of the table; another arrangement with each seed."""
    rng = np.random.default_rng((seed, *name.encode()))
    return render(name, SCENES[name](rng), rng)


def darker(image: U8) -> F64:
    """Three quarters of the exposure."""
    return np.asarray(0.75 * image, np.float64)


def curved(image: U8) -> F64:
    """Another tone curve: gamma 0.7."""
    return np.asarray(255 * (image / 255) ** 0.7, np.float64)


def shaded(image: U8) -> F64:
    """A lens that darkens by 0.5 towards the corners."""
    height, width = image.shape
    v, u = np.mgrid[-1 : 1 : 1j * height, -1 : 1 : 1j * width]
    r2 = ((u * width) ** 2 + (v * height) ** 2) / (width**2 + height**2)
    return np.asarray(image * (1.1 - 0.5 * r2), np.float64)


EXPOSURES: dict[str, Callable[[U8], F64]] = {
    "darker": darker,
    "gamma": curved,
    "vignetting": shaded,
}


def exposed(pair: TruePair, exposure: str) -> TruePair:
    """The pair with a right image of another exposure."""
    levels = np.rint(EXPOSURES[exposure](pair.right))
    return replace(pair, right=np.clip(levels, 0, 255).astype(np.uint8))


def _striped(rng: np.random.Generator, period: float, tall: float, contrast: float) -> Paint:
    """Equal stripes across, or windows ``tall`` px apart, with weak texture that tells them."""
    own = mottled(rng, 115, contrast)

    def paint(u: F64, v: F64) -> F64:
        wave = np.tanh(2 * np.sin(2 * np.pi * u / period))
        if tall > 1:
            wave = np.where(np.tanh(2 * np.sin(2 * np.pi * v / tall)) > -0.3, wave, -1)
        return np.asarray(own(u, v) + 35 * wave, np.float64)

    return paint


def _box(left: float, right: float, top: float, bottom: float) -> Outline:
    return lambda u, v: (u >= left) & (u < right) & (v >= top) & (v < bottom)


def _strip(start: float, lean: float, wide: float) -> Outline:
    """A strip from the top at ``start``, that moves by ``lean`` per row."""
    return lambda u, v: np.abs(u - start - lean * v) < wide / 2 * np.hypot(1, lean)


def _ellipse(centre: tuple[float, float], radii: F64, turn: float) -> Outline:
    c, s = np.cos(turn), np.sin(turn)

    def inside(u: F64, v: F64) -> Bool:
        x, y = u - centre[0], v - centre[1]
        return np.asarray(((c * x + s * y) / radii[0]) ** 2 + ((c * y - s * x) / radii[1]) ** 2 < 1)

    return inside
