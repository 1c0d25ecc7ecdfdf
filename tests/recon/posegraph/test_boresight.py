"""The rotation between the camera and the attitude reported of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flown_track import node
from scipy.spatial.transform import Rotation
from spied import spied

from recon import parallel, se3
from recon.posegraph import alignment
from recon.posegraph.records import Node
from recon.posegraph.sensor_offsets import Constants, constants
from recon.types import F64, PosePrior

DOWN = np.diag([1.0, -1.0, -1.0])


def boresight(stretches: list[list[Node]]) -> Constants:
    return constants([], 0.0, [alignment.boresight(nodes) for nodes in stretches])


def flown(
    turn: F64, headings: list[float], seed: int, span_s: float, sigma_deg: float = 0.3
) -> list[Node]:
    """Legs of twenty keyframes; attitudes of a camera off by ``turn`` from what they say."""
    rng = np.random.default_rng(seed)
    odom = Rotation.random(random_state=seed).as_matrix()
    out, step_s = list[Node](), span_s / (20 * len(headings) - 1)
    for heading in headings:
        for _ in range(20):
            wobble = se3.so3_exp(rng.normal(size=3) * 0.02)
            R = se3.so3_exp(np.array([0.0, 0.0, heading])) @ DOWN @ wobble
            error = se3.so3_exp(np.radians(sigma_deg) * rng.normal(size=3))
            T = se3.compose(odom @ R, rng.normal(size=3))
            said = error @ R @ se3.so3_exp(-turn)
            prior = PosePrior(said, np.radians(0.5), np.radians(2.0))
            out.append(node(T, prior, time_s=step_s * len(out)))
    return out


@pytest.mark.parametrize("seed", range(4))
def test_two_degrees_are_found_on_legs_to_and_fro(seed: int) -> None:
    turn = np.radians([1.6, -1.2, 0.0])
    found = boresight([flown(turn, [0.4, 0.4 + np.pi, 0.4], seed, 300.0)])
    assert np.degrees(np.abs(found.turn[:2] - turn[:2])).max() < 0.3
    assert found.is_turn_sure and np.degrees(found.sigma_turn[:2]).max() < 0.5


def test_what_one_leg_cannot_tell_is_left_alone() -> None:
    found = boresight([flown(np.radians([1.6, -1.2, 0.0]), [0.4, 0.4, 0.4], 1, 300.0)])
    assert not found.is_turn_sure and np.degrees(np.abs(found.turn)).max() < 0.3
    assert np.degrees(found.sigma_turn).min() > 1.5
    got = found.without(PosePrior(np.eye(3))).R_world_camera
    assert got is not None
    np.testing.assert_array_equal(got, np.eye(3))


def test_stretches_of_their_own_frames_count_together() -> None:
    """Each leg in a frame of its own tells nothing; with a turn in one of them they agree."""
    turn = np.radians([0.0, 2.0, 0.0])
    alone = [flown(turn, [heading], 7, 150.0) for heading in (0.0, np.pi)]
    assert not boresight(alone).is_turn_sure
    both = boresight([*alone, flown(turn, [0.0, np.pi], 8, 300.0)])
    assert np.degrees(np.abs(both.turn - turn)[:2]).max() < 0.3


def test_other_threads_run_between_its_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    released = spied(monkeypatch, parallel, "release_gil")
    boresight([flown(np.radians([1.6, -1.2, 0.0]), [0.4, 0.4 + np.pi], 1, 300.0)])
    assert released.call_count >= 2


def test_noise_is_no_boresight_and_a_wrong_frame_neither() -> None:
    sure = [boresight([flown(np.zeros(3), [0.0, np.pi], s, 60.0)]).is_turn_sure for s in range(20)]
    assert not any(sure)
    nodes = flown(np.zeros(3), [0.0, 1.5, 3.0, 4.5], 1, 60.0)
    anything = Rotation.random(len(nodes), random_state=1).as_matrix()
    nodes = [
        replace(a, prior=replace(a.prior, R_world_camera=R))
        for a, R in zip(nodes, anything, strict=True)
    ]
    assert not boresight([nodes]).turn.any()


@pytest.mark.parametrize("turn_deg", [(0.0, 8.0, 0.0), (-9.0, 8.0, 0.0)])
def test_a_crooked_gimbal_is_found_as_well_as_a_straight_one(turn_deg: F64) -> None:
    turn = np.radians(turn_deg)
    found = boresight([flown(turn, [0.4, 0.4 + np.pi, 0.4], 1, 300.0)])
    off = np.degrees(np.abs(found.turn - turn))[:2]
    assert off.max() < 0.4 and np.all(off < 3.0 * np.degrees(found.sigma_turn[:2]))


def test_a_camera_that_looks_elsewhere_is_not_turned() -> None:
    found = boresight([flown(np.radians([0.0, 25.0, 0.0]), [0.0, np.pi], 1, 600.0)])
    assert not found.turn.any() and not found.is_turn_sure


def test_a_sure_one_turns_the_attitude() -> None:
    turn = np.array([0.03, -0.02, 0.0])
    one = Constants(turn, np.full(3, 0.002))
    R = Rotation.random(random_state=2).as_matrix()
    got = one.without(PosePrior(R)).R_world_camera
    assert got is not None
    np.testing.assert_allclose(got, R @ Rotation.from_rotvec(turn).as_matrix(), atol=1e-12)
