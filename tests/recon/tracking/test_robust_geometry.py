"""Measured points that determine no pose give None; points that do give the exact pose."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paths import ROOT

from recon import se3
from recon.camera_model import project, rays
from recon.tracking import pnp, prediction, robust_geometry, two_view
from recon.types import F64

K = np.array([[930.0, 0, 639.5], [0, 930.0, 359.5], [0, 0, 1.0]])

DEGENERATE = ("coincident", "collinear", "few", "nan", "infinite", "huge", "none", "zero")


def degenerate(kind: str, columns: int, count: int, seed: int) -> F64:
    """(N, columns) points that determine no pose."""
    rng = np.random.default_rng(seed)
    middle = np.r_[640.0, 360.0, 60.0][:columns] + rng.normal(size=columns)
    cloud: F64 = middle + 100.0 * rng.normal(size=(count, columns))
    if kind == "coincident":
        return np.tile(middle, (count, 1))
    if kind == "collinear":
        return np.asarray(middle + rng.normal(size=(count, 1)) * rng.normal(size=columns) * 50.0)
    if kind == "few":
        return cloud[: int(rng.integers(1, 4))]
    if kind in ("nan", "infinite"):
        cloud[rng.integers(count)] = np.nan if kind == "nan" else np.inf
        return cloud
    if kind == "huge":
        cloud[rng.integers(count)] *= 1e304
        return cloud
    return np.zeros((0 if kind == "none" else count, columns))


def good(columns: int, count: int, seed: int) -> F64:
    rng = np.random.default_rng(seed)
    low, high = np.r_[10.0, 10.0, 50.0][:columns], np.r_[1270.0, 710.0, 62.0][:columns]
    return rng.uniform(low, high, (count, columns))


def pixel_solvers(a: F64, b: F64) -> list[Callable[[], object]]:
    return [
        lambda: robust_geometry.relative_pose(a, b, K),
        lambda: robust_geometry.homography(a, b, 3.0),
        lambda: robust_geometry.affine(a, b, 8.0),
        lambda: robust_geometry.affine(a, b, 8.0, is_similarity=True),
        lambda: two_view.solve(a, b, K, None, np.pi, np.array([0.0, 0.0, -1.0])),
        lambda: two_view.solve(a, b, K, np.eye(3), 0.12, np.array([0.0, 0.0, -1.0])),
    ]


def point_solvers(points: F64, uv: F64) -> list[Callable[[], object]]:
    start = se3.compose(np.eye(3), np.array([0.0, 0.0, 50.0]))
    return [
        lambda: robust_geometry.pose_from_points(points, uv, K, cv2.SOLVEPNP_EPNP),
        lambda: robust_geometry.pose_from_points(points, uv, K, cv2.SOLVEPNP_SQPNP),
        lambda: robust_geometry.consensus_pose(points, uv, K, 2.0, 200, 0.9999),
        lambda: pnp.solve(points, uv, K, start),
    ]


kinds = st.sampled_from(DEGENERATE)
counts = st.integers(4, 60)
seeds = st.integers(0, 2**31)


@settings(max_examples=150)
@given(kind=kinds, count=counts, seed=seeds, second=st.booleans(), both=st.booleans())
def test_matches_that_determine_no_motion_give_none(
    kind: str, count: int, seed: int, second: bool, both: bool
) -> None:
    bad = degenerate(kind, 2, count, seed)
    other = degenerate(kind, 2, count, seed + 1)[: len(bad)] if both else good(2, len(bad), seed)
    bad = bad[: len(other)]
    a, b = (other, bad) if second else (bad, other)
    for number, solve in enumerate(pixel_solvers(a, b)):
        result = solve()
        gives_affine_map = kind == "few" and len(a) == 3 and number in (2, 3)
        assert result is None or gives_affine_map


@settings(max_examples=150)
@given(kind=kinds, count=counts, seed=seeds, pixels=st.booleans())
def test_points_that_determine_no_pose_give_none(
    kind: str, count: int, seed: int, pixels: bool
) -> None:
    points, uv = good(3, count, seed), good(2, count, seed)
    if pixels:
        uv = degenerate(kind, 2, count, seed)
    else:
        points = degenerate(kind, 3, count, seed)
    count = min(len(points), len(uv))
    for solve in point_solvers(points[:count], uv[:count])[: 3 if kind == "few" else 4]:
        assert solve() is None


@settings(max_examples=80)
@given(kind=kinds, seed=seeds, share=st.floats(0.2, 1.0), in_points=st.booleans())
@pytest.mark.slow
def test_a_pose_from_partly_degenerate_points_never_raises(
    kind: str, seed: int, share: float, in_points: bool
) -> None:
    count = 40
    points, uv = good(3, count, seed), good(2, count, seed + 1)
    target = points if in_points else uv
    bad = degenerate(kind, target.shape[1], int(share * count), seed)
    target[: len(bad)] = bad
    found = pnp.solve(points, uv, K, prior_T_camera_points=np.eye(4))
    assert found is None or np.isfinite(found.T_camera_points).all()
    for solve in point_solvers(points, uv) + pixel_solvers(uv, uv[::-1].copy()):
        solve()


def test_exact_views_give_the_exact_motion() -> None:
    rng = np.random.default_rng(3)
    T_b_a = se3.exp(np.array([0.02, -0.03, 0.1, 6.0, 1.0, 0.5]))
    uv_a = rng.uniform([10, 10], [1270, 710], (200, 2))
    points = rays(K, uv_a) * rng.uniform(50, 62, (200, 1))
    uv_b = project(K, se3.transform(T_b_a, points))
    found = robust_geometry.relative_pose(uv_a, uv_b, K)
    assert found is not None
    np.testing.assert_allclose(found[0], T_b_a[:3, :3], atol=1e-3)
    np.testing.assert_allclose(found[1], T_b_a[:3, 3] / np.linalg.norm(T_b_a[:3, 3]), atol=1e-2)
    assert found[2] > 190
    for flags in (cv2.SOLVEPNP_EPNP, cv2.SOLVEPNP_SQPNP):
        pose = robust_geometry.pose_from_points(points, uv_b, K, flags)
        assert pose is not None
        np.testing.assert_allclose(pose, T_b_a, atol=1e-4)
    pose = robust_geometry.consensus_pose(points, uv_b, K, 2.0, 200, 0.9999)
    assert pose is not None
    np.testing.assert_allclose(pose, T_b_a, atol=1e-3)


def test_a_plane_gives_its_homography_and_motion() -> None:
    rng = np.random.default_rng(4)
    R, t, normal = se3.so3_exp(np.array([0.02, -0.03, 0.1])), np.array([6.0, 1.0, 0.5]), 1 / 55.0
    exact = K @ (R + np.outer(t, [0.0, 0.0, normal])) @ np.linalg.inv(K)
    uv_a = rng.uniform([10, 10], [1270, 710], (200, 2))
    there = np.c_[uv_a, np.ones(200)] @ exact.T
    uv_b = there[:, :2] / there[:, 2:]
    uv_b[:20] = rng.uniform([10, 10], [1270, 710], (20, 2))
    found = robust_geometry.homography(uv_a, uv_b, 3.0)
    assert found is not None
    H, inliers = found
    np.testing.assert_allclose(H / H[2, 2], exact / exact[2, 2], rtol=1e-3, atol=1e-4)
    assert inliers[20:].all() and inliers[:20].sum() < 4
    motions = robust_geometry.homography_motions(H, K)
    assert any(np.allclose(m[0], R, atol=1e-3) and np.allclose(m[1], t * normal, atol=1e-3)
               for m in motions)  # fmt: skip


def test_affine_maps_are_exact_in_spite_of_outliers() -> None:
    rng = np.random.default_rng(5)
    a = rng.uniform([10, 10], [1270, 710], (100, 2))
    turn = np.array([[0.9, -0.2, 14.0], [0.2, 0.9, -3.0]])
    b = a @ turn[:, :2].T + turn[:, 2]
    b[:15] += 300.0
    for is_similarity in (False, True):
        A = robust_geometry.affine(a, b, 2.0, is_similarity)
        assert A is not None
        np.testing.assert_allclose(A, turn, atol=1e-3)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("far", [0.0, 1e4, 1e6])
def test_a_plane_is_distinguished_from_a_line_at_any_scale_and_place(
    scale: float, far: float
) -> None:
    rng = np.random.default_rng(6)
    plane = scale * (rng.normal(size=(50, 2)) @ rng.normal(size=(2, 3)) + far)
    line = scale * (rng.normal(size=(50, 1)) * rng.normal(size=3) + far)
    assert robust_geometry.span_a_plane(plane)
    assert not robust_geometry.span_a_plane(line)
    assert not robust_geometry.span_a_plane(plane, line)


def test_no_other_module_calls_opencv_on_measured_points() -> None:
    calls = ("solvePnP", "findEssentialMat", "recoverPose", "findHomography", "estimateAffine",
             "decomposeHomography", "phaseCorrelate", "findTransformECC",
             "findFundamentalMat")  # fmt: skip
    offenders = [
        f"{path.relative_to(ROOT)}: {call}"
        for package in ("recon", "service", "mavlink")
        for path in (ROOT / package).rglob("*.py")
        for call in calls
        if f"cv2.{call}" in path.read_text(encoding="utf-8")
    ]
    allowed = ("recon/tracking/robust_geometry.py", "service/bench/tracking.py")
    assert [o for o in offenders if not o.startswith(allowed)] == []


def test_corners_on_a_line_give_no_motion_instead_of_a_fault() -> None:
    line = degenerate("collinear", 2, 40, 7)
    assert prediction.base_to_height(line, line, K, None) == 0.0
    assert robust_geometry.affine(line, line, 8.0) is None


@pytest.mark.parametrize(("near", "expected"), [(0.3, 0.1), (1.0, 0.1), (0.05, 0.0)])
def test_motion_counts_where_near_ground_shows_it(near: float, expected: float) -> None:
    """Of matches ahead most are far; a few wrong ones are not near ground."""
    K = np.array([[400.0, 0, 320], [0, 400.0, 180], [0, 0, 1]])
    R = se3.so3_exp(np.array([0.02, -0.03, 0.01]))
    uv = np.random.default_rng(0).uniform([0, 0], [640, 360], (200, 2))
    ray = rays(K, uv) @ R.T
    ray /= ray[:, 2:]
    ray[: int(near * 200), 1] += 0.1
    assert prediction.base_to_height(uv, project(K, ray), K, R) == pytest.approx(expected, abs=1e-6)
