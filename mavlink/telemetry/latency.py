"""The camera's latency, estimated from the rotation in its images.

A frame stamped ``t`` was exposed at ``t - latency``. The rotations between frames, shifted by
the latency, must match those of telemetry (VINS calls it ``td``, DOI 10.1109/IROS.2018.8593603):
those of the head for a gimbal, of the body for a fixed mount. The mount need not be known; the
rotation between the two sets of axes is estimated as well. Quaternions here are arrays (N, 4),
w x y z, unit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mavlink.telemetry.quaternion import Quaternion, conjugate, multiply, normalised

MIN_WINDOWS, MIN_SPAN_S = 12, 10.0  # non-overlapping, and their time together
FITTED = 6  # windows that the rotation, the scatter and the time are worth
MIN_CORRELATION = 0.7
SURE = 0.9  # correlation at which images surely turn with the log
WINDOW_S = 0.2  # shorter rotations are mostly noise; longer ones hide the latency
FLOOR_MS = 2.0  # accuracy of exposure times and telemetry stamps
SETTLED_MS = 5.0  # maximum sigma of an estimate that may be applied
MAX_SIGMA_MS = 40.0  # maximum sigma of an estimate that is reported
RIVAL = 1.3  # a second solution, further away than RIVAL_APART_S, must fit worse by this factor
RIVAL_APART_S = 0.15
KEPT = 2000
LONG_NS = 1_000_000_000  # a turn over a shorter time is mostly noise
LONG_KEPT = 120
REACH_S = 5.0  # latencies that are sought, either way: a range without the true one holds aliases
COARSE_S, FINE_S, FINE_STEPS = 0.04, 0.004, 8
MIN_SHARE = 0.5  # of the most windows that telemetry covers at any latency
NEAR_S = np.array([-0.5, 0.0, 0.5]) * COARSE_S
FAR_WINDOW_S, FAR_STEP_S = 1.0, 0.1  # of the search over a whole log
FAR_REACH_S = 600.0
OUTLIER = 4.0  # times the median misfit


@dataclass(frozen=True, slots=True)
class LatencyEstimate:
    latency_ms: float
    sigma_ms: float
    correlation: float  # of visual and telemetry rotation at that latency, 0 to 1
    windows: int  # rotations used

    @property
    def is_settled(self) -> bool:
        """True when it is good enough to be applied."""
        return self.sigma_ms <= SETTLED_MS


@dataclass(frozen=True, slots=True, eq=False)
class _Turns:
    """Rotations from the images, over windows of time."""

    start_s: F64  # (N,)
    end_s: F64  # (N,)
    rate: F64  # (N, 3) rad/s in the camera's axes at the start
    overlap: int  # windows that share an instant

    def __len__(self) -> int:
        return len(self.start_s)

    def only(self, mask: Bool | slice) -> _Turns:
        return _Turns(self.start_s[mask], self.end_s[mask], self.rate[mask], self.overlap)

    def apart(self) -> _Turns:
        """Those that share no instant."""
        return replace(self.only(slice(None, None, self.overlap)), overlap=1)


class LatencyWatch:
    def __init__(self) -> None:
        self._frames: deque[tuple[int, int, Quaternion]] = deque(maxlen=KEPT)  # run, time, turned
        self._run = 0
        self._start: tuple[int, int, Quaternion]  # of the next long turn
        self.long_turns: deque[tuple[int, int, Quaternion]] = deque(maxlen=LONG_KEPT)
        """Rotations over a second or a little more, one after the other: the stamps of the first
        and the second frame, and ``q_camera(first)_camera(second)``."""

    def add(self, first_ns: int, second_ns: int, q_step: Quaternion) -> None:
        """Add ``q_camera(first)_camera(second)`` between two frames, at their stamps. Consecutive
        steps are joined. Invalid rotations and steps back in time are ignored."""
        step = normalised(q_step)
        if second_ns <= first_ns or step is None:
            return
        if not self._frames or self._frames[-1][1] != first_ns:
            self._run += 1
            self._start = (self._run, first_ns, (1.0, 0.0, 0.0, 0.0))
            self._frames.append(self._start)
        turned = multiply(self._frames[-1][2], step)
        self._frames.append((self._run, second_ns, normalised(turned) or turned))
        _, start_ns, q_start = self._start
        if second_ns - start_ns >= LONG_NS:
            long = multiply(conjugate(q_start), self._frames[-1][2])
            self.long_turns.append((start_ns, second_ns, long))
            self._start = self._frames[-1]

    def since_ns(self, frames: int) -> int | None:
        """The stamp of the oldest of the newest ``frames``; None without any."""
        return self._frames[-min(frames, len(self._frames))][1] if self._frames else None

    def estimate(self, attitudes: Sequence[tuple[int, Quaternion]]) -> LatencyEstimate | None:
        """The latency by attitudes (time in ns, attitude) over the same time, oldest first.

        It is sought within ``REACH_S``. None with too few frames, too little rotation, or no
        unambiguous solution.
        """
        if len(attitudes) < MIN_WINDOWS or len(self._frames) < MIN_WINDOWS:
            return None
        return self._about(Attitudes(attitudes), 0.0)

    def image_roll(
        self, attitudes: Sequence[tuple[int, Quaternion]], R_head: F64, latency_ms: float
    ) -> tuple[float, float] | None:
        """The angle, rad, by which images are turned clockwise about the line of sight against a
        head that is ``R_head`` (3, 3) times the attitudes' axes, and the correlation of the turns
        across it then, 0 to 1; None with too few turns."""
        if len(attitudes) < MIN_WINDOWS or len(self._frames) < MIN_WINDOWS:
            return None
        track = Attitudes(attitudes)
        seen = self._turns(track)
        fit = _fit(seen, track, 1e-3 * latency_ms)
        if fit is None:
            return None
        head, images = fit.ours @ fit.R @ R_head.T, seen.rate
        # Complex numbers: what lies across the line of sight.
        a, b = (rate[fit.good, 1] + 1j * rate[fit.good, 2] for rate in (head, images))
        power = float(np.linalg.norm(a) * np.linalg.norm(b))
        together = complex(np.vdot(a, b))
        return float(np.angle(together)), abs(together) / max(power, 1e-30)

    def rate(self, attitudes: Sequence[tuple[int, Quaternion]]) -> tuple[float, float] | None:
        """How fast the latency grows, seconds in a second, and its sigma: by the latencies of the
        earlier and of the later half of the frames. None where one of them is not sure."""
        if len(attitudes) < MIN_WINDOWS or len(self._frames) < MIN_WINDOWS:
            return None
        track = Attitudes(attitudes)
        seen = self._turns(track)
        is_late: Bool = seen.start_s > 0.5 * (seen.start_s[:1] + seen.end_s[-1:])
        early, late = (self._of(seen.only(mask), track, 0.0) for mask in (~is_late, is_late))
        if early is None or late is None or min(early.correlation, late.correlation) < SURE:
            return None
        apart_s = float(seen.start_s[is_late].mean() - seen.start_s[~is_late].mean())
        grown_ms = late.latency_ms - early.latency_ms
        sigma_ms = float(np.hypot(early.sigma_ms, late.sigma_ms))
        return 1e-3 * grown_ms / apart_s, 1e-3 * sigma_ms / apart_s

    def anywhere(self, attitudes: Sequence[tuple[int, Quaternion]]) -> LatencyEstimate | None:
        """The latency by attitudes of a whole log; of a recording whose clock is minutes off."""
        if len(attitudes) < MIN_WINDOWS or len(self._frames) < MIN_WINDOWS:
            return None
        track = Attitudes(attitudes)
        seen = self._turns(track, FAR_WINDOW_S).apart()
        if len(seen) < MIN_WINDOWS:
            return None
        low = max(float(seen.start_s[0]) - track.last_s, -FAR_REACH_S)
        high = min(float(seen.end_s[-1]) - track.first_s, FAR_REACH_S)
        lag_s = _best_lag(seen, track, np.arange(low, high, FAR_STEP_S, dtype=np.float64))
        found = None if lag_s is None else self._about(track, lag_s)
        if found is None or abs(found.latency_ms) <= 1e3 * REACH_S:
            return found
        # The turn at the end of a leg looks like the next one: what is between must agree as well.
        fit = _fit(seen, track, 1e-3 * found.latency_ms)
        return None if fit is None or fit.agreement(seen) < MIN_CORRELATION else found

    def _about(self, track: Attitudes, about_s: float) -> LatencyEstimate | None:
        seen = self._turns(track)
        return self._of(seen, track, about_s)

    @staticmethod
    def _of(seen: _Turns, track: Attitudes, about_s: float) -> LatencyEstimate | None:
        steps = round(REACH_S / COARSE_S)
        lags: F64 = about_s + COARSE_S * np.arange(-steps, steps + 1, dtype=np.float64)
        coarse_s = _best_lag(seen.apart(), track, lags)
        if coarse_s is None:
            return None
        near = [(_fit(seen, track, lag_s), lag_s) for lag_s in coarse_s + NEAR_S]
        best, lag_s = min(near, key=lambda fit: np.inf if fit[0] is None else fit[0].misfit)
        if best is None or best.span_s(seen) < MIN_SPAN_S:
            return None
        return _refine(seen.only(best.good), track, float(lag_s))

    def _turns(self, track: Attitudes, window_s: float = WINDOW_S) -> _Turns:
        """Rotations over ``window_s``, or two of the track's attitudes, or a little more, four per
        window."""
        window_s = max(window_s, 2.0 * track.spacing_s)
        run = np.array([frame[0] for frame in self._frames])
        time_s: F64 = np.array([(frame[1] - track.base_ns) * 1e-9 for frame in self._frames])
        q: F64 = np.array([frame[2] for frame in self._frames], np.float64)
        i = np.arange(len(run))
        j = np.minimum(np.searchsorted(time_s, time_s + 0.99 * window_s), len(run) - 1)
        whole = (run[j] == run[i]) & (time_s[j] - time_s[i] >= 0.99 * window_s)
        i, j = i[whole], j[whole]
        stride = max(1, int(np.median(j - i)) // 4) if len(i) else 1
        i, j = i[::stride], j[::stride]
        span = (time_s[j] - time_s[i])[:, None]
        rate = rotation_vectors(q[i], q[j]) / span
        overlap = int(np.ceil(np.median((j - i) / stride))) if len(i) else 1
        return _Turns(time_s[i], time_s[j], rate, overlap)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Telemetry against the images at one latency."""

    R: F64  # (3, 3) from telemetry's axes to the camera's
    ours: F64  # (N, 3) telemetry's rates in the camera's axes
    rest: F64  # (N, 3) the images' rates minus these
    known: Bool  # (N,) telemetry is available
    misfit: float  # share of the images' rotation that is not explained
    correlation: float

    def span_s(self, seen: _Turns) -> float:
        return float((seen.end_s - seen.start_s)[self.known].sum()) / seen.overlap

    def agreement(self, seen: _Turns) -> float:
        """Mean cosine between the rates of images and telemetry: all windows count alike."""
        ours, rate = self.ours[self.known], seen.rate[self.known]
        sizes = np.linalg.norm(ours, axis=1) * np.linalg.norm(rate, axis=1)
        return float(((ours * rate).sum(axis=1) / np.maximum(sizes, 1e-30)).mean())

    @property
    def good(self) -> Bool:
        """(N,) all but outliers, such as a wrongly placed frame."""
        size = np.linalg.norm(self.rest, axis=1)
        good: Bool = self.known & (size <= OUTLIER * np.median(size[self.known]))
        return good


def _fit(seen: _Turns, track: Attitudes, lag_s: float) -> _Fit | None:
    """None where telemetry is insufficient."""
    turns, known = track.turns(seen.start_s - lag_s, seen.end_s - lag_s)
    if known.sum() < MIN_WINDOWS:
        return None
    ours = turns / (seen.end_s - seen.start_s)[:, None]
    R = best_rotation(ours[known], seen.rate[known])
    ours = ours @ R.T
    rest = seen.rate - ours
    a, b = ours[known], seen.rate[known]
    of_images = max(float((b**2).sum()), 1e-30)
    power = float(np.sqrt((a**2).sum() * of_images))
    correlation = float((a * b).sum()) / power if power > 0.0 else 0.0
    return _Fit(R, ours, rest, known, float((rest[known] ** 2).sum()) / of_images, correlation)


def _best_lag(seen: _Turns, track: Attitudes, lags: F64) -> float | None:
    """The latency of the least misfit, inside the range; None where another is as good."""
    fits = [_fit(seen, track, float(lag)) for lag in lags]
    counts = np.array([0 if fit is None else int(fit.known.sum()) for fit in fits])
    misfits = np.array([np.inf if fit is None else fit.misfit for fit in fits])
    misfits[counts < MIN_SHARE * counts.max(initial=0)] = np.inf
    k = int(np.argmin(misfits)) if len(lags) else 0
    best = fits[k] if len(lags) else None
    if best is None or not 0 < k < len(lags) - 1 or best.correlation < MIN_CORRELATION:
        return None
    far = np.abs(lags - lags[k]) > RIVAL_APART_S
    is_rivalled = bool((misfits[far] < RIVAL * best.misfit).any())
    return None if is_rivalled else float(lags[k])


def _refine(seen: _Turns, track: Attitudes, lag_s: float) -> LatencyEstimate | None:
    """The minimum weighted misfit near a latency; weights come from the misfit itself.

    The heading of an autopilot wanders more than its tilt, so each axis is weighted by its fit.
    The sigma accounts for correlated misfits (Newey and West, DOI 10.2307/1913610).
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
    if before is None or at is None or after is None or not np.isfinite(costs).all():
        return None
    bend, tilt, _ = np.polyfit(lags - lag_s, costs, 2)
    latency = float(lag_s - 0.5 * tilt / bend) if bend > 0.0 else np.inf
    if not abs(latency - lag_s) <= FINE_STEPS * FINE_S:
        return None
    slope = (after.ours - before.ours) / (2.0 * FINE_S)
    known = before.known & at.known & after.known
    count = float(known.sum())
    pull = _pull(slope[known] @ weight, at.rest[known], 2 * seen.overlap)
    sigma = pull / (count * bend)
    sigma *= count / max(count - FITTED * seen.overlap, 1.0)
    sigma_ms = float(np.hypot(1e3 * sigma, FLOOR_MS))
    if not sigma_ms <= MAX_SIGMA_MS:
        return None
    return LatencyEstimate(1e3 * latency, sigma_ms, at.correlation, int(known.sum()))


def _cost(fit: _Fit | None, weight: F64) -> float:
    """Mean weighted square of the rotation that telemetry does not explain."""
    if fit is None:
        return float("inf")
    rest = fit.rest[fit.known]
    return float(np.einsum("ij,jk,ik->i", rest, weight, rest).mean())


def _pull(weighted: F64, rest: F64, lasting: int) -> float:
    """1 sigma of half the slope of all misfits together, which are correlated over some windows."""
    pulls = (weighted * rest).sum(axis=1)
    variance = float((pulls**2).sum())
    total = variance
    for k in range(1, min(lasting, len(pulls) - 1) + 1):
        total += 2.0 * (1.0 - k / (lasting + 1)) * float((pulls[k:] * pulls[:-k]).sum())
    return float(np.sqrt(max(total, variance)))


F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

MAX_GAP_S = 0.45
"""Attitudes further apart are not interpolated: a ground station's log has three or four a second,
and a camera swings at up to 1 Hz."""

FINER = 4  # steps from one attitude to the next

AVERAGED = 6
"""Steps over which attitudes are averaged: over one and a half spacings the noise of the mean is as
large between two samples as on one, to 0.6 %. Over one spacing it is 17 % less half-way."""


class Attitudes:
    """Attitudes of a flight; gives the rotation between any two times."""

    def __init__(self, samples: Sequence[tuple[int, Quaternion]]) -> None:
        """``samples`` are (time in ns, ``q_ned_body``), oldest first; at least two.

        They are averaged (``AVERAGED``). Otherwise noise would be minimal half-way between two
        samples, and would bias every comparison towards that point.
        """
        self.base_ns = samples[0][0]
        times_s: F64 = np.array([(t - self.base_ns) * 1e-9 for t, _ in samples])
        q: F64 = np.array([q for _, q in samples], np.float64)
        flips = np.where(np.einsum("ij,ij->i", q[1:], q[:-1]) < 0.0, -1.0, 1.0)
        q[1:] *= np.cumprod(flips)[:, None]  # same hemisphere, so that neighbours average
        self.spacing_s = float(np.median(np.diff(times_s)))
        self._step_s = max(self.spacing_s / FINER, 1e-3)
        self._grid_s = self._grid(times_s)
        fine, known = _between(times_s, q, self._grid_s)
        weights = np.concatenate([[0.5], np.ones(AVERAGED - 1), [0.5]]) / AVERAGED
        self._q = np.stack([np.convolve(fine[:, k], weights, "same") for k in range(4)], axis=1)
        self._known: Bool = np.convolve(known, weights, "same") > 0.999

    @property
    def first_s(self) -> float:
        return float(self._grid_s[0])

    @property
    def last_s(self) -> float:
        return float(self._grid_s[-1])

    def _grid(self, times_s: F64) -> F64:
        """Times a step apart; of a gap only two, as where the clock of a log was set."""
        gaps = np.flatnonzero(np.diff(times_s) > MAX_GAP_S)
        first = np.floor(times_s[np.append(0, gaps + 1)] / self._step_s)
        last = np.ceil(times_s[np.append(gaps, len(times_s) - 1)] / self._step_s)
        last[:-1] += 2
        runs = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
        grid: F64 = self._step_s * np.unique(np.concatenate(runs))
        return grid

    def turns(self, start_s: F64, end_s: F64) -> tuple[F64, Bool]:
        """((N, 3) rotation vectors in rad in the axes at the start, (N,) where known). Times are
        seconds since ``base_ns``."""
        first, ok_first = self._at(start_s)
        second, ok_second = self._at(end_s)
        return rotation_vectors(first, second), ok_first & ok_second

    def _at(self, time_s: F64) -> tuple[F64, Bool]:
        """(N, 4) attitudes at times, and where samples are close enough."""
        i = np.searchsorted(self._grid_s, time_s, "right")
        inside = (i > 0) & (i < len(self._grid_s))
        i = np.clip(i, 1, len(self._grid_s) - 1)
        u = np.clip((time_s - self._grid_s[i - 1]) / self._step_s, 0.0, 1.0)[:, None]
        q = (1.0 - u) * self._q[i - 1] + u * self._q[i]
        known = inside & self._known[i - 1] & self._known[i]
        return q / np.linalg.norm(q, axis=1, keepdims=True), known


def _between(times_s: F64, q: F64, at_s: F64) -> tuple[F64, Bool]:
    """(N, 4) attitudes interpolated linearly between samples, and where samples are close enough.
    For samples this close, linear interpolation equals slerp to a thousandth of the rotation."""
    i = np.clip(np.searchsorted(times_s, at_s, "right"), 1, len(times_s) - 1)
    gap = times_s[i] - times_s[i - 1]
    u = (at_s - times_s[i - 1]) / np.maximum(gap, 1e-9)
    mixed = q[i - 1] + np.clip(u, 0.0, 1.0)[:, None] * (q[i] - q[i - 1])
    return mixed, (u > -1e-9) & (u < 1.0 + 1e-9) & (gap < MAX_GAP_S)


def rotation_vectors(first: F64, second: F64) -> F64:
    """(N, 3) rotations in rad from the first to the second (N, 4) attitudes, in the first axes."""
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (first, second))
    cosine = np.sum(a * b, axis=1, keepdims=True)
    axis = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    axis = np.where(cosine < 0, -axis, axis)
    half = np.arctan2(np.linalg.norm(axis, axis=1, keepdims=True), np.abs(cosine))
    return np.asarray(2.0 / np.sinc(half / np.pi) * axis)


def best_rotation(source: F64, target: F64) -> F64:
    """(3, 3) rotation R with ``target ~ R source`` for (N, 3) vectors. Kabsch, DOI
    10.1107/S0567739476001873."""
    u, _, vt = np.linalg.svd(target.T @ source)
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    return np.asarray(u @ turn @ vt)
