"""A place to fly over: terrain, roads, houses, halls, cars and trees, laid out from a seed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from recon.parallel import parallel_for
from recon.surface import triangle_grid
from recon.surface.triangle_grid import TriangleGrid
from recon.types import F64, U8
from service.sim import shapes
from service.sim.noise import fractal2
from service.sim.shapes import FLAT, GABLED, PLAIN, VEHICLE, Body

ASPHALT, DIRT = 1, 2
ROOFS = ((50, 62, 128), (58, 80, 140), (72, 72, 78), (62, 68, 96), (96, 92, 90))
WALLS = ((196, 206, 212), (150, 182, 206), (120, 150, 190), (205, 205, 200), (110, 120, 160))
CHANGE_M, CHANGE_HEIGHT_M = (1.0, 4.0), (0.3, 2.5)
"""Sides and height of a box that stands at one date only."""
PAINTS = ((40, 40, 160), (150, 90, 40), (210, 210, 210), (60, 60, 60), (40, 120, 180))


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A strip of one surface along a line."""

    line: F64  # (N, 2) m
    width_m: float
    surface: int  # ASPHALT or DIRT


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The place: its mesh with materials, and the tables that the colouring reads."""

    area: Area
    terrain: HeightField
    roads: tuple[Road, ...]
    blocks: F64  # (B, COLUMNS), see service.sim.shapes
    trees: F64  # (T, 8)
    vertices: F64  # (N, 3) ENU m
    triangles: npt.NDArray[np.int32]  # (M, 3)
    material: U8  # (M,)
    owner: npt.NDArray[np.int32]  # (M,) row of the block or tree table, -1 ground
    grid: TriangleGrid
    seed: int
    changes: tuple[ChangedBox, ...] = ()


@dataclass(frozen=True, slots=True)
class ChangedBox:
    """A box that stands on the ground at one of two dates only."""

    outline_m: tuple[tuple[float, float], ...]  # corners, ENU
    height_m: float  # above the highest ground below it
    volume_m3: float  # above the ground
    date: int  # at which it stands: 1 was removed, 2 was added


def make(
    area: Area, relief_m: float, density: float, seed: int, changes: int = 0, date: int = 1
) -> Scene:
    """The place of ``seed`` over ``area``; ``density`` 1 is a village, 0 is open country.

    Of ``changes`` boxes the first half stands at ``date`` 1 only, the others at ``date`` 2.
    """
    rng = np.random.default_rng(seed)
    ground = make_terrain(area, relief_m, 1.0, seed)
    roads = _roads(area, rng)
    free = _FreeGround(area, roads)
    blocks = _houses(roads, ground, free, density, rng)
    blocks += _cars(area, roads, ground, density, rng)
    trees, heights, trunks = _trees(area, ground, free, density, rng)
    boxes, changed = _changes(area, ground, free, changes, seed)
    blocks += [box for box, change in zip(boxes, changed, strict=True) if change.date == date]
    table = np.array(blocks + trunks) if blocks or trunks else np.zeros((0, shapes.COLUMNS))
    vertices, triangles, material, owner = shapes.joined([
        _ground_body(ground, table),
        *(body for k, block in enumerate(table) for body in shapes.block_bodies(block, k)),
        *(shapes.crown(tree, float(heights[k]), k) for k, tree in enumerate(trees)),
    ])  # fmt: skip
    grid = triangle_grid.build(vertices, triangles, 1.0)
    return Scene(
        area, ground, roads, table, trees, vertices, triangles, material, owner, grid, seed,
        tuple(changed),
    )  # fmt: skip


class _FreeGround:
    """Where nothing stands yet, on squares of half a metre."""

    STEP_M = 0.5

    def __init__(self, area: Area, roads: tuple[Road, ...]) -> None:
        self.area = area
        w, h = (int(np.ceil(s / self.STEP_M)) for s in area.size_m)
        self.taken = np.zeros((h, w), np.uint8)
        for road in roads:
            thickness = max(1, round((road.width_m + 1.5) / self.STEP_M))
            cv2.polylines(self.taken, [self._cells(road.line)], False, 255, thickness)

    def _cells(self, points: F64) -> npt.NDArray[np.int32]:
        low = np.array([self.area.x0, self.area.y0])
        return np.asarray(np.round((points - low) / self.STEP_M - 0.5), np.int32)

    def take(self, outline: F64) -> bool:
        """Reserve a convex outline (N, 2); False, and nothing reserved, when it does not fit."""
        low, high = outline.min(axis=0), outline.max(axis=0)
        if (low < [self.area.x0, self.area.y0]).any() or (
            high > [self.area.x1, self.area.y1]
        ).any():
            return False
        mask = np.zeros_like(self.taken)
        cv2.fillConvexPoly(mask, self._cells(outline), 255)
        if bool((mask & self.taken).any()):
            return False
        self.taken |= mask
        return True


def _roads(area: Area, rng: np.random.Generator) -> tuple[Road, ...]:
    """A main road through the middle, a side road across it, and dirt tracks."""
    middle = np.array([0.5 * (area.x0 + area.x1), 0.5 * (area.y0 + area.y1)])
    reach = float(np.hypot(*area.size_m))
    along = float(np.arctan2(area.size_m[1], area.size_m[0]) + rng.uniform(-0.2, 0.2))
    roads = [Road(_bent(middle, along, reach, 9.0, rng), 6.2, ASPHALT)]
    for k in range(max(1, round(reach / 130.0))):
        share = (k + 0.5) / max(1, round(reach / 130.0)) - 0.5
        start = middle + 0.8 * share * reach * np.array([np.cos(along), np.sin(along)])
        angle = along + np.pi / 2 + rng.uniform(-0.35, 0.35)
        roads.append(Road(_bent(start, angle, reach, 6.0, rng), 4.8, ASPHALT))
    for _ in range(max(1, round(reach / 160.0))):
        start = middle + rng.uniform(-0.3, 0.3, 2) * reach
        roads.append(Road(_bent(start, rng.uniform(0, np.pi), reach, 12.0, rng), 2.6, DIRT))
    return tuple(roads)


def _bent(start: F64, angle: float, reach_m: float, bend_m: float, rng: np.random.Generator) -> F64:
    """(N, 2) a line through ``start``, swinging ``bend_m`` to either side."""
    s = np.arange(-reach_m, reach_m, 2.0)
    phase, length = rng.uniform(0, 2 * np.pi), rng.uniform(110, 190)
    swing = bend_m * (np.sin(2 * np.pi * s / length + phase) - np.sin(phase))
    ahead = np.array([np.cos(angle), np.sin(angle)])
    return np.asarray(start + np.outer(s, ahead) + np.outer(swing, [-ahead[1], ahead[0]]))


def _stations(road: Road, gap_m: tuple[float, float], rng: np.random.Generator) -> list[F64]:
    """Rows (x, y, heading) along a road at random gaps."""
    steps = np.diff(road.line, axis=0)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    out, at = [], rng.uniform(0, gap_m[1])
    while at < s[-1]:
        k = min(int(np.searchsorted(s, at, "right")) - 1, len(heading) - 1)
        x, y = np.interp(at, s, road.line[:, 0]), np.interp(at, s, road.line[:, 1])
        out.append(np.array([x, y, heading[k]]))
        at += rng.uniform(*gap_m)
    return out


def _block(kind: float, x: float, y: float, heading: float, size: tuple[float, float]) -> F64:
    """A row of the block table with its plan; heights and colours are still zero."""
    row = np.zeros(shapes.COLUMNS)
    row[: shapes.BASE] = kind, x, y, np.cos(heading), np.sin(heading), size[0] / 2, size[1] / 2
    return row


def _stand(row: F64, ground: HeightField, eave_m: float, ridge_m: float) -> None:
    """Set a block's heights: its floor on the highest ground below it, its walls into it."""
    corners = np.vstack([shapes.footprint(row), row[[shapes.X, shapes.Y]]])
    z = ground.height(corners[:, 0], corners[:, 1])
    floor = float(z.max())
    row[shapes.BASE], row[shapes.EAVE] = float(z.min()) - 0.5, floor + eave_m
    row[shapes.RIDGE] = floor + eave_m + ridge_m


def _paint(row: F64, top: tuple[int, ...], wall: tuple[int, ...], rng: np.random.Generator) -> None:
    row[shapes.TOP_B : shapes.TOP_R + 1] = np.array(top) * rng.uniform(0.85, 1.15)
    row[shapes.WALL_B : shapes.WALL_R + 1] = np.array(wall) * rng.uniform(0.85, 1.1)
    row[shapes.SEED] = int(rng.integers(1, 1 << 20))


def _houses(
    roads: tuple[Road, ...],
    ground: HeightField,
    free: _FreeGround,
    density: float,
    rng: np.random.Generator,
) -> list[F64]:
    """Houses, halls and garages along the asphalt roads, with chimneys."""
    out: list[F64] = []
    for road in (r for r in roads if r.surface == ASPHALT):
        for x, y, heading in _stations(road, (15.0, 30.0), rng):
            for side in (-1.0, 1.0):
                if rng.uniform() > 0.75 * density:
                    continue
                hall = rng.uniform() < 0.12
                size = (
                    (rng.uniform(20, 30), rng.uniform(12, 18))
                    if hall
                    else (rng.uniform(9.5, 15), rng.uniform(7.5, 10))
                )
                away = road.width_m / 2 + size[1] / 2 + rng.uniform(4, 9)
                hx, hy = x - side * away * np.sin(heading), y + side * away * np.cos(heading)
                kind = FLAT if hall or rng.uniform() < 0.2 else GABLED
                row = _block(kind, hx, hy, heading + rng.uniform(-0.06, 0.06), size)
                if free.take(shapes.footprint(row, 1.5)):
                    _stand(row, ground, rng.uniform(3.0, 6.5), 0.5 * size[1] * rng.uniform(0.6, 1))
                    _paint(row, _pick(ROOFS, rng), _pick(WALLS, rng), rng)
                    out += [row, *_next_to(row, ground, free, rng)]
    return out


def _pick(colours: tuple[tuple[int, ...], ...], rng: np.random.Generator) -> tuple[int, ...]:
    return colours[int(rng.integers(len(colours)))]


def _next_to(
    house: F64, ground: HeightField, free: _FreeGround, rng: np.random.Generator
) -> list[F64]:
    """A chimney on the roof and perhaps a garage next to a house."""
    out = []
    heading = float(np.arctan2(house[shapes.SIN], house[shapes.COS]))
    ahead = np.array([np.cos(heading), np.sin(heading)])
    if house[shapes.KIND] == GABLED:
        x, y = house[[shapes.X, shapes.Y]] + ahead * house[shapes.HALF_L] * rng.uniform(-0.6, 0.6)
        row = _block(PLAIN, x, y, heading, (0.8, 0.6))
        row[shapes.BASE], row[shapes.EAVE] = house[shapes.EAVE], house[shapes.RIDGE] + 0.9
        _paint(row, (70, 75, 90), (70, 80, 120), rng)
        out.append(row)
    if rng.uniform() < 0.5:
        length = rng.uniform(5.5, 7)
        x, y = house[[shapes.X, shapes.Y]] + ahead * (house[shapes.HALF_L] + length / 2 + 1.8)
        row = _block(FLAT, x, y, heading, (length, rng.uniform(3.2, 6)))
        if free.take(shapes.footprint(row, 0.2)):
            _stand(row, ground, rng.uniform(2.3, 2.8), 0.0)
            _paint(row, (120, 122, 124), _pick(WALLS, rng), rng)
            out.append(row)
    return out


def _cars(
    area: Area,
    roads: tuple[Road, ...],
    ground: HeightField,
    density: float,
    rng: np.random.Generator,
) -> list[F64]:
    """Parked cars at the kerb: a body and a cabin each."""
    out = []
    for road in (r for r in roads if r.surface == ASPHALT):
        for x, y, heading in _stations(road, (12.0, 60.0), rng):
            if rng.uniform() > density:
                continue
            side = rng.choice([-1.0, 1.0]) * (road.width_m / 2 - 1.1)
            cx, cy = x - side * np.sin(heading), y + side * np.cos(heading)
            if not (area.x0 + 3 < cx < area.x1 - 3 and area.y0 + 3 < cy < area.y1 - 3):
                continue
            body = _block(VEHICLE, cx, cy, heading, (4.4, 1.8))
            cabin = _block(VEHICLE, cx - 0.2 * np.cos(heading), cy - 0.2 * np.sin(heading),
                           heading, (2.3, 1.55))  # fmt: skip
            _stand(body, ground, 0.85, 0.0)
            _paint(body, _pick(PAINTS, rng), (60, 60, 60), rng)
            cabin[shapes.TOP_B :] = body[shapes.TOP_B :]
            cabin[shapes.WALL_B : shapes.WALL_R + 1] = 45, 40, 38
            cabin[shapes.BASE], cabin[shapes.EAVE] = body[shapes.EAVE], body[shapes.EAVE] + 0.6
            out += [body, cabin]
    return out


def _changes(
    area: Area, ground: HeightField, free: _FreeGround, count: int, seed: int
) -> tuple[list[F64], list[ChangedBox]]:
    """Boxes on free ground in the inner two thirds of the area, for one of two dates each."""
    rng = np.random.default_rng(seed + 77)
    middle = np.array([0.5 * (area.x0 + area.x1), 0.5 * (area.y0 + area.y1)])
    rows: list[F64] = []
    found: list[ChangedBox] = []
    for _ in range(1000 * count):
        if len(rows) == count:
            break
        x, y = middle + rng.uniform(-1 / 3, 1 / 3, 2) * area.size_m
        size = rng.uniform(*CHANGE_M), rng.uniform(*CHANGE_M)
        row = _block(FLAT, float(x), float(y), rng.uniform(0, np.pi), size)
        height = float(rng.uniform(*CHANGE_HEIGHT_M))
        if not free.take(shapes.footprint(row, 2.0)):
            continue
        _stand(row, ground, height, 0.0)
        _paint(row, _pick(ROOFS, rng), _pick(WALLS, rng), rng)
        gx, gy = np.meshgrid(*(np.arange(c - 4.0, c + 4.0, 0.05) for c in (x, y)))
        under = shapes.inside(row, gx, gy)
        level = ground.height(gx[under], gy[under])
        volume = float((row[shapes.EAVE] - level).mean() * size[0] * size[1])
        outline = tuple((float(a), float(b)) for a, b in shapes.footprint(row))
        rows.append(row)
        found.append(ChangedBox(outline, height, volume, 1 if len(rows) <= count // 2 else 2))
    return rows, found


def _trees(
    area: Area, ground: HeightField, free: _FreeGround, density: float, rng: np.random.Generator
) -> tuple[F64, F64, list[F64]]:
    """(tree table, heights, trunks as blocks): groves, single trees and bushes."""
    surface = area.size_m[0] * area.size_m[1]
    centres = rng.uniform([area.x0, area.y0], [area.x1, area.y1], (max(3, int(surface / 3000)), 2))
    rows, heights, trunks = [], [], []
    for _ in range(int(surface * (0.002 + 0.006 * min(1.0, density)))):
        bush = rng.uniform() < 0.45
        at = centres[int(rng.integers(len(centres)))] + rng.normal(0, 12.0, 2)
        radius = rng.uniform(0.7, 1.4) if bush else rng.uniform(2.0, 4.2)
        height = radius * (rng.uniform(1.2, 1.6) if bush else rng.uniform(2.2, 2.8))
        corners = at + 0.8 * radius * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        if not free.take(corners):
            continue
        z = float(ground.height(at[:1], at[1:])[0])
        green = np.array([38, 82, 62]) * rng.uniform(0.75, 1.25) + rng.uniform(-8, 8, 3)
        rows.append(np.array([at[0], at[1], z, radius, *green, int(rng.integers(1, 1 << 20))]))
        heights.append(height)
        if not bush:
            trunk = _block(PLAIN, at[0], at[1], 0.3, (0.36, 0.36))
            trunk[shapes.BASE], trunk[shapes.EAVE] = z - 0.3, z + 0.6 * height
            trunk[shapes.WALL_B : shapes.WALL_R + 1] = 50, 62, 78
            trunks.append(trunk)
    table = np.array(rows) if rows else np.zeros((0, 8))
    return table, np.array(heights), trunks


def _ground_body(ground: HeightField, blocks: F64) -> Body:
    """The terrain's triangles, left out where a block's floor covers them whole."""
    ny, nx = ground.z_m.shape
    x = ground.area.x0 + ground.step_m * np.arange(nx)
    y = ground.area.y0 + ground.step_m * np.arange(ny)
    gx, gy = np.meshgrid(x, y)
    corner = np.arange(ny * nx, dtype=np.int32).reshape(ny, nx)
    keep = np.ones((ny - 1, nx - 1), bool)
    for block in blocks:
        if block[shapes.KIND] in (FLAT, GABLED):
            under = shapes.inside(block, gx, gy, 0.1)
            keep &= ~(under[:-1, :-1] & under[:-1, 1:] & under[1:, :-1] & under[1:, 1:])
    a, b = corner[:-1, :-1][keep], corner[:-1, 1:][keep]
    c, d = corner[1:, :-1][keep], corner[1:, 1:][keep]
    triangles = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    vertices = np.stack([gx.ravel(), gy.ravel(), ground.z_m.ravel()], axis=1)
    return vertices, triangles, shapes.GROUND, -1


@dataclass(frozen=True, slots=True)
class Area:
    """A rectangle of the world in metres east and north."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def size_m(self) -> tuple[float, float]:
        """(east, north) extent."""
        return self.x1 - self.x0, self.y1 - self.y0


@dataclass(frozen=True, slots=True, eq=False)
class HeightField:
    """Heights on a square grid; two triangles per square, split from south-west to north-east."""

    area: Area
    step_m: float
    z_m: F64  # (ny, nx), row j at y0 + j * step

    def height(self, x_m: F64, y_m: F64) -> F64:
        """(N,) height of the triangles at (N,) positions; the rim's height outside."""
        ny, nx = self.z_m.shape
        u = np.clip((np.asarray(x_m) - self.area.x0) / self.step_m, 0, nx - 1 - 1e-9)
        v = np.clip((np.asarray(y_m) - self.area.y0) / self.step_m, 0, ny - 1 - 1e-9)
        i, j = u.astype(int), v.astype(int)
        fu, fv = u - i, v - j
        a, b = self.z_m[j, i], self.z_m[j, i + 1]
        c, d = self.z_m[j + 1, i], self.z_m[j + 1, i + 1]
        lower = a + fu * (b - a) + fv * (d - b)  # south-east triangle
        upper = a + fv * (c - a) + fu * (d - c)
        return np.asarray(np.where(fu >= fv, lower, upper))


def make_terrain(area: Area, relief_m: float, step_m: float, seed: int) -> HeightField:
    """A terrain whose hills span about ``relief_m`` metres, with 0 m at the world's origin."""
    nx = int(np.ceil(area.size_m[0] / step_m)) + 1
    ny = int(np.ceil(area.size_m[1] / step_m)) + 1
    z = np.empty((ny, nx))
    parallel_for(_heights, ny, z, area.x0, area.y0, step_m, relief_m, seed)
    terrain = HeightField(area, step_m, z)
    zero = terrain.height(np.zeros(1), np.zeros(1))[0]
    return HeightField(area, step_m, z - zero)


@njit(cache=True, nogil=True)
def _heights(begin, end, z, x0, y0, step_m, relief_m, seed):  # type: ignore[no-untyped-def]
    for j in range(begin, end):
        for i in range(z.shape[1]):
            x, y = x0 + i * step_m, y0 + j * step_m
            hills = 0.30 * relief_m * fractal2(x, y, 130.0, 2, 0.45, seed + 11)
            knolls = 0.06 * relief_m * fractal2(x, y, 28.0, 3, 0.5, seed + 23)
            bumps = 0.05 * fractal2(x, y, 5.0, 2, 0.5, seed + 37)
            z[j, i] = hills + knolls + min(1.0, relief_m) * bumps
