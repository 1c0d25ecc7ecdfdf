"""Where a camera is taken to be while vision is lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recon import se3
from recon.posegraph.pose_priors import dead_reckoned
from recon.types import F64, PosePrior


def turned(*rpy: float) -> F64:
    return se3.so3_exp(np.array(rpy))


def test_telemetrys_constant_errors_do_not_move_the_camera() -> None:
    """A map shifted against the fixes and a camera turned against the gimbal: no jump."""
    at, then = turned(0.1, 0.0, 1.0), turned(0.1, 0.05, 1.4)
    shift, compass = np.array([1.5, -0.7, 2.0]), turned(0.0, 0.0, 0.1)
    place, later = np.array([10.0, 20.0, 60.0]), np.array([13.0, 24.0, 61.0])
    before = PosePrior(compass @ at, 0.01, 0.05, place + shift, np.ones(3))
    now = PosePrior(compass @ then, 0.01, 0.05, later + shift, np.ones(3))
    T = dead_reckoned(before, now, se3.compose(at, place), None, 2.0)
    np.testing.assert_allclose(T[:3, 3], later, atol=1e-12)
    angle = np.linalg.norm(se3.so3_log(T[:3, :3] @ then.T))
    assert angle < 0.06  # what the compass error turns of the tilt's change
    still = dead_reckoned(before, before, se3.compose(at, place), None, 2.0)
    np.testing.assert_allclose(still, se3.compose(at, place), atol=1e-12)


def test_without_positions_the_last_velocity_goes_on() -> None:
    prior = PosePrior(np.eye(3), 0.01, 3.0)
    T = dead_reckoned(prior, prior, np.eye(4), np.array([1.0, 0.0, -0.5]), 4.0)
    np.testing.assert_allclose(T[:3, 3], [4.0, 0.0, -2.0])
    np.testing.assert_allclose(T[:3, :3], np.eye(3))


def test_an_attitude_that_begins_after_the_loss_is_taken_as_it_is() -> None:
    R = turned(0.2, 0.1, -2.0)
    now = PosePrior(R, 0.01, 0.05)
    before = replace(now, R_world_camera=None)
    np.testing.assert_allclose(dead_reckoned(before, now, np.eye(4), None, 1.0)[:3, :3], R)
