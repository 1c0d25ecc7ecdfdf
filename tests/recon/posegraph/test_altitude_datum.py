"""All fixes of an interval as one, and the zero of the altitude from all of them."""

from __future__ import annotations

import numpy as np
import pytest
from flown_track import node

from recon import se3
from recon.posegraph.alignment import fit
from recon.posegraph.pose_priors import FixAverage
from recon.posegraph.sensor_offsets import altitude_datum
from recon.types import PosePrior

SIGMA = np.array([1.0, 1.0, 1.5])


def intervals(above: list[float], fixes: int = 5) -> list[PosePrior]:
    return [
        PosePrior(None, position_m=np.zeros(3), sigma_position_m=SIGMA, gnss_minus_baro_m=a,
                  gnss_minus_baro_fixes=fixes)
        for a in above
    ]  # fmt: skip


@pytest.mark.parametrize("offset", [-0.8, 2.5])
def test_white_fixes_tell_the_barometers_zero(offset: float) -> None:
    rng = np.random.default_rng(0)
    errors, sigmas = [], []
    for _ in range(100):
        above = offset + rng.normal(size=30) * 1.5 / np.sqrt(5)
        found = altitude_datum(intervals(list(above)), 30.0)
        errors.append(found.up_m - offset)
        sigmas.append(found.sigma_up_m)
    assert np.sqrt(np.mean(np.square(errors))) < 0.4  # of 1.5 m in one fix
    assert np.median(np.abs(errors)) < np.median(sigmas) < 0.3


def test_a_wander_is_not_taken_for_the_zero() -> None:
    """Fixes that all err alike say nothing in half a minute, and something in half an hour."""
    above = [2.0] * 30
    assert altitude_datum(intervals(above), 30.0).up_m == 0.0
    assert 1.5 < altitude_datum(intervals(above), 1800.0).up_m < 2.0


def test_a_wander_under_the_scatter_is_seen_in_five_minutes() -> None:
    """The scatter alone is all that the receiver claims, and its errors wander by 1.5 m as well."""
    rng, ratios = np.random.default_rng(0), []
    for _ in range(60):
        wander = rng.normal() * 1.5
        above = []
        for _ in range(300):
            wander = np.exp(-1 / 60) * wander + 1.5 * np.sqrt(1 - np.exp(-2 / 60)) * rng.normal()
            above.append(wander + 1.5 * rng.normal() / np.sqrt(5))
        found = altitude_datum(intervals(above), 300.0)
        ratios.append(found.up_m / found.sigma_up_m)  # of a zero that is right
    assert np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_a_jump_of_the_receiver_does_not_count() -> None:
    rng = np.random.default_rng(1)
    above = 1.0 + rng.normal(size=40) * 0.67
    above[12:20] += 30.0
    assert altitude_datum(intervals(list(above)), 40.0).up_m == pytest.approx(1.0, abs=0.5)


def test_without_fixes_nothing_is_shifted() -> None:
    assert altitude_datum([PosePrior()] * 9, 60.0).up_m == 0.0
    assert altitude_datum(intervals([1.0, 1.0]), 60.0).up_m == 0.0


def test_the_mean_of_an_interval_lies_where_its_fixes_were() -> None:
    """A similarity fitted to means finds what made the fixes, though the track is bent."""
    rng = np.random.default_rng(2)
    scale, t = 1.7, np.array([5.0, -3.0, 60.0])
    R = se3.so3_exp(np.array([0.0, 0.0, 0.8]))
    nodes, average = [], FixAverage()
    for i in range(120):
        s = i / 10.0
        at = np.array([4.0 * s, 3.0 * np.sin(s), 0.2 * s])
        T = se3.compose(se3.so3_exp(rng.normal(size=3) * 0.05), at)
        fix = scale * R @ at + t
        prior = PosePrior(R @ T[:3, :3], 0.01, 0.05, fix, SIGMA, gnss_minus_baro_m=float(i // 2),
                          gnss_minus_baro_fixes=1, gnss_minus_baro_ns=1 + i // 2)  # fmt: skip
        average.take(T, prior)
        if i % 8 == 7:
            given = average.given()
            assert given.gnss_minus_baro_fixes == 4 and given.fix_offset is not None
            assert given.gnss_minus_baro_m == pytest.approx(i // 2 - 1.5)
            nodes.append(node(T, given, None))
    found = fit(nodes)
    assert found is not None and found.scale == pytest.approx(scale, rel=1e-3)
    np.testing.assert_allclose(found.t, t, atol=0.02)


def test_nothing_is_carried_over_a_break() -> None:
    average, prior = FixAverage(), PosePrior(position_m=np.ones(3), sigma_position_m=SIGMA)
    average.take(np.eye(4), prior)
    average.forget()
    later = PosePrior(position_m=np.zeros(3), sigma_position_m=SIGMA)
    average.take(np.eye(4), later)
    given = average.given()
    assert given.fix_offset is None
    assert given.position_m is not None and not given.position_m.any()


def test_fixes_much_better_than_those_before_have_a_mean_of_their_own() -> None:
    average = FixAverage()
    for sigma_m, x in ((1.0, 9.0), (1.0, 9.0), (1.0, 9.0), (0.02, 1.0), (0.02, 2.0)):
        fix = PosePrior(position_m=np.full(3, x), sigma_position_m=np.full(3, sigma_m))
        average.take(np.eye(4), fix)
    mean = average.given().position_m
    assert mean is not None
    np.testing.assert_allclose(mean, 1.5)
