"""All poses, points and the one camera of a flight, adjusted at once from their pixels.

Levenberg-Marquardt with the Schur complement on the points (Triggs et al., Bundle Adjustment - A
Modern Synthesis, 2000, doi:10.1007/3-540-44480-7_21). The reduced system of the poses is sparse:
two of them meet only where they see a common point. The camera is a dense border of eight columns.
After each step every point goes on alone to where its sightings cost least: poses and camera then
follow the curved valley in which a focal length and a height trade places (variable projection;
Ruhe and Wedin, SIAM Review 22, 1980, doi:10.1137/1022057).
Poses err by left perturbations of T_camera_world, rotation first. Under a rolling shutter each view
has three unknowns more: its turn from the first row to the last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from recon import se3
from recon.calibration.bundle_kernels import (
    CAMERA,
    errors,
    mark_pairs,
    reduce_points,
    settle_points,
)
from recon.parallel import parallel_for, run_parallel
from recon.rolling_shutter import row_shares
from recon.types import F64, I64, Camera

DAMPING, MAX_DAMPING = 1e-6, 1e-5
"""At the start, as a share of the diagonal, and where a short step still means the end."""

SETTLED_SIGMAS = 0.01
"""Length, over the sigmas of poses and camera together, of a step after which none follows."""

PARTS = 8
"""Of the points, whose sums are made at the same time: the result is that of any number of cores.
"""

MAX_COVARIANCES = 100
"""Number of poses whose covariance is computed; the others take that of the nearest one."""


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Landmarks seen in distorted images of full size; one row of each array per sighting."""

    view: I64  # (M,) which pose
    landmark: I64  # (M,) which landmark
    uv_px: F64  # (M, 2)


def joint(a: Sightings, b: Sightings) -> Sightings:
    return Sightings(
        np.append(a.view, b.view), np.append(a.landmark, b.landmark),
        np.concatenate([a.uv_px, b.uv_px]),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """Prior knowledge about N poses and P points, besides their pixels; NaN where there is none."""

    fixes: F64  # (N, 3) measured places of the cameras, m, world
    sigma_fixes: F64  # (N, 3)
    attitudes: F64  # (N, 3, 3) R_world_camera
    sigma_attitudes: F64  # (N, 3) about the world's axes, rad
    surveyed: F64  # (P, 3) places of points, m, world
    sigma_surveyed: F64  # (P, 3)
    placed: F64  # (N, 4, 4) T_world_camera, with the
    placing: F64  # (N, 6, 6) information of a left perturbation of T_camera_world

    @classmethod
    def none(cls, poses: int, points: int) -> Knowledge:
        def unknown(*shape: int) -> F64:
            return np.full(shape, np.nan)

        return cls(
            fixes=unknown(poses, 3), sigma_fixes=unknown(poses, 3),
            attitudes=unknown(poses, 3, 3), sigma_attitudes=unknown(poses, 3),
            surveyed=unknown(points, 3), sigma_surveyed=unknown(points, 3),
            placed=np.tile(np.eye(4), (poses, 1, 1)), placing=np.zeros((poses, 6, 6)),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class RowMotion:
    """How N cameras move from the first row of an image to the last.

    T_camera_world of a row is ``exp(share * (turn, move))`` times that of the middle row, where
    ``share`` goes from -0.5 to 0.5. A turn is free about what is ``expected``: over flat ground
    pixels alone do not determine it (arXiv:2209.08503).
    """

    turns: F64  # (N, 3) rad
    moves: F64  # (N, 3) m, known
    expected: F64  # (N, 3) rad
    sigma_turns: F64  # (N, 3) rad

    def by_row(self, camera: Camera, poses: F64, seen: Sightings) -> F64:
        """(M, 4, 4) T_world_camera of each sighting's row; ``poses`` (N, 4, 4) of the views."""
        share = row_shares(camera, seen.uv_px[:, camera.shutter.axis])
        T, own = se3.each_inverse(poses), seen.view
        return se3.each_inverse(_of_rows(T[own], self.turns[own], self.moves[own], share))


def _of_rows(T: F64, turns: F64, moves: F64, share: F64) -> F64:
    """(M, 4, 4) T_camera_world of rows, to second order in the turn across the image."""
    w, t = share[:, None] * turns, share[:, None] * moves
    rows = np.zeros_like(T)
    rows[:, :3, :3], rows[:, 3, 3] = se3.each_so3_exp(w), 1.0
    rows[:, :3, 3] = t + 0.5 * np.cross(w, t)
    return np.asarray(rows @ T)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    poses: F64  # (N, 4, 4) T_world_camera
    points: F64  # (P, 3) world, m; NaN where neither rays nor a survey place one
    camera: Camera
    errors_px: F64  # (M,) lengths, infinite behind the camera
    covariances: F64  # (N, 6, 6) left perturbation of T_world_camera; empty when not asked for
    camera_covariance: F64  # (8, 8) of CAMERA's parameters
    camera_step: F64  # (8,) that the equations at the result still ask for
    rows: RowMotion | None = None  # None: a global shutter


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Sightings with a start; ``camera_information`` (8, 8) holds the camera to ``given``."""

    camera: Camera
    given: Camera
    poses: F64  # (N, 4, 4) T_world_camera
    points: F64  # (P, 3) world, m
    seen: Sightings
    sigma_px: F64  # (M,) of a coordinate
    known: Knowledge
    camera_information: F64
    huber_sigmas: float = 1.5
    cauchy_sigmas: float = 2.0  # of a fix
    rows: RowMotion | None = None  # None: a global shutter

    def widened(self, by: float) -> Problem:
        """The same with sightings that scatter more; Huber's limit stays the same in pixels."""
        return replace(self, sigma_px=by * self.sigma_px, huber_sigmas=self.huber_sigmas / by)


def errors_px(
    camera: Camera, poses: F64, points: F64, seen: Sightings, rows: RowMotion | None = None
) -> F64:
    """(M,) lengths of the errors of sightings; infinite behind the camera, or of no point."""
    out, pose = np.zeros((len(seen.view), 2)), seen.view
    if rows is not None:
        poses, pose = rows.by_row(camera, poses, seen), np.arange(len(seen.view))
    k, k3 = _vector(camera), float(camera.distortion[4])
    X = np.ascontiguousarray(points)
    T = se3.each_inverse(poses)
    parallel_for(errors, len(pose), T, X, k, k3, pose, seen.landmark, seen.uv_px, out)
    return np.asarray(np.hypot(out[:, 0], out[:, 1]))


def solve(problem: Problem, iterations: int = 40, covariances: bool = False) -> Solution:
    """Adjust until a step is short against the sigmas of poses and camera.

    Points do not decide about the end: of a few seen wrongly, Huber's weights change for long,
    and nothing else follows. Raises ValueError for a landmark seen twice in one view.
    """
    bundle = _Bundle(problem)
    state = bundle.start
    cost, damping, lowered = bundle.cost(state), DAMPING, True
    for _ in range(iterations):
        new, sigmas = bundle.stepped(state, damping)
        new_cost = bundle.cost(new)
        is_last = sigmas < SETTLED_SIGMAS and damping <= MAX_DAMPING
        if new_cost < cost:
            state, cost = new, new_cost
            damping, lowered = damping * (0.1 if lowered else 1.0), True
        else:
            damping, lowered = 10.0 * damping, False
        if is_last or damping > 1e6:
            break
    return bundle.solution(state, covariances)


def dispersion(problem: Problem) -> float:
    """Variance of the camera over the one that independent sightings would give.

    ``problem`` holds the adjusted state. What shifts a patch of a view shifts all sightings in it.
    So the scatter of the views' pulls on the camera (poses and points follow) is compared with
    that of independent sightings: the mean design effect (Rao and Scott 1984,
    doi:10.1214/aos/1176346391) with views as clusters.
    """
    bundle = _Bundle(problem)
    s = bundle.start
    eq, before = bundle._equations(s, 0.0), bundle._errors(s)
    step = 0.1 * np.sqrt(np.abs(np.diag(np.linalg.inv(eq.Hk))))
    still, none = np.zeros(eq.g.shape), np.zeros(eq.bp.shape)
    moved = [bundle._errors(bundle._moved(s, eq, d, still, none)) for d in np.diag(step)]
    D = np.stack([(before - after) / h for after, h in zip(moved, step, strict=True)], axis=2)
    lengths = np.hypot(*before.T) / bundle._sigma
    ok = np.isfinite(D).all(axis=(1, 2)) & np.isfinite(lengths)
    huber = problem.huber_sigmas
    w = np.minimum(1.0, huber / np.maximum(lengths[ok], 1e-12)) / bundle._sigma[ok] ** 2
    score, known = np.zeros((len(s.T), CAMERA)), np.zeros((len(s.T), CAMERA, CAMERA))
    np.add.at(score, bundle._view[ok], np.einsum("mik,m,mi->mk", D[ok], w, before[ok]))
    np.add.at(known, bundle._view[ok], np.einsum("mik,m,mil->mkl", D[ok], w, D[ok]))
    share = np.linalg.solve(known.sum(axis=0), known)  # of each view in what all know
    fitted = np.einsum("nij,nji->", share, share)
    spread = np.trace(np.linalg.solve(known.sum(axis=0), score.T @ score))
    return float(spread / max(CAMERA - fitted, 1.0))


def step_covariances(problem: Problem) -> F64:
    """(N, 6, 6) of the motion from the pose before to each, left perturbation of T_here_before.
    ``problem`` holds the adjusted state. Zero for the first pose."""
    bundle = _Bundle(problem)
    T, V = bundle.start.T, bundle._unknowns
    eq, out = bundle._equations(bundle.start, 0.0), np.zeros((len(T), 6, 6))
    for n in range(1, len(T)):
        both = _joint(eq, np.r_[V * (n - 1) : V * (n - 1) + 6, V * n : V * n + 6])
        J = np.hstack([-se3.adjoint(T[n] @ se3.inverse(T[n - 1])), np.eye(6)])
        out[n] = J @ both @ J.T
    return np.asarray(0.5 * (out + out.transpose(0, 2, 1)))


def turn_covariances(problem: Problem) -> F64:
    """(N, 3, 3) of the turns of the rows, in rad^2; ``problem`` holds the adjusted state."""
    bundle = _Bundle(problem)
    eq, V = bundle._equations(bundle.start, 0.0), bundle._unknowns
    return np.array([_joint(eq, np.r_[V * n + 6 : V * n + 9]) for n in range(len(bundle.start.T))])


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    T: F64  # (N, 4, 4) T_camera_world
    X: F64  # (P, 3)
    k: F64  # (8,)
    turns: F64  # (N, 3) of the rows; unused under a global shutter


@dataclass(slots=True, eq=False)
class _Equations:
    """The reduced system of N views with V unknowns each, factored, with its border."""

    solved: Any  # solves for columns (V N, n)
    Hk: F64  # (8, 8), reduced by the points and the views
    g: F64  # (V N,)
    gk: F64  # (8,)
    Z: F64  # (V N, 8) solved(B)
    Hp_inverse: F64  # (P, 3, 3)
    bp: F64  # (P, 3)
    W: F64  # (M, V, 3)
    Wk: F64  # (P, 8, 3)


class _Bundle:
    """The arrays of one adjustment, sorted by landmark and view."""

    def __init__(self, problem: Problem) -> None:
        self._of = problem
        seen, P = problem.seen, len(problem.points)
        self._order = np.lexsort((seen.view, seen.landmark))
        self._view = np.ascontiguousarray(seen.view[self._order], np.int64)
        self._point = np.ascontiguousarray(seen.landmark[self._order], np.int64)
        twice = (np.diff(self._point) == 0) & (np.diff(self._view) == 0)
        if twice.any():
            raise ValueError(f"landmark {self._point[1:][twice][0]} is seen twice in one view")
        self._uv = np.ascontiguousarray(seen.uv_px[self._order], np.float64)
        self._sigma = np.ascontiguousarray(problem.sigma_px[self._order], np.float64)
        self._start_of = np.searchsorted(self._point, np.arange(P + 1)).astype(np.int64)
        T = se3.each_inverse(problem.poses)
        rows = problem.rows
        self._unknowns = 6 if rows is None else 9  # of a view
        self._share = row_shares(problem.camera, self._uv[:, problem.camera.shutter.axis])
        turns = np.zeros((len(T), 3)) if rows is None else rows.turns
        self.start = _State(T, np.array(problem.points, np.float64), _vector(problem.camera), turns)
        self._k3 = float(problem.camera.distortion[4])
        self._surveyed = np.nan_to_num(problem.known.surveyed)
        self._sure = np.nan_to_num(1.0 / problem.known.sigma_surveyed)
        met = np.eye(len(T), dtype=np.bool_)
        mark_pairs(self._view, self._start_of, met)
        self._rows, self._columns = np.nonzero(met)
        self._pair = np.full(met.shape, -1, np.int64)
        self._pair[self._rows, self._columns] = np.arange(len(self._rows))

    # ---- cost -------------------------------------------------------------------------------

    def _of_sightings(self, s: _State) -> tuple[F64, I64]:
        """T_camera_world (n, 4, 4), and which of them each sighting has."""
        rows, v = self._of.rows, self._view
        if rows is None:
            return s.T, v
        T = _of_rows(s.T[v], s.turns[v], rows.moves[v], self._share)
        return T, np.arange(len(v))

    def _errors(self, s: _State) -> F64:
        out = np.zeros((len(self._view), 2))
        T, pose = self._of_sightings(s)
        parallel_for(errors, len(out), T, s.X, s.k, self._k3, pose, self._point, self._uv, out)
        return out

    def _lengths(self, s: _State) -> F64:
        return np.asarray(np.hypot(*self._errors(s).T))

    def cost(self, s: _State) -> float:
        """Half the sum of squares, robust losses applied."""
        huber, c = self._of.huber_sigmas, self._of.cauchy_sigmas
        e = np.minimum(self._lengths(s) / self._sigma, 1e4)
        pixels = np.where(e <= huber, 0.5 * e**2, huber * (e - 0.5 * huber)).sum()
        fixes, attitude, placing, points = self._known_errors(s)
        loss = 0.5 * c**2 * np.log1p(np.sum(fixes**2, axis=1) / c**2).sum()
        bent = s.k - _vector(self._of.given)
        return float(
            pixels + loss + 0.5 * np.sum(attitude**2) + 0.5 * np.sum(points**2)
            + 0.5 * np.sum(self._off_turns(s) ** 2)
            + 0.5 * np.einsum("ni,nij,nj->", placing, self._of.known.placing, placing)
            + 0.5 * bent @ self._of.camera_information @ bent
        )  # fmt: skip

    def _known_errors(self, s: _State) -> tuple[F64, F64, F64, F64]:
        """Whitened errors of fixes (N, 3), attitudes (N, 3) and points (P, 3), 0 where nothing is
        known, and of the placing (N, 6), not whitened."""
        known = self._of.known
        centre = -np.einsum("nji,nj->ni", s.T[:, :3, :3], s.T[:, :3, 3])
        fixes = np.nan_to_num((centre - known.fixes) / known.sigma_fixes)
        points = np.nan_to_num((s.X - known.surveyed) / known.sigma_surveyed)
        attitude, placing = np.zeros((len(s.T), 3)), np.zeros((len(s.T), 6))
        for n in np.flatnonzero(np.isfinite(known.attitudes[:, 0, 0])):
            turned = known.attitudes[n] @ s.T[n, :3, :3]  # in the world
            attitude[n] = se3.so3_log(turned) / known.sigma_attitudes[n]
        for n in np.flatnonzero(known.placing.any(axis=(1, 2))):
            placing[n] = se3.log(s.T[n] @ known.placed[n])
        return fixes, attitude, placing, points

    def _off_turns(self, s: _State) -> F64:
        """(N, 3) whitened errors of the rows' turns; 0 under a global shutter."""
        rows = self._of.rows
        if rows is None:
            return np.zeros((len(s.T), 3))
        return np.asarray((s.turns - rows.expected) / rows.sigma_turns)

    # ---- steps ------------------------------------------------------------------------------

    def stepped(self, s: _State, damping: float) -> tuple[_State, float]:
        """The state after one step, and the step's length over the sigmas of poses and camera."""
        eq = self._equations(s, damping)
        dk, dc = np.asarray(np.linalg.solve(eq.Hk, eq.gk), np.float64), eq.solved(eq.g)
        new = self._moved(s, eq, dk, dc, eq.bp)
        return self._with_settled_points(new), float(np.sqrt(eq.gk @ dk + eq.g @ dc))

    def _with_settled_points(self, s: _State) -> _State:
        X = s.X.copy()
        T, pose = self._of_sightings(s)
        parallel_for(
            settle_points, len(X), T, pose, X, s.k, self._k3, self._start_of, self._uv, self._sigma,
            self._of.huber_sigmas, self._surveyed, self._sure,
        )  # fmt: skip
        return replace(s, X=X)

    def _moved(self, s: _State, eq: _Equations, dk: F64, dc: F64, bp: F64) -> _State:
        """The state after the camera's step ``dk`` (8,); poses and points follow it. ``dc`` (V N,)
        and ``bp`` (P, 3) are their own step and right-hand sides."""
        dc = (dc - eq.Z @ dk).reshape(len(s.T), -1)
        bp = bp - np.einsum("pkc,k->pc", eq.Wk, dk)
        carried = np.einsum("mac,ma->mc", eq.W, dc[self._view])
        np.subtract.at(bp, self._point, carried)
        T = np.array([se3.exp(d) @ one for d, one in zip(dc[:, :6], s.T, strict=True)])
        turns = s.turns if dc.shape[1] == 6 else s.turns + dc[:, 6:]
        return _State(T, s.X + np.einsum("pij,pj->pi", eq.Hp_inverse, bp), s.k + dk, turns)

    def _equations(self, s: _State, damping: float) -> _Equations:
        N, P, M, V = len(s.T), len(s.X), len(self._view), self._unknowns
        S, g, B = np.zeros((len(self._rows), V, V)), np.zeros((N, V)), np.zeros((N, V, CAMERA))
        Hk, gk = self._of.camera_information.copy(), np.zeros(CAMERA)
        gk += self._of.camera_information @ (_vector(self._of.given) - s.k)
        Hp, bp = np.zeros((P, 3, 3)), np.zeros((P, 3))
        self._add_known(s, S, g, Hp, bp)
        W, Wk = np.zeros((M, V, 3)), np.zeros((P, CAMERA, 3))
        T, pose = self._of_sightings(s)
        sums = S, g, B, Hk, gk
        parts = [np.zeros((PARTS, *one.shape)) for one in sums]
        ends = np.searchsorted(self._start_of, M * np.arange(1, PARTS) // PARTS)
        run_parallel(*(
            partial(
                reduce_points, first, end, T, pose, self._share, s.X, s.k, self._k3, self._view,
                self._start_of, self._uv, self._sigma, self._of.huber_sigmas, Hp, bp, damping,
                self._pair, W, Wk, *own,
            )
            for first, end, *own in zip([0, *ends], [*ends, P], *parts, strict=True)
        ))  # fmt: skip
        for whole, own in zip(sums, parts, strict=True):
            whole += own.sum(axis=0)
        own = self._pair[np.arange(N), np.arange(N)]
        for i in range(V):
            S[own, i, i] += damping * np.abs(S[own, i, i]) + 1e-9
        Hk[np.diag_indices(CAMERA)] *= 1.0 + damping
        solved, border = self._factored(S, N), B.reshape(V * N, CAMERA)
        Z = solved(border)
        reduced, right = Hk - border.T @ Z, gk - Z.T @ g.ravel()
        return _Equations(solved, reduced, g.ravel(), right, Z, Hp, bp, W, Wk)

    def _factored(self, S: F64, N: int) -> Any:
        """Solves with the symmetric matrix of the blocks ``S``."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.linalg import splu

        shape, V = S.shape, self._unknowns
        each = np.arange(V)
        rows = np.broadcast_to(V * self._rows[:, None, None] + each[:, None], shape).ravel()
        columns = np.broadcast_to(V * self._columns[:, None, None] + each, shape).ravel()
        off = np.repeat(self._rows != self._columns, V * V)
        data = S.ravel()
        both = coo_matrix(
            (
                np.concatenate([data, data[off]]),
                (np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]])),
            ),
            (V * N, V * N),
        )
        options = {"SymmetricMode": True}
        return splu(
            both.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
        ).solve

    def _add_known(self, s: _State, S: F64, g: F64, Hp: F64, bp: F64) -> None:
        known, c = self._of.known, self._of.cauchy_sigmas
        fixes, attitude, placing, points = self._known_errors(s)
        R = s.T[:, :3, :3]
        weight = 1.0 / (1.0 + np.sum(fixes**2, axis=1) / c**2)
        J = -np.transpose(R, (0, 2, 1)) / known.sigma_fixes[:, :, None]  # of the translation
        J = np.nan_to_num(J)
        own = self._pair[np.arange(len(s.T)), np.arange(len(s.T))]
        S[own, 3:6, 3:6] += weight[:, None, None] * np.einsum("nij,nik->njk", J, J)
        g[:, 3:6] -= weight[:, None] * np.einsum("nij,ni->nj", J, fixes)
        turn = np.nan_to_num(known.attitudes / known.sigma_attitudes[:, :, None])
        S[own, :3, :3] += np.einsum("nij,nik->njk", turn, turn)
        g[:, :3] -= np.einsum("nij,ni->nj", turn, attitude)
        S[own, :6, :6] += known.placing
        g[:, :6] -= np.einsum("nij,nj->ni", known.placing, placing)
        if self._of.rows is not None:
            off, sigma = self._off_turns(s), self._of.rows.sigma_turns
            for i in range(3):
                S[own, 6 + i, 6 + i] += sigma[:, i] ** -2
            g[:, 6:] -= off / sigma
        for i in range(3):
            Hp[:, i, i] += self._sure[:, i] ** 2
        bp -= self._sure * points

    # ---- result -----------------------------------------------------------------------------

    def solution(self, s: _State, covariances: bool) -> Solution:
        eq = self._equations(s, 0.0)
        spread = np.asarray(np.linalg.inv(eq.Hk), np.float64)
        errors = np.empty(len(self._view))
        errors[self._order] = self._lengths(s)
        poses = se3.each_inverse(s.T)
        known = self._covariances(eq, poses) if covariances else np.zeros((0, 6, 6))
        camera, step = _camera(self._of.camera, s.k), spread @ eq.gk
        rows = None if self._of.rows is None else replace(self._of.rows, turns=s.turns)
        return Solution(poses, s.X, camera, errors, known, spread, step, rows)

    def _covariances(self, eq: _Equations, poses: F64) -> F64:
        """(N, 6, 6) of a left perturbation of T_world_camera, the camera's own included."""
        N = len(poses)
        some = np.unique(np.linspace(0, N - 1, min(N, MAX_COVARIANCES)).astype(int))
        out = []
        for n, T in zip(some, poses[some], strict=True):
            own = _joint(eq, np.r_[self._unknowns * n : self._unknowns * n + 6])
            A = se3.adjoint(T)
            out.append(0.5 * A @ (own + own.T) @ A.T)
        nearest = np.abs(np.arange(N)[:, None] - some).argmin(axis=1)
        return np.asarray(np.array(out)[nearest])


def _joint(eq: _Equations, rows: I64) -> F64:
    """Covariance of some unknowns of the views, the camera's own included."""
    unit = np.zeros((len(eq.Z), len(rows)))
    unit[rows] = np.eye(len(rows))
    return np.asarray(eq.solved(unit)[rows] + eq.Z[rows] @ np.linalg.inv(eq.Hk) @ eq.Z[rows].T)


def _vector(camera: Camera) -> F64:
    K = camera.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.distortion[:4]])


def _camera(given: Camera, k: F64) -> Camera:
    K = np.array([[k[0], 0.0, k[2]], [0.0, k[1], k[3]], [0.0, 0.0, 1.0]])
    distortion = given.distortion.copy()
    distortion[:4] = k[4:]
    return replace(given, K=K, distortion=distortion)
