"""The readout of a rolling shutter, found by the residuals of windows of keyframes.

Each window is adjusted at several readouts; a parabola through the costs about the best has its
minimum at the window's own readout. The motion of the rows comes from the poses of
neighbouring frames, which a wrong readout bends, so the search repeats from window to window.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from recon.rolling_shutter import RowClock
from recon.tracking import bundle
from recon.tracking.bundle import HUBER_PX
from recon.tracking.frame import Frame
from recon.tracking.keyframe_window import observations
from recon.types import F64

KEYFRAMES, FIRST_KEYFRAMES = 5, 3
"""Keyframes of a window, and until the readout is sure, as what is not known of it bends long ones;
the next window begins at its last one."""

COARSE_S = 1e-3 * np.arange(-40.0, 41.0, 10.0)  # readouts that are tried while none is sure
STEP_S = 5e-3  # spacing of the readouts tried around the one in use, once it is sure
NEAR_S = 1e-3  # a readout further from the one in use starts the search again
MAX_READOUT_S = 0.05  # longest readout tried: an image at 20 a second is read by then
MIN_SIGMAS = 5.0  # a readout is taken over when it differs from none by so many sigmas
FLOOR_S = 1e-4  # sigma of the row motion's own errors
BENT = 0.1  # of the way from the readout in use, by which the rows' motion was bent: a sigma
MIN_WINDOWS = 2  # fewer make nothing sure
GLOBAL_S = 5e-4  # a readout and a sigma below it show a global shutter
USUAL_S = 0.02  # sigma of a readout of which nothing is known: cameras of drones read in 0 to 35 ms


class ReadoutSearch:
    """Looks at keyframes as they settle, and sets the clock of their rows. ``readout_s`` is
    negative against the shutter's direction; ``windows`` of keyframes show it, 0 until one does."""

    def __init__(self, clock: RowClock, K: F64) -> None:
        self.readout_s, self.sigma_s, self.windows = 0.0, USUAL_S, 0
        self._clock, self._K = clock, K
        self._last_seq = -1
        self._found: deque[tuple[float, float]] = deque(maxlen=4)  # readout, weight

    @property
    def is_open(self) -> bool:
        return self.windows == 0 and self._clock.readout_s == 0.0

    @property
    def is_sure(self) -> bool:
        """True where the windows agree that it is not zero."""
        return self.windows >= MIN_WINDOWS and abs(self.readout_s) > MIN_SIGMAS * self.sigma_s

    @property
    def is_none(self) -> bool:
        """True where the images show a global shutter."""
        is_known = self.windows >= MIN_WINDOWS and self.sigma_s < GLOBAL_S
        return is_known and abs(self.readout_s) < GLOBAL_S

    @property
    def doubt_s(self) -> float:
        """Sigma of the readout in use."""
        if self.windows == 0:
            return USUAL_S if self.is_open else 0.0
        off_s = self.readout_s - self._clock.readout_s
        return min(float(np.hypot(self.sigma_s, off_s)), USUAL_S)

    def update(self, keyframes: list[Frame]) -> bool:
        """Search once the newest of the ``keyframes``, all settled, ends a further window. True
        where this changes the readout in use."""
        before_s = self._clock.readout_s
        size = KEYFRAMES if self.is_sure or self.doubt_s == 0.0 else FIRST_KEYFRAMES
        window = keyframes[-size:]
        if len(window) < size or window[0].seq < self._last_seq:
            return False
        if all(key.row_motion.is_measured for key in window):
            self._last_seq = window[-1].seq
            self._take(window)
        return self._clock.readout_s != before_s

    def _take(self, window: list[Frame]) -> None:
        now = self._clock.readout_s
        tried = now + STEP_S * np.arange(-1.0, 2.0) if self.is_sure else COARSE_S
        costs = [window_cost(window, float(readout_s), self._K) for readout_s in tried]
        k = int(np.clip(np.argmin([cost for cost, _ in costs]), 1, len(tried) - 2))
        (below, _), (here, redundancy), (above, _) = costs[k - 1 : k + 2]
        spacing = tried[1] - tried[0]
        curvature = (below - 2.0 * here + above) / spacing**2
        if curvature <= 0.0 or redundancy <= 0 or here <= 0.0:
            return
        step = np.clip((below - above) / (2.0 * spacing * curvature), -spacing, spacing)
        best = float(tried[k] + step)
        if abs(best - now) > NEAR_S:
            self._found.clear()
            self._last_seq += 1  # its keyframe takes no part in the next window
        self._found.append((best, float(0.5 * curvature * redundancy / here)))
        self._combine(max(BENT * abs(best - now), FLOOR_S))

    def _combine(self, floor_s: float) -> None:
        readouts, weights = np.array(self._found).T
        mean = float(weights @ readouts / weights.sum())
        spread = weights @ (readouts - mean) ** 2 / weights.sum() / max(len(weights) - 1, 1)
        sigma = float(np.sqrt(max(1.0 / weights.sum(), spread, floor_s**2)))
        self.readout_s, self.sigma_s, self.windows = mean, sigma, len(weights)
        is_refined = self._clock.readout_s != 0.0 and sigma < GLOBAL_S
        if is_refined or abs(mean) > MIN_SIGMAS * sigma:
            self._clock.readout_s = float(np.clip(mean, -MAX_READOUT_S, MAX_READOUT_S))


def window_cost(window: list[Frame], readout_s: float, K: F64) -> tuple[float, int]:
    """Huber cost, px^2, of the window adjusted with a readout, and its redundancy."""
    ids, index, camera, uv = observations(window, K, 3, readout_s)  # two give way to any readout
    T_camera_odom, free = np.stack([k.T_camera_odom for k in window]), np.arange(len(window)) > 0
    found = bundle.adjust(T_camera_odom, window[0].landmarks[ids], camera, index, uv, K, free)
    error = np.minimum(found.residual_px, 1e3)
    cost = np.where(error < HUBER_PX, error**2, 2.0 * HUBER_PX * error - HUBER_PX**2)
    return float(cost.sum()), 2 * len(error) - 3 * len(ids) - 6 * (len(window) - 1)
