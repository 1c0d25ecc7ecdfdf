"""Registration of two 320x180 depth maps, 57,600 points each, against Open3D and small_gicp."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.mapping.registration import IcpConfig, register_projective
from recon.surface.triangle_grid import TriangleGrid
from recon.types import F64, DepthMap
from service.bench import BenchOptions, BenchResult, compare
from service.sim.scene import Area, make

K: F64 = np.array([[190.7, 0, 159.5], [0, 190.7, 89.5], [0, 0, 1.0]])
PIXELS: F64 = np.indices((180, 320), np.float64)[::-1].reshape(2, -1).T
"""(57,600, 2) u and v, row by row."""
SCENES = 8
NOISE_M = 0.05


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds from the same depth maps and start, preparation included."""
    source, target, T = pair(0, 0.0)
    guess = start(0, T)
    config = IcpConfig()
    what = "align 57,600 points of a village"
    ours = partial(register_projective, source, target, guess, config)
    results = []
    for peer, other in peers().items():
        theirs = partial(other, source, target, guess)
        results.append(compare(what, ours, options, peer, theirs))
    return results


def peers() -> dict[str, Callable[[DepthMap, DepthMap, F64], F64]]:
    """Those that can be imported, by name."""
    found: dict[str, Callable[[DepthMap, DepthMap, F64], F64]] = {}
    if find_spec("open3d") is not None:
        found["Open3D rgbd_odometry_multi_scale"] = by_open3d
    if find_spec("small_gicp") is not None:
        found["small_gicp VGICP 1 m"] = by_small_gicp
    return found


@lru_cache(maxsize=1)
def village() -> TriangleGrid:
    """Hills with houses and trees, under all the scenes."""
    return make(Area(-80.0, -70.0, 110.0, 80.0), relief_m=8.0, density=1.0, seed=1).grid


def rendered(T_world_camera: F64) -> F64:
    """(180, 320) depth along z of the village."""
    directions = rays(K, PIXELS) @ T_world_camera[:3, :3].T
    return village().cast(T_world_camera[:3, 3], directions)[0].reshape(180, 320)


@lru_cache(maxsize=2 * SCENES)
def views(seed: int) -> tuple[F64, F64, F64]:
    """Exact depth of the source and the target, and T_target_source."""
    nadir = np.diag([1.0, -1.0, -1.0])
    a = se3.compose(nadir, np.array([3.0 * seed, 1.0 * seed, 60.0]))
    turned = nadir @ se3.so3_exp(np.array([0.01, -0.015, 0.03]))
    b = se3.compose(turned, a[:3, 3] + np.array([4.0, 1.0, 0.5]))
    return rendered(b), rendered(a), np.asarray(se3.inverse(a) @ b)


def pair(seed: int, blur_px: float) -> tuple[DepthMap, DepthMap, F64]:
    """Source and target from two places 4 m apart, and the true T_target_source."""
    rng = np.random.default_rng(seed)
    source, target, T = views(seed)
    maps = []
    for exact in (source, target):
        noise = rng.normal(size=(180, 320))
        if blur_px > 0:
            noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), blur_px))
        depth = exact + NOISE_M * noise / noise.std()
        maps.append(
            DepthMap(
                depth.astype(np.float32), np.full((180, 320), NOISE_M, np.float32),
                np.full((180, 320), 2, np.uint8), K, np.eye(4),
            )
        )  # fmt: skip
    return maps[0], maps[1], T


def start(seed: int, T: F64) -> F64:
    """The truth moved by about half a metre and half a degree."""
    rng = np.random.default_rng(1000 + seed)
    twist = np.concatenate([rng.normal(size=3) * 0.003, rng.normal(size=3) * 0.27])
    return np.asarray(se3.exp(twist) @ T)


def by_open3d(source: DepthMap, target: DepthMap, guess: F64) -> F64:
    """(4, 4) by Open3D's tensor RGB-D odometry, point to plane on three scales."""
    o3d: Any = import_module("open3d")
    geometry, odometry = o3d.t.geometry, o3d.t.pipelines.odometry
    blank = np.zeros((180, 320, 3), np.uint8)
    images = [
        geometry.RGBDImage(geometry.Image(blank), geometry.Image(d.depth_m[..., None]))
        for d in (source, target)
    ]
    found = odometry.rgbd_odometry_multi_scale(
        *images, o3d.core.Tensor(K), o3d.core.Tensor(guess), 1.0, 100.0,
        [odometry.OdometryConvergenceCriteria(n) for n in (6, 4, 2)],
        odometry.Method.PointToPlane, odometry.OdometryLossParams(1.5, 1.0, 0.3),
    )  # fmt: skip
    return np.asarray(found.transformation.numpy(), np.float64)


def by_small_gicp(source: DepthMap, target: DepthMap, guess: F64) -> F64:
    """(4, 4) by voxelised generalised ICP of small_gicp on two threads."""
    import small_gicp

    directions = rays(K, PIXELS)
    clouds = [directions * d.depth_m.reshape(-1, 1) for d in (target, source)]
    found = small_gicp.align(
        *clouds, guess, registration_type="VGICP", voxel_resolution=1.0,
        downsampling_resolution=1.0, num_threads=2,
    )  # fmt: skip
    return np.asarray(found.T_target_source, np.float64)
