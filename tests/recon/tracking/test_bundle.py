"""Bundle adjustment and triangulation against exact synthetic geometry."""

from __future__ import annotations

import numpy as np
import scipy.optimize

from recon import se3
from recon.tracking import bundle
from recon.types import F64, I64

K = np.array([[1000.0, 0, 640], [0, 1000.0, 360], [0, 0, 1]])


def flight(seed: int, cameras: int = 6, points: int = 400) -> tuple[F64, F64, I64, I64, F64]:
    """Poses (C, 4, 4), points, and the observations: camera, point and pixel."""
    rng = np.random.default_rng(seed)
    X = np.c_[rng.uniform(-60, 60, (points, 2)), rng.uniform(0, 10, points)]
    poses = []
    for i in range(cameras):
        R = se3.so3_exp(rng.normal(0, 0.05, 3)) @ np.diag([1.0, -1, -1])
        centre = np.array([i * 6.0 - 15, 0, 60.0]) + rng.normal(0, 0.3, 3)
        poses.append(se3.compose(R, -R @ centre))
    cam, pt, uv = [], [], []
    for c, T in enumerate(poses):
        P = se3.transform(T, X)
        pixel = P[:, :2] / P[:, 2:] * 1000 + [640, 360]
        for n in np.flatnonzero(np.all((pixel > 0) & (pixel < [1280, 720]), axis=1)):
            cam.append(c)
            pt.append(n)
            uv.append(pixel[n])
    ids, index = np.unique(pt, return_inverse=True)
    return np.stack(poses), X[ids], np.array(cam, np.int64), index.astype(np.int64), np.array(uv)


def disturbed(T: F64, rng: np.random.Generator) -> F64:
    out = T.copy()
    for c in range(2, len(T)):
        out[c] = se3.exp(np.r_[rng.normal(0, 0.01, 3), rng.normal(0, 0.5, 3)]) @ T[c]
    return np.asarray(out)


def test_exact_pixels_bring_the_poses_back() -> None:
    T, X, cam, pt, uv = flight(0)
    rng = np.random.default_rng(1)
    free = np.arange(len(T)) >= 2
    start = X + rng.normal(0, 1.0, X.shape)
    result = bundle.adjust(disturbed(T, rng), start, cam, pt, uv, K, free, iterations=40)
    np.testing.assert_allclose(result.T_camera_world, T, atol=1e-4)
    assert np.median(result.residual_px) < 1e-3


def test_the_least_squared_error_is_found_whatever_the_order() -> None:
    """SciPy's answer, with fixed cameras between free ones and points seen twice by a camera."""
    T, X, cam, pt, uv = flight(3, cameras=5, points=60)
    rng = np.random.default_rng(3)
    often = np.flatnonzero(np.bincount(pt) >= 3)
    kept = np.isin(pt, often)
    X, cam, pt, uv = X[often], cam[kept], np.searchsorted(often, pt[kept]), uv[kept]
    twice = rng.choice(len(cam), 15, replace=False)
    cam, pt = (np.concatenate([a, a[twice]]) for a in (cam, pt))
    uv = np.vstack([uv, uv[twice]]) + rng.normal(0, 0.5, (len(cam), 2))
    mixed = rng.permutation(len(cam))
    cam, pt, uv = cam[mixed], pt[mixed], uv[mixed]
    free = np.array([False, True, False, True, True])
    found = bundle.adjust(T, X, cam, pt, uv, K, free, huber_px=1e6, iterations=60)

    def residual(x: F64) -> F64:
        poses, moved = T.copy(), X + x[18:].reshape(-1, 3)
        for c, twist in zip(np.flatnonzero(free), x[:18].reshape(3, 6), strict=True):
            poses[c] = se3.exp(twist) @ T[c]
        P = np.einsum("nij,nj->ni", poses[cam][:, :3, :3], moved[pt]) + poses[cam][:, :3, 3]
        return np.asarray((P[:, :2] / P[:, 2:] * 1000 + [640, 360] - uv).ravel())

    best = scipy.optimize.least_squares(residual, np.zeros(18 + X.size), xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose(np.sum(found.residual_px**2), 2 * best.cost, rtol=1e-5)
    inverse = np.linalg.inv(best.jac.T @ best.jac)[:18, :18]
    for block, c in enumerate(np.flatnonzero(free)):
        part = inverse[6 * block : 6 * block + 6, 6 * block : 6 * block + 6]
        np.testing.assert_allclose(np.diag(found.joint[c, c]), 0.3**2 * np.diag(part), rtol=2e-2)


def test_outliers_hardly_move_the_poses() -> None:
    T, X, cam, pt, uv = flight(2)
    rng = np.random.default_rng(3)
    noisy = uv + rng.normal(0, 0.3, uv.shape)
    wrong = rng.random(len(uv)) < 0.05
    noisy[wrong] += rng.uniform(-60, 60, (int(wrong.sum()), 2))
    free = np.arange(len(T)) >= 2
    result = bundle.adjust(disturbed(T, rng), X, cam, pt, noisy, K, free, iterations=30)
    for c in range(2, len(T)):
        a, b = se3.inverse(result.T_camera_world[c]), se3.inverse(T[c])
        assert np.linalg.norm(a[:3, 3] - b[:3, 3]) < 0.15


def test_covariance_covers_the_errors() -> None:
    """Normalised squared errors of the last pose over many seeds have the right mean (6)."""
    squared = []
    for seed in range(30):
        T, X, cam, pt, uv = flight(seed, cameras=4, points=250)
        rng = np.random.default_rng(100 + seed)
        noisy = uv + rng.normal(0, 0.3, uv.shape)
        free = np.arange(len(T)) >= 2
        result = bundle.adjust(
            T, X, cam, pt, noisy, K, free, huber_px=10.0, sigma_px=0.3, iterations=20
        )
        error = se3.log(result.T_camera_world[-1] @ se3.inverse(T[-1]))
        squared.append(error @ np.linalg.solve(result.joint[-1, -1], error))
    assert 3.5 < np.mean(squared) < 9.5


def test_the_motion_between_two_views_is_known_better_than_their_poses() -> None:
    """Normalised squared errors of the last motion have the right mean (6), noise by residuals."""
    squared, sharper = [], []
    for seed in range(30):
        T, X, cam, pt, uv = flight(seed, cameras=7, points=150)
        noisy = uv + np.random.default_rng(200 + seed).normal(0, 0.1, uv.shape)
        free = np.arange(len(T)) >= 2
        found = bundle.adjust(
            T, X, cam, pt, noisy, K, free, huber_px=10.0, sigma_px=None, iterations=20
        )
        before, last = found.T_camera_world[-2:]
        error = se3.log((last @ se3.inverse(before)) @ se3.inverse(T[-1] @ se3.inverse(T[-2])))
        covariance = found.step_covariance(5, 6)
        squared.append(error @ np.linalg.solve(covariance, error))
        sharper.append(np.trace(covariance[3:, 3:]) / np.trace(found.joint[-1, -1][3:, 3:]))
    assert 3.5 < np.mean(squared) < 9.5
    assert np.median(sharper) < 0.8
    np.testing.assert_allclose(found.step_covariance(1, 2), found.joint[2, 2])  # 1 is fixed


def test_pixels_that_move_together_are_in_the_covariance_of_a_motion() -> None:
    """Normalised squared errors of the last motion have about the right mean (6) where blocks of
    80 pixels of each image move together, as an encoder predicts them."""
    squared = []
    for seed in range(20):
        T, X, cam, pt, uv = flight(seed, cameras=5, points=2000)
        rng = np.random.default_rng(200 + seed)
        shift, block = rng.normal(0, 0.1, (5, 16, 9, 2)), uv.astype(int) // 80
        noisy = uv + shift[cam, block[:, 0], block[:, 1]] + rng.normal(0, 0.05, uv.shape)
        free = np.arange(len(T)) >= 2
        found = bundle.adjust(T, X, cam, pt, noisy, K, free, sigma_px=None)
        before, last = found.T_camera_world[-2:]
        error = se3.log((last @ se3.inverse(before)) @ se3.inverse(T[-1] @ se3.inverse(T[-2])))
        squared.append(error @ np.linalg.solve(found.step_covariance(3, 4), error))
    assert 3.5 < np.mean(squared) < 12.0


def test_fixed_cameras_stay() -> None:
    T, X, cam, pt, uv = flight(4)
    free = np.array([False, False, True, False, True, True])
    result = bundle.adjust(T, X, cam, pt, uv + 0.2, K, free)
    np.testing.assert_array_equal(result.T_camera_world[~free], T[~free])
    assert not result.joint[~free].any()


def test_triangulation_finds_points_and_refuses_those_behind() -> None:
    T, X, _, _, _ = flight(6)
    a, b = T[0], T[3]

    def pixels(pose: F64, points: F64) -> F64:
        P = se3.transform(pose, points)
        return np.asarray(P[:, :2] / P[:, 2:] * 1000 + [640, 360])

    points, angle, error = bundle.triangulate(a, b, K, pixels(a, X), pixels(b, X))
    np.testing.assert_allclose(points, X, atol=1e-6)
    assert (angle > 0.05).all() and error.max() < 1e-6
    off_line = pixels(b, X) + np.array([0.0, 4.0])  # as far from both images, across the baseline
    _, _, error = bundle.triangulate(a, b, K, pixels(a, X), off_line)
    assert ((error > 1.0) & (error < 4.0)).all()
    behind, _, off = bundle.triangulate(a, b, K, pixels(b, X), pixels(a, X))
    assert np.isnan(behind).any() and np.isinf(off[np.isnan(behind[:, 0])]).all()
