"""The benchmark over real flights, on a few of the demo's own stills."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_options import DataOptions
from bench_real import flatness, run, shared_ground, whole_depth
from paths import DEMO

from recon.types import DepthMap
from service.bench.keyframes import make_keyframe
from service.errors import InputError
from service.scans.drawing import save_debug
from service.stream.records import Repose, ScanHeader
from service.stream.store import ScanStore

STILLS = sorted((DEMO / "frames").glob("*.jpg"))


def test_a_few_real_stills_are_placed_and_measured(tmp_path: Path) -> None:
    frames = tmp_path / "caliterra_nadir" / "frames"
    frames.mkdir(parents=True)
    for still in STILLS[:5]:
        shutil.copy(still, frames)
    results = run(DataOptions(data=tmp_path, previews=tmp_path / "kept"))
    figures = {r.what.removeprefix("Caliterra: "): r.value for r in results}
    assert (tmp_path / "kept" / "caliterra.jpg").stat().st_size > 10_000
    assert figures["frames placed by vision"] >= 80.0
    assert figures["unbroken stretches"] == 1
    assert figures["points"] > 0.05
    assert figures["track to fixes, horizontal rms"] < 20.0
    assert any(name.startswith("trust: ") for name in figures)


@pytest.mark.parametrize("data", [None, "empty"])
def test_without_a_set_it_says_what_it_needs(tmp_path: Path, data: str | None) -> None:
    with pytest.raises(InputError, match=r"--data|none of Caliterra"):
        run(DataOptions(data=None if data is None else tmp_path))


def test_a_set_that_is_refused_has_its_reason(tmp_path: Path) -> None:
    (tmp_path / "aphill_orbit_fmv").mkdir()
    (tmp_path / "aphill_orbit_fmv" / "aphill_klv_10s.ts").touch()
    (refused,) = run(DataOptions(data=tmp_path))
    assert refused.what.startswith("AP Hill, with its metadata: refused: skyrelief: ")
    assert refused.what.endswith("copy it from the camera again")


def test_a_shifted_surface_shows_as_a_seam() -> None:
    depth = make_keyframe(0).depth
    above = make_keyframe(0).depth
    lifted = type(depth)(
        depth.depth_m,
        depth.sigma_m,
        depth.views,
        depth.K,
        depth.T_world_camera + np.array([[0, 0, 0, 0]] * 2 + [[0, 0, 0, 0.5], [0, 0, 0, 0]]),
    )
    found = shared_ground(above, lifted, np.random.default_rng(0))
    assert found is not None
    off, sigma = found
    assert np.median(off) == pytest.approx(0.5, abs=0.05)
    assert np.median(sigma) == pytest.approx(np.sqrt(2) * np.nanmedian(depth.sigma_m), rel=0.1)


def test_whole_depth_images_have_the_scale_that_their_keyframe_has_in_the_end(
    tmp_path: Path,
) -> None:
    keyframe = make_keyframe(0)
    depth = keyframe.depth
    save_debug(tmp_path, 0, {"depth_m": 0.5 * depth.depth_m, "sigma_m": 0.5 * depth.sigma_m})
    known = replace(depth, depth_m=np.full_like(depth.depth_m, np.nan))  # nothing in it is new
    again = replace(keyframe, depth=known)
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        first = whole_depth(store, again)
        store.add_reposes([Repose(0, 1, depth.T_world_camera, 2.0, np.eye(6))])
        whole = whole_depth(store, again)
        assert whole_depth(store, replace(again, seq=1)) is known
    np.testing.assert_allclose(first.depth_m, 0.5 * depth.depth_m, rtol=1e-5)
    np.testing.assert_allclose(whole.depth_m, depth.depth_m, rtol=1e-5)
    np.testing.assert_allclose(whole.sigma_m, depth.sigma_m, rtol=1e-5)


def test_tilts_between_keyframes_are_told_from_the_bend_of_each() -> None:
    K = np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]])
    level = np.full((90, 120), 80.0, np.float32)
    maps = []
    for n in range(6):
        T = np.diag([1.0, -1, -1, 1])
        T[:3, 3] = 0.0, 0.0, 80.0 + 2.0 * (n % 2)  # every second keyframe is 2 m too high
        maps.append(DepthMap(level, 0.1 * level, np.ones_like(level, np.uint8), K, T))
    figures = {what: value for what, value, _ in flatness(maps)}
    assert figures["flat ground, robust sigma about a plane"] == pytest.approx(1 / 0.6745, rel=0.01)
    assert figures["flat ground, keyframes about their own planes"] == pytest.approx(0.0, abs=1e-6)
    assert figures["flat ground, slope"] == pytest.approx(0.0, abs=1e-6)
