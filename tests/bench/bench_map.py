"""The map and the fused cloud, against a NumPy voxel set and Open3D.

A nadir camera at 60 m flies a metre per keyframe over relief; depth has 15 cm of noise.
"""

from __future__ import annotations

import numpy as np

from recon import se3
from recon.mapping.cloud_fusion import cloud_of, fuse
from recon.mapping.free_space import seen_through
from recon.mapping.voxel_map import VoxelMap
from recon.types import Array, DepthMap, PointCloud
from service.bench import BenchOptions, BenchResult, compare

SIZE_PX = (320, 180)
HEIGHT_M = 60.0
SIGMA_M = 0.15
KEYFRAMES = 24
LONG_FLIGHT = 400
NADIR = np.diag([1.0, -1.0, -1.0])


def keyframe_depth(east_m: float, seed: int) -> DepthMap:
    """Relief of 3 m amplitude seen from above at (east, 0)."""
    w, h = SIZE_PX
    K = np.array([[240.0, 0.0, 159.5], [0.0, 240.0, 89.5], [0.0, 0.0, 1.0]])
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    x = east_m + (u - K[0, 2]) / K[0, 0] * HEIGHT_M
    y = -(v - K[1, 2]) / K[1, 1] * HEIGHT_M
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_M, (h, w))
    depth = HEIGHT_M - 3.0 * np.sin(x / 15.0) * np.cos(y / 12.0) + noise
    return DepthMap(
        depth.astype(np.float32),
        np.full((h, w), SIGMA_M, np.float32),
        np.ones((h, w), np.uint8),
        K,
        se3.compose(NADIR, np.array([east_m, 0.0, HEIGHT_M])),
    )


def run(options: BenchOptions) -> list[BenchResult]:
    """Times per keyframe of 57,600 points, voxels of half a metre (map) and a quarter (fusion)."""
    depths = [keyframe_depth(float(k), k) for k in range(KEYFRAMES)]
    bgr = np.full((SIZE_PX[1], SIZE_PX[0], 3), 120, np.uint8)
    clouds = [cloud_of(depth, bgr) for depth in depths]
    return [_map(depths, clouds, options), _growth(), *_fusion(depths, clouds, options)]


def _map(depths: list[DepthMap], clouds: list[PointCloud], options: BenchOptions) -> BenchResult:
    """Fresh pixels and their insertion, against the same question to a sorted NumPy set."""
    voxel_map = VoxelMap(0.5)
    for depth in depths:
        voxel_map.insert(depth, voxel_map.fresh(depth))
    held = np.unique(np.concatenate([_keys(cloud) for cloud in clouds]))
    last = depths[-1]

    def ours() -> object:
        return voxel_map.insert(last, voxel_map.fresh(last))

    def theirs() -> object:
        keys = _keys(clouds[-1])
        return np.isin(keys, held, kind="sort")

    return compare(
        "fresh + insert, 57,600 points",
        ours,
        options,
        "NumPy voxel set",
        theirs,
        "ours also looks along the ray and at sigma",
    )


def _keys(cloud: PointCloud, voxel_m: float = 0.5) -> Array:
    """Packed voxel indices by NumPy."""
    i = np.floor(cloud.xyz_m.astype(np.float64) / voxel_m).astype(np.int64) + (1 << 20)
    return (i[:, 0] << 42) | (i[:, 1] << 21) | i[:, 2]


def _growth() -> BenchResult:
    """Memory of the map after a flight of two kilometres."""
    voxel_map = VoxelMap(0.5)
    for k in range(LONG_FLIGHT):
        depth = keyframe_depth(5.0 * k, k)
        voxel_map.insert(depth, voxel_map.fresh(depth))
    flown_m2 = (5.0 * LONG_FLIGHT + 80.0) * 45.0
    megabytes = voxel_map.nbytes / 1e6
    return BenchResult("memory", megabytes / flown_m2 * 1e4, "MB per hectare flown")


def _fusion(
    depths: list[DepthMap], clouds: list[PointCloud], options: BenchOptions
) -> list[BenchResult]:
    """Fusion of all keyframes, against Open3D's voxel grid mean (no sigma, no views)."""
    fewer = BenchOptions(max(options.rounds // 6, 3), 1)
    fused = fuse(clouds, 0.25)
    name = f"fuse {KEYFRAMES} keyframes"
    try:
        import open3d as o3d
    except ImportError:  # not installed, or a library of the system is missing
        fusion = compare(name, lambda: fuse(clouds, 0.25), fewer)
    else:
        xyz = np.concatenate([c.xyz_m for c in clouds]).astype(np.float64)
        points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
        points.colors = o3d.utility.Vector3dVector(np.full_like(xyz, 0.5))
        fusion = compare(
            name,
            lambda: fuse(clouds, 0.25),
            fewer,
            "Open3D voxel_down_sample",
            lambda: points.voxel_down_sample(0.25),
            "the peer has no sigma, views or outlier test",
        )
    seen = compare("free-space test of it", lambda: seen_through(fused, depths), fewer)
    return [fusion, seen]
