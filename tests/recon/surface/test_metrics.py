"""Metrics against closed forms: known offsets, known motions, known holes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from recon import se3
from recon.surface import metrics, triangle_grid
from recon.surface.metrics import Fit
from recon.surface.triangle_grid import TriangleGrid
from recon.types import F64


def relief() -> TriangleGrid:
    """Waves with a box on top: a surface that fixes all seven degrees of freedom."""
    n = 81
    x, y = np.meshgrid(np.linspace(-20, 20, n), np.linspace(-20, 20, n))
    z = 1.5 * np.sin(x / 4) * np.cos(y / 5) + 3.0 * ((abs(x) < 4) & (abs(y - 3) < 5))
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    return triangle_grid.build(np.stack([x, y, z], axis=-1).reshape(-1, 3), triangles)


def plane() -> TriangleGrid:
    vertices = np.array([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], dtype=float)
    return triangle_grid.build(vertices, np.array([[0, 1, 2], [0, 2, 3]]), 10.0)


def line_of_poses(count: int = 40) -> F64:
    """A dead straight flight, looking down, wobbling."""
    rng = np.random.default_rng(3)
    out = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        out[k, :3, :3] = np.diag([1.0, -1.0, -1.0]) @ se3.so3_exp(0.02 * rng.normal(size=3))
        out[k, :3, 3] = 2.5 * k, 0.0, 60.0
    return out


def moved(poses: F64, fit: Fit) -> F64:
    """The scan's poses that ``fit`` would bring onto ``poses``."""
    inverse = Fit(1 / fit.scale, fit.R.T, -fit.R.T @ fit.t / fit.scale)
    return inverse.poses(poses)


TRUE_FIT = Fit(1.3, se3.so3_exp(np.array([0.2, -0.4, 0.9])), np.array([5.0, -7.0, 2.0]))


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_straight_flight_is_aligned_exactly(scale: float) -> None:
    truth = line_of_poses()
    want = Fit(scale, TRUE_FIT.R, TRUE_FIT.t)
    scan = moved(truth, want)
    fit = metrics.fit_trajectory(scan, truth, with_scale=scale != 1.0)
    np.testing.assert_allclose(fit.scale, scale, rtol=1e-9)
    np.testing.assert_allclose(fit.R, want.R, atol=1e-9)
    np.testing.assert_allclose(fit.t, want.t, atol=1e-6)
    errors = metrics.trajectory_errors(fit.poses(scan), truth)
    assert errors.rms_m < 1e-6 and errors.median_deg < 1e-5 and errors.drift_percent < 1e-6


def test_trajectory_errors_of_a_known_drift() -> None:
    truth = line_of_poses(101)
    scan = truth.copy()
    scan[:, 1, 3] += np.linspace(0, 5, 101)  # 5 m over 250 m
    scan[:, :3, :3] = scan[:, :3, :3] @ se3.so3_exp(np.radians([0.0, 0.0, 2.0]))
    errors = metrics.trajectory_errors(scan, truth)
    assert errors.max_m == pytest.approx(5.0)
    assert errors.median_m == pytest.approx(2.5)
    assert errors.rms_m == pytest.approx(np.sqrt(np.mean(np.linspace(0, 5, 101) ** 2)))
    assert errors.drift_percent == pytest.approx(2.0)
    assert errors.median_deg == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_surface_fit_finds_the_motion(with_scale: bool, seed: int) -> None:
    surface = relief()
    rng = np.random.default_rng(seed)
    on, _ = metrics.sample_surface(surface, 0.5, seed)
    on = on[(np.abs(on[:, :2]) < 16).all(axis=1)]
    noisy = on + 0.05 * rng.normal(size=on.shape)
    noisy[::20] += rng.uniform(-4, 4, (len(noisy[::20]), 3))  # outliers
    scale = 1.03 if with_scale else 1.0
    want = Fit(scale, se3.so3_exp(0.03 * rng.normal(size=3)), rng.uniform(-0.8, 0.8, 3))
    scan = (noisy - want.t) @ want.R / want.scale
    fit = metrics.fit_surface(scan, surface, Fit.identity(), with_scale)
    gap = np.linalg.norm(fit.points(scan) - noisy, axis=1)
    assert np.median(gap) < 0.02
    assert fit.scale == pytest.approx(scale, abs=2e-3)


def test_noise_of_points_does_not_shrink_the_surface() -> None:
    """Half a metre of scatter would take 4 % off the scale."""
    surface, rng = relief(), np.random.default_rng(4)
    places, normals = metrics.sample_surface(surface, 0.3)
    scan = places + normals * rng.normal(0.0, 0.5, (len(places), 1))
    fit = metrics.fit_surface(scan, surface, Fit.identity(), with_scale=True)
    assert fit.scale == pytest.approx(1.0, abs=0.003)


def test_surface_errors_of_a_known_offset() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-40, 40, (4000, 2)), 0.2 + 0.1 * rng.normal(size=4000)])
    points[:400, 2] = 30.0  # a tenth far above
    distance, signed = metrics.distances(points, plane(), 5.0)
    errors = metrics.surface_errors(distance, signed, 5.0)
    assert errors.far_share == pytest.approx(0.1)
    assert errors.bias_m == pytest.approx(0.2, abs=0.01)
    near = np.abs(points[400:, 2])
    assert errors.rms_m == pytest.approx(np.sqrt((near**2).sum() / 4000 + 0.1 * 25), rel=1e-9)
    assert errors.share_25cm == pytest.approx((near < 0.25).sum() / 4000)
    below = metrics.surface_errors(*metrics.distances(points * [1, 1, -1], plane(), 5.0), 5.0)
    assert below.bias_m == pytest.approx(-errors.bias_m)


def test_honesty_of_gaussian_errors_and_of_boasts() -> None:
    error = np.abs(np.random.default_rng(0).normal(size=20000))
    fair = metrics.honesty(0.3 * error, np.full(20000, 0.3, np.float32))
    boast = metrics.honesty(0.3 * error, np.full(20000, 0.1, np.float32))
    assert fair is not None and boast is not None
    assert fair.within_1_sigma == pytest.approx(0.683, abs=0.01)
    assert fair.within_2_sigma == pytest.approx(0.954, abs=0.01)
    assert boast.within_1_sigma < 0.3
    assert metrics.honesty(error, np.full(20000, np.nan)) is None


def test_samples_are_even_by_area() -> None:
    points, normals = metrics.sample_surface(plane(), 0.5)
    assert len(points) == 40000
    assert (normals == [0, 0, 1]).all()
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=4, range=[[-50, 50]] * 2)
    assert counts.min() > 0.85 * 2500 and counts.max() < 1.15 * 2500


def test_seen_respects_image_occlusion_and_angle() -> None:
    ground = np.array([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], dtype=float)
    roof = np.array([[-2, -2, 5], [2, -2, 5], [2, 2, 5], [-2, 2, 5]], dtype=float)
    quads = np.array([[0, 1, 2], [0, 2, 3]])
    surface = triangle_grid.build(np.vstack([ground, roof]), np.vstack([quads, quads + 4]), 5.0)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), [0, 0, 20]
    K = np.array([[100.0, 0, 99.5], [0, 100, 99.5], [0, 0, 1]])
    x = np.array([0.0, 2.5, 2.6, 2.7, 5.0, 19.5, 20.5])
    points = np.column_stack([x, np.zeros(7), np.zeros(7)])
    up = np.tile([0.0, 0.0, 1.0], (7, 1))
    seen = metrics.seen_from(points, up, surface, T, K, np.array([200, 200]))
    # Shadow of the roof's edge at 2 * 20 / 15 = 2.67 m; image border at 99.5 px = 19.9 m.
    assert seen.tolist() == [False, False, False, True, True, True, False]
    wall = np.tile([-1.0, 0.0, 0.0], (7, 1))
    assert not metrics.seen_from(points[3:5], wall[3:5], surface, T, K, np.array([200, 200])).any()


def test_coverage_counts_holes() -> None:
    samples, _ = metrics.sample_surface(plane(), 1.0)
    cloud = np.random.default_rng(0).uniform([-50, -50, -0.1], [0, 50, 0.1], (60000, 3))
    covered = metrics.share_covered(samples, cloud, 0.5)
    assert covered[samples[:, 0] < -0.5].mean() > 0.99
    assert covered[samples[:, 0] > 0.6].max() == 0.0
    assert metrics.share_covered(samples, np.zeros((0, 3)), 0.5).sum() == 0.0


def test_interpolation_agrees_with_scipy_and_knows_its_limits() -> None:
    poses = line_of_poses(10)
    times = np.array([0, 1, 2, 3, 4, 25, 26, 27, 28, 29.0])  # with a gap
    at = np.array([-0.5, 0.0, 2.25, 4.5, 10.0, 26.75, 29.0, 29.5])
    out, known = metrics.poses_at(times, poses, at)
    assert known.tolist() == [False, True, True, False, False, True, True, False]
    slerp = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))
    np.testing.assert_allclose(out[known, :3, :3], slerp(at[known]).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(out[2, :3, 3], [2.5 * 2.25, 0, 60])


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="no points"):
        metrics.surface_errors(np.zeros(0), np.zeros(0), 5.0)
