"""Velocity of the vehicle integrated along the flight.

Between two instants of one run the difference of two travels is the displacement, with an error
that grows with time only. That gives the scale of the odometry better than fixes, whose error
wanders (:mod:`recon.graph.alignment`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recon.types import F64, PosePrior, Travel

MAX_GAP_S = 3.0
"""A longer time without a velocity begins a new run."""


class Odometer:
    """Takes the prior of every frame, in the order of time, and adds the travel to it."""

    def __init__(self) -> None:
        """Nothing is travelled yet."""
        self._last: tuple[int, F64] | None = None  # time in ns, (3,) m/s
        self._travel = Travel(np.zeros(3), 0.0, 0)

    def take(self, time_ns: int, prior: PosePrior) -> PosePrior:
        """The prior with its travel; as it is when it has no velocity."""
        velocity = prior.velocity_m_s
        if velocity is None or not np.isfinite(velocity).all():
            return prior
        last, self._last = self._last, (time_ns, velocity)
        before = self._travel
        passed_s = 0.0 if last is None else (time_ns - last[0]) * 1e-9
        if last is None or not 0.0 < passed_s <= MAX_GAP_S:
            self._travel = Travel(np.zeros(3), 0.0, before.run + 1)
        else:
            way = 0.5 * passed_s * (last[1] + velocity)
            self._travel = Travel(before.metres + way, before.seconds + passed_s, before.run)
        return replace(prior, travel=self._travel)
