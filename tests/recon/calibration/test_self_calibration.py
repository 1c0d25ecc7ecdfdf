"""A camera found again from the flight, against projections by OpenCV; refused where it must be."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon import se3
from recon.calibration.flight import (
    SelfCalibrated,
    SelfCalibrationConfig,
    camera_information,
    camera_sigmas,
    doubt,
    loosely_placed,
    self_calibrate,
    shared,
)
from recon.calibration.global_bundle import Problem, Sightings, errors_px, solve
from recon.calibration.tracks import crossings
from recon.types import F64, Camera
from service.commands.missing_metadata import still_assumed
from service.offline.refine.by_images import fitted
from service.offline.refine.own_camera import TiedViews, bent, by_tags

SIZE = (1280, 720)
TRUE = Camera(
    np.array([[960.0, 0.0, 643.3], [0.0, 960.0, 356.6], [0.0, 0.0, 1.0]]),
    np.array([-0.12, 0.03, 0.0, 0.0, 0.0]), SIZE,
)  # fmt: skip
SIGMA_PX = 0.3


def _pose(x: float, y: float, z: float, yaw: float, ahead: float) -> F64:
    R = se3.so3_exp(np.array([0.0, 0.0, -yaw])).T @ np.diag([1.0, -1.0, -1.0])
    return se3.compose(R @ se3.so3_exp(np.array([ahead, 0.0, 0.0])), np.array([x, y, z]))


def _oblique_turn() -> F64:
    """Out, round and back, looking 25 degrees ahead of straight down."""
    tilt, out = np.radians(25.0), []
    for k in range(8):
        out.append(_pose(0.0, 6.0 * k, 60.0, 0.0, tilt))
    for k in range(1, 6):
        angle = np.pi * k / 6
        place = 14.0 * (1 - np.cos(angle)), 42.0 + 14.0 * np.sin(angle)
        out.append(_pose(*place, 60.0, -angle, tilt))
    for k in range(8):
        out.append(_pose(28.0, 42.0 - 6.0 * k, 60.0, np.pi, tilt))
    return np.array(out)


def _nadir(heights: tuple[float, ...]) -> F64:
    return np.array(
        [_pose(6.0 * k, 15.0 * i, z, 0.0, 0.0) for i, z in enumerate(heights) for k in range(10)]
    )


def _shown(points: F64, camera: Camera) -> F64:
    """(N, 2) distorted pixels of points in the camera's frame, by OpenCV."""
    zero = np.zeros(3)
    uv, _ = cv2.projectPoints(points[:, None], zero, zero, camera.K, camera.distortion)
    return np.asarray(uv[:, 0], np.float64)


def _seen(poses: F64, camera: Camera, seed: int = 0) -> tuple[F64, Sightings]:
    """Landmarks on gentle ground and where OpenCV projects them to, with noise."""
    rng = np.random.default_rng(seed)
    low, high = poses[:, :2, 3].min(axis=0) - 35, poses[:, :2, 3].max(axis=0) + 35
    spots = rng.uniform(low, high, (600, 2))
    points = np.column_stack([spots, 2.0 * np.sin(spots[:, 0] / 15) + rng.uniform(0, 3, 600)])
    view, landmark, uv = [], [], []
    for k, T in enumerate(poses):
        T_camera_world = se3.inverse(T)
        here = se3.transform(T_camera_world, points)
        flat = here[:, :2] / here[:, 2:]
        near = np.flatnonzero((here[:, 2] > 1) & (np.abs(flat) < [0.72, 0.42]).all(axis=1))
        shown = _shown(here[near], camera)
        inside = ((shown >= 0) & (shown < SIZE)).all(axis=1)
        view += [k] * int(inside.sum())
        landmark += near[inside].tolist()
        uv.append(shown[inside])
    noisy = np.concatenate(uv) + rng.normal(size=(len(view), 2)) * SIGMA_PX
    return points, Sightings(np.array(view), np.array(landmark), noisy)


def _guess(points: F64, poses: F64, seed: int = 5) -> tuple[F64, F64]:
    """Poses and landmarks as a scan with a wrong camera has them."""
    rng = np.random.default_rng(seed)
    off = np.array([se3.exp(rng.normal(size=6) * [2e-3, 2e-3, 2e-3, 0.1, 0.1, 0.1]) @ T
                    for T in poses])  # fmt: skip
    return off, points + rng.normal(size=points.shape) * 0.3


WRONG = Camera(TRUE.K * [[1.02, 1, 1], [1, 1.02, 1], [1, 1, 1]], np.zeros(5), SIZE)


@pytest.mark.slow
def test_a_focal_length_two_percent_off_is_found_on_an_oblique_turn() -> None:
    poses = _oblique_turn()
    points, seen = _seen(poses, TRUE)
    fixes = poses[:, :3, 3] + np.random.default_rng(3).normal(size=(len(poses), 3)) * 0.5
    start, near = _guess(points, poses)
    found = self_calibrate(WRONG, start, near, seen, fixes, np.full((len(poses), 3), 0.5))
    assert not found.why_not
    assert abs(found.camera.K[0, 0] / 960.0 - 1.0) < 0.004  # said to be sure to 0.0026
    assert abs(found.camera.K[1, 1] / 960.0 - 1.0) < 0.004
    assert np.abs(found.camera.K[:2, 2] - TRUE.K[:2, 2]).max() < 6.0
    assert np.abs(found.camera.distortion[:2] - TRUE.distortion[:2]).max() < 0.03
    assert abs(found.camera.K[0, 0] - 960.0) < 4.0 * found.sigma_focal * 960.0
    assert found.rms_before_px > 3 * found.rms_after_px and found.rms_after_px < 0.4
    assert found.camera.size_px == SIZE


@pytest.mark.slow
def test_a_lens_off_its_axis_is_found_where_turned_views_meet() -> None:
    """Decentred as a consumer's camera was found to be; the flight turns over ground seen twice."""
    bent = Camera(
        TRUE.K + np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 10.0], [0.0, 0.0, 0.0]]),
        np.array([-0.012, 0.01, 0.003, 0.006, 0.0]), SIZE,
    )  # fmt: skip
    poses = _oblique_turn()
    points, seen = _seen(poses, bent)
    fixes = poses[:, :3, 3] + np.random.default_rng(3).normal(size=(len(poses), 3)) * 0.5
    start, near = _guess(points, poses)
    found = self_calibrate(WRONG, start, near, seen, fixes, np.full((len(poses), 3), 0.5))
    assert not found.why_not and found.rms_after_px < 0.4
    off = np.abs(found.camera.distortion[2:4] - bent.distortion[2:4])
    assert (off < 4.0 * np.array(found.sigma_p)).all() and (off < 0.001).all()
    # What a pixel means is what counts: the terms and the centre nearly trade places.
    rng = np.random.default_rng(0)
    ahead = np.column_stack([rng.uniform(-0.6, 0.6, 99), rng.uniform(-0.33, 0.33, 99), np.ones(99)])
    apart = _shown(ahead, found.camera) - _shown(ahead, bent)
    assert np.abs(apart - apart.mean(axis=0)).max() < 1.0


def test_strips_flown_both_ways_agree_by_the_camera_that_surfaces_keep() -> None:
    """Its centre is 3 px off, which is found; poses of the camera found would not be of that."""
    given = Camera(TRUE.K + np.eye(3)[2] * [[3.0], [-2.0], [0.0]], TRUE.distortion, SIZE)
    poses = _oblique_turn()
    points, seen = _seen(poses, TRUE)
    start, near = _guess(points, poses)
    asked = SelfCalibrationConfig(max_sigma_focal=0.02)
    found = fitted(given, start, TiedViews(given, start, near, seen), len(poses), asked)
    assert not found.doubt and abs(found.camera.K[0, 2] - TRUE.K[0, 2]) < 1.0
    places = crossings(found.poses, given, seen, len(points))
    off_px = errors_px(given, found.poses, places, seen)
    assert np.quantile(off_px, 0.9) < 1.0  # 2 px by the poses of the camera found


def test_poses_are_of_the_camera_that_surfaces_keep_where_images_show_another_focal_length() -> (
    None
):
    """Surfaces and textures would lie far apart by the poses of the camera found."""
    given = Camera(WRONG.K, TRUE.distortion, SIZE)
    poses = _oblique_turn()
    points, seen = _seen(poses, TRUE)
    start, near = _guess(points, poses)
    asked = SelfCalibrationConfig(max_sigma_focal=0.02)
    found = fitted(given, start, TiedViews(given, start, near, seen), len(poses), asked)
    assert abs(found.camera.K[0, 0] / 960.0 - 1.0) < 0.01

    def off_px(poses: F64) -> float:
        places = crossings(poses, given, seen, len(points))
        return float(np.quantile(errors_px(given, poses, places, seen), 0.9))

    assert off_px(found.poses) < 1.0 < 5.0 < off_px(poses)  # the true ones are the camera found's


def _in_patches(seen: Sightings, amplitude_px: float, seed: int) -> Sightings:
    """With an error that is smooth over each view and of its own in each."""
    rng = np.random.default_rng(seed)
    x, y = (2.5 * (seen.uv_px / np.array(SIZE) * 2.0 - 1.0)).T
    waves = np.stack([np.sin(x + a) * np.sin(y + b) for a in (0.0, 1.57) for b in (0.0, 1.57)])
    heights = rng.normal(size=(int(seen.view.max()) + 1, 2, 4)) * amplitude_px
    off = np.einsum("mik,km->mi", heights[seen.view], waves)
    return Sightings(seen.view, seen.landmark, seen.uv_px + off)


def _about_nadir() -> F64:
    """Two strips both ways, straight down but for 2 degrees."""
    rng, away = np.random.default_rng(7), _nadir((60.0, 61.0))
    away[10:, :3, :2] *= -1.0
    return np.array([T @ se3.exp(np.append(rng.normal(size=3) * 0.035, np.zeros(3))) for T in away])


@pytest.mark.parametrize(
    ("poses", "amplitude_px"),
    [(_oblique_turn(), 0.0), (_oblique_turn(), 0.3), (_about_nadir(), 0.3)],
    ids=["oblique", "oblique, in patches", "nadir, in patches"],
)
@pytest.mark.slow
def test_the_sigma_holds_where_the_sightings_of_a_view_err_alike(
    poses: F64, amplitude_px: float
) -> None:
    sigmas = []
    for seed in range(4):
        points, seen = _seen(poses, TRUE, seed)
        seen = _in_patches(seen, amplitude_px, seed)
        start, near = _guess(points, poses, seed)
        fixes = poses[:, :3, 3] + np.random.default_rng(seed).normal(size=(len(poses), 3)) * 0.1
        sigma, loose = np.full((len(poses), 3), 0.1), SelfCalibrationConfig(max_sigma_focal=0.05)
        found = self_calibrate(WRONG, start, near, seen, fixes, sigma, loose)
        assert not found.why_not
        sigmas.append((found.camera.K[0, 0] / 960.0 - 1.0) / found.sigma_focal)
    assert 0.3 < np.sqrt(np.mean(np.square(sigmas))) < 1.2


@pytest.mark.slow
def test_straight_down_from_one_height_it_is_not_determined() -> None:
    poses = _nadir((60.0, 60.0))
    points, seen = _seen(poses, TRUE)
    start, near = _guess(points, poses)
    none = np.full((len(poses), 3), np.nan)
    found = self_calibrate(WRONG, start, near, seen, none, none)
    assert "straight down from one height" in found.why_not


def test_an_adjustment_ends_by_itself_where_height_and_focal_length_trade_places() -> None:
    poses = _about_nadir()
    points, seen = _seen(poses, TRUE)
    seen.uv_px[::40] += np.random.default_rng(1).uniform(-20, 20, seen.uv_px[::40].shape)
    start, near = _guess(points, poses)
    loose = camera_information(WRONG, SelfCalibrationConfig(sigma_focal=0.2))
    sigmas, known = np.full(len(seen.view), SIGMA_PX), loosely_placed(start, seen)
    problem = Problem(WRONG, WRONG, start, near[: len(known.surveyed)], seen, sigmas, known, loose)
    found, further = solve(problem, 20), solve(problem, 100)
    np.testing.assert_array_equal(found.poses, further.poses)
    assert (np.abs(found.camera_step) < 0.02 * np.sqrt(np.diag(found.camera_covariance))).all()


@pytest.mark.slow
def test_two_heights_known_to_centimetres_determine_it() -> None:
    poses = _nadir((60.0, 90.0))
    points, seen = _seen(poses, TRUE)
    start, near = _guess(points, poses)
    fixes = poses[:, :3, 3] + np.random.default_rng(3).normal(size=(len(poses), 3)) * 0.02
    found = self_calibrate(WRONG, start, near, seen, fixes, np.full((len(poses), 3), 0.02))
    assert not found.why_not and abs(found.camera.K[0, 0] / 960.0 - 1.0) < 0.003


@pytest.mark.slow
def test_a_camera_beyond_belief_and_wild_sightings() -> None:
    poses = _oblique_turn()
    points, seen = _seen(poses, TRUE)
    start, near = _guess(points, poses)
    fixes, sigma = poses[:, :3, 3], np.full((len(poses), 3), 0.3)
    uv = seen.uv_px.copy()
    uv[::23] += np.random.default_rng(1).uniform(-60, 60, uv[::23].shape)
    wild = Sightings(seen.view, seen.landmark, uv)
    found = self_calibrate(WRONG, start, near, wild, fixes, sigma)
    assert not found.why_not and abs(found.camera.K[0, 0] / 960.0 - 1.0) < 0.005
    far = Camera(TRUE.K * [[1.25, 1, 1], [1, 1.25, 1], [1, 1, 1]], np.zeros(5), SIZE)
    assert "chessboard" in self_calibrate(far, start, near, seen, fixes, sigma).why_not


def test_an_adjustment_that_has_not_settled_is_refused() -> None:
    poses = _oblique_turn()
    points, seen = _seen(poses, TRUE)
    start, near = _guess(points, poses)
    fixes, sigma = poses[:, :3, 3], np.full((len(poses), 3), 0.3)
    hasty = SelfCalibrationConfig(iterations=1, max_step=0.003)
    assert "settle" in self_calibrate(WRONG, start, near, seen, fixes, sigma, hasty).why_not


def test_wrong_calls_are_refused() -> None:
    poses = _nadir((60.0,))
    points, seen = _seen(poses, TRUE)
    few = Sightings(seen.view[:20], seen.landmark[:20], seen.uv_px[:20])
    with pytest.raises(ValueError, match="too few"):
        self_calibrate(TRUE, poses, points, few, poses[:, :3, 3], poses[:, :3, 3])


def test_a_camera_whose_covariance_is_none_is_refused() -> None:
    def without(i: int, j: int, value: float) -> F64:
        out = np.diag(np.full(8, 1e-6))
        out[i, j] = out[j, i] = value
        return out

    assert camera_sigmas(without(0, 1, 5e-7)) == pytest.approx(np.full(8, 1e-3))
    for wrong in (without(6, 6, -1e-9), without(6, 6, np.nan), without(2, 6, 2e-6)):
        sigmas = camera_sigmas(wrong)
        assert "does not determine" in doubt(TRUE, TRUE, sigmas, SelfCalibrationConfig())


BARREL = Camera(TRUE.K, np.array([-0.43, 0.2, 0.0, 0.0, 0.0]), SIZE)


@pytest.mark.parametrize("stated", [True, False])
def test_a_strong_distortion_is_found_where_nothing_states_another(stated: bool) -> None:
    poses = _oblique_turn()
    points, seen = _seen(poses, BARREL)
    start, near = _guess(points, poses)
    fixes, sigma = poses[:, :3, 3], np.full((len(poses), 3), 0.5)
    search = by_tags(0.02) if stated else bent(by_tags(0.02))
    found = self_calibrate(WRONG, start, near, seen, fixes, sigma, search)
    assert found.why_not.startswith("the camera found is too far") == stated
    if not stated:
        assert not found.why_not
        np.testing.assert_allclose(found.camera.distortion[:2], [-0.43, 0.2], atol=0.02)


def test_an_open_distortion_that_the_flight_does_not_determine_is_refused() -> None:
    search, sigmas = bent(by_tags(0.02)), np.array([3.0, 3.0, 2.0, 2.0, 0.01, 0.01, 1e-3, 1e-3])
    assert not doubt(BARREL, WRONG, sigmas, search)
    sigmas[4:6] = 0.05
    assert "does not determine the distortion" in doubt(BARREL, WRONG, sigmas, search)


def test_a_wide_lens_surer_than_an_unknown_one_is_taken_and_its_distortion_stays_unsure() -> None:
    """A compact on a fixed wing, 72 degrees across: k1 to 0.014 bends a corner by 2.3 %."""
    K = np.array([[2775.0, 0.0, 1999.5], [0.0, 2775.0, 1499.5], [0.0, 0.0, 1.0]])
    wide, search = Camera(K, np.zeros(5), (4000, 3000)), bent(by_tags(0.05))

    def refused(sigma_k1: float) -> bool:
        sigmas = np.array([30.0, 30.0, 9.0, 9.0, sigma_k1, 0.02, 1e-3, 1e-3])
        return bool(doubt(wide, wide, sigmas, search))

    def unsure(sigma_k1: float) -> tuple[str, ...]:
        k, none = (sigma_k1, 0.02), np.zeros((0, 4, 4))
        return still_assumed(
            SelfCalibrated(wide, 0.01, k, (1e-3, 1e-3), 1.0, 0.5, none[:, 0, 0], none, "")
        )

    assert [refused(s) for s in (0.01, 0.014, 0.03)] == [False, False, True]
    assert [unsure(s) for s in (0.01, 0.014)] == [(), ("distortion",)]


@pytest.mark.slow
def test_landmarks_without_a_place_take_no_part() -> None:
    poses = _oblique_turn()
    points, seen = _seen(poses, TRUE)
    start, near = _guess(points, poses)
    fixes, sigma = poses[:, :3, 3], np.full((len(poses), 3), 0.5)
    lost = np.arange(len(near)) % 5 == 0
    without = shared(seen, ~lost[seen.landmark])
    expected = self_calibrate(WRONG, start, near, without, fixes, sigma)
    near[lost] = np.nan
    found = self_calibrate(WRONG, start, near, seen, fixes, sigma)
    assert len(found.errors_px) == len(expected.errors_px)
    np.testing.assert_allclose(found.camera.K, expected.camera.K, atol=0.01)
