"""Windowed bundle adjustment: camera poses and landmarks from their pixels.

DEVIATION: the paper avoids bundle adjustment and keeps the EPnP pose of every frame. A
window of a few keyframes costs milliseconds here and takes most of the drift away, because
a landmark seen from several keyframes ties their scale together.

Minimises the Huber cost of the reprojection error over poses and points by
Levenberg-Marquardt with the Schur complement on the points (Triggs et al., Bundle
Adjustment - A Modern Synthesis, 2000, doi:10.1007/3-540-44480-7_21).

Errors of neighbouring points are alike: an encoder moves blocks, and a track that drifts takes its
later pixels along. So the noise follows from how cells of the image scatter, not single pixels
(Liang and Zeger, Longitudinal data analysis using generalized linear models, 1986,
doi:10.1093/biomet/73.1.13).

The kernels of :mod:`recon.calibration.global_bundle` give the same poses to a micrometre, but take
four times as long for two views: they know neither the number of unknowns nor a held camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from recon import se3
from recon.camera_model import project, rays
from recon.small_matrices import invert_3x3, solve_symmetric
from recon.types import F64, I64, Bool

HUBER_PX = 1.0  # longer errors lose weight: corners err by some tenths, mismatches by more

CELL_ROWS = 4
"""Cells whose errors count as independent: so many strips with as many cells each. Larger ones hold
more of what an encoder moves together; fewer do not show how they scatter."""


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """Refined poses and points."""

    T_camera_world: F64  # (C, 4, 4)
    points_m: F64  # (N, 3) world
    residual_px: F64  # (M,) length of the reprojection error, inf behind the camera
    joint: F64  # (C, C, 6, 6) covariance, left perturbations of T_camera_world; zero where fixed

    def step_covariance(self, a: int, b: int) -> F64:
        """(6, 6) of the motion from camera ``a`` to ``b``, left perturbation of T_b_a."""
        A = se3.adjoint(self.T_camera_world[b] @ se3.inverse(self.T_camera_world[a]))
        both = self.joint[b, a] @ A.T
        return np.asarray(self.joint[b, b] - both - both.T + A @ self.joint[a, a] @ A.T)


@njit(cache=True, nogil=True)
def se3_exp(d: F64, out: F64) -> None:
    """``out`` (4, 4) motion of the twist ``d`` (rotation, translation)."""
    wx, wy, wz = d[0], d[1], d[2]
    a2 = wx * wx + wy * wy + wz * wz
    a = np.sqrt(a2)
    if a < 1e-8:
        s, c, e = 1.0, 0.5, 1.0 / 6.0
    else:
        s, c, e = np.sin(a) / a, (1 - np.cos(a)) / a2, (a - np.sin(a)) / (a2 * a)
    W = np.array([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]])
    out[:, :] = 0.0
    out[3, 3] = 1.0
    for i in range(3):
        for j in range(3):
            eye = 1.0 if i == j else 0.0
            squared = d[i] * d[j] - eye * a2
            out[i, j] = eye + s * W[i, j] + c * squared
            out[i, 3] += (eye + c * W[i, j] + e * squared) * d[3 + j]


@njit(cache=True, nogil=True)
def compose(A: F64, B: F64, out: F64) -> None:
    """``out`` = A B, (4, 4) each."""
    for i in range(4):
        for j in range(4):
            out[i, j] = 0.0
            for n in range(4):
                out[i, j] += A[i, n] * B[n, j]


@njit(cache=True, nogil=True)
def cost_of(T: F64, X: F64, cam: I64, pt: I64, uv: F64, k: F64, huber: float, res: F64) -> float:
    """Huber cost of all observations; ``res`` (M,) receives the error lengths in pixels."""
    total = 0.0
    for m in range(cam.size):
        P = T[cam[m]]
        x = X[pt[m]]
        z = P[2, 0] * x[0] + P[2, 1] * x[1] + P[2, 2] * x[2] + P[2, 3]
        if z < 1e-6:
            res[m] = np.inf
            total += huber * 1e3
            continue
        u = k[0] * (P[0, 0] * x[0] + P[0, 1] * x[1] + P[0, 2] * x[2] + P[0, 3]) / z + k[2]
        v = k[1] * (P[1, 0] * x[0] + P[1, 1] * x[1] + P[1, 2] * x[2] + P[1, 3]) / z + k[3]
        r = np.sqrt((u - uv[m, 0]) ** 2 + (v - uv[m, 1]) ** 2)
        res[m] = r
        total += 0.5 * r * r if r <= huber else huber * (r - 0.5 * huber)
    return total


@njit(cache=True, nogil=True)
def linearise(P: F64, x: F64, uv: F64, k: F64, huber: float, Jc: F64, Jp: F64, r: F64) -> float:
    """Fill the (2, 6) and (2, 3) Jacobians and the error ``r``; return the Huber weight."""
    X0 = P[0, 0] * x[0] + P[0, 1] * x[1] + P[0, 2] * x[2] + P[0, 3]
    X1 = P[1, 0] * x[0] + P[1, 1] * x[1] + P[1, 2] * x[2] + P[1, 3]
    X2 = P[2, 0] * x[0] + P[2, 1] * x[1] + P[2, 2] * x[2] + P[2, 3]
    if X2 < 1e-6:
        return 0.0
    iz = 1.0 / X2
    a, b = X0 * iz, X1 * iz
    r[0] = k[0] * a + k[2] - uv[0]
    r[1] = k[1] * b + k[3] - uv[1]
    fx, fy = k[0], k[1]
    Jc[0, 0], Jc[0, 1], Jc[0, 2] = -fx * a * b, fx * (1 + a * a), -fx * b
    Jc[1, 0], Jc[1, 1], Jc[1, 2] = -fy * (1 + b * b), fy * a * b, fy * a
    Jc[0, 3], Jc[0, 4], Jc[0, 5] = fx * iz, 0.0, -fx * a * iz
    Jc[1, 3], Jc[1, 4], Jc[1, 5] = 0.0, fy * iz, -fy * b * iz
    for j in range(3):
        Jp[0, j] = Jc[0, 3] * P[0, j] + Jc[0, 5] * P[2, j]
        Jp[1, j] = Jc[1, 4] * P[1, j] + Jc[1, 5] * P[2, j]
    length = np.sqrt(r[0] * r[0] + r[1] * r[1])
    return 1.0 if length <= huber else huber / length


@njit(cache=True, nogil=True)
def linearise_all(
    T: F64, X: F64, cam: I64, point: I64, uv: F64, k: F64, huber: float, Jc: F64, Jp: F64, r: F64,
    weight: F64,
) -> None:  # fmt: skip
    """:func:`linearise` of each observation, into its row of the last four."""
    for m in range(cam.size):
        weight[m] = linearise(T[cam[m]], X[point[m]], uv[m], k, huber, Jc[m], Jp[m], r[m])


@njit(cache=True, nogil=True)
def _normal_equations(
    T: F64, X: F64, cam: I64, start: I64, uv: F64, k: F64, huber: float, slot: I64, n_free: int,
    damping: float, S: F64, g: F64, Hpp_inv: F64, bp: F64, W: F64,
) -> None:  # fmt: skip
    """Reduced camera system ``S`` (6F, 6F), ``g`` (6F,) and what back-substitution needs."""
    S[:, :] = 0.0
    g[:] = 0.0
    Jc = np.zeros((2, 6))
    Jp = np.zeros((2, 3))
    r = np.zeros(2)
    A = np.zeros((6, 3))
    for p in range(X.shape[0]):
        H = np.zeros((3, 3))
        b = np.zeros(3)
        for m in range(start[p], start[p + 1]):
            W[m] = 0.0
            w = linearise(T[cam[m]], X[p], uv[m], k, huber, Jc, Jp, r)
            if w == 0.0:
                continue
            s = slot[cam[m]]
            for i in range(3):
                b[i] -= w * (Jp[0, i] * r[0] + Jp[1, i] * r[1])
                for j in range(3):
                    H[i, j] += w * (Jp[0, i] * Jp[0, j] + Jp[1, i] * Jp[1, j])
            if s < 0:
                continue
            for i in range(6):
                g[6 * s + i] -= w * (Jc[0, i] * r[0] + Jc[1, i] * r[1])
                for j in range(6):
                    S[6 * s + i, 6 * s + j] += w * (Jc[0, i] * Jc[0, j] + Jc[1, i] * Jc[1, j])
                for j in range(3):
                    W[m, i, j] = w * (Jc[0, i] * Jp[0, j] + Jc[1, i] * Jp[1, j])
        ridge = 1e-9 * (H[0, 0] + H[1, 1] + H[2, 2]) + 1e-9  # far points have no depth
        for i in range(3):
            H[i, i] += damping * H[i, i] + ridge
        invert_3x3(H, Hpp_inv[p])
        for i in range(3):
            bp[p, i] = b[i]
    trace = 0.0
    for i in range(6 * n_free):
        trace += S[i, i]
    ridge = 1e-10 * trace / (6 * n_free) + 1e-9
    for i in range(6 * n_free):
        S[i, i] += damping * S[i, i] + ridge
    for p in range(X.shape[0]):
        for m in range(start[p], start[p + 1]):
            s = slot[cam[m]]
            if s < 0:
                continue
            for i in range(6):
                for j in range(3):
                    A[i, j] = 0.0
                    for n in range(3):
                        A[i, j] += W[m, i, n] * Hpp_inv[p, n, j]
                    g[6 * s + i] -= A[i, j] * bp[p, j]
            for n in range(start[p], start[p + 1]):
                t = slot[cam[n]]
                if t < 0:
                    continue
                for i in range(6):
                    for j in range(6):
                        S[6 * s + i, 6 * t + j] -= (
                            A[i, 0] * W[n, j, 0] + A[i, 1] * W[n, j, 1] + A[i, 2] * W[n, j, 2]
                        )


@njit(cache=True, nogil=True)
def _adjust(
    T: F64, X: F64, cam: I64, start: I64, uv: F64, k: F64, huber: float, slot: I64, n_free: int,
    iterations: int, first: I64,
) -> tuple[F64, F64, F64, F64, F64]:  # fmt: skip
    """Poses, points, lengths of the errors, and by runs of points from ``first`` (R + 1,) on their
    (R, 6F, 6F) reduced systems and (R, 6F) right sides."""
    M, N = cam.size, X.shape[0]
    pt = np.empty(M, np.int64)
    for p in range(N):
        pt[start[p] : start[p + 1]] = p
    S = np.zeros((6 * n_free, 6 * n_free))
    g = np.zeros(6 * n_free)
    Hpp_inv = np.zeros((N, 3, 3))
    bp = np.zeros((N, 3))
    W = np.zeros((M, 6, 3))
    res = np.zeros(M)
    step = np.zeros((4, 4))
    dc = np.zeros((6 * n_free, 1))
    cost = cost_of(T, X, cam, pt, uv, k, huber, res)
    damping = 1e-4
    for _ in range(iterations):
        _normal_equations(
            T, X, cam, start, uv, k, huber, slot, n_free, damping, S, g, Hpp_inv, bp, W
        )
        for i in range(6 * n_free):
            dc[i, 0] = g[i]
        if not solve_symmetric(S, dc):
            damping *= 10.0
            continue
        T_new, X_new = T.copy(), X.copy()
        for c in range(T.shape[0]):
            if slot[c] >= 0:
                se3_exp(dc[6 * slot[c] : 6 * slot[c] + 6, 0], step)
                compose(step, T[c], T_new[c])
        for p in range(N):
            for m in range(start[p], start[p + 1]):
                s = slot[cam[m]]
                if s < 0:
                    continue
                for i in range(6):
                    for j in range(3):
                        bp[p, j] -= W[m, i, j] * dc[6 * s + i, 0]
            for i in range(3):
                for j in range(3):
                    X_new[p, i] += Hpp_inv[p, i, j] * bp[p, j]
        cost_new = cost_of(T_new, X_new, cam, pt, uv, k, huber, res)
        if cost_new < cost:
            gain = (cost - cost_new) / max(cost, 1e-12)
            T, X, cost = T_new, X_new, cost_new
            damping = max(damping * 0.2, 1e-9)
            if gain < 1e-5:
                break
        else:
            damping *= 10.0
            if damping > 1e4:
                break
    cost_of(T, X, cam, pt, uv, k, huber, res)
    runs, sides = np.zeros((first.size - 1, g.size, g.size)), np.zeros((first.size - 1, g.size))
    for c in range(first.size - 1):
        a, b = first[c], first[c + 1]
        _normal_equations(
            T, X[a:b], cam, start[a : b + 1], uv, k, huber, slot, n_free, 0.0, runs[c], sides[c],
            Hpp_inv[a:b], bp[a:b], W,
        )  # fmt: skip
    return T, X, res, runs, sides


def adjust(
    T_camera_world: F64,
    points_m: F64,
    camera_index: I64,
    point_index: I64,
    uv_px: F64,
    K: F64,
    free: Bool,
    *,
    huber_px: float = HUBER_PX,
    sigma_px: float | None = 0.3,
    iterations: int = 8,
) -> BundleResult:
    """Poses and points that explain the pixels best.

    Args:
        T_camera_world: (C, 4, 4) start poses; the world frame is kept by the fixed cameras.
        points_m: (N, 3) start points in the world frame; each needs an observation or more.
        camera_index, point_index: (M,) which camera saw which point.
        uv_px: (M, 2) where, in undistorted pixels.
        K: (3, 3) intrinsics shared by the cameras.
        free: (C,) True for the cameras that may move.
        huber_px: error at which the quadratic cost turns linear.
        sigma_px: pixel noise that the covariances are scaled with; None: as the residuals of
            cells of the image show.
        iterations: most Levenberg-Marquardt steps.
    """
    n_free, N = int(free.sum()), len(points_m)
    by_place = _by_place(T_camera_world[len(T_camera_world) // 2], points_m)
    number = np.empty(N, np.int64)
    number[by_place] = np.arange(N)
    first = np.linspace(0, N, CELL_ROWS**2 + 1).astype(np.int64)
    order = np.argsort(number[point_index], kind="stable")
    start = np.searchsorted(number[point_index[order]], np.arange(N + 1)).astype(np.int64)
    slot = np.where(free, np.cumsum(free) - 1, -1).astype(np.int64)
    k = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    T, moved, residual, cells, sides = _adjust(
        np.ascontiguousarray(T_camera_world, dtype=np.float64),
        np.ascontiguousarray(points_m[by_place], dtype=np.float64),
        np.ascontiguousarray(camera_index[order], dtype=np.int64),
        start,
        np.ascontiguousarray(uv_px[order], dtype=np.float64),
        k,
        huber_px,
        slot,
        n_free,
        iterations,
        first,
    )
    inverse = np.linalg.pinv(cells.sum(axis=0), hermitian=True)
    variance = noise(inverse, cells, sides) if sigma_px is None else sigma_px**2
    C, where = len(T), np.flatnonzero(free)
    joint = np.zeros((C, C, 6, 6))
    full = variance * inverse
    joint[np.ix_(where, where)] = full.reshape(n_free, 6, n_free, 6).swapaxes(1, 2)
    back = np.empty(len(uv_px))
    back[order] = residual
    points = np.empty_like(moved)
    points[by_place] = moved
    return BundleResult(T, points, back, joint)


def _by_place(T_camera_world: F64, points_m: F64) -> I64:
    """(N,) order of points in which equal runs are cells of one view: strips, each cut across."""
    seen = se3.transform(T_camera_world, points_m)
    right = np.argsort(np.arctan2(seen[:, 0], seen[:, 2]))
    strip = np.empty(len(points_m), np.int64)
    strip[right] = np.arange(len(points_m)) * CELL_ROWS // len(points_m)
    return np.asarray(np.lexsort((np.arctan2(seen[:, 1], seen[:, 2]), strip)))


def noise(inverse: F64, cells: F64, sides: F64) -> float:
    """Variance in px^2 of pixels that would let the fit err as far as cells of the image show.

    ``inverse`` (n, n) is that of the sum of ``cells`` (C, n, n), the cells' normal matrices;
    ``sides`` (C, n) are their right sides at the minimum. The expectation of their squares lacks
    what the fit takes up of each cell.
    """
    leverage = inverse @ cells
    squares = np.einsum("ci,ij,cj->", sides, inverse, sides)
    return float(squares / (len(inverse) - np.einsum("cij,cji->", leverage, leverage)))


def reprojection_error(T_camera_world: F64, points_m: F64, K: F64, uv_px: F64) -> F64:
    """(N,) distance in pixels; inf for points behind the camera or NaN."""
    error = np.linalg.norm(project(K, se3.transform(T_camera_world, points_m)) - uv_px, axis=1)
    return np.asarray(np.where(np.isfinite(error), error, np.inf))


def triangulate(
    T_a_world: F64, T_b_world: F64, K: F64, uv_a: F64, uv_b: F64
) -> tuple[F64, F64, F64]:
    """(N, 3) world points between two rays each, (N,) parallax angles in rad, and the larger (N,)
    of their two reprojection errors in px.

    Midpoint of the shortest segment between the rays (T_x_world are camera-from-world).
    Points behind a camera come back as NaN.
    """
    centre_a = -T_a_world[:3, :3].T @ T_a_world[:3, 3]
    centre_b = -T_b_world[:3, :3].T @ T_b_world[:3, 3]
    da, db = rays(K, uv_a) @ T_a_world[:3, :3], rays(K, uv_b) @ T_b_world[:3, :3]
    da /= np.linalg.norm(da, axis=1, keepdims=True)
    db /= np.linalg.norm(db, axis=1, keepdims=True)
    w = centre_b - centre_a
    ab = np.sum(da * db, axis=1)
    aw, bw = da @ w, db @ w
    den = np.maximum(1.0 - ab**2, 1e-12)
    sa = (aw - ab * bw) / den
    sb = (ab * aw - bw) / den
    points = 0.5 * (centre_a + sa[:, None] * da + centre_b + sb[:, None] * db)
    points[(sa <= 0) | (sb <= 0)] = np.nan
    error = np.maximum(
        reprojection_error(T_a_world, points, K, uv_a),
        reprojection_error(T_b_world, points, K, uv_b),
    )
    return points, np.arctan2(np.linalg.norm(np.cross(da, db), axis=1), ab), error
