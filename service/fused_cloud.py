"""The fused cloud of a scan, from the keyframes in its store."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from recon.cloud_fusion import cloud_of, fuse
from recon.free_space import seen_through
from recon.types import PointCloud
from recon.voxel_map import ground_sample_m
from service.stream.store import ScanStore

LARGEST_POINTS = 20_000_000
"""Fused points at most; a scan that would have more gets larger voxels, and a note."""

SMALLEST_VOXEL_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class FusedCloud:
    """A scan's fused cloud in its own ENU metres, and what it was made of."""

    cloud: PointCloud
    voxel_m: float
    ground_sample_m: float | None  # median over keyframes
    keyframes: int
    points_in: int
    notes: tuple[str, ...] = ()


def fused_cloud(store: ScanStore, voxel_m: float | None = None) -> FusedCloud:
    """All keyframes of ``store`` fused; voxels of the ground sample distance by default.

    Points that other keyframes see through are left out. The store is read three times, so
    that memory holds one keyframe and the fused points only.
    """
    samples, points = [], 0
    for keyframe in store.keyframes():
        sample = ground_sample_m(keyframe.depth)
        if sample is not None:
            samples.append(sample)
        points += int(np.isfinite(keyframe.depth.depth_m).sum())
    sample = float(np.median(samples)) if samples else None
    size = max(voxel_m or sample or 0.25, SMALLEST_VOXEL_M)
    notes: tuple[str, ...] = ()
    if points > LARGEST_POINTS:
        size *= float(np.sqrt(points / LARGEST_POINTS))
        notes = (f"{points} points before fusion: voxels enlarged to {size:.3f} m",)
    cloud = fuse(_clouds(store), size)
    if len(cloud):
        keep = ~seen_through(cloud, (k.depth for k in store.keyframes()))
        cloud = PointCloud(
            cloud.xyz_m[keep], cloud.rgb[keep], cloud.sigma_m[keep], cloud.views[keep]
        )
    return FusedCloud(cloud, size, sample, len(samples), points, notes)


def _clouds(store: ScanStore) -> Iterator[PointCloud]:
    for keyframe in store.keyframes():
        yield cloud_of(keyframe.depth, keyframe.bgr, keyframe.fresh)
