"""Poses and drifting scales that fit all factors best: sparse Gauss-Newton over arrays.

Nothing is incremental: new poses are predicted until they are solved, and more may wait the more
is held, so that the mean cost of a pose stays flat. docs/pose-graph.md has the errors and their
Jacobians. A pose is perturbed by a rotation about its own camera and a shift, both in world axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from recon import parallel, se3
from recon.table import Rows, Table
from recon.types import F64, I64

MIN_WAIT, POSES_PER_WAIT = 2, 100  # poses that wait between updates; poses held for one more
STEPS, MANY_STEPS = 1, 10  # maximum number of steps of an update, and where many poses may move far
SMALL_STEP = 1e-3  # rad, m and log scale; none follows a step that is smaller
SHARES = 0.5 ** np.arange(8)  # shares of a step, tried in turn until the cost falls
NO_SCALE = 0  # key of a scale that is held at 1

MOTION = np.dtype(
    [("a", int), ("b", int), ("scale", int), ("unit", int), ("R", float, (3, 3)),
     ("t", float, (3,)), ("weight", float, (6, 6))]
)  # fmt: skip
TURN = np.dtype([("key", int), ("R", float, (3, 3)), ("weight", float, (3,))])
PLACE = np.dtype([("key", int), ("t", float, (3,)), ("weight", float, (3,))])
SCALE = np.dtype([("a", int), ("b", int), ("log", float), ("weight", float)])


class State(NamedTuple):
    R: F64  # (N, 3, 3)
    t: F64  # (N, 3) m
    logs: F64  # (M,)

    def moved(self, step: F64) -> State:
        """The state after a step (6 N + M,)."""
        poses = step[: 6 * len(self.R)].reshape(-1, 6)
        return State(
            se3.each_so3_exp(poses[:, :3]) @ self.R,
            self.t + poses[:, 3:],
            self.logs + step[6 * len(self.R) :],
        )


Linear = tuple[F64, F64, I64]
"""Factors of one kind about a state: whitened errors (n, d), their Jacobian (n, d, k), and the
unknowns (n, k) that it is of."""


def _of_motions(rows: Rows, at: State) -> Linear:
    """log of T_a_b over the motion, whose lengths grow with a scale; left in the frame of a.

    Lengths are compared in a unit that is a scale of the same track: in metres, motions that
    contradict each other would agree better the smaller the map is.
    """
    a, b, scale = rows["a"], rows["b"], rows["scale"]
    R_a_world = at.R[a].transpose(0, 2, 1)
    turned = at.R[b] @ rows["R"].transpose(0, 2, 1)
    expected = np.einsum("nij,nj->ni", turned, rows["t"] * np.exp(at.logs[scale])[:, None])
    apart = at.t[b] - at.t[a] - expected  # m, in the world
    per_unit = np.exp(-at.logs[rows["unit"]])[:, None]
    R_a_units = R_a_world * per_unit[:, :, None]
    off = np.einsum("nij,nj->ni", R_a_units, apart)
    error = np.hstack([se3.each_so3_log(R_a_world @ turned), off])
    J = np.zeros((len(rows), 6, 14))
    J[:, :3, 0:3], J[:, 3:, 3:6] = -R_a_world, -R_a_units
    J[:, :3, 6:9], J[:, 3:, 9:12] = R_a_world, R_a_units
    J[:, 3:, 0:3] = R_a_units @ se3.hat(apart)
    J[:, 3:, 6:9] = R_a_units @ se3.hat(expected)
    J[:, 3:, 12] = -np.einsum("nij,nj->ni", R_a_units, expected)
    J[:, 3:, 13] = -off
    J[scale == NO_SCALE, :, 12] = J[rows["unit"] == NO_SCALE, :, 13] = 0.0
    of_scales = [scale_columns(at, scale), scale_columns(at, rows["unit"])]
    columns = np.hstack([columns_of(a, 0, 6), columns_of(b, 0, 6), *of_scales])
    error = np.einsum("nij,nj->ni", rows["weight"], error)
    return error, rows["weight"] @ J, columns


def _of_turns(rows: Rows, at: State) -> Linear:
    """Rotation from the measured one, in world axes."""
    error = se3.each_so3_log(at.R[rows["key"]] @ rows["R"].transpose(0, 2, 1)) * rows["weight"]
    return error, np.eye(3) * rows["weight"][:, :, None], columns_of(rows["key"], 0, 3)


def _of_places(rows: Rows, at: State) -> Linear:
    error = (at.t[rows["key"]] - rows["t"]) * rows["weight"]
    return error, np.eye(3) * rows["weight"][:, :, None], columns_of(rows["key"], 3, 6)


def _of_scales(rows: Rows, at: State) -> Linear:
    """Log of b's scale over a's, less the measured one."""
    weight = rows["weight"][:, None]
    error = (at.logs[rows["b"]] - at.logs[rows["a"]] - rows["log"])[:, None] * weight
    J = np.stack([np.where(rows["a"][:, None] == NO_SCALE, 0.0, -weight), weight], axis=2)
    return error, J, np.hstack([scale_columns(at, rows["a"]), scale_columns(at, rows["b"])])


def columns_of(keys: I64, first: int, end: int) -> I64:
    """(n, end - first) columns of poses: 0 to 3 turn them, 3 to 6 shift them."""
    return np.asarray(6 * keys[:, None] + np.arange(first, end))


def scale_columns(at: State, keys: I64) -> I64:
    return np.asarray(6 * len(at.R) + keys[:, None])


class Factors:
    def __init__(
        self, form: Callable[[Rows, State], Linear], dtype: np.dtype[Any], huber: float,
        cauchy: float = np.inf,
    ) -> None:  # fmt: skip
        """Whitened errors longer than ``huber`` lose weight; by ``cauchy`` they lose all of it."""
        self.form, self.huber, self.cauchy = form, huber, cauchy
        self.table = Table(dtype)

    def loss(self, length: F64) -> tuple[F64, F64]:
        """(n,) weights and costs of whitened errors of this length (n,)."""
        if np.isfinite(self.cauchy):
            share = (length / self.cauchy) ** 2
            return 1.0 / (1.0 + share), 0.5 * self.cauchy**2 * np.log1p(share)
        weight = np.minimum(1.0, self.huber / np.maximum(length, 1e-12))
        return weight, weight * length * (length - 0.5 * weight * length)


@dataclass(frozen=True, eq=False)
class System:
    """The normal equations about a state."""

    at: State
    H: Any  # sparse (U, U) information
    g: F64  # (U,)
    cost: float

    @staticmethod
    def of(factors: list[Factors], at: State) -> System:
        parallel.release_gil()
        count, first_log = 6 * len(at.R) + len(at.logs), 6 * len(at.R)
        held = np.array([first_log + NO_SCALE])
        values, rows, columns, g, cost = [np.ones(1)], [held], [held], np.zeros(count), 0.0
        for one in factors:
            error, J, unknowns = one.form(one.table.rows, at)
            weight, costs = one.loss(np.linalg.norm(error, axis=1))
            cost += float(np.sum(costs))
            JW, width = J.transpose(0, 2, 1) * weight[:, None, None], unknowns.shape[1]
            g += np.bincount(unknowns.ravel(), (JW @ error[:, :, None]).ravel(), count)
            values.append((JW @ J).ravel())
            rows.append(np.repeat(unknowns, width, axis=1).ravel())
            columns.append(np.tile(unknowns, (1, width)).ravel())
        where = np.concatenate(rows), np.concatenate(columns)
        H = sparse.csc_matrix((np.concatenate(values), where), shape=(count, count))
        return System(at, H, g, cost)

    @cached_property
    def factors(self) -> Any:
        """The information, factorised. Raises RuntimeError where it is singular."""
        return splu(
            self.H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip

    def covariance(self, key: int) -> F64:
        """(6, 6) of a pose, as a left perturbation in the world."""
        unit = np.zeros((len(self.g), 6))
        unit[6 * key : 6 * key + 6] = np.eye(6)
        own = self.factors.solve(unit)[6 * key : 6 * key + 6]
        return se3.about(-self.at.t[key], 0.5 * (own + own.T))


def solved(factors: list[Factors], start: State, steps: int) -> System:
    """The system about the state with the lowest cost that is found in so many steps. Raises
    RuntimeError when there is none."""
    system = System.of(factors, start)
    if not np.isfinite(system.cost):
        raise RuntimeError("factors are not finite")
    for _ in range(steps):
        step = -system.factors.solve(system.g)
        tried = (System.of(factors, system.at.moved(share * step)) for share in SHARES)
        lower = next((one for one in tried if one.cost <= system.cost), None)
        if lower is None:
            break
        system = lower
        if np.abs(step).max() < SMALL_STEP:
            break
    return system


class Smoother:
    """Poses by key 0, 1, 2 ...; scales by key from 1 on, :data:`NO_SCALE` before them."""

    def __init__(self) -> None:
        self.factors: dict[str, Factors] = {}
        self._held = System.of([], State(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(1)))
        self._waiting: list[tuple[F64, F64]] = []  # pose and its left covariance
        self._fresh_logs: list[float] = []
        self._covariances: dict[int, F64] = {}  # asked for since the last update
        self.updates = 0

    def __len__(self) -> int:
        return len(self._held.at.R) + len(self._waiting)

    # ---- what goes in --------------------------------------------------------------------------

    def add_motion(
        self, kind: str, keys: tuple[int, int], T_a_b: F64, covariance: F64,
        scale: int = NO_SCALE, unit: int = NO_SCALE, huber: float = np.inf,
    ) -> None:  # fmt: skip
        """A motion (4, 4) between poses a and b, whose lengths grow with a ``scale``; its
        covariance (6, 6) is of the left perturbation in a's frame, whose lengths grow with the
        scale ``unit``."""
        weight = np.linalg.inv(np.linalg.cholesky(covariance))
        row = (*keys, scale, unit, T_a_b[:3, :3], T_a_b[:3, 3], weight)
        self.add(_of_motions, MOTION, kind, row, huber)

    def add_turn(self, kind: str, key: int, R: F64, sigma: F64, huber: float = np.inf) -> None:
        """A rotation (3, 3) of a pose; sigma (3,) in rad about the world's axes."""
        self.add(_of_turns, TURN, kind, (key, R, 1.0 / sigma), huber)

    def add_place(
        self, kind: str, key: int, place: F64, sigma: F64, huber: float = np.inf,
        cauchy: float = np.inf,
    ) -> None:  # fmt: skip
        """A place (3,) of a pose, with sigma (3,) m; infinite where nothing is known."""
        self.add(_of_places, PLACE, kind, (key, place, 1.0 / sigma), huber, cauchy)

    def add_scale(
        self, kind: str, keys: tuple[int, int], log: float, sigma: float, huber: float = np.inf
    ) -> None:
        """The log of scale b over scale a."""
        self.add(_of_scales, SCALE, kind, (*keys, log, 1.0 / sigma), huber)

    def add(
        self, form: Callable[[Rows, State], Linear], dtype: np.dtype[Any], kind: str,
        row: tuple[Any, ...], huber: float = np.inf, cauchy: float = np.inf,
    ) -> None:  # fmt: skip
        """A factor of any form; all of one kind share a loss (:class:`Factors`)."""
        if kind not in self.factors:
            self.factors[kind] = Factors(form, dtype, huber, cauchy)
        self.factors[kind].table.append(np.array([row], dtype))

    def append_pose(self, T: F64, covariance: F64) -> None:
        """The next pose (4, 4) with its predicted left covariance (6, 6)."""
        self._waiting.append((T, covariance))

    def append_scale(self, log: float) -> int:
        """The key of a new scale that begins with this logarithm."""
        self._fresh_logs.append(log)
        return len(self._held.at.logs) + len(self._fresh_logs) - 1

    def update(self, now: bool = False, steps: int = STEPS) -> bool:
        """Solve the waiting factors if there are enough or ``now``; True when it did. Raises
        RuntimeError when there is no solution; all stays as predicted then."""
        held = self._held.at
        if not now and len(self._waiting) <= MIN_WAIT + len(held.R) // POSES_PER_WAIT:
            return False
        T = np.array([T for T, _ in self._waiting]).reshape(-1, 4, 4)
        start = State(
            np.concatenate([held.R, T[:, :3, :3]]),
            np.concatenate([held.t, T[:, :3, 3]]),
            np.concatenate([held.logs, self._fresh_logs]),
        )
        self._held = solved(list(self.factors.values()), start, steps)
        self._waiting, self._fresh_logs = [], []
        self._covariances.clear()
        self.updates += 1
        return True

    # ---- what comes out ------------------------------------------------------------------------

    def pose(self, key: int) -> F64:
        """(4, 4) best estimate of a pose."""
        held = self._held.at
        if key >= len(held.R):
            return self._waiting[key - len(held.R)][0]
        return se3.compose(held.R[key], held.t[key])

    def state(self, key: int) -> tuple[F64, F64]:
        """A pose and its (6, 6) left covariance."""
        if key >= len(self._held.at.R):
            return self._waiting[key - len(self._held.at.R)]
        if key not in self._covariances:
            self._covariances[key] = self._held.covariance(key)
        return self.pose(key), self._covariances[key]

    def logs(self) -> F64:
        """(M,) logarithms of all scales, by their keys."""
        return np.concatenate([self._held.at.logs, self._fresh_logs])

    def poses(self) -> F64:
        """(N, 4, 4) of all poses in the order of their keys."""
        held = self._held.at
        out = np.tile(np.eye(4), (len(self), 1, 1))
        out[: len(held.R), :3, :3], out[: len(held.R), :3, 3] = held.R, held.t
        for key, (T, _) in enumerate(self._waiting, len(held.R)):
            out[key] = T
        return out

    def residuals(self) -> dict[str, F64]:
        """Whitened errors of all factors by kind, one row per factor, without their losses. Empty
        while something waits."""
        if self._waiting:
            return {}
        at = self._held.at
        return {kind: one.form(one.table.rows, at)[0] for kind, one in self.factors.items()}
