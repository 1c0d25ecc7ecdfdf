"""Frames of the scene: one exact ray per pixel through the distorted lens, smooth at edges."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from recon.camera_model import check_camera
from recon.parallel import parallel_for
from recon.surface.triangle_grid import first_hit
from recon.types import F32, F64, U8, Camera
from service.sim.ground_texture import (
    AMBIENT,
    SUN_STRENGTH,
    GroundTexture,
    crown_shade,
    wall_colour,
)
from service.sim.noise import fractal2, normal, smoothstep, value3
from service.sim.scene import Scene
from service.sim.shapes import CROWN, TREE_B, TREE_SEED, WALL

SKY = (225.0, 205.0, 185.0)


def camera_rays(camera: Camera) -> F64:
    """(H, W, 3) ray with z = 1 of every pixel of the distorted image, in the camera frame. Raises
    ValueError when the lens model cannot be inverted over the whole image."""
    check_camera(camera)
    W, H = camera.size_px
    u, v = np.meshgrid(np.arange(W, dtype=np.float64), np.arange(H, dtype=np.float64))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    xy0 = (pixels - camera.K[:2, 2]) / [camera.K[0, 0], camera.K[1, 1]]
    k1, k2, p1, p2, k3 = camera.distortion
    xy = xy0.copy()
    for _ in range(100):  # fixed point of Brown's model
        x, y, r2 = xy[:, 0], xy[:, 1], (xy**2).sum(axis=1)
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        before, xy = xy, (xy0 - np.stack([dx, dy], axis=1)) / radial[:, None]
        if np.abs(xy - before).max() < 1e-14:
            break
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    back = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.distortion)[0]
    error = float(np.abs(back.reshape(-1, 2) - pixels).max())
    if not error < 1e-3:
        raise ValueError(f"the lens model does not invert over {W}x{H} (off by {error:.2g} px)")
    return np.asarray(rays.reshape(H, W, 3))


@dataclass(frozen=True, slots=True)
class Look:
    """Effects between the scene and the file: noise, exposure, water."""

    noise: float = 1.5  # sensor noise, gray levels, 1 sigma
    vignette: float = 0.12  # share of light lost in the corners
    exposure: float = 1.0  # gain
    water_m: float | None = None  # level of a sea with waves and clouds; None: no water


class Renderer:
    def __init__(self, scene: Scene, texture: GroundTexture, camera: Camera) -> None:
        """Prepare the rays and tables; raises ValueError for an unusable camera."""
        self.scene, self.texture, self.camera = scene, texture, camera
        self.rays = camera_rays(camera)
        self._straight = camera_rays(Camera(camera.K, np.zeros(5), camera.size_px))
        self._normals = scene.grid.normals()

    def frame(self, T_world_camera: F64, index: int, look: Look, time_s: float = 0.0) -> U8:
        """(H, W, 3) BGR image as the distorted camera takes it at one moment."""
        return self.develop(self.light(T_world_camera, look, time_s), index, look)

    def light(self, T_world_camera: F64, look: Look, time_s: float = 0.0) -> F32:
        """(H, W, 3) BGR light that falls on the pixels.

        ``T_world_camera`` is one pose (4, 4), or one for each row (H, 4, 4); for each column
        (W, 4, 4) where the shutter moves sideways. Water moves with ``time_s``.
        """
        H, W = self.rays.shape[:2]
        colour = np.empty((H, W, 3), np.float32)
        depth = np.empty((H, W))
        body = np.empty((H, W), np.int32)
        sideways = self.camera.shutter.axis == 0
        poses = np.broadcast_to(T_world_camera, (W if sideways else H, 4, 4))
        R, c = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
        focal = float(0.5 * (self.camera.K[0, 0] + self.camera.K[1, 1]))
        view = self.rays, R, c, sideways, focal
        parallel_for(_render, H, self._place(), *view, colour, depth, body)
        parallel_for(_smooth_edges, H, self._place(), *view, colour, depth, body)
        if look.water_m is not None:
            parallel_for(_flood, H, colour, depth, *view, look.water_m, time_s)
        return colour

    def develop(self, light: F32, index: int, look: Look) -> U8:
        """(H, W, 3) the image that the sensor makes of the light (H, W, 3)."""
        out = np.empty(light.shape, np.uint8)
        camera = look.noise, look.vignette, look.exposure
        parallel_for(_develop, len(out), light, self.rays, *camera, index, out)
        return out

    def depth(self, T_world_camera: F64, water_m: float | None = None) -> F32:
        """(H, W) depth along z of the camera without distortion; NaN in the sky and on water."""
        H, W = self._straight.shape[:2]
        directions = self._straight.reshape(-1, 3) @ T_world_camera[:3, :3].T
        t, _ = self.scene.grid.cast(T_world_camera[:3, 3], directions)
        if water_m is not None:
            t[T_world_camera[2, 3] + t * directions[:, 2] < water_m] = np.nan
        return np.asarray(t.reshape(H, W), np.float32)

    def _place(self) -> tuple[object, ...]:
        """What the compiled functions take as ``place``."""
        p = self.texture
        return (
            self.scene.grid.arrays(), self._normals, self.scene.material, self.scene.owner,
            self.scene.blocks, self.scene.trees, p.bgr, p.levels, p.x0, p.y0, p.texel_m, p.sun,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _texel(bgr, levels, level, x0, y0, texel_m, x, y):  # type: ignore[no-untyped-def]
    """(b, g, r) of one level of the image from above, bilinear."""
    offset, rows, cols = levels[level, 0], levels[level, 1], levels[level, 2]
    size = texel_m * (1 << level)
    u = min(max((x - x0) / size - 0.5, 0.0), cols - 1.001)
    v = min(max((y - y0) / size - 0.5, 0.0), rows - 1.001)
    i, j = int(u), int(v)
    fu, fv = u - i, v - j
    k = offset + j * cols + i
    wa, wb = (1 - fu) * (1 - fv), fu * (1 - fv)
    wc, wd = (1 - fu) * fv, fu * fv
    m = k + cols
    b = wa * bgr[k, 0] + wb * bgr[k + 1, 0] + wc * bgr[m, 0] + wd * bgr[m + 1, 0]
    g = wa * bgr[k, 1] + wb * bgr[k + 1, 1] + wc * bgr[m, 1] + wd * bgr[m + 1, 1]
    r = wa * bgr[k, 2] + wb * bgr[k + 1, 2] + wc * bgr[m, 2] + wd * bgr[m + 1, 2]
    return b, g, r


@njit(cache=True, nogil=True, error_model="numpy")
def _turned(R, a, b):  # type: ignore[no-untyped-def]
    """The direction (a, b, 1) of a camera, in the world."""
    return (
        R[0, 0] * a + R[0, 1] * b + R[0, 2],
        R[1, 0] * a + R[1, 1] * b + R[1, 2],
        R[2, 0] * a + R[2, 1] * b + R[2, 2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _seen(place, R, c, a, b, pixel):  # type: ignore[no-untyped-def]
    """(b, g, r, t, body) along the ray (a, b, 1); ``pixel`` is the angle of a pixel in rad. ``t``
    counts in lengths of the direction; body 0 is the ground, -1 the sky."""
    grid, normals, material, owner, blocks, trees, bgr, levels, x0, y0, texel_m, sun = place
    dx, dy, dz = _turned(R, a, b)
    t, m = first_hit(grid, c[0], c[1], c[2], dx, dy, dz)
    if m < 0:
        return SKY[0], SKY[1], SKY[2], np.inf, -1
    x, y, z = c[0] + t * dx, c[1] + t * dy, c[2] + t * dz
    nx, ny, nz = normals[m, 0], normals[m, 1], normals[m, 2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    slant = max(0.08, abs(nx * dx + ny * dy + nz * dz) / length)
    size = t * length * pixel / np.sqrt(slant)
    kind = material[m]
    if kind in (WALL, CROWN):
        facing = max(0.0, nx * sun[0] + ny * sun[1] + nz * sun[2])
        bright = AMBIENT + SUN_STRENGTH * facing
        k = owner[m]
        if kind == WALL:
            b, g, r = wall_colour(blocks[k], x, y, z, nx, ny, size)
            return b * bright, g * bright, r * bright, t, 1 + k
        shade = bright * crown_shade(x, y, z, int(trees[k, TREE_SEED]), size)
        body = 1 + len(blocks) + k
        return (
            trees[k, TREE_B] * shade, trees[k, TREE_B + 1] * shade, trees[k, TREE_B + 2] * shade,
            t, body,
        )  # fmt: skip
    level = min(max(np.log2(size / texel_m), 0.0), len(levels) - 1.001)
    low = int(level)
    b, g, r = _texel(bgr, levels, low, x0, y0, texel_m, x, y)
    b2, g2, r2 = _texel(bgr, levels, low + 1, x0, y0, texel_m, x, y)
    f = level - low
    return b + f * (b2 - b), g + f * (g2 - g), r + f * (r2 - r), t, 1 + owner[m]


@njit(cache=True, nogil=True, error_model="numpy")
def _render(  # type: ignore[no-untyped-def]
    begin, end, place, rays, poses_R, poses_c, sideways, focal, colour, depth, body
):
    for v in range(begin, end):
        for u in range(rays.shape[1]):
            R, c = (poses_R[u], poses_c[u]) if sideways else (poses_R[v], poses_c[v])
            cb, cg, cr, t, m = _seen(place, R, c, rays[v, u, 0], rays[v, u, 1], 1.0 / focal)
            colour[v, u, 0], colour[v, u, 1], colour[v, u, 2] = cb, cg, cr
            depth[v, u], body[v, u] = t, m


@njit(cache=True, nogil=True)
def _is_edge(depth, body, u, v):  # type: ignore[no-untyped-def]
    """True where a neighbour belongs to another body or depth."""
    for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        a, b = v + dv, u + du
        if 0 <= a < depth.shape[0] and 0 <= b < depth.shape[1]:
            if body[a, b] != body[v, u]:
                return True
            if body[v, u] > 0 and abs(depth[a, b] - depth[v, u]) > 0.004 * depth[v, u]:
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth_edges(  # type: ignore[no-untyped-def]
    begin, end, place, rays, poses_R, poses_c, sideways, focal, colour, depth, body
):
    """Average a rotated square of four rays wherever an outline crosses the pixel."""
    H, W = rays.shape[0], rays.shape[1]
    for v in range(begin, end):
        for u in range(W):
            if not _is_edge(depth, body, u, v):
                continue
            un, vn = (u + 1 if u + 1 < W else u - 1), (v + 1 if v + 1 < H else v - 1)
            su, sv = un - u, vn - v
            ax, ay = su * (rays[v, un, 0] - rays[v, u, 0]), su * (rays[v, un, 1] - rays[v, u, 1])
            bx, by = sv * (rays[vn, u, 0] - rays[v, u, 0]), sv * (rays[vn, u, 1] - rays[v, u, 1])
            R, c = (poses_R[u], poses_c[u]) if sideways else (poses_R[v], poses_c[v])
            tb, tg, tr = 0.0, 0.0, 0.0
            for p, q in ((0.375, 0.125), (-0.125, 0.375), (-0.375, -0.125), (0.125, -0.375)):
                a = rays[v, u, 0] + p * ax + q * bx
                b = rays[v, u, 1] + p * ay + q * by
                cb, cg, cr, _, _ = _seen(place, R, c, a, b, 1.0 / focal)
                tb, tg, tr = tb + cb, tg + cg, tr + cr
            colour[v, u, 0], colour[v, u, 1], colour[v, u, 2] = 0.25 * tb, 0.25 * tg, 0.25 * tr


@njit(cache=True, nogil=True, error_model="numpy")
def _develop(begin, end, colour, rays, noise, vignette, exposure, index, out):  # type: ignore[no-untyped-def]
    """Vignetting, exposure and sensor noise."""
    W = colour.shape[1]
    corner = rays[0, 0, 0] ** 2 + rays[0, 0, 1] ** 2
    for v in range(begin, end):
        for u in range(W):
            r2 = (rays[v, u, 0] ** 2 + rays[v, u, 1] ** 2) / corner
            gain = exposure * (1.0 - vignette * r2)
            for k in range(3):
                value = gain * colour[v, u, k]
                if noise > 0.0:
                    value += noise * normal(u, v, 3 * index + k)
                out[v, u, k] = min(255.0, max(0.0, value + 0.5))


# A sea with moving waves up to the horizon, and clouds that drift above it: no two frames show the
# same surface. The waves are those of deep water: a length L moves at sqrt(g L / 2 pi).

LONGEST_M, OCTAVES = 24.0, 7
CLOUDS_ABOVE_M, CLOUD_M, CLOUD_SPEED_M_S = 600.0, 500.0, 9.0


@njit(cache=True, nogil=True, error_model="numpy")
def _flood(
    begin: int, end: int, colour: F32, depth: F64, rays: F64, poses_R: F64, poses_c: F64,
    sideways: bool, focal: float, level_m: float, time_s: float,
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
    for v in range(begin, end):
        for u in range(rays.shape[1]):
            R, c = (poses_R[u], poses_c[u]) if sideways else (poses_R[v], poses_c[v])
            dx, dy, dz = _turned(R, rays[v, u, 0], rays[v, u, 1])
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
