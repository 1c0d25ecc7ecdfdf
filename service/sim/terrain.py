"""The ground: smooth hills, small relief, and roads that follow it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from recon.types import F64
from service.sim.noise import fractal2


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
class Terrain:
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


def make(area: Area, relief_m: float, step_m: float, seed: int) -> Terrain:
    """A terrain whose hills span about ``relief_m`` metres, with 0 m at the world's origin."""
    nx = int(np.ceil(area.size_m[0] / step_m)) + 1
    ny = int(np.ceil(area.size_m[1] / step_m)) + 1
    z = np.empty((ny, nx))
    _heights(z, area.x0, area.y0, step_m, relief_m, seed)
    terrain = Terrain(area, step_m, z)
    zero = terrain.height(np.zeros(1), np.zeros(1))[0]
    return Terrain(area, step_m, z - zero)


@njit(cache=True, nogil=True, parallel=True)
def _heights(z, x0, y0, step_m, relief_m, seed):  # type: ignore[no-untyped-def]
    for j in prange(z.shape[0]):
        for i in range(z.shape[1]):
            x, y = x0 + i * step_m, y0 + j * step_m
            hills = 0.30 * relief_m * fractal2(x, y, 130.0, 2, 0.45, seed + 11)
            knolls = 0.06 * relief_m * fractal2(x, y, 28.0, 3, 0.5, seed + 23)
            bumps = 0.05 * fractal2(x, y, 5.0, 2, 0.5, seed + 37)
            z[j, i] = hills + knolls + min(1.0, relief_m) * bumps
