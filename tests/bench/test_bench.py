"""The frame of the benchmarks: figures, ratios, the table and the kept file."""

from __future__ import annotations

import json
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from bench_middlebury import not_hidden, seen_by_both
from bench_run import DEVELOPMENT
from command_line import skyrelief

from service import bench
from service.bench import BENCHMARKS, BenchOptions, BenchResult, compare, record, table
from service.bench.stereo import bad_share, scene, semi_global_disparity
from service.bench.stereo_scenes import TruePair as Pair


def test_every_line_of_the_table_can_be_called() -> None:
    assert not set(BENCHMARKS) & set(DEVELOPMENT)
    for target in (BENCHMARKS | DEVELOPMENT).values():
        module, _, function = target.partition(":")
        assert callable(getattr(import_module(module), function))


def test_compare_times_both_in_turn() -> None:
    calls: list[str] = []

    def ours() -> None:
        calls.append("ours")
        time.sleep(0.004)

    def theirs() -> None:
        calls.append("theirs")
        time.sleep(0.001)

    result = compare("y", ours, BenchOptions(rounds=3, warm_up=1), "sleep", theirs)
    assert calls == ["ours", "theirs"] * 4
    assert result.value >= 4
    assert result.ratio is not None
    assert result.ratio > 1
    assert compare("y", ours, BenchOptions(rounds=1, warm_up=0)).ratio is None


def test_table_and_record_hold_every_figure() -> None:
    results = [BenchResult("b", 2.0, "ms", 0.1, "peer", 4.0), BenchResult("d", 7.0, "Hz")]
    lines = table(results).splitlines()
    assert len(lines) == 3
    assert "0.50" in lines[1]
    kept = record(results, BenchOptions(rounds=5))
    assert kept["results"][0]["ratio"] == 0.5
    assert kept["results"][1]["ratio"] is None
    assert set(kept) == {"date", "commit", "machine", "rounds", "results"}
    assert "cores" in kept["machine"]


def rounds(options: BenchOptions) -> list[BenchResult]:
    return [BenchResult("figure", float(options.rounds), "ms")]


def test_command_prints_and_keeps(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(BENCHMARKS, "stereo", f"{__name__}:rounds")
    ended = skyrelief("bench", "stereo", "--rounds", "7", "--keep", tmp_path, "--json")
    assert ended.returncode == 0
    printed = json.loads(ended.stdout.splitlines()[-1])
    (kept,) = tmp_path.glob("*-stereo.json")
    assert json.loads(kept.read_text()) == printed
    assert printed["results"][0]["value"] == 7
    assert printed["results"][0]["name"] == "stereo"
    ended = skyrelief("bench", "nothing")
    assert ended.returncode == 2 and "there are stereo" in ended.stderr


def test_commit_is_unknown_without_git(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert bench.commit() == "unknown"


def test_visible_pixels_are_those_that_both_views_see() -> None:
    """A near stripe hides the wall to its left; both ways of telling agree."""
    left = np.full((4, 60), 5.0, np.float32)
    left[:, 30:40] = 15
    right = np.full((4, 60), 5.0, np.float32)
    right[:, 15:25] = 15
    by_truth, by_depth = seen_by_both(left, right), not_hidden(left)
    np.testing.assert_array_equal(by_truth, by_depth)
    assert not by_truth[:, :5].any()  # their partners lie outside
    assert not by_truth[:, 20:30].any()  # behind the stripe
    assert by_truth[:, 30:].all()
    pair = Pair("x", left.astype(np.uint8), right.astype(np.uint8), left, by_truth, 16)
    assert bad_share(left + 0.6, pair, 1.0) == 0
    assert bad_share(left + 0.6, pair, 0.5) == 1
    assert bad_share(np.full_like(left, np.nan), pair, 1.0) == 1


def test_peer_is_at_its_best() -> None:
    """The padded matcher finds the truth of the benchmark's scene, its left border included."""
    left, right = scene(160, 90, 16)
    truth = np.full(left.shape, 6.0, np.float32)
    found = semi_global_disparity(Pair("x", left, right, truth, truth > 0, 16), 0)
    assert np.isfinite(found[:, 16:]).mean() > 0.95
