"""Tilt by the ground where no attitude is known."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from some_views import view_at

from recon import se3
from recon.backends.cpu import CpuBackend
from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA, rotation_from_rpy
from recon.pipeline.keyframe_map import KeyframeMap
from recon.pipeline.stages import untimed
from recon.posegraph.ground import (
    ASSUMED_TILT_RAD,
    LEVEL_SIGMA_RAD,
    levelled,
)
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, PosePrior


def looking(pitch_deg: float, yaw_deg: float = 0.0) -> F64:
    """R_world_camera of a level head at a pitch; -90 looks straight down."""
    head = rotation_from_rpy(0.0, math.radians(pitch_deg), math.radians(yaw_deg))
    return np.asarray(R_ENU_NED @ head @ R_GIMBAL_CAMERA)


def ground_seen(R_world_camera: F64, relief_m: float = 0.0) -> F64:
    """(N, 3) of the level ground 50 m below, in the camera's frame, with walls here and there."""
    rng = np.random.default_rng(1)
    rays = rng.uniform(-0.5, 0.5, (400, 2))
    directions = np.column_stack([rays, np.ones(400)]) @ R_world_camera.T
    down = directions[directions[:, 2] < -0.05]
    ground = down * (50.0 / -down[:, 2])[:, None]
    ground[:, 2] += rng.normal(0, 0.3, len(ground)) + relief_m * rng.uniform(0, 1, len(ground))
    ground[::10, 2] += 8.0
    return np.asarray(ground @ R_world_camera)


NADIR = PosePrior(
    R_world_camera=looking(-90), sigma_tilt_rad=ASSUMED_TILT_RAD, sigma_yaw_rad=3.0,
    is_view_assumed=True,
)  # fmt: skip


@pytest.mark.parametrize("pitch_deg", [-60, -40, -25])
def test_a_view_far_from_the_assumed_one_is_levelled_by_its_ground(pitch_deg: float) -> None:
    truth = looking(pitch_deg, 70)
    prior = levelled(NADIR, ground_seen(truth))
    assert prior.R_world_camera is not None and prior.sigma_tilt_rad == LEVEL_SIGMA_RAD
    assert np.degrees(np.arccos(prior.R_world_camera[2] @ truth[2])) < 2.0  # the same up
    assert np.linalg.norm(se3.so3_log(prior.R_world_camera.T @ truth)) > 0.1  # not the heading


def test_a_few_landmarks_placed_far_off_change_no_tilt() -> None:
    truth = looking(-40)
    points = ground_seen(truth)
    points[3::20] *= np.geomspace(3.0, 100.0, len(points[3::20]))[:, None]
    prior = levelled(NADIR, points)
    assert prior.R_world_camera is not None
    assert np.degrees(np.arccos(prior.R_world_camera[2] @ truth[2])) < 2.0


def test_a_known_attitude_and_a_slope_below_the_camera_stay() -> None:
    steep = ground_seen(looking(-40))
    known = replace(NADIR, sigma_tilt_rad=0.02, is_view_assumed=False)
    assert levelled(known, steep) is known
    assert levelled(NADIR, ground_seen(looking(-75))) is NADIR
    blind = PosePrior()
    assert levelled(blind, steep) is blind


def test_ground_without_a_plane_levels_nothing() -> None:
    assert levelled(NADIR, ground_seen(looking(-40), relief_m=150.0)) is NADIR
    assert levelled(NADIR, ground_seen(looking(-40))[:20]) is NADIR


@pytest.mark.parametrize(("steep", "is_levelled"), [(1, False), (2, False), (3, True), (10, True)])
def test_a_few_steep_views_do_not_doubt_the_mount_of_all(steep: int, is_levelled: bool) -> None:
    keyframes = KeyframeMap(Trajectory(), None, CpuBackend(), Counter(), untimed)
    for seq in range(10):
        R, T = looking(-40 if seq < steep else -90), np.eye(4)
        T[0, 3] = seq
        view = view_at(seq, T, prior=NADIR, points=ground_seen(R))
        keyframes.add(view, None)
    assert keyframes.is_levelled == is_levelled
