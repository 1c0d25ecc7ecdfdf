"""Axioms of rigid motions, and SciPy's Rotation as the other opinion."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from recon import se3
from recon.types import F64

small = st.floats(-1.7, 1.7, allow_nan=False)
metres = st.floats(-200, 200, allow_nan=False)
rotation_vectors = st.tuples(small, small, small).map(lambda v: np.array(v, np.float64))
twists = st.tuples(small, small, small, metres, metres, metres).map(
    lambda v: np.array(v, np.float64)
)
motions = twists.map(se3.exp)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(
    lambda q: float(np.linalg.norm(q)) > 1e-3
)  # fmt: skip


def matrix(twist: F64) -> F64:
    """(4, 4) element of the Lie algebra."""
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.hat(twist[:3]), twist[3:]
    return out


@given(rotation_vectors)
def test_rotations_agree_with_scipy(w: F64) -> None:
    R = se3.so3_exp(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(se3.so3_log(R), Rotation.from_matrix(R).as_rotvec(), atol=1e-7)


@given(rotation_vectors, rotation_vectors)
def test_rotations_of_many_agree_with_scipy(a: F64, b: F64) -> None:
    w = np.stack([a, b, np.zeros(3), 1e-9 * a, np.array([0.0, np.pi, 0.0])])
    R = se3.each_so3_exp(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-12)
    back = Rotation.from_rotvec(se3.each_so3_log(R)).as_matrix()
    np.testing.assert_allclose(back, R, atol=1e-7)


@given(twists)
def test_the_exponential_is_the_matrix_exponential(twist: F64) -> None:
    np.testing.assert_allclose(se3.exp(twist), scipy.linalg.expm(matrix(twist)), atol=1e-9)


@given(twists)
def test_log_inverts_exp(twist: F64) -> None:
    if np.linalg.norm(twist[:3]) < 3.1:
        np.testing.assert_allclose(se3.log(se3.exp(twist)), twist, atol=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-9, 1e-7, 1.1e-7, 1e-6, 1.1e-6, 1e-4])
def test_small_motions_keep_their_digits(size: float) -> None:
    twist = size * np.array([0.6, -0.8, 0.3, 1.0, 2.0, -0.5])
    np.testing.assert_allclose(se3.exp(twist), scipy.linalg.expm(matrix(twist)), atol=1e-15)
    np.testing.assert_allclose(se3.log(se3.exp(twist)), twist, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize(
    "axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0], [0, 0.6, -0.8]]])
)
@pytest.mark.parametrize("angle", [np.pi - 1e-3, np.pi - 1e-6, np.pi])
def test_half_turns_have_a_logarithm(axis: F64, angle: float) -> None:
    R = Rotation.from_rotvec(axis * angle).as_matrix()
    w = se3.so3_log(R)
    assert np.linalg.norm(w) == pytest.approx(angle, abs=1e-6)
    np.testing.assert_allclose(se3.so3_exp(w), R, atol=1e-7)


@given(motions, motions, motions)
def test_motions_form_a_group(A: F64, B: F64, C: F64) -> None:
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-8)
    np.testing.assert_allclose(A @ se3.inverse(A), np.eye(4), atol=1e-10)
    np.testing.assert_allclose(se3.inverse(A), np.linalg.inv(A), atol=1e-9)
    np.testing.assert_allclose(se3.each_inverse(np.stack([A, B]))[1], se3.inverse(B), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-9)
    np.testing.assert_allclose(A[:3, :3] @ A[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(A[:3, :3]) == pytest.approx(1.0)


@given(motions, twists)
def test_the_adjoint_moves_a_twist_to_the_other_frame(T: F64, twist: F64) -> None:
    moved = T @ se3.exp(0.1 * twist) @ se3.inverse(T)
    np.testing.assert_allclose(se3.exp(se3.adjoint(T) @ (0.1 * twist)), moved, atol=1e-8)


@given(motions, motions)
def test_points_follow_the_product(A: F64, B: F64) -> None:
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 60.0]])
    np.testing.assert_allclose(
        se3.transform(A @ B, points), se3.transform(A, se3.transform(B, points)), atol=1e-8
    )
    homogeneous = np.column_stack([points, np.ones(2)]) @ A.T
    np.testing.assert_allclose(se3.transform(A, points), homogeneous[:, :3], atol=1e-10)


@given(quaternions)
def test_quaternions_agree_with_scipy(q: F64) -> None:
    R = se3.rotation_from_quaternion(q)
    np.testing.assert_allclose(R, Rotation.from_quat(np.roll(q, -1)).as_matrix(), atol=1e-12)
    back = se3.quaternion_from_rotation(R)
    assert back[0] >= 0
    assert abs(back @ q) / np.linalg.norm(q) == pytest.approx(1.0, abs=1e-9)
    each = se3.each_quaternion(np.stack([np.eye(3), R]))
    assert np.abs(each @ np.stack([[1, 0, 0, 0], back]).T).diagonal() == pytest.approx(1.0)


@pytest.mark.parametrize("q", [np.zeros(4), np.full(4, np.nan), np.array([np.inf, 0, 0, 0])])
def test_a_quaternion_without_direction_is_refused(q: F64) -> None:
    with pytest.raises(ValueError, match="direction"):
        se3.rotation_from_quaternion(q)


def test_the_nearest_rotation_is_that_of_scipy_and_never_a_mirror() -> None:
    rng = np.random.default_rng(4)
    for mirror in (1.0, -1.0):
        for _ in range(20):
            a = rng.normal(size=(8, 3))
            b = mirror * a @ Rotation.random(random_state=rng).as_matrix().T
            b += 0.1 * rng.normal(size=a.shape)
            R = se3.nearest_rotation(b.T @ a)
            assert np.linalg.det(R) == pytest.approx(1.0)
            other = Rotation.align_vectors(b, a)[0].as_matrix()
            assert pytest.approx(other, abs=1e-9) == R


def test_the_average_weighs_by_information() -> None:
    rng = np.random.default_rng(0)
    truth = se3.exp(np.array([0.3, -0.2, 1.0, 5.0, 6.0, -7.0]))
    cov_a, cov_b = np.diag([1e-6] * 3 + [1e-2] * 3), np.diag([4e-6] * 3 + [1e-3] * 3)
    errors = []
    for _ in range(300):
        A = se3.exp(rng.multivariate_normal(np.zeros(6), cov_a)) @ truth
        B = se3.exp(rng.multivariate_normal(np.zeros(6), cov_b)) @ truth
        mean, covariance = se3.average(A, cov_a, B, cov_b)
        errors.append(se3.log(mean @ se3.inverse(truth)))
    spread = np.cov(np.array(errors).T)
    oracle = np.linalg.inv(np.linalg.inv(cov_a) + np.linalg.inv(cov_b))
    np.testing.assert_allclose(covariance, oracle, rtol=1e-9)
    np.testing.assert_allclose(np.diag(spread), np.diag(oracle), rtol=0.3)


@given(motions, twists)
def test_the_average_of_equals_is_halfway_and_symmetric(T: F64, twist: F64) -> None:
    other = se3.exp(1e-3 * twist) @ T
    mean, covariance = se3.average(T, np.eye(6), other, np.eye(6))
    np.testing.assert_allclose(mean, se3.exp(0.5e-3 * twist) @ T, atol=1e-7)
    swapped, _ = se3.average(other, np.eye(6), T, np.eye(6))
    np.testing.assert_allclose(mean, swapped, atol=1e-7)
    np.testing.assert_allclose(covariance, np.eye(6) / 2)


def test_the_covariance_of_a_place_is_that_of_perturbed_poses() -> None:
    rng = np.random.default_rng(0)
    T = se3.compose(se3.so3_exp(np.array([0.1, 0.2, 0.3])), np.array([40.0, -10.0, 60.0]))
    A = rng.normal(0, 0.01, (6, 6))
    own = se3.about(T[:3, 3], A @ A.T)
    twists = rng.multivariate_normal(np.zeros(6), A @ A.T, 4000)
    places = np.array([(se3.exp(x) @ T)[:3, 3] for x in twists])
    np.testing.assert_allclose(own[3:, 3:], np.cov(places.T), atol=0.06 * np.trace(own[3:, 3:]))
    np.testing.assert_allclose(se3.about(-T[:3, 3], own), A @ A.T, atol=1e-12)
