"""Telemetry weighs by what its residuals show, and velocity gives the scale."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from flown_track import node
from paths import ROOT
from scipy.ndimage import gaussian_filter1d
from scipy.stats import chi2

from recon import se3
from recon.posegraph.alignment import fit, scales
from recon.posegraph.pose_priors import VelocityIntegrator
from recon.posegraph.records import Node
from recon.posegraph.sensor_noise import (
    CHI_SQUARED_MEDIANS,
    Noise,
    bias_time_constant_s,
    drift_noise,
    gauss_markov_noise,
)
from recon.types import F64, PosePrior, Travel

NADIR = np.diag([1.0, -1.0, -1.0])
SPEED_M_S = 5.0


def seconds(count: int, step_s: float = 1.0) -> F64:
    return np.arange(count, dtype=np.float64) * step_s


def gauss_markov(
    rng: np.random.Generator, times: F64, sigma: float, tau_s: float, axes: int = 2
) -> F64:
    """(N, axes) first-order Gauss-Markov errors."""
    keep = np.exp(-np.diff(times) / tau_s)
    out = rng.normal(size=(len(times), axes)) * sigma
    for i, k in enumerate(keep, 1):
        out[i] = k * out[i - 1] + np.sqrt(1 - k * k) * out[i]
    return np.asarray(out)


def test_a_sensor_errs_as_far_as_its_residuals_scatter() -> None:
    """A gimbal is moved once, half-way: no variogram of short lags shows it."""
    times = seconds(100)
    moved = np.where(times < 50.0, -4.0, 4.0)[:, None] + np.zeros(2)
    noise = Noise(0.5, 1.0, 10.0)
    found = noise.scattered(moved)
    assert found.bias**2 + found.white**2 == pytest.approx(16.0)
    assert found.bias**2 / found.tau_s == pytest.approx(noise.bias**2 / noise.tau_s)
    assert noise.scattered(0.1 * moved) == noise
    assert Noise(0.5, 0.0, 10.0).scattered(moved).tau_s > 1e6  # nothing moves in a short time
    # As unsure as one reading, in place of a mean of a hundred.
    assert found.effective_sigma(100, 99.0) / 100**0.5 == pytest.approx(found.bias, rel=0.25)


@pytest.mark.parametrize(("sigma_m", "expected_s"), [(0.02, 10.0), (0.29, 10.0), (0.3, 60.0)])
def test_precise_receivers_wander_faster(sigma_m: float, expected_s: float) -> None:
    assert bias_time_constant_s(sigma_m) == expected_s


@pytest.mark.parametrize(("white", "bias", "tau_s"), [(1.0, 0.0, 60.0), (0.1, 1.5, 5.0)])
def test_white_noise_and_wander_are_separated(white: float, bias: float, tau_s: float) -> None:
    found = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        times = seconds(300, 2.0)
        errors = gauss_markov(rng, times, bias, tau_s) + white * rng.normal(size=(300, 2))
        noise = gauss_markov_noise(times, errors, 60.0)
        assert noise is not None
        found.append((noise.white, noise.bias, noise.effective_sigma(300, 600.0)))
    each = Noise(white, bias, tau_s).effective_sigma(300, 600.0)
    assert np.median(found, axis=0) == pytest.approx([white, bias, each], rel=0.2, abs=0.15)


@pytest.mark.parametrize("count", [1, 2, 40])
def test_weights_of_wandering_readings_agree_with_the_dense_inverse(count: int) -> None:
    rng = np.random.default_rng(count)
    times, extra = np.sort(rng.uniform(0, 90, count)), rng.exponential(size=count)
    apart = np.abs(times[:, None] - times)
    dense = 1.2**2 * np.exp(-apart / 30.0) + np.diag(0.4**2 + extra)
    found = Noise(0.4, 1.2, 30.0).information(times, extra)
    np.testing.assert_allclose(found, np.linalg.inv(dense), atol=1e-9)


@pytest.mark.parametrize(
    ("step_s", "legs", "most"), [(1.2, 1, 0.013), (0.6, 1, 0.012), (1.2, 3, 0.007)]
)
def test_sigma_of_the_scale_covers_fixes_that_wander(step_s: float, legs: int, most: float) -> None:
    """Legs of 12 s at 6 m/s, where a wander of 1 m in 60 s stretches each by 1 %."""
    error, sigma = np.array([wandering(step_s, legs, seed) for seed in range(20)]).T
    assert np.sqrt(np.mean(error**2)) < most
    assert 0.6 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.4


def wandering(step_s: float, legs: int, seed: int) -> tuple[float, float]:
    """Log of the scale that fixes of a flight to and fro give, which is 1, and its sigma."""
    rng, times = np.random.default_rng(seed), seconds(int(12 * legs / step_s) + 1, step_s)
    back = np.abs((times / 12.0 + 1.0) % 2.0 - 1.0)
    at = np.column_stack([72.0 * back, 2.0 * times, 60.0 + 0.3 * np.sin(times)])
    error = np.column_stack([gauss_markov(rng, times, sigma, 60.0) for sigma in (1.0, 1.5)])
    fixes = at + error[:, :3] + 0.05 * rng.normal(size=at.shape)
    claimed = np.array([1.0, 1.0, 1.5])
    some = [
        node(se3.compose(NADIR, p), PosePrior(NADIR, 0.02, 0.1, fix, claimed), None, 0.0, t)
        for p, fix, t in zip(at, fixes, times, strict=True)
    ]
    found = fit(some)
    assert found is not None
    return float(np.log(found.scale)), found.sigma_scale


def test_a_filtered_wander_keeps_its_speed_where_readings_come_fast() -> None:
    """A climb and a landing, with five keyframes a second: a filter hides the wander in such lags,
    and those which are small by chance must not count most."""
    found, true = [], 0.5 / np.sqrt(60.0)
    for seed in range(40):
        fine = seconds(600, 0.1)
        errors = gauss_markov(np.random.default_rng(seed), fine, 0.5, 60.0)[:, :1]
        at = np.r_[0:60:2, 60:540:10, 540:600:2]
        noise = gauss_markov_noise(fine[at], gaussian_filter1d(errors, 5.0, axis=0)[at], 60.0)
        assert noise is not None
        found.append(noise.bias / np.sqrt(noise.tau_s) / true)
    low, middle, high = np.percentile(found, [10, 50, 90])
    assert low > 0.55 and 0.7 < middle < 1.1 and high < 1.3


def test_outliers_do_not_count_as_noise() -> None:
    rng = np.random.default_rng(1)
    times = seconds(100)
    errors = 0.5 * rng.normal(size=(100, 2))
    errors[10:90:9] += 40.0
    noise = gauss_markov_noise(times, errors, 60.0)
    assert noise is not None and noise.total < 1.0


@pytest.mark.parametrize(("walk", "rate"), [(0.1, 0.0), (0.02, 0.05), (0.1, 0.05)])
def test_a_drift_is_known_after_a_minute(walk: float, rate: float) -> None:
    """The sum of walk and rate over 60 s, whichever of them it is counted as."""
    after_m = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        times = seconds(400)
        drift: F64 = np.cumsum(walk * rng.normal(size=(400, 3)), axis=0)
        drift = drift + times[:, None] * rate * np.array([1.0, -1.0, 1.0])
        found = drift_noise(times, drift)
        assert found is not None
        after_m.append(np.hypot(found[0] * 60.0**0.5, found[1] * 60.0))
    truth_m = np.hypot(walk * 60.0**0.5, rate * 60.0)
    assert np.median(after_m) == pytest.approx(truth_m, rel=0.35)
    assert drift_noise(times[:5], drift[:5]) is None


def drifting_nodes(
    stretch: float, claimed_m: float, seed: int = 3, travel: bool = True
) -> list[Node]:
    """30 s along a line at 60 m; fixes drift so that the line seems ``stretch`` times as long."""
    rng, out = np.random.default_rng(seed), []
    for i in range(30):
        at = np.array([SPEED_M_S * i, 0.3 * np.sin(0.4 * i), 60.0])
        fix = at * [stretch, 1.0, 1.0] + 0.05 * rng.normal(size=3)
        way = Travel(at + 0.03 * rng.normal(size=3), float(i), 1) if travel else None
        prior = PosePrior(
            NADIR, 0.01, 0.05, fix, np.full(3, claimed_m), None, travel=way, is_agl_measured=False
        )
        out.append(node(se3.compose(NADIR, at / 1.5), prior, 40.0, 0.0, float(i)))
    return out


def test_velocity_gives_the_scale_where_fixes_drift() -> None:
    drifting = fit(drifting_nodes(1.006, 2.0))
    alone = fit(drifting_nodes(1.006, 2.0, travel=False))
    assert drifting is not None and alone is not None
    assert drifting.scale == pytest.approx(1.5, rel=0.003)
    assert alone.scale == pytest.approx(1.5 * 1.006, rel=0.002)
    assert abs(np.log(drifting.scale / 1.5)) < 2.0 * drifting.sigma_scale


def legs_flown(seed: int, leg_s: float, count: int, rate_m_s: float, tau_s: float) -> list[Node]:
    """A keyframe a second, 60 m up; fixes wander by 1 m (60 s), velocities by ``rate_m_s``."""
    rng, times = np.random.default_rng(seed), seconds(count)
    along = SPEED_M_S * np.abs((times + leg_s) % (2.0 * leg_s) - leg_s)
    at = np.column_stack([along, times, np.full(count, 60.0)])
    fixes = at + gauss_markov(rng, times, 1.0, 60.0, 3)
    slow = np.cumsum(gauss_markov(rng, times, rate_m_s, tau_s, 3), axis=0)
    ways = at + slow + np.cumsum(0.02 * rng.normal(size=(count, 3)), axis=0)
    return [
        node(
            se3.compose(NADIR, place / 1.5),
            PosePrior(
                NADIR, 0.01, 0.05, fix, np.ones(3), None,
                travel=Travel(way, float(t), 1), is_agl_measured=False,
            ),
            None, 0.0, float(t),
        )
        for t, place, fix, way in zip(times, at, fixes, ways, strict=True)
    ]  # fmt: skip


@pytest.mark.parametrize("tau_s", [20.0, 1e4])
@pytest.mark.parametrize(("leg_s", "count", "expected"), [(30.0, 30, 0.007), (10.0, 60, 0.0015)])
def test_sigma_of_the_scale_covers_velocities_that_err_slowly(
    tau_s: float, leg_s: float, count: int, expected: float
) -> None:
    """By 0.05 m/s: over turns the error cancels, along a leg it looks like another scale."""
    found = [fit(legs_flown(seed, leg_s, count, 0.05, tau_s)) for seed in range(12)]
    off = np.array([[np.log(f.scale / 1.5), f.sigma_scale] for f in found if f is not None])
    error, over_sigma = np.sqrt(np.mean(np.square([off[:, 0], off[:, 0] / off[:, 1]]), axis=1))
    assert error < expected and over_sigma < 1.9


def test_fixes_of_a_precise_receiver_outweigh_velocity() -> None:
    some = drifting_nodes(1.0, 0.02)
    for i, a in enumerate(some):
        slow = Travel(0.99 * a.T_odom_camera[:3, 3] * 1.5, float(i), 1)
        some[i] = replace(a, prior=replace(a.prior, travel=slow))
    found = fit(some)
    assert found is not None
    assert found.scale == pytest.approx(1.5, rel=0.002)


@pytest.mark.parametrize("claimed_m", [1.0, 5.0])
def test_a_take_off_point_above_the_site_does_not_bend_the_scale(claimed_m: float) -> None:
    some = []
    for a in drifting_nodes(1.0, claimed_m):
        some.append(replace(a, prior=replace(a.prior, agl_m=40.0, sigma_agl_m=10.0)))
    found = fit(some)
    assert found is not None
    assert found.scale == pytest.approx(1.5, rel=0.002)
    assert scales(some, found)[1] is None  # so nothing is reported against the fixes


def test_a_compass_that_is_off_is_no_drift_of_the_velocity() -> None:
    """Its 3 degrees are 8 m across a line of 150 m, which the velocity does not drift by."""
    off = se3.so3_exp(np.array([0.0, 0.0, np.radians(3.0)]))
    some = []
    for a in drifting_nodes(1.0, 2.0):
        assert a.prior.R_world_camera is not None
        some.append(replace(a, prior=replace(a.prior, R_world_camera=off @ a.prior.R_world_camera)))
    found = fit(some)
    assert found is not None and found.noise is not None
    assert found.noise.rate_m_s < 0.03
    assert abs(np.degrees(se3.so3_log(found.R)[2])) < 0.5


@pytest.mark.parametrize("share", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("claimed_m", [1.0, 2.0])
def test_velocities_that_contradict_the_fixes_are_left_out(share: float, claimed_m: float) -> None:
    """As of a vehicle that stands, or in another unit; most of all readings would agree on them."""
    wrong = []
    for a in drifting_nodes(1.0, claimed_m):
        assert a.prior.travel is not None
        travel = replace(a.prior.travel, metres=share * a.prior.travel.metres)
        wrong.append(replace(a, prior=replace(a.prior, travel=travel)))
    found = fit(wrong)
    assert found is not None
    assert found.scale == pytest.approx(1.5, rel=0.002)


def test_velocity_is_integrated_until_a_gap() -> None:
    integrator = VelocityIntegrator()
    prior = PosePrior(velocity_m_s=np.array([4.0, 0.0, 0.0]))
    faster = PosePrior(velocity_m_s=np.array([6.0, 0.0, 0.0]))
    assert integrator.add(0, PosePrior()).travel is None
    steps = [integrator.add(t, p).travel for t, p in ((10**9, prior), (2 * 10**9, faster))]
    assert steps[0] is not None and steps[1] is not None
    np.testing.assert_allclose(steps[1].metres - steps[0].metres, [5.0, 0.0, 0.0])
    assert (steps[1].seconds, steps[1].run) == (1.0, steps[0].run)
    after = integrator.add(20 * 10**9, faster).travel
    assert after is not None and after.run != steps[1].run and after.seconds == 0.0
    back = integrator.add(19 * 10**9, faster).travel
    assert back is not None and back.run != after.run


def test_medians_of_chi_squared_agree_with_scipy() -> None:
    medians = [chi2.median(axes) for axes in (1, 2, 3)]
    np.testing.assert_allclose(CHI_SQUARED_MEDIANS, medians, rtol=1e-12)


@pytest.mark.slow
def test_a_flight_does_without_large_parts_of_scipy() -> None:
    """Each takes 10 MiB of memory and a tenth of a second."""
    parts = "{'scipy.stats', 'scipy.optimize', 'scipy.special', 'scipy.spatial'}"
    script = f"import sys, service.flight.scan; print(bool({parts} & set(sys.modules)))"
    root = str(ROOT)
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=root
    )
    assert run.stdout == "False\n"


def test_a_wander_reaches_as_far_as_claim_and_speed_say() -> None:
    slow, fast = Noise(0.0, 0.5, 60.0), Noise(0.0, 3.0, 60.0)
    assert slow.reach(2.0, 1.0) == fast.reach(2.0, 0.0) == 2.0  # claimed, or as fast as that
    assert slow.reach(2.0, 0.1) == pytest.approx(1.0)  # between 0.5 and 2
    assert Noise(0.5, 0.0, 60.0).reach(2.0, 0.01) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("noise", "span_s", "expected"),
    [
        (Noise(0.1, 0.25, 60.0), 30.0, 1.0),  # hardly moves within the flight: all of the claim
        (Noise(0.1, 1.0, 60.0), 30.0, 0.9),
        (Noise(0.1, 1.0, 10.0), 2000.0, 0.1),  # a hundred independent errors
        (Noise(1.0, 0.25, 60.0), 30.0, 0.25),  # the claim is white noise, which averages out
        (Noise(3.0, 0.0, 60.0), 30.0, 0.39),  # and more noise than claimed averages out less
        (Noise(0.0, 0.0, 60.0), 1e6, 1.0),
    ],
)
def test_the_mean_error_of_a_flight_is_as_far_as_the_sensor_claims(
    noise: Noise, span_s: float, expected: float
) -> None:
    assert noise.of_mean(1.0, 100, span_s) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(
    ("white", "bias", "tau_s", "most"), [(2.0, 0.0, 60.0, 1.3), (0.1, 3.0, 3.0, 2.0)]
)
@pytest.mark.parametrize("legs", [1, 3])
def test_sigma_of_the_position_covers_fixes_that_scatter_more_than_claimed(
    white: float, bias: float, tau_s: float, most: float, legs: int
) -> None:
    """By several times what the receiver claims: the mean of 40 s errs, and the sigma says so."""
    off = []
    for seed in range(8):
        rng, times = np.random.default_rng(seed), seconds(40)
        back = np.abs((legs * times / 40.0 + 1.0) % 2.0 - 1.0)
        at = np.column_stack([200.0 * back, 2.0 * times, 60.0 + 0.3 * np.sin(times)])
        error = gauss_markov(rng, times, bias, tau_s, 3) + white * rng.normal(size=(40, 3))
        some = [
            node(
                se3.compose(NADIR, p / 1.5), PosePrior(NADIR, 0.01, 0.05, fix, np.full(3, 0.8)),
                None, 0.0, t,
            )
            for p, fix, t in zip(at, at + error, times, strict=True)
        ]  # fmt: skip
        found = fit(some)
        assert found is not None and found.sigma_fixes is not None and found.noise is not None
        off.append(error.mean(axis=0) / found.sigma_fixes)
        assert found.noise.over_claim.max() > 1.5
    assert np.sqrt(np.mean(np.square(off))) < most
