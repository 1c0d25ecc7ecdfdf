"""How much a sensor errs along one flight, from its residuals against vision.

A receiver's error has a part that is new in each reading (white) and a bias that wanders
(first-order Gauss-Markov), which the variogram separates (docs/pose-graph.md, Noise). Medians stand
for means, so that jumps do not count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solveh_banded

from recon.types import F64

MIN_READINGS = 12  # readings from which on their scatter is measured

FIX_S, ATTITUDE_S, ALTITUDE_S = 60.0, 40.0, 120.0
"""Usual time constants with which a receiver's error wanders, an attitude's and a barometer's."""

TAUS_S = (2.0, 5.0, 10.0, 20.0, 40.0)  # time constants that are tried
TAUS_SEEN = 2.5  # that the longest lag must span, so that the variogram is seen to level off
SURE_OF_BIAS = 1.4  # a bias is accepted when the variogram fits so many times better with it
PRECISE_TAU_S = 10.0  # time constant of a receiver's bias with RTK or PPK
MIN_BIAS = 0.25  # share of a receiver's claimed sigma by which it always wanders
PRECISE_M = 0.3  # fixes of a smaller sigma are RTK's or PPK's
LAG_SHARE = 1.0 / 6.0  # longest lag over the span: a fit hides correlations over longer ones
LAGS = 12  # bins of the variogram, in equal ratios, as correlation falls off exponentially

CHI_SQUARED_MEDIANS = (0.45493642311957283, 1.3862943611198906, 2.3659738843753377)
"""Of one to three degrees of freedom."""

MAX_PAIRED = 400  # readings that are compared with each other; of more, every n-th
MIN_FRESH = 1e-9  # share of a bias's variance that is new in each reading: two may be at one time

FLOOR_SHARE, ROUNDS = 0.05, 4
"""Least share of a model's largest value that gives weight, and times that weights are renewed."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Errors of one kind of reading, 1 sigma per axis, in the readings' unit."""

    white: float
    bias: float
    tau_s: float
    steady: float = 0.0  # drift from the middle of the readings to either end

    @property
    def total(self) -> float:
        return float(np.hypot(self.white, self.bias))

    def change(self, passed_s: float) -> float:
        """Sigma of the change from one reading to the next after so many seconds."""
        change = self.bias**2 * (1.0 - np.exp(-passed_s / self.tau_s))
        return float(np.sqrt(2.0 * (self.white**2 + change)))

    def information(self, times_s: F64, extra: F64) -> F64:
        """(N, N) inverse of the covariance of readings at (N,) times. ``extra`` (N,) is each
        reading's own variance besides the white one, which is not 0."""
        P = self.weighted(times_s, extra, np.eye(len(extra)))
        if self.steady == 0.0:
            return P
        ends = 2.0 * (times_s - times_s[0]) / max(float(np.ptp(times_s)), 1e-9) - 1.0
        drift = P @ ends
        return np.asarray(P - np.outer(drift, drift) / (self.steady**-2 + ends @ drift))

    def weighted(self, times_s: F64, extra: F64, rows: F64) -> F64:
        """The inverse of the covariance, without the steady drift, times ``rows`` (N, k).

        The inverse of a Gauss-Markov covariance K is tridiagonal, and with D of the readings' own
        variances (D + K)^-1 = D^-1 - D^-1 (K^-1 + D^-1)^-1 D^-1 (Woodbury).
        """
        own = self.white**2 + extra
        if len(own) < 2 or self.bias == 0.0:
            return np.asarray(rows / (own + self.bias**2)[:, None])
        keep = np.exp(-np.diff(times_s) / self.tau_s)
        fresh = 1.0 / (self.bias**2 * np.maximum(1.0 - keep**2, MIN_FRESH))
        inner = np.zeros((2, len(own)))
        inner[0, 1:] = -keep * fresh
        inner[1] = 1.0 / own
        inner[1, 0] += self.bias**-2
        inner[1, 1:] += fresh
        inner[1, :-1] += keep**2 * fresh
        alone = rows / own[:, None]
        return np.asarray(alone - solveh_banded(inner, alone) / own[:, None])

    def bounded(self, claimed: float, usual_tau_s: float, least: float) -> Noise:
        """The same with a bias between ``least`` and what the sensor claims.

        A steady drift of the sensor looks like another scale and cannot be measured, so some
        is always there. What was measured beyond the claim is vision's own drift. In both cases
        the time constant is not the sensor's, and the usual one stands in for it.
        """
        if least <= self.bias <= claimed:
            return self
        return replace(self, bias=min(max(self.bias, least), claimed), tau_s=usual_tau_s)

    def scattered(self, residuals: F64) -> Noise:
        """The same with a bias as large as (N, axes) ``residuals`` scatter, at least.

        A variogram looks no farther than a sixth of the span. What changes once on the way, as a
        gimbal that the pilot moves, is in the scatter alone. The time constant grows with it, as
        the variogram shows how fast a sensor wanders (bias^2 / tau).
        """
        seen = float(np.mean(np.square(residuals))) - self.white**2
        if seen <= self.bias**2:
            return self
        tau_s = self.tau_s * seen / max(self.bias**2, MIN_FRESH * seen)
        return replace(self, bias=float(np.sqrt(seen)), tau_s=tau_s)

    def drifting(self, claimed: float, tau_s: float, span_s: float) -> Noise:
        """The same with the steady drift that a bias as far as :meth:`reach` says may have.

        Over a track without turns it looks like another scale, so no residual shows it. The bias
        is at most as ``claimed``.
        """
        bias = min(self.bias, claimed)
        spans = span_s / tau_s
        # Variance of the slope of a Gauss-Markov error: spans / 5 if short, 2 / spans if long.
        slope = 3.0 * spans / (5.0 + 0.5 * spans**2)
        far = max(self.reach(claimed, MIN_BIAS) ** 2 - bias**2, 0.0)
        return replace(self, bias=bias, steady=float(np.sqrt(far * slope)))

    def in_units_of(self, unit: float) -> Noise:
        """The same in another unit."""
        return replace(
            self, white=self.white / unit, bias=self.bias / unit, steady=self.steady / unit
        )

    def effective_sigma(self, count: int, span_s: float) -> float:
        """The sigma of each of ``count`` readings over ``span_s``, as if all were independent. A
        bias counts as 1 + span / (2 tau) independent errors."""
        independent = min(1.0 + span_s / (2.0 * self.tau_s), count)
        return float(np.sqrt(self.white**2 + self.bias**2 * count / independent))

    def of_mean(self, claimed: float, count: float, span_s: float) -> float:
        """The sigma of the mean error of ``count`` readings over ``span_s``, with a bias as far as
        the sensor claims.

        A flight no longer than the time constant shows how fast a sensor wanders (bias^2 / tau),
        not how far: its mean error is in no residual. Of the claim, only the white part averages
        out.
        """
        far = max(claimed**2 - self.white**2, (MIN_BIAS * claimed) ** 2)
        tau_s = self.tau_s * max(1.0, far / max(self.bias**2, 1e-12))
        return float(np.sqrt(far / (1.0 + span_s / (2.0 * tau_s)) + self.white**2 / max(count, 1)))

    def reach(self, sigma: float, min_share: float) -> float:
        """How far the sensor may wander: at most its ``sigma``, less where it wanders slowly.

        The speed of a bias gives its size up to a time constant that is known to a factor of
        two, and sensors that claim nothing differ as much from the typical one. Two estimates
        as good as each other in their logarithm make the geometric mean. ``min_share`` of the
        variance stays in any case.
        """
        return float(sigma * np.sqrt(np.clip(self.bias / max(sigma, 1e-9), min_share, 1.0)))


def inflation(count: int, span_s: float, tau_s: float) -> float:
    """Factor on the sigmas of so many readings, whose errors wander with a time constant, as if all
    were independent."""
    return float(np.sqrt(max(1.0, count / (1.0 + span_s / (2.0 * tau_s)))))


def fresh_shares(errors: F64) -> F64:
    """(C,) shares of (N, C) readings in the order of time that err independently: where one errs as
    the one before, their mean is less certain than of as many independent ones."""
    e = errors - np.median(errors, axis=0)
    alike = np.sum(e[1:] * e[:-1], axis=0) / np.maximum(np.sum(e * e, axis=0), 1e-12)
    alike = np.clip(alike, 0.0, 0.95)
    return np.asarray((1.0 - alike) / (1.0 + alike))


def bias_time_constant_s(sigma_m: float) -> float:
    """The time constant of a receiver that claims ``sigma_m``."""
    return PRECISE_TAU_S if sigma_m < PRECISE_M else FIX_S


def gauss_markov_noise(
    times_s: F64, residuals: F64, usual_tau_s: float, sure: float = SURE_OF_BIAS
) -> Noise | None:
    """The noise of readings with (N, axes) ``residuals`` at (N,) times; None for too few.
    ``usual_tau_s`` is the time constant of a bias too slow to be measured."""
    lag, change = variogram(times_s, residuals)
    if len(lag) < 3:
        return None
    two = np.full(len(lag), 2.0)
    (white,), least = _fit_variogram(lag, change, two)
    best = Noise(float(np.sqrt(white)), 0.0, usual_tau_s)
    shorter = [tau for tau in TAUS_S if tau <= lag[-1] / TAUS_SEEN]
    for tau_s in [usual_tau_s, *shorter]:
        parts, error = _fit_variogram(lag, change, two, 2.0 * (1.0 - np.exp(-lag / tau_s)))
        if parts[1] > 0.0 and sure * error <= least:
            # Means and filtered positions change less over short lags: as if white^2 < 0.
            own, common = np.sqrt(np.maximum(parts, 0.0))
            best, least = Noise(float(own), float(common), tau_s), error
            sure = max(sure, SURE_OF_BIAS)
    return best


def _fit_variogram(lag: F64, change: F64, *columns: F64) -> tuple[F64, float]:
    """Factors (C,) of ``columns`` (L,) that sum up best to the ``change`` (L,), and the misfit.

    Errors are relative and grow with the root of the ``lag`` (L,) s. Weights follow from the model
    (Cressie, Math. Geology 17, 1985): by the values themselves, those that are small by chance
    would count most.
    """
    A, model = np.column_stack(columns), np.full(len(lag), change.mean())
    for _ in range(ROUNDS):
        weight = np.sqrt(lag[-1] / lag) / np.maximum(model, 1e-12)
        parts = np.linalg.lstsq(A * weight[:, None], change * weight, rcond=None)[0]
        model = A @ parts
        np.maximum(model, FLOOR_SHARE * model.max(), out=model)
    return parts, float(np.linalg.norm(weight * (A @ parts - change)))


def drift_noise(times_s: F64, residuals: F64) -> tuple[float, float] | None:
    """Random walk (m / sqrt(s)) and constant rate (m / s) of a drift, 1 sigma per axis.
    ``residuals`` (N, axes) m are an integrated velocity's at (N,) times; None for too few."""
    lag, change = variogram(times_s, residuals)
    if len(lag) < 3:
        return None
    parts, _ = _fit_variogram(lag, change, lag, lag**2)
    walk, rate = np.sqrt(np.maximum(parts, 0.0))
    return float(walk), float(rate)


def variogram(times_s: F64, residuals: F64) -> tuple[F64, F64]:
    """Lags (L,) s up to a sixth of the span, and the robust mean square (L,) of the change."""
    if len(times_s) < MIN_READINGS:
        return np.zeros(0), np.zeros(0)
    step = max(1, len(times_s) // MAX_PAIRED)
    t, e = times_s[::step], residuals[::step]
    a, b = np.triu_indices(len(t), 1)
    h = np.abs(t[b] - t[a])
    near = (h > 0) & (h <= LAG_SHARE * float(np.ptp(t)))
    if not near.any():
        return np.zeros(0), np.zeros(0)
    h, square = h[near], np.mean((e[b[near]] - e[a[near]]) ** 2, axis=1)
    axes = e.shape[1]
    edges = np.geomspace(h.min() * 0.999, h.max() * 1.001, LAGS + 1)
    bins = np.digitize(h, edges)
    used = [k for k in range(1, LAGS + 1) if np.count_nonzero(bins == k) >= MIN_READINGS // 2]
    lag = np.array([np.mean(h[bins == k]) for k in used])
    change = np.array([np.median(square[bins == k]) for k in used])
    return lag, change * axes / CHI_SQUARED_MEDIANS[axes - 1]
