"""A sea with moving waves up to the horizon, and clouds that drift above it.

Nothing of it holds still, so no two frames show the same surface. The waves are those of deep
water: a length L moves at sqrt(g L / 2 pi).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from recon.types import F32, F64
from service.sim.noise import fractal2, smoothstep, value3

LONGEST_M, OCTAVES = 24.0, 7
CLOUDS_ABOVE_M, CLOUD_M, CLOUD_SPEED_M_S = 600.0, 500.0, 9.0


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def flood(
    colour: F32, depth: F64, rays: F64, poses_R: F64, poses_c: F64, sideways: bool, focal: float,
    level_m: float, time_s: float,
) -> None:  # fmt: skip
    """Draw water at ``level_m`` where it is nearer than what is seen, and clouds behind all.

    Args:
        colour: (H, W, 3) BGR, drawn into.
        depth: (H, W) along the camera's z, infinite in the sky; NaN where water is drawn.
        rays: (H, W, 3) with z = 1 in the camera frame.
        poses_R: (N, 3, 3) R_world_camera of each row, ``poses_c`` (N, 3) the camera's place;
            of each column with ``sideways``.
        focal: px.
    """
    for v in prange(rays.shape[0]):
        for u in range(rays.shape[1]):
            R, c = (poses_R[u], poses_c[u]) if sideways else (poses_R[v], poses_c[v])
            a, b = rays[v, u, 0], rays[v, u, 1]
            dx = R[0, 0] * a + R[0, 1] * b + R[0, 2]
            dy = R[1, 0] * a + R[1, 1] * b + R[1, 2]
            dz = R[2, 0] * a + R[2, 1] * b + R[2, 2]
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            t = (level_m - c[2]) / dz if dz < -1e-4 * length else np.inf
            bright = 0.0
            if t < depth[v, u] and t < np.inf:
                pixel_m = t * length / focal * np.sqrt(length / -dz)
                bright = _waves(c[0] + t * dx, c[1] + t * dy, time_s, pixel_m)
                colour[v, u, 0], colour[v, u, 1] = 118 + 60 * bright, 96 + 60 * bright
                colour[v, u, 2] = 70 + 60 * bright
                depth[v, u] = np.nan
            elif depth[v, u] == np.inf:
                up = max(dz / length, 0.0)
                far = CLOUDS_ABOVE_M / max(up, 0.03)
                x = c[0] + far * dx / length + CLOUD_SPEED_M_S * time_s
                bright = fractal2(x, c[1] + far * dy / length, CLOUD_M, 5, 0.6, 977)
                bright = smoothstep(-0.1, 0.6, bright) * smoothstep(0.0, 0.1, up)
                for k in range(3):
                    clear = 225.0 - 20.0 * k
                    colour[v, u, k] = clear + bright * (240.0 - clear)


@njit(cache=True, nogil=True, error_model="numpy")
def _waves(x: float, y: float, time_s: float, pixel_m: float) -> float:
    """Brightness about 0 of the water at a place; waves shorter than two pixels fade."""
    total, strength, long_m = 0.0, 0.5, LONGEST_M
    for n in range(OCTAVES):
        seen = 1.0 - smoothstep(0.25, 0.6, pixel_m / long_m)
        if seen > 0.0:
            speed = np.sqrt(9.81 * long_m / (2.0 * np.pi))
            turn = 0.9 * n - 0.4 * (n % 3)  # each length runs its own way about the wind's
            s, q = np.sin(0.5 * np.sin(turn)), np.cos(0.5 * np.sin(turn))
            along = (q * x + s * y - speed * time_s) / (0.5 * long_m)
            across = (q * y - s * x) / long_m
            alive = value3(along, across, time_s * speed / long_m, 4001 + n)
            total += strength * seen * (2.0 * alive - 1.0)
        strength *= 0.85
        long_m *= 0.5
    return total
