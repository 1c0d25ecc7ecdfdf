"""New surface of the map, and fused clouds, against dictionaries and closed forms."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from recon import se3
from recon.mapping.cloud_fusion import (
    CORRELATION,
    cloud_of,
    fuse,
    fuse_strips,
    without_contradicted,
)
from recon.mapping.voxel_map import VoxelMap, ground_sample_m
from recon.types import F64, Bool, DepthMap, PointCloud

K = np.array([[100.0, 0.0, 79.5], [0.0, 100.0, 44.5], [0.0, 0.0, 1.0]])
NADIR = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


def view(
    east_m: float, height_m: float = 50.0, sigma_m: float = 0.1, roof_m: float = 0.0
) -> DepthMap:
    """A nadir camera over flat ground at height 0, with a roof where 10 < east < 14."""
    h, w = 90, 160
    depth = np.full((h, w), height_m, np.float32)
    if roof_m:
        east = east_m + (np.arange(w) - K[0, 2]) / K[0, 0] * (height_m - roof_m)
        depth[:, (east > 10) & (east < 14)] = height_m - roof_m
    sigma = np.full((h, w), sigma_m, np.float32)
    T = se3.compose(NADIR, np.array([east_m, 3.0, height_m]))
    return DepthMap(depth, sigma, np.ones((h, w), np.uint8), K, T)


def world_points(depth: DepthMap) -> F64:
    """(h, w, 3) by the pinhole formula, written out on its own."""
    h, w = depth.depth_m.shape
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(depth.K).T
    camera = rays * depth.depth_m[..., None]
    return np.asarray(camera @ depth.T_world_camera[:3, :3].T + depth.T_world_camera[:3, 3])


def cloud(xyz: list[list[float]], sigma: list[float], views: list[int] | None = None) -> PointCloud:
    n = len(xyz)
    return PointCloud(
        np.array(xyz, np.float32),
        np.tile(np.arange(n, dtype=np.uint8)[:, None] * 10, (1, 3)),
        np.array(sigma, np.float32),
        np.array(views or [1] * n, np.uint8),
    )


def test_inserts_as_many_voxels_as_a_set_of_indices() -> None:
    depth = view(0.0, roof_m=6.0)
    voxel_map = VoxelMap(0.7)
    new = voxel_map.insert(depth)
    indices = np.floor(world_points(depth).reshape(-1, 3) / 0.7).astype(int)
    assert new == len(voxel_map) == len({tuple(i) for i in indices})
    assert voxel_map.insert(depth) == 0


def test_known_surface_needs_no_more_memory() -> None:
    depth = view(0.0, roof_m=6.0)
    voxel_map = VoxelMap(5.0)
    voxel_map.insert(depth)
    held = voxel_map.nbytes
    many = replace(depth, depth_m=np.tile(depth.depth_m, (8, 8)))
    many = replace(many, sigma_m=np.tile(depth.sigma_m, (8, 8)))
    assert many.depth_m.size > held / 16  # slots for all its pixels would double the table
    nothing = np.zeros(many.depth_m.shape, np.bool_)
    assert voxel_map.insert(many, nothing) == 0
    assert voxel_map.nbytes == held


def test_all_is_fresh_before_and_nothing_after() -> None:
    depth = view(0.0, roof_m=6.0)
    voxel_map = VoxelMap(1.0)
    assert voxel_map.fresh(depth).all()
    voxel_map.insert(depth)
    assert not voxel_map.fresh(depth).any()


@pytest.mark.parametrize("shift_m", [10.0, 40.0])
def test_only_the_strip_not_seen_before_is_fresh(shift_m: float) -> None:
    voxel_map = VoxelMap(1.0)
    voxel_map.insert(view(0.0))
    second = view(shift_m)
    fresh = voxel_map.fresh(second)
    seen_before = world_points(second)[..., 0] <= world_points(view(0.0))[..., 0].max()
    edge = 3  # pixels: one voxel
    columns = seen_before.all(axis=0)
    first_new = int(np.argmin(columns))
    assert not fresh[:, : first_new - edge].any()
    assert fresh[:, first_new + edge :].all()


def test_clearly_better_surface_is_fresh_and_slightly_better_is_not() -> None:
    voxel_map = VoxelMap(1.0)
    voxel_map.insert(view(0.0, sigma_m=0.3))
    assert not voxel_map.fresh(view(0.0, sigma_m=0.25)).any()
    assert voxel_map.fresh(view(0.0, sigma_m=0.19)).all()
    voxel_map.insert(view(0.0, sigma_m=0.19))
    assert not voxel_map.fresh(view(0.0, sigma_m=0.3)).any()


def test_noise_within_sigma_is_not_new_surface_but_a_roof_is() -> None:
    voxel_map = VoxelMap(0.5)
    voxel_map.insert(view(0.0, sigma_m=0.4))
    rng = np.random.default_rng(0)
    noisy = view(0.0, sigma_m=0.4)
    noisy.depth_m[:] += rng.normal(0, 0.4, noisy.depth_m.shape).astype(np.float32)
    assert voxel_map.fresh(noisy).mean() < 0.02
    with_roof = view(0.0, sigma_m=0.4, roof_m=6.0)
    roof = with_roof.depth_m < 45
    assert voxel_map.fresh(with_roof)[roof].all()


def test_unknown_pixels_are_neither_fresh_nor_inserted() -> None:
    depth = view(0.0)
    depth.depth_m[:45] = np.nan
    depth.sigma_m[45:50] = np.nan
    voxel_map = VoxelMap(1.0)
    fresh = voxel_map.fresh(depth)
    assert not fresh[:50].any()
    assert fresh[50:].all()
    voxel_map.insert(depth)
    assert voxel_map.fresh(view(0.0))[:40].all()


def test_insert_takes_only_the_masked_pixels() -> None:
    depth = view(0.0)
    mask: Bool = np.zeros(depth.depth_m.shape, np.bool_)
    mask[:, :40] = True
    voxel_map = VoxelMap(1.0)
    voxel_map.insert(depth, mask)
    fresh = voxel_map.fresh(depth)
    assert not fresh[:, :40].any()
    assert fresh[:, 44:].all()


def test_memory_is_bounded_and_the_oldest_goes_first() -> None:
    voxel_map = VoxelMap(0.5, 40_000)
    for k in range(12):
        voxel_map.insert(view(80.0 * k))
    assert len(voxel_map) < 40_000 + 90 * 160
    assert not voxel_map.fresh(view(80.0 * 11)).any()
    assert voxel_map.fresh(view(0.0)).all()


def test_far_and_broken_poses_do_no_harm() -> None:
    depth = view(0.0)
    broken = DepthMap(depth.depth_m, depth.sigma_m, depth.views, K, depth.T_world_camera * np.nan)
    voxel_map = VoxelMap(0.5)
    assert voxel_map.insert(view(1e7)) == 0
    assert voxel_map.insert(broken) == 0
    assert not voxel_map.fresh(broken).any()


def test_ground_sample_is_depth_over_focal_length() -> None:
    assert ground_sample_m(view(0.0, height_m=50.0)) == pytest.approx(0.5)
    empty = view(0.0)
    empty.depth_m[:] = np.nan
    assert ground_sample_m(empty) is None


def test_fuse_is_the_inverse_variance_mean_of_a_dictionary() -> None:
    rng = np.random.default_rng(5)
    voxel_m = 0.5
    clouds = []
    for _ in range(4):
        n = 3000
        clouds.append(
            PointCloud(
                rng.uniform([-8, -8, 0], [8, 8, 2], (n, 3)).astype(np.float32),
                rng.integers(0, 256, (n, 3), dtype=np.uint8),
                rng.uniform(0.05, 0.5, n).astype(np.float32),
                rng.integers(2, 5, n).astype(np.uint8),
            )
        )
    rows: dict[tuple[int, ...], list[tuple[int, int]]] = defaultdict(list)
    for c, one in enumerate(clouds):
        for p, index in enumerate(np.floor(one.xyz_m.astype(float) / voxel_m).astype(int)):
            rows[tuple(index)].append((c, p))
    fused = fuse(clouds, voxel_m)
    assert len(fused) == len(rows)
    for i, index in enumerate(np.floor(fused.xyz_m.astype(float) / voxel_m).astype(int)):
        members = rows[tuple(index)]
        w = np.array([1.0 / float(clouds[c].sigma_m[p]) ** 2 for c, p in members])
        xyz = np.array([clouds[c].xyz_m[p] for c, p in members])
        rgb = np.array([clouds[c].rgb[p] for c, p in members])
        np.testing.assert_allclose(fused.xyz_m[i], w @ xyz / w.sum(), atol=1e-5)
        assert np.abs(fused.rgb[i] - w @ rgb / w.sum()).max() <= 0.51
        best: dict[int, float] = {}
        seen: dict[int, int] = {}
        for (c, p), weight in zip(members, w, strict=True):
            best[c] = max(best.get(c, 0.0), float(weight))
            seen[c] = max(seen.get(c, 0), int(clouds[c].views[p]))
        expected = np.sqrt(
            CORRELATION / max(best.values()) + (1.0 - CORRELATION) / sum(best.values())
        )
        assert fused.sigma_m[i] == pytest.approx(expected, rel=1e-5)
        assert fused.views[i] == sum(seen.values())


def test_sigma_of_the_mean_covers_the_errors() -> None:
    """Flat ground seen by several clouds whose errors are drawn from their sigma."""
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 40, (20_000, 2))
    clouds = []
    for _ in range(3):
        sigma = rng.uniform(0.02, 0.06, len(xy))
        z = 0.5 + rng.normal(0, sigma)
        clouds.append(
            PointCloud(
                np.column_stack([xy, z]).astype(np.float32),
                np.zeros((len(xy), 3), np.uint8),
                sigma.astype(np.float32),
                np.ones(len(xy), np.uint8),
            )
        )
    fused = fuse(clouds, 1.0)
    inside = np.abs(fused.xyz_m[:, 2] - 0.5) < fused.sigma_m
    assert inside.mean() > 0.66  # never over-confident; neighbours make it better than said


def test_a_lone_contradicted_point_is_left_out_and_a_lone_mast_is_kept() -> None:
    ground = [[x + 0.05, y + 0.05, 0.05] for x in range(10) for y in range(10)]
    seen_twice = cloud(ground, [0.1] * 100, [2] * 100)
    flyer = cloud([[5.05, 5.05, 7.0]], [0.5], [1])
    mast = cloud([[3.05, 3.05, z + 0.05] for z in range(1, 6)], [0.05] * 5, [3] * 5)
    away = cloud([[30.0, 30.0, 7.0]], [0.5], [1])
    fused = fuse([seen_twice, flyer, mast, away], 1.0)
    heights = fused.xyz_m[:, 2]
    assert not np.isclose(heights, 7.0).sum() > 1
    assert np.isclose(fused.xyz_m[:, 0], 30.0).sum() == 1
    assert (np.isclose(fused.xyz_m[:, 0], 3.05) & (heights > 0.9)).sum() == 5
    assert len(fused) == 100 + 5 + 1


def test_a_small_piece_in_the_air_that_one_pair_shows_is_left_out() -> None:
    def level(x0: float, z: float, side: int, views: int) -> PointCloud:
        xyz = [[x0 + i, 10.5 + j, z + 0.5] for i in range(side) for j in range(side)]
        return cloud(xyz, [0.1] * len(xyz), [views] * len(xyz))

    ground = level(0.0, 0.0, 100, 2)
    pieces = {
        "tower": (level(10.0, 30.0, 8, 1), False),
        "seen twice": (level(40.0, 30.0, 8, 2), True),
        "roof": (level(60.0, 30.0, 15, 1), True),
        "car": (level(80.0, 7.0, 8, 1), True),
        "elsewhere": (level(300.0, 30.0, 8, 1), True),
    }
    fused = fuse([ground, *(piece for piece, _ in pieces.values())], 1.0)
    for name, (piece, stays) in pieces.items():
        same = (fused.xyz_m[:, None] == piece.xyz_m[None]).all(axis=2).any(axis=0)
        assert same.all() if stays else not same.any(), name
    assert len(fused) == len(ground) + sum(len(p) for p, stays in pieces.values() if stays)


def test_no_clouds_and_empty_clouds_fuse_to_nothing() -> None:
    assert len(fuse([], 0.5)) == 0
    empty = PointCloud(
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.uint8),
        np.zeros(0, np.float32),
        np.zeros(0, np.uint8),
    )
    assert len(fuse([empty, empty], 0.5)) == 0


def test_unusable_points_are_left_out() -> None:
    good = cloud([[0.1, 0.1, 0.1]], [0.1])
    bad = cloud([[np.nan, 0, 0], [1e9, 0, 0], [1, 1, 1], [2, 2, 2]], [0.1, 0.1, np.nan, 0.0])
    assert len(fuse([good, bad], 0.5)) == 1


def test_a_cloud_is_what_the_pinhole_formula_says_of_the_pixels_asked_for() -> None:
    rng = np.random.default_rng(11)
    flat = view(4.0, roof_m=6.0)
    turned = se3.compose(se3.so3_exp(rng.normal(0, 1, 3)), np.array([30.0, -2000.0, 70.0]))
    depth = DepthMap(flat.depth_m.copy(), flat.sigma_m.copy(), flat.views, K, turned)
    depth.depth_m[:9], depth.depth_m[9:12], depth.sigma_m[12:15] = np.nan, -1.0, np.inf
    bgr = rng.integers(0, 256, (90, 160, 3), np.uint8)
    mask = rng.random((90, 160)) > 0.4
    found = cloud_of(depth, bgr, mask)
    known = mask.copy()
    known[:15] = False
    np.testing.assert_allclose(found.xyz_m, world_points(depth)[known], rtol=1e-6, atol=1e-5)
    np.testing.assert_array_equal(found.rgb, bgr[known][:, ::-1])
    np.testing.assert_array_equal(found.sigma_m, depth.sigma_m[known])


def test_fusing_in_strips_gives_the_same_points() -> None:
    rng = np.random.default_rng(8)
    n = 4000
    clouds = [
        PointCloud(
            rng.uniform([-20, -5, 0], [20, 5, 9], (n, 3)).astype(np.float32),
            rng.integers(0, 256, (n, 3), dtype=np.uint8),
            rng.uniform(0.05, 0.5, n).astype(np.float32),
            rng.integers(1, 3, n).astype(np.uint8),
            time_ns=np.full(n, 100 + number),
        )
        for number in range(5)
    ]
    whole = fuse(clouds, 0.7)
    edges = [-np.inf, -11.3, 0.0, 0.1, 6.66, np.inf]
    parts = without_contradicted(*fuse_strips([lambda: clouds] * 5, edges, 0.7))
    assert len(whole) < 5 * n
    for name in ("xyz_m", "rgb", "sigma_m", "views", "time_ns"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


def test_a_point_has_the_time_of_the_image_that_knows_it_best() -> None:
    places = [[0.1, 0.1, 0.1], [5.1, 0.1, 0.1], [9.1, 0.1, 0.1]]
    clouds = [
        replace(cloud(places[:2], [0.3, 0.1]), time_ns=np.full(2, 10)),
        replace(cloud(places, [0.2, 0.2, 0.2]), time_ns=np.full(3, 20)),
        replace(cloud(places[:1], [0.4]), time_ns=np.full(1, 30)),
    ]
    fused = fuse(clouds, 0.5)
    assert fused.time_ns is not None and fused.time_ns.tolist() == [20, 10, 20]
    assert fuse([*clouds, cloud(places, [0.1] * 3)], 0.5).time_ns is None


def test_a_cloud_leaves_out_depth_that_other_views_contradict() -> None:
    depth = view(0.0, height_m=50.0, sigma_m=1.0)
    depth.sigma_m[:30] = 20.0
    depth.sigma_m[30:40] = np.nan
    found = cloud_of(depth, np.zeros((90, 160, 3), np.uint8))
    assert len(found) == 50 * 160 and found.sigma_m.max() == 1.0
    depth.sigma_m[:70] = 20.0  # most of it: the rest agrees by chance
    assert len(cloud_of(depth, np.zeros((90, 160, 3), np.uint8))) == 0
