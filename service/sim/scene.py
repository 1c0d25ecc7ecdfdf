"""A place to fly over: terrain, roads, houses, halls, cars and trees, laid out from a seed."""

from __future__ import annotations

from collections.abc import Iterator
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
TERRAIN_STEP_M = 1.0
Colour = tuple[int, ...]
ROOFS = ((50, 62, 128), (58, 80, 140), (72, 72, 78), (62, 68, 96), (96, 92, 90))
WALLS = ((196, 206, 212), (150, 182, 206), (120, 150, 190), (205, 205, 200), (110, 120, 160))
CHANGE_M, CHANGE_HEIGHT_M = (1.0, 4.0), (0.3, 2.5)
"""Sides and height of a box that stands at one date only."""
PAINTS = ((40, 40, 160), (150, 90, 40), (210, 210, 210), (60, 60, 60), (40, 120, 180))


@dataclass(frozen=True, slots=True, eq=False)
class Road:
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
    """The place of ``seed`` over ``area``; ``density`` 1 is a village, 0 is open country. Of
    ``changes`` boxes the first half stands at ``date`` 1 only, the others at ``date`` 2."""
    layout = _Layout(area, relief_m, density, seed)
    layout.add_houses()
    layout.add_cars()
    layout.add_trees()
    changed = layout.add_changes(changes, date, seed)
    blocks = layout.blocks + layout.trunks
    table = np.array(blocks) if blocks else np.zeros((0, shapes.COLUMNS))
    trees = np.array(layout.trees) if layout.trees else np.zeros((0, 8))
    vertices, triangles, material, owner = shapes.joined([
        _ground_body(layout.ground, table),
        *(body for k, block in enumerate(table) for body in shapes.block_bodies(block, k)),
        *(shapes.crown(tree, layout.heights_m[k], k) for k, tree in enumerate(trees)),
    ])  # fmt: skip
    grid = triangle_grid.build(vertices, triangles, 1.0)
    return Scene(
        area, layout.ground, layout.roads, table, trees, vertices, triangles, material, owner, grid,
        seed, tuple(changed),
    )  # fmt: skip


class _Layout:
    """The place while it is laid out: what stands, and where nothing does, on squares of half a
    metre."""

    STEP_M = 0.5

    def __init__(self, area: Area, relief_m: float, density: float, seed: int) -> None:
        self.area, self.density = area, density
        self.rng = np.random.default_rng(seed)
        self.ground = make_terrain(area, relief_m, seed)
        self.roads = self._roads()
        self.blocks: list[F64] = []
        self.trees: list[F64] = []
        self.heights_m: list[float] = []  # of the trees
        self.trunks: list[F64] = []  # blocks
        w, h = (int(np.ceil(s / self.STEP_M)) for s in area.size_m)
        self.taken = np.zeros((h, w), np.uint8)
        for road in self.roads:
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

    def _roads(self) -> tuple[Road, ...]:
        """A main road through the middle, a side road across it, and dirt tracks."""
        area, rng = self.area, self.rng
        middle = np.array([0.5 * (area.x0 + area.x1), 0.5 * (area.y0 + area.y1)])
        reach = float(np.hypot(*area.size_m))
        along = float(np.arctan2(area.size_m[1], area.size_m[0]) + rng.uniform(-0.2, 0.2))
        roads = [Road(self._bent(middle, along, reach, 9.0), 6.2, ASPHALT)]
        sides = max(1, round(reach / 130.0))
        for k in range(sides):
            share = (k + 0.5) / sides - 0.5
            start = middle + 0.8 * share * reach * np.array([np.cos(along), np.sin(along)])
            angle = along + np.pi / 2 + rng.uniform(-0.35, 0.35)
            roads.append(Road(self._bent(start, angle, reach, 6.0), 4.8, ASPHALT))
        for _ in range(max(1, round(reach / 160.0))):
            start = middle + rng.uniform(-0.3, 0.3, 2) * reach
            roads.append(Road(self._bent(start, rng.uniform(0, np.pi), reach, 12.0), 2.6, DIRT))
        return tuple(roads)

    def _bent(self, start: F64, angle: float, reach_m: float, bend_m: float) -> F64:
        """(N, 2) a line through ``start``, swinging ``bend_m`` to either side."""
        s = np.arange(-reach_m, reach_m, 2.0)
        phase, length = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(110, 190)
        swing = bend_m * (np.sin(2 * np.pi * s / length + phase) - np.sin(phase))
        ahead = np.array([np.cos(angle), np.sin(angle)])
        return np.asarray(start + np.outer(s, ahead) + np.outer(swing, [-ahead[1], ahead[0]]))

    def _stations(self, gap_m: tuple[float, float]) -> Iterator[tuple[Road, float, float, float]]:
        """Asphalt roads with x, y and heading at random gaps along each."""
        for road in (r for r in self.roads if r.surface == ASPHALT):
            steps = np.diff(road.line, axis=0)
            s = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
            heading = np.arctan2(steps[:, 1], steps[:, 0])
            places, at = [], self.rng.uniform(0, gap_m[1])
            while at < s[-1]:
                k = min(int(np.searchsorted(s, at, "right")) - 1, len(heading) - 1)
                x, y = np.interp(at, s, road.line[:, 0]), np.interp(at, s, road.line[:, 1])
                places.append((road, float(x), float(y), float(heading[k])))
                at += self.rng.uniform(*gap_m)
            yield from places  # drawn all before what stands there

    def _stand(self, row: F64, eave_m: float, ridge_m: float) -> None:
        """Set a block's heights: its floor on the highest ground below it, its walls into it."""
        corners = np.vstack([shapes.footprint(row), row[[shapes.X, shapes.Y]]])
        z = self.ground.height(corners[:, 0], corners[:, 1])
        floor = float(z.max())
        row[shapes.BASE], row[shapes.EAVE] = float(z.min()) - 0.5, floor + eave_m
        row[shapes.RIDGE] = floor + eave_m + ridge_m

    def _paint(self, row: F64, top: Colour, wall: Colour) -> None:
        row[shapes.TOP_B : shapes.TOP_R + 1] = np.array(top) * self.rng.uniform(0.85, 1.15)
        row[shapes.WALL_B : shapes.WALL_R + 1] = np.array(wall) * self.rng.uniform(0.85, 1.1)
        row[shapes.SEED] = int(self.rng.integers(1, 1 << 20))

    def _pick(self, colours: tuple[Colour, ...]) -> Colour:
        return colours[int(self.rng.integers(len(colours)))]

    def add_houses(self) -> None:
        """Houses, halls and garages along the asphalt roads, with chimneys."""
        rng = self.rng
        for road, x, y, heading in self._stations((15.0, 30.0)):
            for side in (-1.0, 1.0):
                if rng.uniform() > 0.75 * self.density:
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
                if self.take(shapes.footprint(row, 1.5)):
                    self._stand(row, rng.uniform(3.0, 6.5), 0.5 * size[1] * rng.uniform(0.6, 1))
                    self._paint(row, self._pick(ROOFS), self._pick(WALLS))
                    self.blocks.append(row)
                    self._add_next_to(row)

    def _add_next_to(self, house: F64) -> None:
        """A chimney on the roof and perhaps a garage next to a house."""
        rng = self.rng
        heading = float(np.arctan2(house[shapes.SIN], house[shapes.COS]))
        ahead = np.array([np.cos(heading), np.sin(heading)])
        at = house[[shapes.X, shapes.Y]]
        if house[shapes.KIND] == GABLED:
            x, y = at + ahead * house[shapes.HALF_L] * rng.uniform(-0.6, 0.6)
            row = _block(PLAIN, x, y, heading, (0.8, 0.6))
            row[shapes.BASE], row[shapes.EAVE] = house[shapes.EAVE], house[shapes.RIDGE] + 0.9
            self._paint(row, (70, 75, 90), (70, 80, 120))
            self.blocks.append(row)
        if rng.uniform() < 0.5:
            length = rng.uniform(5.5, 7)
            x, y = at + ahead * (house[shapes.HALF_L] + length / 2 + 1.8)
            row = _block(FLAT, x, y, heading, (length, rng.uniform(3.2, 6)))
            if self.take(shapes.footprint(row, 0.2)):
                self._stand(row, rng.uniform(2.3, 2.8), 0.0)
                self._paint(row, (120, 122, 124), self._pick(WALLS))
                self.blocks.append(row)

    def add_cars(self) -> None:
        """Parked cars at the kerb: a body and a cabin each."""
        area = self.area
        for road, x, y, heading in self._stations((12.0, 60.0)):
            if self.rng.uniform() > self.density:
                continue
            side = self.rng.choice([-1.0, 1.0]) * (road.width_m / 2 - 1.1)
            cx, cy = x - side * np.sin(heading), y + side * np.cos(heading)
            if not (area.x0 + 3 < cx < area.x1 - 3 and area.y0 + 3 < cy < area.y1 - 3):
                continue
            body = _block(VEHICLE, cx, cy, heading, (4.4, 1.8))
            cabin = _block(VEHICLE, cx - 0.2 * np.cos(heading), cy - 0.2 * np.sin(heading),
                           heading, (2.3, 1.55))  # fmt: skip
            self._stand(body, 0.85, 0.0)
            self._paint(body, self._pick(PAINTS), (60, 60, 60))
            cabin[shapes.TOP_B :] = body[shapes.TOP_B :]
            cabin[shapes.WALL_B : shapes.WALL_R + 1] = 45, 40, 38
            cabin[shapes.BASE], cabin[shapes.EAVE] = body[shapes.EAVE], body[shapes.EAVE] + 0.6
            self.blocks += [body, cabin]

    def add_changes(self, count: int, date: int, seed: int) -> list[ChangedBox]:
        """Boxes on free ground in the inner two thirds of the area, for one of two dates each;
        those of ``date`` stand."""
        area, self.rng = self.area, np.random.default_rng(seed + 77)
        middle = np.array([0.5 * (area.x0 + area.x1), 0.5 * (area.y0 + area.y1)])
        found: list[ChangedBox] = []
        for _ in range(1000 * count):
            if len(found) == count:
                break
            x, y = middle + self.rng.uniform(-1 / 3, 1 / 3, 2) * area.size_m
            size = self.rng.uniform(*CHANGE_M), self.rng.uniform(*CHANGE_M)
            row = _block(FLAT, float(x), float(y), self.rng.uniform(0, np.pi), size)
            height = float(self.rng.uniform(*CHANGE_HEIGHT_M))
            if not self.take(shapes.footprint(row, 2.0)):
                continue
            self._stand(row, height, 0.0)
            self._paint(row, self._pick(ROOFS), self._pick(WALLS))
            gx, gy = np.meshgrid(*(np.arange(c - 4.0, c + 4.0, 0.05) for c in (x, y)))
            under = shapes.inside(row, gx, gy)
            level = self.ground.height(gx[under], gy[under])
            volume = float((row[shapes.EAVE] - level).mean() * size[0] * size[1])
            outline = tuple((float(a), float(b)) for a, b in shapes.footprint(row))
            box = ChangedBox(outline, height, volume, 1 if len(found) < count // 2 else 2)
            found.append(box)
            if box.date == date:
                self.blocks.append(row)
        return found

    def add_trees(self) -> None:
        """Groves, single trees and bushes."""
        area, rng = self.area, self.rng
        surface = area.size_m[0] * area.size_m[1]
        groves = max(3, int(surface / 3000))
        centres = rng.uniform([area.x0, area.y0], [area.x1, area.y1], (groves, 2))
        for _ in range(int(surface * (0.002 + 0.006 * min(1.0, self.density)))):
            bush = rng.uniform() < 0.45
            at = centres[int(rng.integers(len(centres)))] + rng.normal(0, 12.0, 2)
            radius = rng.uniform(0.7, 1.4) if bush else rng.uniform(2.0, 4.2)
            height = radius * (rng.uniform(1.2, 1.6) if bush else rng.uniform(2.2, 2.8))
            if not self.take(at + 0.8 * radius * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])):
                continue
            z = float(self.ground.height(at[:1], at[1:])[0])
            green = np.array([38, 82, 62]) * rng.uniform(0.75, 1.25) + rng.uniform(-8, 8, 3)
            own_seed = int(rng.integers(1, 1 << 20))
            self.trees.append(np.array([at[0], at[1], z, radius, *green, own_seed]))
            self.heights_m.append(float(height))
            if not bush:
                trunk = _block(PLAIN, at[0], at[1], 0.3, (0.36, 0.36))
                trunk[shapes.BASE], trunk[shapes.EAVE] = z - 0.3, z + 0.6 * height
                trunk[shapes.WALL_B : shapes.WALL_R + 1] = 50, 62, 78
                self.trunks.append(trunk)


def _block(kind: float, x: float, y: float, heading: float, size: tuple[float, float]) -> F64:
    """A row of the block table with its plan; heights and colours are still zero."""
    row = np.zeros(shapes.COLUMNS)
    row[: shapes.BASE] = kind, x, y, np.cos(heading), np.sin(heading), size[0] / 2, size[1] / 2
    return row


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


def make_terrain(area: Area, relief_m: float, seed: int) -> HeightField:
    """A terrain whose hills span about ``relief_m`` metres, with 0 m at the world's origin."""
    nx, ny = (int(np.ceil(side / TERRAIN_STEP_M)) + 1 for side in area.size_m)
    z = np.empty((ny, nx))
    parallel_for(_heights, ny, z, area.x0, area.y0, TERRAIN_STEP_M, relief_m, seed)
    zero = HeightField(area, TERRAIN_STEP_M, z).height(np.zeros(1), np.zeros(1))[0]
    return HeightField(area, TERRAIN_STEP_M, z - zero)


@njit(cache=True, nogil=True)
def _heights(begin, end, z, x0, y0, step_m, relief_m, seed):  # type: ignore[no-untyped-def]
    for j in range(begin, end):
        for i in range(z.shape[1]):
            x, y = x0 + i * step_m, y0 + j * step_m
            hills = 0.30 * relief_m * fractal2(x, y, 130.0, 2, 0.45, seed + 11)
            knolls = 0.06 * relief_m * fractal2(x, y, 28.0, 3, 0.5, seed + 23)
            bumps = 0.05 * fractal2(x, y, 5.0, 2, 0.5, seed + 37)
            z[j, i] = hills + knolls + min(1.0, relief_m) * bumps
