"""Segments of a flight that nothing ties together, and the report of a short scan."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import cv2
import laspy
import numpy as np
from painted_ground import CAMERA, FOOTPRINT_M, HEIGHT_M, pose, still
from typer.testing import CliRunner

from recon.posegraph.alignment import Similarity
from recon.posegraph.loop_book import Edge
from recon.posegraph.pose_graph import PoseGraph
from recon.types import F64, PosePrior
from service.cameras.camera_file import save_camera
from service.cli import app
from service.flight.chain import Pieces

NOWHERE = PosePrior()
PLACED = PosePrior(np.eye(3), 0.02, 0.1, np.zeros(3), np.ones(3))


@dataclass
class Ties:
    """A graph as far as pieces ask it."""

    loops: list[Edge] = field(default_factory=list)
    fixed: tuple[int, ...] = ()
    tied: tuple[int, ...] = ()

    def similarity(self, segment: int) -> Similarity | None:
        sources = ("gnss",) if segment in self.fixed else ("altitude",)
        return Similarity(1.0, np.eye(3), np.zeros(3), np.eye(7), sources)

    def is_tied(self, segment: int) -> bool:
        return segment in self.tied


def apart(
    ties: Ties, points: tuple[int, ...] = (100, 300, 200, 50), prior: PosePrior = NOWHERE
) -> list[tuple[int, int]]:
    """Four segments of three keyframes: 0 to 2, 10 to 12, 20 to 22, 30 to 32."""
    pieces = Pieces()
    for segment, count in enumerate(points):
        for i in range(3):
            pieces.add(10 * segment + i, segment, count, prior)
    return pieces.apart(cast(PoseGraph, ties))


def test_without_ties_the_largest_stays() -> None:
    assert apart(Ties()) == [(0, 2), (20, 22), (30, 32)]


def test_loops_make_pieces_and_a_waiting_loop_does_not() -> None:
    loops = [Edge(2, 30, True), Edge(11, 21, False)]
    assert apart(Ties(loops)) == [(0, 2), (20, 22), (30, 32)]
    assert apart(Ties([Edge(2, 21, True), Edge(22, 30, True)])) == [(10, 12)]


def test_what_fixes_place_stays_whatever_its_size() -> None:
    assert apart(Ties(fixed=(3,))) == [(0, 2), (10, 12), (20, 22)]
    assert apart(Ties([Edge(12, 22, True)], fixed=(0, 2))) == [(30, 32)]
    assert apart(Ties(), prior=PLACED) == []


def test_a_forgotten_loop_still_ties() -> None:
    assert apart(Ties(tied=(2,))) == [(0, 2), (30, 32)]


def replayed(tmp_path: Path, track: list[F64]) -> tuple[dict[str, Any], F64]:
    """The scan.json and the cloud's points of a folder of stills, two seconds apart."""
    folder, out = tmp_path / "stills", tmp_path / "scan"
    folder.mkdir()
    for i, T in enumerate(track):
        gray = still(T)
        cv2.imwrite(str(folder / f"{i:02d}.png"), np.dstack([gray, gray, gray]))
    save_camera(tmp_path / "camera.yaml", CAMERA)
    done = CliRunner().invoke(
        app,
        ["replay", f"images:{folder}?interval_s=2", "--camera-model", str(tmp_path / "camera.yaml"),
         "--out", str(out), "--backend", "cpu", "--json",
         "--set", f"scan.assumed_agl_m={HEIGHT_M}"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    xyz = np.asarray(laspy.read(out / "cloud.laz").xyz, np.float64)
    return json.loads((out / "scan.json").read_text()), xyz


def test_two_places_are_not_laid_into_one_cloud(tmp_path: Path) -> None:
    """Five stills here, five far away, no telemetry: the cloud is as wide as one place."""
    step = 0.25 * FOOTPRINT_M
    here = [pose(step * i - 90.0, seed=i) for i in range(5)]
    there = [pose(step * i + 30.0, seed=9 + i) for i in range(5)]
    scan, xyz = replayed(tmp_path, here + there)
    assert scan["run"]["segments"] == 2 and scan["run"]["keyframes"] > scan["counts"]["keyframes"]
    wide = np.ptp(xyz[:, :2], axis=0)
    assert FOOTPRINT_M < wide.max() < FOOTPRINT_M + 5 * step
    assert any("left out of the cloud" in warning for warning in scan["run"]["warnings"])


def test_a_scan_finished_at_its_end_is_not_called_empty(tmp_path: Path) -> None:
    """Of three stills all surface comes when the scan is closed."""
    scan, xyz = replayed(tmp_path, [pose(0.25 * FOOTPRINT_M * i, seed=i) for i in range(3)])
    assert scan["counts"]["keyframes"] > 0 and len(xyz) > 1000
    assert not [w for w in scan["run"]["warnings"] if "nothing was reconstructed" in w]
