"""The camera's latency by what its pictures say of the vehicle's rotation.

A frame stamped ``t`` was exposed at ``t - latency``. The turns seen between frames, shifted by
the latency, must be those of telemetry (VINS calls it ``td``, DOI 10.1109/IROS.2018.8593603):
those of the head for a gimbal, of the body for a fixed mount. The mount need not be known; the
rotation between the two sets of axes is solved for as well.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mavlink.quaternion import Quaternion, normalised
from mavlink.quaternion import multiply as product
from mavlink.turns import (
    F64,
    Attitudes,
    Bool,
    best_rotation,
    conjugate,
    multiply,
    rotation_vectors,
)

LEAST_WINDOWS = 50  # that do not overlap
LEAST_CORRELATION = 0.7
WINDOW_S = 0.2  # turns over less are mostly noise; over more, the latency drowns
FLOOR_MS = 2.0  # neither exposures nor the stamps of telemetry are known better
SETTLED_MS = 5.0  # sigma of an estimate that may be believed
LARGEST_SIGMA_MS = 25.0  # one that is not worth telling
RIVAL = 1.3  # a second answer, further away than RIVAL_APART_S, must fit worse by so much
RIVAL_APART_S = 0.15
KEPT = 2000
COARSE_S, FINE_S, FINE_STEPS = 0.02, 0.004, 8
OUTLIER = 4.0  # times the median misfit


@dataclass(frozen=True, slots=True)
class LatencyEstimate:
    """The latency that fits best."""

    latency_ms: float
    sigma_ms: float
    correlation: float  # of the turns seen and those of telemetry at that latency, 0 to 1
    windows: int  # turns that took part

    @property
    def is_settled(self) -> bool:
        """True when it is good enough to be applied."""
        return self.sigma_ms <= SETTLED_MS


@dataclass(frozen=True, slots=True, eq=False)
class _Turns:
    """What the pictures say: turns over windows of time."""

    start_s: F64  # (N,)
    end_s: F64  # (N,)
    rate: F64  # (N, 3) rad/s in the camera's axes at the start
    overlap: int  # windows that share an instant

    def __len__(self) -> int:
        return len(self.start_s)

    def only(self, mask: Bool) -> _Turns:
        """Those of a mask."""
        return _Turns(self.start_s[mask], self.end_s[mask], self.rate[mask], self.overlap)


class LatencyWatch:
    """Collects turns between frames and says what latency they speak for."""

    def __init__(self, range_ms: tuple[float, float] = (-200.0, 800.0)) -> None:
        if not range_ms[0] < range_ms[1]:
            raise ValueError(f"latency range {range_ms} must go upwards")
        self._range_s = (range_ms[0] * 1e-3, range_ms[1] * 1e-3)
        self._frames: deque[tuple[int, int, Quaternion]] = deque(maxlen=KEPT)  # run, time, turned
        self._run = 0

    def add(self, first_ns: int, second_ns: int, q_step: Quaternion) -> None:
        """Take in ``q_camera(first)_camera(second)`` between two frames, at their stamps.

        Steps that follow on each other are joined. What is no rotation, or goes back in time,
        is left out.
        """
        step = normalised(q_step)
        if second_ns <= first_ns or step is None:
            return
        if not self._frames or self._frames[-1][1] != first_ns:
            self._run += 1
            self._frames.append((self._run, first_ns, (1.0, 0.0, 0.0, 0.0)))
        turned = product(self._frames[-1][2], step)
        self._frames.append((self._run, second_ns, normalised(turned) or turned))

    def estimate(self, attitudes: Sequence[tuple[int, Quaternion]]) -> LatencyEstimate | None:
        """The latency by attitudes (time in ns, attitude) over the same time, oldest first.

        None while there are too few frames, too little rotation, or no clear answer.
        """
        if len(attitudes) < LEAST_WINDOWS or len(self._frames) < LEAST_WINDOWS:
            return None
        track = Attitudes(attitudes)
        low, high = self._range_s
        seen = self._turns(track.base_ns, max(WINDOW_S, 2.0 * track.spacing_s))
        inside = (seen.start_s - high > track.first_s) & (seen.end_s - low < track.last_s)
        seen = seen.only(inside)
        if len(seen) < LEAST_WINDOWS * seen.overlap:
            return None
        lags = np.arange(low, high + COARSE_S / 2, COARSE_S)
        fits = [_fit(seen, track, float(lag)) for lag in lags]
        misfits = np.array([np.inf if fit is None else fit.misfit for fit in fits])
        k = int(np.argmin(misfits))
        best = fits[k]
        if best is None or not 0 < k < len(lags) - 1 or best.correlation < LEAST_CORRELATION:
            return None
        far = np.abs(lags - lags[k]) > RIVAL_APART_S
        if (misfits[far] < RIVAL * best.misfit).any():
            return None  # two latencies explain the pictures nearly as well
        return _refine(seen.only(best.good), track, float(lags[k]))

    def _turns(self, base_ns: int, window_s: float) -> _Turns:
        """Turns over ``window_s`` or a little more, four to a window."""
        run = np.array([frame[0] for frame in self._frames])
        time_s: F64 = np.array([(frame[1] - base_ns) * 1e-9 for frame in self._frames])
        q: F64 = np.array([frame[2] for frame in self._frames], np.float64)
        i = np.arange(len(run))
        j = np.minimum(np.searchsorted(time_s, time_s + 0.99 * window_s), len(run) - 1)
        whole = (run[j] == run[i]) & (time_s[j] - time_s[i] >= 0.99 * window_s)
        i, j = i[whole], j[whole]
        stride = max(1, int(np.median(j - i)) // 4) if len(i) else 1
        i, j = i[::stride], j[::stride]
        span = (time_s[j] - time_s[i])[:, None]
        rate = rotation_vectors(multiply(conjugate(q[i]), q[j])) / span
        overlap = int(np.ceil(np.median((j - i) / stride))) if len(i) else 1
        return _Turns(time_s[i], time_s[j], rate, overlap)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Telemetry against the pictures at one latency."""

    ours: F64  # (N, 3) telemetry's rates in the camera's axes
    rest: F64  # (N, 3) what the pictures saw beyond them
    known: Bool  # (N,) telemetry is there
    misfit: float  # mean square of the rest
    correlation: float

    @property
    def good(self) -> Bool:
        """(N,) all but what no noise explains, such as a frame placed wrongly."""
        size = np.linalg.norm(self.rest, axis=1)
        good: Bool = self.known & (size <= OUTLIER * np.median(size[self.known]))
        return good


def _fit(seen: _Turns, track: Attitudes, lag_s: float) -> _Fit | None:
    """None where telemetry says too little."""
    turns, known = track.turns(seen.start_s - lag_s, seen.end_s - lag_s)
    if known.sum() < LEAST_WINDOWS:
        return None
    ours = turns / (seen.end_s - seen.start_s)[:, None]
    ours = ours @ best_rotation(ours[known], seen.rate[known]).T
    rest = seen.rate - ours
    a, b = ours[known], seen.rate[known]
    power = float(np.sqrt((a**2).sum() * (b**2).sum()))
    correlation = float((a * b).sum()) / power if power > 0.0 else 0.0
    return _Fit(ours, rest, known, float((rest[known] ** 2).sum(axis=1).mean()), correlation)


def _refine(seen: _Turns, track: Attitudes, lag_s: float) -> LatencyEstimate | None:
    """The least weighted misfit near a latency; weights are those of the misfit itself.

    The heading of an autopilot wanders more than its tilt, so each axis counts by how well it
    fits. The sigma allows for misfits that last (Newey and West, DOI 10.2307/1913610).
    """
    start = _fit(seen, track, lag_s)
    if start is None:
        return None
    scatter: F64 = np.cov(start.rest[start.known].T) + 1e-12 * np.eye(3)
    weight: F64 = np.asarray(np.linalg.inv(scatter), np.float64)
    lags = lag_s + FINE_S * np.arange(-FINE_STEPS, FINE_STEPS + 1)
    fits = [_fit(seen, track, float(lag)) for lag in lags]
    costs = np.array([_cost(fit, weight) for fit in fits])
    k = int(np.argmin(costs))
    if not 0 < k < len(lags) - 1:
        return None
    before, at, after = fits[k - 1], fits[k], fits[k + 1]
    bend = costs[k - 1] - 2.0 * costs[k] + costs[k + 1]
    if before is None or at is None or after is None or not bend > 0.0:
        return None
    latency = float(lags[k] - 0.5 * FINE_S * (costs[k + 1] - costs[k - 1]) / bend)
    slope = (after.ours - before.ours) / (2.0 * FINE_S)
    known = before.known & at.known & after.known
    sigma = _sigma(slope[known] @ weight, slope[known], at.rest[known], 2 * seen.overlap)
    sigma_ms = float(np.hypot(1e3 * sigma, FLOOR_MS))
    if not sigma_ms <= LARGEST_SIGMA_MS:
        return None
    return LatencyEstimate(1e3 * latency, sigma_ms, at.correlation, int(known.sum()))


def _cost(fit: _Fit | None, weight: F64) -> float:
    """Mean weighted square of what telemetry leaves unexplained."""
    if fit is None:
        return float("inf")
    rest = fit.rest[fit.known]
    return float(np.einsum("ij,jk,ik->i", rest, weight, rest).mean())


def _sigma(weighted: F64, slope: F64, rest: F64, lasting: int) -> float:
    """1 sigma in s of a time found by least squares, for misfits that last some windows."""
    information = float((weighted * slope).sum())
    pulls = (weighted * rest).sum(axis=1)
    variance = float((pulls**2).sum())
    total = variance
    for k in range(1, min(lasting, len(pulls) - 1) + 1):
        total += 2.0 * (1.0 - k / (lasting + 1)) * float((pulls[k:] * pulls[:-k]).sum())
    return float(np.sqrt(max(total, variance))) / information if information > 0.0 else np.inf
