"""One recorded flight through the whole path on a GPU and compiled: clouds that score alike."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command_line import skyrelief

SMALL = ("compute.stereo_width=160", "compute.guide_width=320", "compute.pairs=1")


def replayed(*arguments: str | Path) -> dict[str, Any]:
    """The JSON that a replay in a process of its own ends with."""
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", "replay", *map(str, arguments), "--json"],
        capture_output=True, text=True, timeout=500, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return report


def scored(flight: Path, backend: str) -> dict[str, float]:
    """Points, surface error and completeness of the flight replayed with a backend."""
    out = flight.parent / backend
    summary = replayed(
        flight / "flight.mp4", "--telemetry", flight / "flight.tlog",
        "--camera-model", flight / "camera.yaml", "--out", out, "--backend", backend,
        *(word for setting in SMALL for word in ("--set", setting)),
    )  # fmt: skip
    assert summary["backend"] == backend
    done = skyrelief("score", out, flight, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[-1])
    surface = report["surface"]["rigid"]
    return {
        "clouds": summary["clouds"],
        "points": report["points"],
        "median_m": surface["median_m"],
        "p90_m": surface["p90_m"],
        "complete": report["completeness"]["share"],
    }


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated nadir flight of 5 s."""
    folder = tmp_path_factory.mktemp("sim") / "flight"
    made = skyrelief(
        "simulate", "--out", folder, "--size", "320x180", "--fps", "4", "--duration-s", "5",
        "--height-m", "40", "--speed-m-s", "6", "--seed", "3",
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    return folder


@pytest.fixture(scope="module")
def compiled(flight: Path) -> dict[str, float]:
    """Scores of the compiled backend."""
    return scored(flight, "cpu")


@pytest.mark.slow
def test_the_device_scores_within_a_tenth(
    flight: Path, compiled: dict[str, float], request: pytest.FixtureRequest
) -> None:
    """Number of clouds and points, surface error and completeness."""
    if request.config.getoption("--device") != "cuda":
        pytest.skip("needs --device cuda")
    found = scored(flight, "torch")
    assert compiled["clouds"] >= 8
    assert compiled["complete"] > 0.3
    for name, value in compiled.items():
        assert found[name] == pytest.approx(value, rel=0.1), name
