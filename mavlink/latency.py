"""What the pictures' own rotation says of telemetry: the camera's latency, the gimbal's frame.

A frame stamped ``t`` was exposed at ``t - latency``. The rotation speed seen between frames,
shifted by the latency, must follow the vehicle's (VINS calls it ``td``, DOI
10.1109/IROS.2018.8593603). Only speeds are compared, so that the camera's mount need not be
known; what is compared is the head's speed for a gimbal, the body's for a fixed mount.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from mavlink.gimbal import FrameVerdict, judge_frame
from mavlink.history import VehicleHistory
from mavlink.quaternion import Quaternion, angle_between

F64 = npt.NDArray[np.float64]

LEAST_STEPS = 60
LEAST_FRAMES = 20
LEAST_SPREAD_RAD_S = 0.02  # calmer flight tells nothing
LEAST_CORRELATION = 0.7
LONGEST_GAP_S = 0.25  # between attitudes
KEPT = 900
GRID_S = 0.005


@dataclass(frozen=True, slots=True)
class LatencyEstimate:
    """The latency that fits best."""

    latency_ms: float
    sigma_ms: float
    correlation: float  # of the two speeds at that latency, 0 to 1
    steps: int  # frames that took part


class FrameWatch:
    """Collects rotations between frames and says what the gimbal's quaternion refers to."""

    def __init__(self, history: VehicleHistory) -> None:
        self._history = history
        self._runs: deque[tuple[int, int, Quaternion]] = deque(maxlen=KEPT)

    def add(self, first_ns: int, second_ns: int, q_step: Quaternion) -> None:
        """Take in ``q_head(first)_head(second)``, seen between two frames, in the head's axes."""
        if second_ns > first_ns:
            self._runs.append((first_ns, second_ns, q_step))

    def verdict(self, latency_ms: float = 0.0) -> FrameVerdict | None:
        """The frame that agrees with the pictures; None with less than twenty to go by."""
        shift = round(latency_ms * 1e6)
        sent: list[tuple[Quaternion, Quaternion]] = []
        bodies: list[tuple[Quaternion, Quaternion]] = []
        steps: list[Quaternion] = []
        for first_ns, second_ns, step in self._runs:
            first = self._history.claimed_at(first_ns - shift)
            second = self._history.claimed_at(second_ns - shift)
            if first is not None and second is not None:
                sent.append((first[0], second[0]))
                bodies.append((first[1], second[1]))
                steps.append(step)
        return judge_frame(sent, bodies, steps) if len(steps) >= LEAST_FRAMES else None


class LatencyWatch:
    """Collects rotations between frames and says what latency they speak for."""

    def __init__(self, range_ms: tuple[float, float] = (-200.0, 800.0)) -> None:
        if not range_ms[0] < range_ms[1]:
            raise ValueError(f"latency range {range_ms} must go upwards")
        self._range_ms = range_ms
        self._steps: deque[tuple[int, int, float]] = deque(maxlen=KEPT)

    def add(self, first_ns: int, second_ns: int, angle_rad: float) -> None:
        """Take in the angle that the camera turned by between two frames, at their stamps."""
        if second_ns > first_ns and np.isfinite(angle_rad):
            self._steps.append((first_ns, second_ns, abs(angle_rad)))

    def estimate(self, attitudes: Sequence[tuple[int, Quaternion]]) -> LatencyEstimate | None:
        """The latency by attitudes (time in ns, attitude) over the same time.

        None while there are too few frames, too calm a flight, or no clear answer.
        """
        if len(self._steps) < LEAST_STEPS or len(attitudes) < LEAST_STEPS:
            return None
        base_ns = attitudes[0][0]
        steps = np.array(
            [((a - base_ns) * 1e-9, (b - base_ns) * 1e-9, angle) for a, b, angle in self._steps]
        )
        times, turned, valid = _turned(attitudes, base_ns)
        low, high = (limit * 1e-3 for limit in self._range_ms)
        inside = (steps[:, 0] - high > times[0]) & (steps[:, 1] - low < times[-1])
        steps = steps[inside]
        if len(steps) < LEAST_STEPS:
            return None
        lags: F64 = np.arange(low, high + GRID_S / 2, GRID_S, dtype=np.float64)
        scores = np.array([_score(steps, times, turned, valid, float(lag)) for lag in lags])
        return _peak(lags, scores, len(steps))


def _turned(attitudes: Sequence[tuple[int, Quaternion]], base_ns: int) -> tuple[F64, F64, F64]:
    """Times in s, angle turned so far in rad, and time so far without gaps in s."""
    times = np.array([(t - base_ns) * 1e-9 for t, _ in attitudes])
    angles = np.array([angle_between(a, b) for (_, a), (_, b) in pairwise(attitudes)])
    gaps = np.diff(times)
    good = np.where(gaps < LONGEST_GAP_S, gaps, 0.0)
    return times, np.append(0.0, np.cumsum(angles)), np.append(0.0, np.cumsum(good))


def _score(steps: F64, times: F64, turned: F64, valid: F64, lag: float) -> float:
    """Correlation of the speeds seen with the vehicle's at a lag; NaN where it says nothing."""
    start, end = steps[:, 0] - lag, steps[:, 1] - lag
    known = np.interp(end, times, valid) - np.interp(start, times, valid)
    use = known > 0.9 * (end - start)
    if use.sum() < LEAST_STEPS:
        return float("nan")
    span = (end - start)[use]
    ours = (np.interp(end, times, turned) - np.interp(start, times, turned))[use] / span
    seen = steps[use, 2] / span
    if min(ours.std(), seen.std()) < LEAST_SPREAD_RAD_S:
        return float("nan")
    return float(np.corrcoef(ours, seen)[0, 1])


def _peak(lags: F64, scores: F64, count: int) -> LatencyEstimate | None:
    """The top of the correlation by a parabola; None at an edge or when it is low."""
    if not np.isfinite(scores).any():
        return None
    k = int(np.nanargmax(scores))
    if not 0 < k < len(lags) - 1 or not np.isfinite(scores[k - 1 : k + 2]).all():
        return None
    best = float(scores[k])
    bend = float(scores[k - 1] - 2.0 * best + scores[k + 1]) / GRID_S**2
    if best < LEAST_CORRELATION or bend >= 0.0:
        return None
    slope = float(scores[k + 1] - scores[k - 1]) / (2.0 * GRID_S)
    latency = float(lags[k]) - slope / bend
    # A correlation of n pairs is known to about (1 - r^2) / sqrt(n); so far may the top lie.
    sigma = float(np.sqrt(2.0 * (1.0 - best**2) / np.sqrt(count) / -bend))
    return LatencyEstimate(1e3 * latency, 1e3 * sigma, best, count)
