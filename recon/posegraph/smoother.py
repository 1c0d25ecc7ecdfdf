"""Poses and drifting scalars held by iSAM2, fed in batches that grow with it.

Kaess et al. 2012, doi:10.1177/0278364911430419, by GTSAM. One update costs a little more with
every pose held, so updates become rarer at the same rate: the mean cost stays flat. Poses not
yet in the smoother are predictions with their own covariance.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from recon import se3
from recon.posegraph import factors as graph_factors
from recon.posegraph.factors import matrix, pose3
from recon.types import F64

LEAST_WAIT, POSES_PER_WAIT = 2, 400
"""So many poses wait between two updates, and one more for each so many that are held."""

WILDFIRE = 1e-3
"""rad and m; corrections smaller than this are not passed on."""

RELINEARISE_POSE, RELINEARISE_SCALAR = (0.02, 0.02, 0.02, 1.0, 1.0, 1.0), 0.02
"""rad and m; what moved further is linearised again, at every tenth update. Motions between
poses bend with the angle and hardly with the place."""

SCALAR = "s"
"""First letter of a scalar's key (``gtsam.symbol``); poses have plain numbers."""

SOUND = 1.0
"""What no scalar reaches: they are logarithms of scales, close to nought by their priors."""

ROUNDS = 3
"""Updates after a change that moves many poses; each linearises again what moved."""


class Smoother:
    """Poses by key 0, 1, 2 …; scalars by symbols of the letter :data:`SCALAR`."""

    def __init__(self, careful: bool = False) -> None:
        """``careful`` steps (Powell's dog leg, in a region of trust) are shorter and slower."""
        import gtsam

        self._gtsam = gtsam
        parameters = gtsam.ISAM2Params()
        solver = gtsam.ISAM2DoglegParams() if careful else gtsam.ISAM2GaussNewtonParams()
        solver.setWildfireThreshold(WILDFIRE)
        parameters.setOptimizationParams(solver)
        thresholds = gtsam.ISAM2ThresholdMap()
        thresholds.insert((chr(0), np.array(RELINEARISE_POSE)))
        thresholds.insert((SCALAR, np.array([RELINEARISE_SCALAR])))
        parameters.setRelinearizeThreshold(thresholds)
        parameters.relinearizeSkip = 10
        parameters.setFactorization("QR")  # loose starts beside tight motions are ill-conditioned
        self._isam: Any = gtsam.ISAM2(parameters)
        self._graph: Any = gtsam.NonlinearFactorGraph()
        self._values: Any = gtsam.Values()
        self._kinds: list[str] = []
        self._noises: list[Any] = []
        self._waiting: dict[int, tuple[F64, F64]] = {}  # pose and its left covariance
        self._held = 0
        self.has_failed = False  # nothing can be solved any more: poses stay as predicted
        self.updates = 0
        self._states: dict[int, tuple[F64, F64]] = {}  # asked for since the last update

    def __len__(self) -> int:
        return self._held + len(self._waiting)

    # ---- what goes in --------------------------------------------------------------------------

    def add(self, factor: Any, kind: str, noise: Any = None) -> None:
        """Take a factor; its residuals are reported under ``kind``.

        ``noise`` is its noise model without a robust loss, when it has one.
        """
        self._graph.add(factor)
        self._kinds.append(kind)
        self._noises.append(noise or factor.noiseModel())

    def add_pose(self, key: int, T: F64, covariance: F64) -> None:
        """A new pose (4, 4) with its predicted left covariance (6, 6); keys follow each other."""
        if key != len(self):
            raise ValueError(f"the next pose has key {len(self)}, got {key}")
        self._values.insert(key, pose3(T))
        self._waiting[key] = (T, covariance)

    def add_scalar(self, key: int, value: float) -> None:
        """A new scalar with its first value."""
        self._values.insert(key, np.array([value]))

    def update(self, now: bool = False, rounds: int = 0) -> bool:
        """True when what waits went into the smoother: enough of it waits, or ``now``.

        Raises RuntimeError when there is no solution; after that nothing goes in any more.
        """
        is_due = now or len(self._waiting) > LEAST_WAIT + self._held // POSES_PER_WAIT
        if self.has_failed or not is_due:
            return False
        try:
            self._solve(rounds)
        except RuntimeError:
            self.has_failed = True
            raise
        self._graph.resize(0)
        self._values.clear()
        self._held += len(self._waiting)
        self._waiting.clear()
        self._states.clear()
        self.updates += 1
        return True

    def _solve(self, rounds: int) -> None:
        self._isam.update(self._graph, self._values)
        g = self._gtsam
        nothing: list[Any] = [g.NonlinearFactorGraph(), g.Values(), [], g.KeyGroupMap()]
        nothing += [g.KeyList(), g.KeyList()]
        for _ in range(rounds):
            self._isam.update(*nothing, True)  # relinearise; no new factors, removals or groups
        if len(self):
            self._isam.calculateEstimatePose3(len(self) - 1)  # by QR, faults show only here

    # ---- what comes out ------------------------------------------------------------------------

    def pose(self, key: int) -> F64:
        """(4, 4) best estimate of a pose."""
        if key in self._waiting:
            return self._waiting[key][0]
        return matrix(self._isam.calculateEstimatePose3(key))

    def state(self, key: int) -> tuple[F64, F64]:
        """A pose and its (6, 6) left covariance."""
        if key in self._waiting:
            return self._waiting[key]
        if key not in self._states:
            T = self.pose(key)
            right = np.asarray(self._isam.marginalCovariance(key), np.float64)
            self._states[key] = (T, graph_factors.left_covariance(T, right))
        return self._states[key]

    def scalar(self, key: int) -> float:
        """Best estimate of a scalar."""
        if self._values.exists(key):
            return float(self._values.atVector(key)[0])
        return float(self._isam.calculateEstimateVector(key)[0])

    def is_sound(self) -> bool:
        """False when a scalar has left :data:`SOUND`, as after steps that led nowhere."""
        held = self._gtsam.utilities.extractVectors(self._isam.calculateEstimate(), SCALAR)
        return bool(np.all(np.abs(np.asarray(held, np.float64)) < SOUND))

    def poses(self) -> F64:
        """(N, 4, 4) of all poses in the order of their keys."""
        out = np.tile(np.eye(4), (len(self), 1, 1))
        if self._held:
            rows = np.asarray(
                self._gtsam.utilities.extractPose3(self._isam.calculateEstimate()), np.float64
            )
            out[: self._held, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
            out[: self._held, :3, 3] = rows[:, 9:]
        for key, (T, _) in self._waiting.items():
            out[key] = T
        return out

    def residuals(self) -> dict[str, F64]:
        """Whitened residuals of all factors in the smoother by kind, one row per factor.

        Robust losses are left out: a residual is the error over its sigma. Empty where there is
        no solution.
        """
        if self.has_failed:
            return {}
        values, factors = self._isam.calculateEstimate(), self._isam.getFactorsUnsafe()
        out: dict[str, list[F64]] = {}
        for i, kind in enumerate(self._kinds[: factors.size()]):
            error = graph_factors.whitened(factors.at(i), self._noises[i], values)
            out.setdefault(kind, []).append(error)
        return {kind: np.array(rows) for kind, rows in out.items()}


def moved_covariance(spread: F64, T: F64, covariance: F64) -> F64:
    """(6, 6) left covariance after a motion with left ``covariance`` in the frame of ``T``."""
    A = se3.adjoint(T)
    return np.asarray(spread + A @ covariance @ A.T)
