"""A map whose old parts are on disk answers like one that has all of it in memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from recon import se3
from recon.backends.cpu import CpuBackend
from recon.mapping.disagreement import MIN_FACTOR
from recon.mapping.voxel_map import VoxelMap, tiles_under
from recon.pipeline.keyframe_map import SurfaceMap
from recon.pipeline.views import KNOWN_ROWS
from recon.posegraph.records import Node
from recon.types import F64, Camera, DepthMap, PosePrior
from service.config import load_config
from service.flight.paged_map import MAX_OVER, PagedMap
from service.flight.pipeline import Pipeline

K: F64 = np.array([[60.0, 0.0, 39.5], [0.0, 60.0, 29.5], [0.0, 0.0, 1.0]])
NADIR: F64 = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
VOXEL_M = 0.5


def view(east_m: float, north_m: float = 0.0, sigma_m: float = 0.2) -> DepthMap:
    """A nadir camera 30 m over hilly ground."""
    h, w = 60, 80
    u = np.meshgrid(np.arange(w), np.arange(h))[0]
    east = east_m + (u - K[0, 2]) / K[0, 0] * 30.0
    depth = (30.0 - 2.0 * np.sin(east / 7.0)).astype(np.float32)
    T = se3.compose(NADIR, np.array([east_m, north_m, 30.0]))
    sigma = np.full((h, w), sigma_m, np.float32)
    return DepthMap(depth, sigma, np.ones((h, w), np.uint8), K, T)


def at_origin(seqs: Sequence[int]) -> F64:
    return np.tile(np.eye(4), (len(seqs), 1, 1))


def survey() -> list[DepthMap]:
    """Out along one line, back along the next, then over the start with better sigma."""
    out = [view(12.0 * i) for i in range(40)]
    back = [view(12.0 * i, 20.0) for i in reversed(range(40))]
    return [*out, *back, view(0.0, sigma_m=0.05), view(24.0, 5.0)]


def test_pages_change_no_answer(tmp_path: Path) -> None:
    whole, paged = VoxelMap(VOXEL_M), PagedMap(VOXEL_M, tmp_path / "pages", max_voxels=20_000)
    max_on_disk = largest = 0
    for depth in survey():
        expected = whole.fresh(depth)
        np.testing.assert_array_equal(paged.fresh(depth), expected)
        assert paged.insert(depth, expected) == whole.insert(depth, expected)
        max_on_disk = max(max_on_disk, paged.tiles_on_disk)
        largest = max(largest, len(paged))
    assert len(whole) > 60_000 and max_on_disk > 5
    assert largest < 20_000 + 2 * depth.depth_m.size
    paged.close()
    assert not (tmp_path / "pages").exists()


def test_a_damaged_page_makes_its_ground_new_and_nothing_else(tmp_path: Path) -> None:
    paged = PagedMap(VOXEL_M, tmp_path, max_voxels=20_000)
    for depth in survey()[:40]:
        paged.insert(depth)
    assert paged.tiles_on_disk > 0
    for page in tmp_path.glob("*.npy"):
        page.write_bytes(b"\x00garbage")
    assert paged.fresh(view(0.0)).mean() > 0.95
    assert paged.fresh(view(12.0 * 39)).mean() < 0.05


def test_a_disk_that_takes_no_pages_keeps_the_map_in_memory(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    paged = PagedMap(VOXEL_M, blocked / "pages", max_voxels=20_000)
    for depth in survey()[:40]:
        paged.insert(depth)
    assert paged.tiles_on_disk == 0 and not paged.fresh(view(0.0)).any()


def test_more_and_more_surface_under_one_view_is_bounded(tmp_path: Path) -> None:
    """A map that drifts lays surface over surface where the drone hovers."""
    paged = PagedMap(VOXEL_M, tmp_path, max_voxels=2_000)
    held = []
    for n in range(40):
        depth = view(0.0)
        depth.depth_m[:] += 2.0 * n
        paged.insert(depth)
        held.append(len(paged))
    assert max(held) < MAX_OVER * 2_000 + depth.depth_m.size
    assert held[-1] > 0 and not paged.fresh(depth).any()


def test_tiles_under_a_view_hold_all_of_its_voxels() -> None:
    depth = view(-40.0, 13.0)
    voxel_map = VoxelMap(VOXEL_M)
    voxel_map.insert(depth)
    tiles, counts = voxel_map.oldest_tiles()
    assert set(tiles.tolist()) <= set(tiles_under(depth, 0.5, 1.0).tolist())
    assert counts.sum() == len(voxel_map)
    blind = DepthMap(
        np.full((4, 4), np.nan, np.float32), depth.sigma_m, depth.views, K, depth.T_world_camera
    )
    assert len(tiles_under(blind, 0.5, 1.0)) == 0


def test_pages_of_a_map_that_begins_at_the_very_end_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a few stills all surface comes when the scan is closed."""
    pages, config = tmp_path / "pages", load_config(None, ["compute.map_voxels=1000"])
    pipeline = Pipeline(Camera(K, np.zeros(5), (80, 60)), config, CpuBackend(), pages)

    def drain() -> tuple[()]:
        for seq, depth in enumerate(survey()[:40]):
            T, track = depth.T_world_camera, pipeline.mapper.keyframe_map.trajectory
            track.add(Node(seq, seq, 0, T, 1e-6 * np.eye(6), PosePrior()))
            pipeline.mapper.surface(seq, 0, depth, KNOWN_ROWS, T)
        assert pages.exists() and pipeline.held["map_tiles_on_disk"] > 0
        return ()

    monkeypatch.setattr(pipeline.mapper, "drain", drain)
    pipeline.mapper.finish()
    assert not pages.exists() and pipeline.held["map_voxels"] == 0


def test_nonsense_limits_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="max_voxels"):
        PagedMap(VOXEL_M, tmp_path, max_voxels=10)


def test_an_unknown_readout_widens_the_sigma_and_gives_way_to_what_is_seen_later() -> None:
    surface = SurfaceMap(at_origin)
    seen = view(0.0, sigma_m=0.05)
    unsure, sure = (np.full((1, 1), share, np.float32) for share in (0.03, 0.0))
    known, _ = surface(0, 0, seen, unsure, seen.T_world_camera)
    np.testing.assert_allclose(known.sigma_m, np.hypot(0.05, 0.03 * seen.depth_m), rtol=1e-5)
    known, better = surface(1, 0, seen, sure, seen.T_world_camera)
    np.testing.assert_allclose(
        known.sigma_m, MIN_FACTOR * 0.05, rtol=1e-5
    )  # the same image agrees wholly
    assert better.all()


def test_a_false_match_in_the_air_leaves_the_keyframe_and_the_map() -> None:
    surface, sure = SurfaceMap(at_origin), np.zeros((1, 1), np.float32)
    for seq in range(2):
        before = view(0.0)
        before.views[:] = 2
        surface(seq, 0, before, sure, before.T_world_camera)
    new = view(0.0)
    new.depth_m[20:24, 30:34] -= 8.0
    known, fresh = surface(2, 0, new, sure, new.T_world_camera)
    in_air = np.isnan(known.depth_m)
    assert in_air[20:24, 30:34].all() and in_air.sum() == 16 and not fresh[in_air].any()
