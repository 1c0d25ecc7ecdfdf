"""The frame of the benchmarks: figures, ratios, the table and the kept file."""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from bench_middlebury import not_hidden, seen_by_both
from bench_run import DEVELOPMENT
from bench_scenes import bad_share, semi_global_disparity
from command_line import skyrelief
from stereo_scenes import TruePair as Pair

from service import bench
from service.bench import BENCHMARKS, BenchOptions, BenchResult, board, compare, record, table
from service.bench.stereo import scene
from service.daemon.machine import Machine
from service.errors import InputError, OutsideError


def test_every_line_of_the_table_can_be_called() -> None:
    assert not set(BENCHMARKS) & set(DEVELOPMENT)
    for name, target in (BENCHMARKS | DEVELOPMENT).items():
        if name == "device" and find_spec("triton") is None:
            continue  # a gigabyte that is not everywhere
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


def test_the_last_kept_figures_stand_in_the_table(tmp_path: Path) -> None:
    results = [BenchResult("b", 2.0, "ms", name="icp"), BenchResult("new", 7.0, "Hz", name="icp")]
    assert bench.last_kept(tmp_path, ["icp"]) == {}
    bench.keep(tmp_path, ["icp"], record([replace(results[0], value=8.0)], BenchOptions()))
    before = bench.last_kept(tmp_path, ["icp"])
    assert before == {("icp", "b"): 8.0}
    head, old, new = table(results, before).splitlines()
    assert head.split()[-2:] == ["before", "note"] and old.endswith("8") and "8" not in new
    (tmp_path / "z-icp.json").write_text("[]")
    with pytest.raises(InputError, match=r"z-icp\.json: no results"):
        bench.last_kept(tmp_path, ["icp"])


def test_a_boards_sheet() -> None:
    said: list[str] = []
    options = BenchOptions(rounds=1, warm_up=0, say=said.append)
    results = board.run(options, widths=(320,))
    assert said == ["board: decoding", "board: a flight, stereo 320 wide"]
    by_name = {result.what: result for result in results}
    path = by_name["whole path, stereo 320 wide"]
    assert path.value > 0 and path.peer_value is not None and not path.note.startswith("0 ")
    assert 50 < by_name["its memory, 320 wide"].value < 4000
    assert by_name["decode 1280x720"].value > 1
    assert any("SGBM" in result.peer for result in results if result.unit == "ms")


def test_a_flight_that_is_killed_ends_the_sheet() -> None:
    with pytest.raises(OutsideError, match="too little memory"):
        bench.in_process(os._exit, 9)


def test_a_sheet_has_what_the_board_states() -> None:
    cold, hot = Machine("a board", temperature_c=40.0, power_w=5.0), Machine("a board", 80.0, True)
    found = {r.what: (r.value, r.unit, r.note) for r in board.sheet([cold, hot, cold])}
    assert found == {
        "hottest sensor": (80.0, "°C", "a board"),
        "power, mean": (5.0, "W", "a board"),
        "throttled": (100.0, "% of the time", "a board"),
    }
    assert board.sheet([]) == []


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
    assert ended.returncode == 2 and "there are board" in ended.stderr


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
