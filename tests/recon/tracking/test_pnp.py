"""Camera poses against exact scenes, with and without outliers, far origins and priors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from recon import se3
from recon.camera_model import project, rays
from recon.tracking import pnp
from recon.types import F64, Bool

K = np.array([[930.0, 0, 639.5], [0, 930.0, 359.5], [0, 0, 1.0]])


def average_left_right(left: pnp.PnpResult, right: pnp.PnpResult) -> pnp.PnpResult:
    """The paper's way: the mean of two poses of one image, each by the points of one keyframe.

    When the two disagree by more than their covariances allow, that of the mean grows.
    """
    T, covariance = se3.average(
        left.T_camera_points, left.covariance, right.T_camera_points, right.covariance
    )
    difference = se3.log(right.T_camera_points @ se3.inverse(left.T_camera_points))
    spread = left.covariance + right.covariance
    disagreement = float(difference @ np.linalg.solve(spread, difference)) / 6.0
    return replace(right, T_camera_points=T, covariance=covariance * max(1.0, disagreement))


@dataclass(frozen=True)
class Scene:
    points: F64
    uv: F64
    T: F64  # T_camera_points
    outlier: Bool


def scene(
    seed: int,
    count: int = 600,
    relief_m: float = 12.0,
    noise_px: float = 0.3,
    outliers: float = 0.15,
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """Points 50 m below a camera with any attitude, seen with noise and wild outliers."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([10, 10], [1270, 710], (count, 2))
    depth = 50.0 + relief_m * rng.random(count)
    T = se3.exp(np.concatenate([rng.normal(size=3), rng.normal(size=3) * 20]))
    T = T @ se3.compose(np.eye(3), -np.array(origin_m))
    points = se3.transform(se3.inverse(T), rays(K, uv) * depth[:, None])
    seen = uv + rng.normal(size=uv.shape) * noise_px
    outlier = rng.random(count) < outliers
    seen[outlier] = rng.uniform([0, 0], [1280, 720], (int(outlier.sum()), 2))
    return Scene(points, seen, T, outlier)


def centre(T_camera_points: F64) -> F64:
    return np.asarray(se3.inverse(T_camera_points)[:3, 3])


@pytest.mark.parametrize("relief_m", [12.0, 0.0])
@pytest.mark.parametrize("outliers", [0.0, 0.15, 0.4])
@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), (800.0, -3000.0, 400.0)])
def test_the_camera_is_found_to_centimetres(
    relief_m: float, outliers: float, origin_m: tuple[float, float, float]
) -> None:
    for seed in range(4):
        s = scene(seed, relief_m=relief_m, outliers=outliers, origin_m=origin_m)
        result = pnp.solve(s.points, s.uv, K)
        assert result is not None
        assert np.linalg.norm(centre(result.T_camera_points) - centre(s.T)) < 0.04
        turn = se3.so3_log(result.T_camera_points[:3, :3] @ s.T[:3, :3].T)
        assert np.degrees(np.linalg.norm(turn)) < 0.04
        assert result.inliers[~s.outlier].mean() > 0.99
        assert result.inliers[s.outlier].mean() < 0.02 if s.outlier.any() else True


@settings(max_examples=15)
@given(st.integers(0, 10_000))
def test_without_noise_the_pose_is_exact(seed: int) -> None:
    s = scene(seed, count=80, noise_px=0.0, outliers=0.0)
    result = pnp.solve(s.points, s.uv, K)
    assert result is not None
    np.testing.assert_allclose(result.T_camera_points, s.T, atol=1e-5)
    assert result.inliers.all()


@pytest.mark.parametrize("relief_m", [12.0, 0.0])
def test_reported_covariance_holds(relief_m: float) -> None:
    """Normalised squared errors over many scenes average to their six degrees of freedom."""
    normalised = []
    for seed in range(60):
        s = scene(seed, count=300, relief_m=relief_m)
        result = pnp.solve(s.points, s.uv, K)
        assert result is not None
        error = se3.log(result.T_camera_points @ se3.inverse(s.T))
        normalised.append(error @ np.linalg.solve(result.covariance, error))
    # The mean of 60 chi-squares of 6 degrees has a standard deviation of 0.45.
    assert 4.6 < np.mean(normalised) < 7.8


def test_the_pose_minimises_the_reprojection_error() -> None:
    """SciPy, started at the truth, ends at the same pose."""
    s = scene(3, outliers=0.0)
    result = pnp.solve(s.points, s.uv, K)
    assert result is not None

    def residual(twist: F64) -> F64:
        p = se3.transform(se3.exp(twist) @ s.T, s.points[result.inliers])
        return np.asarray((project(K, p) - s.uv[result.inliers]).ravel())

    best = scipy.optimize.least_squares(residual, np.zeros(6), xtol=1e-14, ftol=1e-14)
    np.testing.assert_allclose(result.T_camera_points, se3.exp(best.x) @ s.T, atol=1e-6)
    jacobian = scipy.optimize.approx_fprime(best.x, residual, 1e-6)
    variance = float(np.sum(best.fun**2)) / (len(best.fun) - 6)
    oracle = np.linalg.inv(jacobian.T @ jacobian) * variance
    np.testing.assert_allclose(
        np.sqrt(np.diag(result.covariance)), np.sqrt(np.diag(oracle)), rtol=0.02
    )


def test_the_refinement_is_no_worse_than_opencvs_epnp() -> None:
    ours, theirs = [], []
    for seed in range(10):
        s = scene(seed, outliers=0.0)
        result = pnp.solve(s.points, s.uv, K)
        assert result is not None
        _, rvec, tvec = cv2.solvePnP(s.points, s.uv, K, None, flags=cv2.SOLVEPNP_EPNP)
        R = np.asarray(cv2.Rodrigues(rvec)[0], np.float64)
        T = se3.compose(R, np.asarray(tvec, np.float64).ravel())
        ours.append(np.linalg.norm(centre(result.T_camera_points) - centre(s.T)))
        theirs.append(np.linalg.norm(centre(T) - centre(s.T)))
    assert np.mean(ours) <= np.mean(theirs)


def test_a_prior_helps_where_outliers_win_the_draw() -> None:
    """With two wrong matches in three a random draw seldom holds; a good prior still does."""
    found = 0
    for seed in range(6):
        s = scene(seed, outliers=0.65)
        prior = se3.exp(np.array([0.0005, -0.0004, 0.0006, 0.01, 0.02, -0.02])) @ s.T
        result = pnp.solve(s.points, s.uv, K, prior)
        if result is not None:
            found += 1
            assert np.linalg.norm(centre(result.T_camera_points) - centre(s.T)) < 0.06
    assert found == 6


@pytest.mark.parametrize("relief_m", [12.0, 0.0])
def test_a_near_prior_gives_the_same_pose_without_drawing(relief_m: float) -> None:
    for seed in range(6):
        s = scene(seed, relief_m=relief_m, outliers=0.2)
        prior = se3.exp(np.array([0.001, -0.001, 0.002, 0.05, 0.04, -0.1])) @ s.T
        drawn, near = pnp.solve(s.points, s.uv, K), pnp.solve(s.points, s.uv, K, prior)
        assert drawn is not None and near is not None
        np.testing.assert_allclose(near.T_camera_points, drawn.T_camera_points, atol=2e-3)
        assert np.mean(near.inliers == drawn.inliers) > 0.99


def test_a_wrong_prior_does_no_harm() -> None:
    s = scene(5)
    prior = se3.exp(np.array([0.3, -0.4, 1.0, 30.0, 2.0, -9.0])) @ s.T
    result = pnp.solve(s.points, s.uv, K, prior)
    assert result is not None
    assert np.linalg.norm(centre(result.T_camera_points) - centre(s.T)) < 0.04


def test_a_thin_consensus_against_the_prior_is_rejected() -> None:
    """Four matches in ten agree on a pose turned away from what telemetry says."""
    s = scene(7, outliers=0.6)
    prior = se3.exp(np.array([0.0, 0.0, 1.2, 0.0, 0.0, 0.0])) @ s.T
    assert pnp.solve(s.points, s.uv, K) is not None
    assert pnp.solve(s.points, s.uv, K, prior) is None


def test_no_pose_is_invented() -> None:
    rng = np.random.default_rng(0)
    s = scene(1)
    assert pnp.solve(s.points, rng.uniform(0, 700, s.uv.shape), K) is None
    assert pnp.solve(s.points[:10], s.uv[:10], K) is None
    assert pnp.solve(np.zeros((0, 3)), np.zeros((0, 2)), K) is None
    assert pnp.solve(np.full((50, 3), np.nan), np.zeros((50, 2)), K) is None
    line = np.column_stack([np.linspace(-20, 20, 100), np.zeros(100), np.full(100, 50.0)])
    assert pnp.solve(line, project(K, line), K) is None
    one = np.tile([[1.0, 2.0, 50.0]], (100, 1))
    assert pnp.solve(one, project(K, one), K) is None


def test_points_that_are_not_finite_are_outliers() -> None:
    s = scene(2, outliers=0.0)
    s.points[5], s.uv[9] = np.nan, np.inf
    result = pnp.solve(s.points, s.uv, K)
    assert result is not None
    assert not result.inliers[5] and not result.inliers[9]
    assert np.mean(result.inliers) > 0.97


def test_the_average_of_left_and_right_is_better_than_either() -> None:
    rng = np.random.default_rng(4)
    left_error, right_error, mean_error, normalised = [], [], [], []
    for seed in range(40):
        s = scene(seed, count=200, outliers=0.0)
        T_left_right = se3.exp(np.array([0.01, 0.02, -0.03, 4.0, 0.1, -0.2]))
        T_right = se3.inverse(T_left_right) @ s.T
        seen = project(K, se3.transform(T_right, s.points))
        left = pnp.solve(s.points, s.uv, K)
        right = pnp.solve(s.points, seen + rng.normal(size=seen.shape) * 0.3, K)
        assert left is not None and right is not None
        A = se3.adjoint(T_left_right)
        moved = replace(
            right, T_camera_points=T_left_right @ right.T_camera_points,
            covariance=A @ right.covariance @ A.T,
        )  # fmt: skip
        mean = average_left_right(left, moved)
        left_error.append(np.linalg.norm(centre(left.T_camera_points) - centre(s.T)))
        right_error.append(
            np.linalg.norm(centre(T_left_right @ right.T_camera_points) - centre(s.T))
        )
        mean_error.append(np.linalg.norm(centre(mean.T_camera_points) - centre(s.T)))
        error = se3.log(mean.T_camera_points @ se3.inverse(s.T))
        normalised.append(error @ np.linalg.solve(mean.covariance, error))
    assert np.mean(mean_error) < 0.85 * min(np.mean(left_error), np.mean(right_error))
    assert 3.5 < np.mean(normalised) < 8.0


def test_a_left_and_right_that_disagree_say_so() -> None:
    s = scene(1)
    left = pnp.solve(s.points, s.uv, K)
    assert left is not None
    wrong = se3.compose(np.eye(3), np.array([0.5, 0.0, 0.0]))
    agreed = average_left_right(left, left)
    np.testing.assert_allclose(agreed.covariance, 0.5 * left.covariance, rtol=1e-6)
    off = replace(left, T_camera_points=wrong @ left.T_camera_points)
    torn = average_left_right(left, off)
    assert np.trace(torn.covariance) > 50 * np.trace(agreed.covariance)
    unsure = average_left_right(left, replace(off, covariance=off.covariance + np.eye(6)))
    assert np.trace(unsure.covariance) < 1.1 * np.trace(left.covariance)


@pytest.mark.slow
def test_one_pose_of_both_keyframes_points_is_as_good_as_the_papers_average() -> None:
    apart, together, differ = [], [], []
    for seed in range(30):
        s = scene(seed, count=300, outliers=0.1)
        prior = se3.exp(np.array([0.001, -0.001, 0.002, 0.05, 0.04, -0.1])) @ s.T
        both = pnp.solve(s.points, s.uv, K, prior)
        halves = [pnp.solve(s.points[i::2], s.uv[i::2], K, prior) for i in range(2)]
        assert both is not None and halves[0] is not None and halves[1] is not None
        mean = average_left_right(halves[0], halves[1])
        apart.append(np.linalg.norm(centre(mean.T_camera_points) - centre(s.T)))
        together.append(np.linalg.norm(centre(both.T_camera_points) - centre(s.T)))
        error = se3.log(both.T_camera_points @ se3.inverse(mean.T_camera_points))
        differ.append(error @ np.linalg.solve(both.covariance, error))
    assert np.mean(together) < 1.02 * np.mean(apart)
    assert np.mean(differ) < 1.0, "they differ by less than either is sure of"
