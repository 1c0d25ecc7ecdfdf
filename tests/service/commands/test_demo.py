"""Both ends on one machine: the ground ends up with the very scan that was made onboard."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from command_line import skyrelief
from paths import DEMO

CPU = ("--set", "compute.backend=cpu")
SPARSE = ("--set", "compute.stereo_width=160")
NAMES = [f"IMG_{n}.jpg" for n in range(9365, 9370)]


def points(path: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(N, 3) coordinates of a LAZ file, in a fixed order."""
    xyz = np.asarray(laspy.read(path).xyz, dtype=np.float64)
    return np.asarray(xyz[np.lexsort(xyz.T)])


@pytest.mark.slow
def test_ground_holds_what_was_made_onboard(tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    (flight / "frames").mkdir(parents=True)
    shutil.copy(DEMO / "camera.yaml", flight)
    for name in NAMES:
        shutil.copy(DEMO / "frames" / name, flight / "frames")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "service.cli", "demo", "--flight", str(flight)]
    done = subprocess.run(
        [*command, "--out", str(out), "--json", *CPU, *SPARSE],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + (out / "ground.log").read_text()
    report = json.loads(done.stdout.splitlines()[-1])
    assert "[1/3] open this page to watch the map grow: http://127.0.0.1:" in done.stderr
    assert "[2/3] flight: tracking and reconstructing 5 images" in done.stderr
    assert "INFO" not in done.stderr
    assert "datalink does not open" not in done.stderr  # the ground outlives the flight
    parts = [line for line in done.stderr.splitlines() if line.startswith("replay: ")]
    assert parts[0].endswith("tracking and reconstructing")
    assert any(part.startswith("replay: sending the rest") for part in parts)
    assert parts[-1].startswith("replay: writing the files")
    assert report["points"] > 10_000
    assert report["points"] == report["ground_points"]
    onboard, ground = Path(report["scan_folder"]), Path(report["ground_folder"])
    for name in ("preview.jpg", "scan.json", "trajectory.tum", "trajectory.csv"):
        assert (onboard / name).stat().st_size > 0
        assert (ground / name).stat().st_size > 0
    np.testing.assert_array_equal(points(onboard / "cloud.laz"), points(ground / "cloud.laz"))
    assert (onboard / "trajectory.tum").read_bytes() == (ground / "trajectory.tum").read_bytes()


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("mine")
    done = skyrelief("demo", "--out", str(tmp_path))
    assert done.returncode == 2
    assert "not empty" in done.stderr
    assert (tmp_path / "holiday.jpg").read_text() == "mine"
    missing = skyrelief("demo", "--flight", str(tmp_path), "--out", str(tmp_path / "out"))
    assert missing.returncode == 2
    assert "camera.yaml" in missing.stderr
