"""A painted ground, 240 m across, and the exact images that a camera above it takes."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.types import F64, U8, Camera

SIZE = (480, 360)
K = np.array([[400.0, 0, 239.5], [0, 400.0, 179.5], [0, 0, 1]])
CAMERA = Camera(K, np.zeros(5), SIZE)
M_PER_PX = 0.1
DOWN = np.diag([1.0, -1, -1])
HEIGHT_M = 40.0
FOOTPRINT_M = HEIGHT_M * SIZE[0] / K[0, 0]


@lru_cache(1)
def painted_ground() -> U8:
    """A texture with detail at all scales."""
    rng = np.random.default_rng(7)
    out = np.zeros((2400, 2400), np.float32)
    for size in (8, 25, 80, 250, 1000, 2400):
        layer = rng.normal(0, 1, (size, size)).astype(np.float32)
        out += cv2.resize(layer, (2400, 2400), interpolation=cv2.INTER_CUBIC)
    out = (out - out.mean()) / out.std() * 45 + 128
    return np.asarray(np.clip(out, 0, 255).astype(np.uint8))


def still(T_world_camera: F64, camera: Camera = CAMERA, ground: U8 | None = None) -> U8:
    """The camera's image of the plane z = 0, painted unless another ground is given."""
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    plane = np.array([[M_PER_PX, 0, -120.0], [0, M_PER_PX, -120.0], [0, 0, 1]])
    H = camera.K @ R.T @ (np.c_[np.eye(3)[:, :2], -t] @ plane)
    seen = painted_ground() if ground is None else ground
    return np.asarray(cv2.warpPerspective(seen, H, camera.size_px, flags=cv2.INTER_AREA), np.uint8)


def pose(east_m: float, yaw_deg: float = 0.0, height_m: float = HEIGHT_M, seed: int = 0) -> F64:
    """Looking down with up to a few degrees of tilt, as a kite or a drone in wind."""
    tilt = np.random.default_rng(seed).normal(0.0, 0.03, 2)
    R = se3.so3_exp(np.array([0.0, 0.0, np.radians(yaw_deg)])) @ se3.so3_exp(np.r_[tilt, 0.0])
    return se3.compose(R @ DOWN, np.array([east_m, 0.1 * east_m, height_m]))


def on_plane(K_grid: F64, size: tuple[int, int], T_world_camera: F64) -> F64:
    """(w h, 3) where the pixels' rays meet the plane, in the camera's frame."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    ray = rays(K_grid, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    return np.asarray(ray * (HEIGHT_M / -(ray @ T_world_camera[2, :3]))[:, None])
