"""The constant by which an autopilot's altitude is off, from all fixes of the GNSS receiver.

An autopilot's altitude follows its barometer, whose zero is off by decimetres to metres. The
receiver's own altitudes scatter more, but about another mean. The part of the receiver's claimed
sigma that shows as scatter from fix to fix averages out; the rest wanders (first-order
Gauss-Markov, as in :mod:`recon.posegraph.readings`) and stays. The autopilot's altitude rests on
the same receiver, so the receiver's mean is taken over only as far as it is the better one. Where
the scatter could be all of the sigma, it is taken to be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.types import PosePrior

LEAST = 3
"""Minimum number of intervals between keyframes with fixes."""

STEADY_SHARE = 0.1
"""Share of the claimed sigma that always stays: one flight cannot show all errors of a receiver."""

OFF_SIGMAS = 4.0
"""Intervals further from the median than so many of the scatter and the sigma do not count."""

WILD_STEPS = 36.0
"""Squared steps from fix to fix beyond so many of their median are jumps, not scatter."""


@dataclass(frozen=True, slots=True)
class AltitudeDatum:
    """Correction to add to altitudes, and the sigma of what is then left of the constant."""

    shift_m: float = 0.0
    sigma_m: float = float("inf")

    def applied(self, prior: PosePrior) -> PosePrior:
        """The prior with its position raised."""
        if self.shift_m == 0.0 or prior.position_m is None:
            return prior
        return replace(prior, position_m=prior.position_m + np.array([0.0, 0.0, self.shift_m]))


def altitude_datum(
    priors: Sequence[PosePrior], span_s: float, wander_s: float = 60.0
) -> AltitudeDatum:
    """The datum by all fixes of a flight of ``span_s``, in the order of time.

    ``wander_s`` is the time constant of a receiver's wander.
    """
    rows = [
        (p.above_m, p.above_fixes, p.sigma_position_m[2])
        for p in priors
        if p.above_m is not None and p.above_fixes > 0 and p.sigma_position_m is not None
    ]
    if len(rows) < LEAST:
        return AltitudeDatum()
    above, fixes, claimed = np.array(rows, np.float64).T
    sigma = float(np.median(claimed))
    steps = np.diff(above) ** 2 / (1.0 / fixes[1:] + 1.0 / fixes[:-1])
    usual = steps[steps <= WILD_STEPS * np.median(steps)]
    white = float(np.sqrt(usual.mean()))  # of one fix
    doubt = 1.0 + 2.0 * np.sqrt(3.0 / len(usual))  # of a variance by so many steps
    apart = np.abs(above - np.median(above))
    near = apart <= OFF_SIGMAS * np.sqrt(white**2 / fixes + sigma**2)
    mean = float(np.average(above[near], weights=fixes[near]))
    slow = max(sigma**2 - doubt * white**2, (STEADY_SHARE * sigma) ** 2)
    slow /= 1.0 + max(span_s, 0.0) / (2.0 * max(wander_s, 1e-3))
    left = slow + white**2 / float(fixes[near].sum())
    share = max(0.0, 1.0 - 2.0 * left / sigma**2)
    return AltitudeDatum(float(share * mean), float(np.sqrt(left)) if share > 0 else sigma)
