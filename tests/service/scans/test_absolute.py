"""Sigma of heights in the world: over many flights as many lie within it as should."""

from __future__ import annotations

import numpy as np
import pytest

from service.scans.trust import SharedSigma
from service.stream.records import PoseRecord

FLIGHTS, AGL_M = 2000, 40.0


def pose(number: int, sigma_m: float) -> PoseRecord:
    """One of a straight track 40 m up, of a known sigma."""
    T = np.eye(4)
    T[:3, 3] = 5.0 * number, 0.0, AGL_M
    covariance = np.zeros((6, 6))
    covariance[5, 5] = sigma_m**2
    return PoseRecord(number, T, covariance)


def test_heights_lie_within_the_absolute_sigma_as_often_as_it_says() -> None:
    """One draw of height and scale moves all points of a flight; each has noise of its own."""
    rng = np.random.default_rng(0)
    own, place, share = 0.05, 0.3, 0.01
    shared = SharedSigma([pose(n, place) for n in range(20)], share)
    points = np.column_stack([rng.uniform(0.0, 95.0, (50, 2)), rng.uniform(0.0, 5.0, 50)])
    sigma_m = shared.absolute_m(np.full(50, own, np.float32), points)
    assert sigma_m.dtype == np.float32
    off = rng.normal(0.0, place, (FLIGHTS, 1))
    off = off + rng.normal(0.0, share, (FLIGHTS, 1)) * (AGL_M - points[:, 2])
    off = off + rng.normal(0.0, own, (FLIGHTS, 50))
    assert (np.abs(off) < sigma_m).mean() == pytest.approx(0.683, abs=0.03)
    assert (np.abs(off) < 2.0 * sigma_m).mean() == pytest.approx(0.954, abs=0.02)


def test_points_have_the_sigma_of_the_track_nearby() -> None:
    shared = SharedSigma([pose(0, 0.1), pose(1, 0.1), pose(20, 2.0)], 0.0)
    places = np.array([[1.0, 30.0, 0.0], [99.0, -30.0, 3.0]])
    sigma_m = shared.absolute_m(np.zeros(2, np.float32), places)
    np.testing.assert_allclose(sigma_m, [0.1, 2.0], rtol=1e-6)


def test_a_long_track_is_asked_at_some_of_its_poses() -> None:
    shared = SharedSigma([pose(n, 0.5) for n in range(12_000)], 0.0)
    sigma_m = shared.absolute_m(np.zeros(1, np.float32), np.array([[55_000.0, 0.0, 0.0]]))
    np.testing.assert_allclose(sigma_m, 0.5, rtol=1e-6)
