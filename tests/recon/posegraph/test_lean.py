"""What is level, where no attitude says it: by altitudes, by turns, or not at all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from flown_track import node

from recon import se3
from recon.posegraph.alignment import fit
from recon.posegraph.alignment_readings import Alignment
from recon.posegraph.ground import ASSUMED_TILT_RAD, LEVEL_SIGMA_RAD
from recon.posegraph.records import Node
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, PosePrior

NADIR = np.diag([1.0, -1.0, -1.0])
STEP_M, STEP_S, STRIP_M, APART_M = 8.0, 6.0, 150.0, 22.0


@dataclass(frozen=True)
class Stills:
    """Stills without attitude, 50 m up, with positions that state no accuracy of the altitude."""

    nodes: list[Node]
    level: F64  # (3, 3) world from odometry

    def lean_deg(self, found: Alignment) -> float:
        """Angle between what is taken as level and what is."""
        up = (found.R @ self.level.T)[2]
        return float(np.degrees(np.arccos(min(1.0, up[2]))))


def stills(
    strips: int,
    mount_deg: float,
    turns: bool = False,
    drift_m: float = 0.0,
    seed: int = 1,
    moved_deg: float = 0.0,
) -> Stills:
    """Strips flown to and fro by a camera that looks ``mount_deg`` ahead; ``turns``: nose first.

    In the first strip it looks ``moved_deg`` less far ahead.
    """
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, STRIP_M, STEP_M)
    p = np.array([(b, s * APART_M, 0.0) for s in range(strips)
                  for b in (x if s % 2 == 0 else x[::-1])])  # fmt: skip
    p += rng.normal(0, (1.0, 1.0, 0.3), p.shape)
    back = np.repeat(np.arange(strips) % 2, len(x)) * (np.pi if turns else 0.0)
    t = np.arange(len(p)) * STEP_S
    along = (t - t.mean()) / np.ptp(t) * 2.0
    noise = rng.normal(0, (1.5, 1.5, 0.3), p.shape) + np.outer(along * drift_m, [0, 0, 1])
    level = se3.so3_exp(np.array([0.2, -0.3, 0.4]))
    nodes = []
    for k in range(len(p)):
        ahead_deg = mount_deg - (moved_deg if k < len(x) else 0.0)
        mount = se3.so3_exp(np.array([0.0, np.radians(ahead_deg), 0.0]))
        wobble = se3.so3_exp(np.r_[np.radians(rng.normal(0, 2.0, 2)), 0.0])
        R = se3.so3_exp(np.array([0.0, 0.0, back[k]])) @ NADIR @ mount @ wobble
        prior = PosePrior(
            NADIR, ASSUMED_TILT_RAD, 3.0, p[k] + noise[k], np.array([5.0, 5.0, 50.0]),
            is_sigma_claimed=False, is_view_assumed=True,
        )  # fmt: skip
        odom = se3.compose(level.T @ R, level.T @ p[k])
        nodes.append(node(odom, prior, None, 0.0, float(t[k])))
    return Stills(nodes, level)


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("mount_deg", [0.0, 15.0])
def test_altitudes_that_agree_with_vision_level_strips(mount_deg: float, turns: bool) -> None:
    """By the assumed view alone the map leans as far as the camera looks ahead."""
    flown = stills(4, mount_deg, turns)
    found = fit(flown.nodes)
    assert found is not None and found.sigma_lean_rad is not None
    assert flown.lean_deg(found) < 0.6
    assert np.degrees(found.sigma_lean_rad) < 1.5
    np.testing.assert_allclose(np.degrees(found.mount_rad), [0, mount_deg, 0], atol=1.0)


@pytest.mark.parametrize("strips", [2, 3])
def test_a_camera_that_the_pilot_moves_once_does_not_tilt_the_map(strips: int) -> None:
    """Its change outweighed altitudes as long as only the readings next to each other counted."""
    for seed in range(1, 6):
        flown = stills(strips, 15.0, turns=True, seed=seed, moved_deg=9.0)
        found = fit(flown.nodes)
        assert found is not None and found.sigma_lean_rad is not None
        assert flown.lean_deg(found) < 1.0
        assert flown.lean_deg(found) < 2.5 * np.degrees(found.sigma_lean_rad)


def test_one_strip_does_not_show_whether_it_leans() -> None:
    flown = stills(1, 8.0)
    found = fit(flown.nodes)
    assert found is not None and found.sigma_lean_rad is not None
    assert flown.lean_deg(found) < 2.0 * np.degrees(found.sigma_lean_rad)
    assert np.degrees(found.sigma_lean_rad) > 3.0


def test_a_view_levelled_by_its_ground_does_not_show_what_is_level() -> None:
    flown = stills(1, 8.0)
    one = flown.nodes[5]
    steep = replace(one.prior, sigma_tilt_rad=LEVEL_SIGMA_RAD, is_view_assumed=False)
    found = fit([replace(a, prior=steep) if a is one else a for a in flown.nodes])
    assert found is not None and found.sigma_lean_rad is not None
    assert flown.lean_deg(found) < 2.0 * np.degrees(found.sigma_lean_rad)


def settled(flown: Stills, broken_at: int = 10**6, turn_rad: float = 1e-4) -> Trajectory:
    """The track of the stills by its pose graph, whose steps turn by ``turn_rad`` too much; a new
    segment begins at ``broken_at``."""
    trajectory, start = Trajectory(), np.eye(4)
    for k, one in enumerate(flown.nodes):
        start = se3.inverse(one.T_odom_camera) if k == broken_at else start
        T, time_ns = start @ one.T_odom_camera, round(one.time_s * 1e9)
        covariance = np.diag([turn_rad**2] * 3 + [0.01**2] * 3)
        trajectory.add(Node(k, time_ns, int(k >= broken_at), T, covariance, one.prior))
    trajectory.moved(final=True)
    return trajectory


def test_poses_say_that_all_may_lean() -> None:
    flown = stills(1, 0.0)
    trajectory = settled(flown)
    sigma_m = [
        np.sqrt(se3.about(placed.T_world_camera[:3, 3], placed.covariance)[5, 5])
        for k in (0, len(flown.nodes) // 2)
        if (placed := trajectory.pose(k))
    ]
    found = trajectory.graph.segments[0].similarity
    assert found is not None and found.sigma_lean_rad is not None
    min_m = 0.5 * STRIP_M * found.sigma_lean_rad
    assert np.hypot(min_m, sigma_m[1]) == pytest.approx(sigma_m[0], rel=0.25)


def test_altitudes_that_drift_by_100_m_level_nothing() -> None:
    """Turns do: the mean of the views is level."""
    flown = stills(4, 4.0, turns=True, drift_m=50.0)
    found = fit(flown.nodes)
    assert found is not None and flown.lean_deg(found) < 1.5
    assert found.drift_m == pytest.approx(50.0, abs=5.0)


@pytest.mark.slow
def test_the_drift_of_altitudes_does_not_bend_the_track() -> None:
    flown = stills(4, 4.0, turns=True, drift_m=50.0)
    trajectory = settled(flown)
    z = [trajectory.pose(k).T_world_camera[2, 3] for k in range(len(flown.nodes))]
    assert np.std(z) < 3.0


@pytest.mark.parametrize("broken_at", [12, 66])
@pytest.mark.slow
def test_a_short_segment_has_the_noise_and_the_height_of_its_flight(broken_at: int) -> None:
    """Altitudes state no accuracy, and ten stills show none: 50 m are typical."""
    flown = stills(4, 4.0, turns=True)
    trajectory = settled(flown, broken_at)
    sigma_m = [trajectory.graph.segments.sigma_height_m(segment) for segment in (0, 1)]
    assert all(sigma is not None and sigma < 5.0 for sigma in sigma_m)
    z = np.array([trajectory.pose(k).T_world_camera[2, 3] for k in range(len(flown.nodes))])
    assert abs(np.mean(z[:broken_at]) - np.mean(z[broken_at:])) < 2.0


@pytest.mark.slow
def test_altitudes_that_drift_lay_no_segment_on_another() -> None:
    trajectory = settled(stills(4, 4.0, turns=True, drift_m=50.0), 38)
    sigma_m = [trajectory.graph.segments.sigma_height_m(segment) for segment in (0, 1)]
    assert max(sigma or 0.0 for sigma in sigma_m) > 20.0


def test_what_is_level_is_as_unsure_as_vision_bends() -> None:
    flown = stills(1, 0.0)
    straight, bent = (
        settled(flown, turn_rad=turn).graph.segments[0].similarity for turn in (1e-6, 1e-3)
    )
    assert straight is not None and straight.sigma_lean_rad is not None
    assert bent is not None and bent.sigma_lean_rad is not None
    bend_rad = np.sqrt(bent.sigma_lean_rad**2 - straight.sigma_lean_rad**2)
    walks = np.cumsum(np.random.default_rng(1).normal(0, 1e-3, (500, len(flown.nodes))), axis=1)
    assert bend_rad == pytest.approx(np.sqrt(np.mean(np.var(walks, axis=1))), rel=0.1)
