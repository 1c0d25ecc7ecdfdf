"""The report's map and its part on consistency: ellipses, loops, residuals, surveyed points."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Loop, Node
from recon.posegraph.segments import Segments
from recon.posegraph.sensor_offsets import Constants
from recon.types import PosePrior
from service.flight.reports import graph_figures
from service.scans.coverage import coverage_of
from service.scans.folder import key_figures, write_deliverables
from service.scans.report import accuracy_words, overlaps, surveyed
from service.scans.report_appendix import consistency, sensor_constants
from service.scans.report_map import map_figure
from service.scans.report_parts import area, length
from service.stream.records import PoseRecord, unpack_covariance, unpack_motion

if TYPE_CHECKING:
    from house_flight import HouseFlight

POINT = {"name": "<A>", "role": "control", "marks": 3, "refused": None,
         "place_m": [10.0, 2.0, 6.0], "before_m": [1.0, 2.0, 3.0],
         "after_m": [0.01, -0.02, 0.03]}  # fmt: skip
REFINED: dict[str, Any] = {
    "moved_m": {"median": 1.5, "most": 2.0},
    "scale": 0.998,
    "residuals": {"vision": {"count": 4, "rms": 0.9}},
    "loops": {"verified": 2, "used": 1, "refused": 1, "pairs": [[0, 3, True], [1, 4, False]]},
    "points": [POINT, POINT | {"name": "B", "role": "check", "refused": "2 m off"}],
    "control": {"count": 1, "rms_h_before_m": 2.2, "rms_v_before_m": 3.0, "rms_h_after_m": 0.02,
                "rms_v_after_m": 0.03},
    "check": None,
}  # fmt: skip
SUMMARY: dict[str, Any] = {
    "refinement": REFINED,
    "run": {
        "graph": {
            "residuals": {"position": {"count": 5, "rms": 1.1}},
            "loops": {"used": 2, "waiting": 1, "pairs": []},
        },
        "scale": {"from": "gnss", "sigma": 0.004},
    },
    "quality": {"distance_m": 100.0},
}


def test_the_map_has_ellipses_loops_and_points(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        poses, coverage = store.poses(), coverage_of(store)
    figure = map_figure(SUMMARY, poses, coverage)
    assert figure.count("<ellipse") == 5
    assert figure.count("<line ") == 2 and figure.count("stroke-dasharray") == 1
    assert figure.count("<polygon") == 1 and figure.count("<circle") == 1
    assert "&lt;A&gt;" in figure and "<A>" not in figure
    assert "enlarged" not in figure
    sure = [replace(p, covariance=np.eye(6) * 1e-10) for p in poses]
    assert "times enlarged" in map_figure(SUMMARY, sure, coverage)
    assert map_figure({}, [], None) == ""
    assert "<image" not in map_figure({}, poses, None)


def test_ellipses_are_those_of_sampled_poses() -> None:
    rng = np.random.default_rng(0)
    T = se3.compose(se3.so3_exp(np.array([0.1, 0.2, 0.3])), np.array([40.0, -10.0, 60.0]))
    A = rng.normal(0, 0.01, (6, 6))
    spread = A @ A.T
    samples = rng.multivariate_normal(np.zeros(6), spread, 20000)
    places = np.array([(se3.exp(x) @ T)[:3, 3] for x in samples[:6000]])
    found = PoseRecord(0, T, spread).position_covariance
    assert np.allclose(found, np.cov(places.T), rtol=0.15, atol=0.05 * np.trace(found))
    across = np.linalg.norm((places - places.mean(axis=0))[:, :2], axis=1)
    of_samples = np.sqrt(np.mean(across**2)), np.std(places[:, 2])
    assert PoseRecord(0, T, spread).sigma_h_v_m == pytest.approx(of_samples, rel=0.1)
    assert PoseRecord(0, np.eye(4), -np.eye(6)).sigma_h_v_m == (0.0, 0.0)  # of a hostile peer


def test_residuals_loops_drift_and_points_are_reported() -> None:
    pose = PoseRecord(0, np.eye(4), np.eye(6) * 0.01)
    page = "".join([*consistency(SUMMARY, [pose, pose]), *surveyed(REFINED)])
    cells = re.findall(r"<td>(.*?)</td>", page)
    assert "1.10 (5)" in cells and "0.90 (4)" in cells
    assert "2 used, 1 waiting" in cells and "1 used, 1 refused" in cells and "0-3" in cells
    assert "1.50 m (max 2.00 m, 2.00 % of the distance)" in cells and "-0.20 %" in cells
    assert "0.17 m, 0.17 m, 0.17 m" in cells and "1 sigma 0.40 %" in cells
    assert "+1.000  +2.000  +3.000" in cells and "2 m off" in cells
    assert "0.020 m, 0.030 m" in cells
    assert consistency({}, []) == []


def quality(level: str, **more: Any) -> dict[str, Any]:
    """A scan's figures of that trust."""
    return {
        "quality": {
            "trust": {"level": level, "reasons": []}, "sigma_median_m": 0.032,
            "sigma_90_percent_m": 0.11, "scale_sigma": 0.004,
            "position_sigma_h_median_m": 1.53, "position_sigma_v_median_m": 2.1,
        }
    } | more  # fmt: skip


def test_accuracy_is_said_by_what_it_rests_on() -> None:
    found = {"count": 3, "rms_h_after_m": 0.021, "rms_v_after_m": 0.034}
    refined = {"check": found, "control": found | {"count": 5}}
    text = " ".join(accuracy_words(quality("georeferenced", refinement=refined)))
    assert "3 check points" in text and "2.1 cm horizontally and 3.4 cm vertically" in text
    text = " ".join(accuracy_words(quality("georeferenced", refinement={"control": found})))
    assert "3 control points" in text and "no independent measure" in text
    flat = found | {"count": 1, "rms_v_after_m": None}
    text = " ".join(accuracy_words(quality("georeferenced", refinement={"check": flat})))
    assert "1 check point, " in text and "vertically" not in text
    text = " ".join(accuracy_words(quality("georeferenced")))
    assert "± 1.53 m horizontally and ± 2.10 m vertically" in text and "± 3.2 cm" in text
    assert "± 0.4 %" in text
    assert "not positions" in " ".join(accuracy_words(quality("scaled")))
    doubtful = accuracy_words(quality("doubtful"))
    assert "measure nothing" in doubtful[0] and not any("scale" in one for one in doubtful)


def test_figures_are_written_as_people_do() -> None:
    assert area(10545.6) == "10,546 m²"
    assert [length(v) for v in (0.0321, 0.218, 1.526, 7562.3)] == [
        "3.2 cm", "22 cm", "1.53 m", "7,562 m",
    ]  # fmt: skip


def test_overlap_is_that_of_footprints(house: HouseFlight) -> None:
    """160 pixels of 140 px focal length cover 45.7 m from 40 m; steps are 5 m."""
    poses = [replace(house.record(k, 5.0 * k), agl_m=40.0) for k in range(4)]
    width_m = 160 / 140 * 40
    assert overlaps(house.K, (160, 90), poses) == pytest.approx([1 - 5 / width_m] * 3, abs=1e-3)
    assert overlaps(house.K, (160, 90), [replace(p, agl_m=None) for p in poses]) == []
    level = [replace(p, T_world_camera=np.eye(4)) for p in poses]  # looks up
    assert overlaps(house.K, (160, 90), level) == []


def test_a_scan_with_a_refinement_shows_it(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        store.finish(SUMMARY["run"])
        summary, poses = write_deliverables(tmp_path, store), store.poses()
    assert key_figures(summary)[2] == "georeferenced"  # the preview states it without reasons too
    page = (tmp_path / "report.html").read_text()
    assert "Consistency" in page and "GNSS position" in page
    for title in ("Accuracy", "Orthophoto", "Surface model", "Appendix: diagnostics"):
        assert f"<h2>{title}" in page
    assert "m2" not in re.sub(r"base64,[^\"]*", "", page)
    assert "Surveyed points" not in page and "<script" not in page
    # without a measured height above ground that above the surface counts
    assert all(p.agl_m is None for p in poses)
    rows = dict(re.findall(r"<tr><td>([^<]+)</td><td>([^<]+)", page))
    assert float(rows["height above ground, median"].removesuffix(" m")) == pytest.approx(40, abs=1)
    assert rows["coordinates"].startswith("WGS 84 / UTM zone 32N (EPSG:32632), metres above")


def test_figures_of_a_graph_are_its_own() -> None:
    graph = PoseGraph()
    rng = np.random.default_rng(1)
    truth = [se3.compose(np.eye(3), np.array([5.0 * k, 0.0, 50.0])) for k in range(30)]
    assert graph_figures(graph) is None
    for k, T in enumerate(truth):
        fix = T[:3, 3] + rng.normal(0, 0.3, 3)
        prior = PosePrior(T[:3, :3], 0.02, 0.05, fix, np.full(3, 0.5))
        graph.add_keyframe(Node(k, k * 10**9, 0, T, np.eye(6) * 1e-6, prior))
    figures = graph_figures(graph)
    assert figures is not None
    rows = graph.residuals()
    assert figures["residuals"]["vision"]["count"] == len(rows["vision"]) == 29
    assert figures["residuals"]["position"]["rms"] == pytest.approx(
        np.sqrt(np.mean(rows["position"] ** 2)), abs=1e-3
    )
    assert figures["loops"]["used"] == 0 and figures["loops"]["motions"] == []


def test_accepted_loops_come_back_with_motion_and_covariance() -> None:
    T_a_b = se3.exp(np.array([0.1, 0.0, 0.3, 4.0, 5.0, 6.0]))
    loop = Loop(3, 40, T_a_b, np.diag([1e-6] * 3 + [1e-3] * 3))

    class Fixed:
        """A graph of known records."""

        entered = 2
        loops, pending = [loop.scaled(0.5)], PoseGraph().pending
        counts: dict[str, int] = {"loop waits": 1}  # noqa: RUF012

        def __len__(self) -> int:
            return 2

        def residuals(self) -> dict[str, Any]:
            return {}

        def scale(self, seq: int) -> float:
            return 2.0

        def constants(self) -> Constants:
            turn, sigma = np.radians([1.6, -1.2, 0.0]), np.radians([0.2, 0.2, 2.0])
            return Constants(turn, sigma, -0.71234, 0.2)

        segments = Segments()

    stand_in: Any = Fixed()
    figures = graph_figures(stand_in)
    assert figures is not None
    ((a, b, motion, upper),) = figures["loops"]["motions"]
    assert (a, b) == (3, 40) and figures["left_out"] == {"loop waits": 1}
    assert figures["boresight"] == {
        "deg": [1.6, -1.2, 0.0], "sigma_deg": [0.2, 0.2, 2.0], "sure": True
    }  # fmt: skip
    assert figures["altitude_datum"] == {"shift_m": -0.712, "sigma_m": 0.2}
    rows = dict(sensor_constants(figures))
    assert "+1.60 ± 0.20, -1.20 ± 0.20" in rows["boresight about right, down, ahead"]
    assert rows["altitude raised to the receiver's"] == "-0.71 m"
    found = unpack_motion(motion)
    assert found is not None and np.allclose(found, T_a_b, atol=1e-7)
    assert np.allclose(unpack_covariance(upper), loop.covariance, rtol=1e-5)
