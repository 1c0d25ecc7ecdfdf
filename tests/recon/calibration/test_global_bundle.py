"""All poses, points and the camera adjusted at once, against a scene that is known exactly."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from spied import spied

from recon import parallel, se3
from recon.calibration import flight
from recon.calibration.flight import (
    SelfCalibrationConfig,
    camera_information,
    first_held,
    network,
)
from recon.calibration.global_bundle import (
    Knowledge,
    Problem,
    Sightings,
    Solution,
    errors_px,
    joint,
    solve,
)
from recon.calibration.tracks import crossings, with_distortion, without_distortion
from recon.types import F64, Camera

SIZE = (640, 360)
TRUE = Camera(
    np.array([[500.0, 0.0, 321.0], [0.0, 500.0, 178.0], [0.0, 0.0, 1.0]]),
    np.array([-0.08, 0.02, 0.002, -0.001, 0.005]), SIZE,
)  # fmt: skip
SURVEYED = 5
FREE = SelfCalibrationConfig()
HELD = replace(
    FREE, sigma_focal=1e-6, sigma_aspect=1e-6, sigma_centre=1e-7, sigma_k=1e-7, sigma_p=1e-8
)


def shown(points: F64, camera: Camera) -> F64:
    """(N, 2) distorted pixels of points in the camera's frame, by OpenCV."""
    zero = np.zeros(3)
    uv, _ = cv2.projectPoints(points[:, None], zero, zero, camera.K, camera.distortion)
    return np.asarray(uv[:, 0], np.float64)


def poses() -> F64:
    """Two legs that lean ahead, flown in opposite directions at two heights."""
    out = []
    for leg, yaw in enumerate((0.0, np.pi)):
        for k in range(6):
            R = se3.so3_exp(np.array([0.0, 0.0, yaw])) @ np.diag([1.0, -1.0, -1.0])
            R = R @ se3.so3_exp(np.array([0.3, 0.05 * (k % 3), 0.02 * k]))
            along = 8.0 * (k if leg == 0 else 5 - k)
            out.append(se3.compose(R, np.array([14.0 * leg, along, 40.0 + 8.0 * leg])))
    return np.array(out)


def scene(noise_px: float = 0.0) -> tuple[F64, F64, Sightings]:
    """Poses, points and where OpenCV projects them to; the first points are surveyed."""
    rng = np.random.default_rng(2)
    T = poses()
    spots = rng.uniform([-20, -15], [35, 75], (400, 2))
    spots[:SURVEYED] = [[0, 10], [14, 12], [2, 40], [15, 45], [7, 28]]
    points = np.column_stack([spots, rng.uniform(0, 5, len(spots))])
    view, landmark, uv = [], [], []
    for k, one in enumerate(T):
        here = se3.transform(se3.inverse(one), points)
        at = shown(here, TRUE)
        near = np.flatnonzero(
            (here[:, 2] > 1) & (at >= 0).all(axis=1) & (at < SIZE).all(axis=1)
            & (np.abs(here[:, :2]) < 0.8 * here[:, 2:]).all(axis=1)
        )  # fmt: skip
        view += [k] * len(near)
        landmark += near.tolist()
        uv.append(at[near])
    shifted = np.concatenate(uv) + noise_px * rng.normal(size=(len(view), 2))
    return T, points, Sightings(np.array(view), np.array(landmark), shifted)


def off(T: F64, seed: int = 1, size: float = 1.0) -> F64:
    rng = np.random.default_rng(seed)
    scale = size * np.array([0.01] * 3 + [0.5] * 3)
    return np.array([one @ se3.exp(rng.normal(size=6) * scale) for one in T])


def known_by_survey(T: F64, points: F64) -> Knowledge:
    known = Knowledge.none(len(T), len(points))
    known.surveyed[:SURVEYED] = points[:SURVEYED]
    known.sigma_surveyed[:SURVEYED] = 0.01
    return known


def adjusted(camera: Camera, config: SelfCalibrationConfig, noise_px: float = 0.0) -> Solution:
    T, points, seen = scene(noise_px)
    start = points + np.random.default_rng(5).normal(size=points.shape)
    sigmas = np.full(len(seen.view), max(noise_px, 0.1))
    problem = Problem(
        camera, camera, off(T), start, seen, sigmas, known_by_survey(T, points),
        camera_information(camera, config),
    )  # fmt: skip
    return solve(problem, 60, covariances=True)


@pytest.mark.slow
def test_surveyed_points_bring_exact_pixels_to_the_exact_scene() -> None:
    T, points, seen = scene()
    found = adjusted(TRUE, HELD)
    often = np.bincount(seen.landmark, minlength=len(points)) >= 2
    assert np.abs(found.poses[:, :3, 3] - T[:, :3, 3]).max() < 1e-4
    assert np.abs(found.points - points)[often].max() < 1e-3
    assert found.errors_px.max() < 1e-3


def test_the_camera_is_found_and_its_sigmas_hold() -> None:
    K = TRUE.K * [[1.015, 1, 1], [1, 1.015, 1], [1, 1, 1]]
    given = Camera(K, np.array([0.0, 0.0, 0.0, 0.0, 0.005]), SIZE)
    found = adjusted(given, FREE, noise_px=0.3)
    true = [500.0, 500.0, 321.0, 178.0, *TRUE.distortion[:4]]
    K = found.camera.K
    ours = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *found.camera.distortion[:4]]
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    assert (np.abs(np.array(ours) - true) < 4.0 * sigmas).all()
    assert sigmas[0] / 500.0 < 0.01 and found.camera.distortion[4] == 0.005


def test_covariances_cover_the_errors_and_are_no_larger_than_needed() -> None:
    T, _, _ = scene()
    found = adjusted(TRUE, HELD, noise_px=0.5)
    chi2 = []
    for true, ours, spread in zip(T, found.poses, found.covariances, strict=True):
        error = se3.log(ours @ se3.inverse(true))
        chi2.append(error @ np.linalg.solve(spread, error))
    assert 2.0 < np.mean(chi2) < 14.0  # 6 degrees of freedom each, all err together


def test_fixes_attitudes_and_a_placing_hold_what_pixels_leave_open() -> None:
    T, points, seen = scene()
    none = Knowledge.none(len(T), len(points))
    sigmas = np.full(len(seen.view), 0.1)
    held = camera_information(TRUE, HELD)
    shift = se3.compose(se3.so3_exp(np.array([0.02, -0.03, 0.3])), np.array([30.0, -20.0, 5.0]))
    there = np.array([shift @ one for one in T])
    ones = np.ones((len(T), 3))
    for known in (
        replace(none, fixes=there[:, :3, 3], sigma_fixes=0.5 * ones),
        replace(none, attitudes=there[:, :3, :3], sigma_attitudes=0.01 * ones,
                fixes=there[:, :3, 3], sigma_fixes=ones),
        replace(none, placed=there, placing=np.tile(100.0 * np.eye(6), (len(T), 1, 1))),
    ):  # fmt: skip
        start = se3.transform(shift, points)
        near = np.array([se3.compose(np.eye(3), np.array([3.0, -2.0, 1.0])) @ one for one in there])
        problem = Problem(TRUE, TRUE, near, start, seen, sigmas, known, held)
        found = solve(problem, 80)
        assert np.abs(found.poses[:, :3, 3] - there[:, :3, 3]).max() < 0.01
        assert np.abs(found.poses[:, :3, :3] - there[:, :3, :3]).max() < 1e-3


def test_poses_that_are_metres_off_and_wild_sightings_do_no_harm() -> None:
    T, points, seen = scene(0.2)
    uv = seen.uv_px.copy()
    wild = np.arange(0, len(uv), 17)
    uv[wild] += np.random.default_rng(3).uniform(-80, 80, (len(wild), 2))
    known = known_by_survey(T, points)
    held = camera_information(TRUE, HELD)
    found = network(TRUE, off(T, 4, 4.0), replace(seen, uv_px=uv), known, held)
    s = found.solution
    assert np.linalg.norm(s.poses[:, :3, 3] - T[:, :3, 3], axis=1).max() < 0.3
    assert found.sigma_px == pytest.approx(0.2, abs=0.06)
    assert len(found.seen.view) < len(uv) - 0.8 * len(wild)


def test_poses_that_agree_with_the_images_are_adjusted_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    T, points, seen = scene(0.2)
    uv = seen.uv_px.copy()
    uv[::17] += 40.0
    seen, known = replace(seen, uv_px=uv), known_by_survey(T, points)
    held = camera_information(TRUE, FREE)
    first = network(TRUE, off(T), seen, known, held)
    solved = spied(monkeypatch, flight, "solve")
    s = first.solution
    again = network(TRUE, s.poses, seen, known, held, near=s.camera)
    assert solved.call_count == 1 and solved.call_args.args[0].given is TRUE
    assert again.sigma_px == pytest.approx(first.sigma_px, rel=0.1)
    assert np.abs(again.solution.poses - s.poses).max() < 0.1  # a fifth of its sigma
    assert again.solution.camera.K[0, 0] == pytest.approx(s.camera.K[0, 0], abs=1.0)
    assert len(again.seen.view) < len(uv) - 0.8 * len(uv[::17])


def test_any_number_of_cores_gives_the_same_result() -> None:
    one, *others = (_with_threads(n) for n in (1, 2, 3))
    assert all(np.array_equal(one.poses, other.poses) for other in others)


def _with_threads(threads: int) -> Solution:
    parallel.limit_threads(threads)
    try:
        return adjusted(TRUE, FREE, noise_px=0.3)
    finally:
        parallel.limit_threads(0)


def test_a_landmark_whose_rays_cross_nowhere_has_no_place() -> None:
    T, points, seen = scene(0.2)
    stray = np.arange(4)
    more = Sightings(stray, stray // 2 + len(points), np.array([[100.0, 80.0], [600.0, 300.0]] * 2))
    known = known_by_survey(T, np.concatenate([points, np.zeros((2, 3))]))
    found = network(TRUE, off(T), joint(seen, more), known, camera_information(TRUE, HELD))
    assert np.isnan(found.solution.points[len(points) :]).all()
    assert found.seen.landmark.max() < len(points)
    assert np.linalg.norm(found.solution.poses[:, :3, 3] - T[:, :3, 3], axis=1).max() < 0.3


def test_a_camera_that_starts_again_each_round_is_held_to_the_one_given() -> None:
    T, points, seen = scene(0.2)
    given = Camera(TRUE.K * [[1.03, 1, 1], [1, 1.03, 1], [1, 1, 1]], TRUE.distortion, SIZE)
    known = replace(
        Knowledge.none(len(T), len(points)), fixes=T[:, :3, 3],
        sigma_fixes=np.full((len(T), 3), 1.0), placed=T, placing=first_held(T),
    )  # fmt: skip
    found = network(given, off(T), seen, known, camera_information(given, HELD))
    assert found.solution.camera.K[0, 0] == pytest.approx(515.0, abs=0.01)


def test_rays_cross_at_the_points_and_parallel_ones_nowhere() -> None:
    T, points, seen = scene()
    found = crossings(T, TRUE, seen, len(points))
    known = np.isfinite(found[:, 2])
    assert known.sum() > 200 and np.abs(found - points)[known].max() < 0.01
    still = Sightings(np.array([0, 1]), np.zeros(2, np.int64), np.array([[300.0, 180.0]] * 2))
    same = np.array([T[0], T[0]])
    assert np.isnan(crossings(same, TRUE, still, 1)).all()
    one = Sightings(np.array([0]), np.array([0]), np.array([[300.0, 180.0]]))
    behind = T[:1, :3, 3] - T[:1, :3, 2]
    assert np.isinf(errors_px(TRUE, T[:1], behind, one)).all()


def test_distortion_goes_and_comes_back() -> None:
    uv = np.random.default_rng(0).uniform([20, 20], [620, 340], (50, 2))
    there = without_distortion(TRUE, uv)
    assert np.abs(there - uv).max() > 1.0
    np.testing.assert_allclose(with_distortion(TRUE, there), uv, atol=0.01)


def test_a_landmark_twice_in_a_view_is_refused() -> None:
    T, points, seen = scene()
    twice = replace(seen, view=np.zeros_like(seen.view))
    problem = Problem(
        TRUE, TRUE, T, points, twice, np.ones(len(seen.view)), Knowledge.none(len(T), len(points)),
        np.eye(8),
    )  # fmt: skip
    with pytest.raises(ValueError, match="twice in one view"):
        solve(problem)
