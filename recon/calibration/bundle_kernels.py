"""Sums over sightings that :mod:`recon.calibration.global_bundle` needs, compiled.

A camera is a vector ``k`` of fx, fy, cx, cy, k1, k2, p1, p2, and ``k3`` apart from it. Poses are
T_camera_world, points (P, 3) in the world, m. The sightings (M,) of point ``p`` are those from
``start[p]`` to ``start[p + 1]``, in the order of their views.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from recon.small_matrices import invert_3x3
from recon.types import F64, I64

CAMERA = 8  # number of the camera's unknowns; k3 stays
POINT_STEPS = 2  # of each point alone after a step of all


@njit(cache=True, nogil=True)
def _pixel(P: F64, X: F64, k: F64, k3: float, out: F64) -> bool:
    """Fill ``out`` with u, v, a, b, z, r2, radial; False behind the camera."""
    z = P[2, 0] * X[0] + P[2, 1] * X[1] + P[2, 2] * X[2] + P[2, 3]
    if not z >= 1e-6:  # NaN: a point without a place
        return False
    a = (P[0, 0] * X[0] + P[0, 1] * X[1] + P[0, 2] * X[2] + P[0, 3]) / z
    b = (P[1, 0] * X[0] + P[1, 1] * X[1] + P[1, 2] * X[2] + P[1, 3]) / z
    r2 = a * a + b * b
    radial = 1.0 + r2 * (k[4] + r2 * (k[5] + r2 * k3))
    out[0] = k[0] * (a * radial + 2.0 * k[6] * a * b + k[7] * (r2 + 2.0 * a * a)) + k[2]
    out[1] = k[1] * (b * radial + k[6] * (r2 + 2.0 * b * b) + 2.0 * k[7] * a * b) + k[3]
    out[2], out[3], out[4], out[5], out[6] = a, b, z, r2, radial
    return True


@njit(cache=True, nogil=True)
def errors(
    first: int, end: int, T: F64, X: F64, k: F64, k3: float, pose: I64, point: I64, uv: F64,
    out: F64,
) -> None:  # fmt: skip
    """``out`` (M, 2) receives the sightings less their prediction, from ``first`` to before
    ``end``; infinite behind the camera."""
    at = np.zeros(7)
    for m in range(first, end):
        if _pixel(T[pose[m]], X[point[m]], k, k3, at):
            out[m, 0], out[m, 1] = uv[m, 0] - at[0], uv[m, 1] - at[1]
        else:
            out[m] = np.inf


@njit(cache=True, nogil=True)
def _linearise(P: F64, X: F64, k: F64, k3: float, at: F64, Jc: F64, Jp: F64, Jk: F64) -> None:
    """Fill the Jacobians (2, 6), (2, 3), (2, 8) of a pixel that :func:`_pixel` gave ``at``."""
    a, b, z, r2, radial = at[2], at[3], at[4], at[5], at[6]
    grows = k[4] + r2 * (2.0 * k[5] + 3.0 * r2 * k3)  # of radial, with r2
    cross = 2.0 * a * b * grows + 2.0 * k[6] * a + 2.0 * k[7] * b
    along = radial + 2.0 * a * a * grows + 2.0 * k[6] * b + 6.0 * k[7] * a
    across = radial + 2.0 * b * b * grows + 6.0 * k[6] * b + 2.0 * k[7] * a
    for i in range(2):
        f = k[i]
        da, db = (f * along, f * cross) if i == 0 else (f * cross, f * across)
        jx, jy, jz = da / z, db / z, -(da * a + db * b) / z
        Jc[i, 3], Jc[i, 4], Jc[i, 5] = jx, jy, jz
        Jc[i, 0], Jc[i, 1], Jc[i, 2] = (jz * b - jy) * z, (jx - jz * a) * z, (jy * a - jx * b) * z
        for j in range(3):
            Jp[i, j] = jx * P[0, j] + jy * P[1, j] + jz * P[2, j]
        s, t = (a, b) if i == 0 else (b, a)
        Jk[i, :] = 0.0
        Jk[i, i] = (at[i] - k[2 + i]) / f
        Jk[i, 2 + i] = 1.0
        Jk[i, 4], Jk[i, 5] = f * s * r2, f * s * r2 * r2
        Jk[i, 6 + i], Jk[i, 7 - i] = f * 2.0 * s * t, f * (r2 + 2.0 * s * s)


@njit(cache=True, nogil=True)
def _product(A: F64, H: F64, out: F64) -> None:
    """Fill ``out`` (n, 3) with A H, of (n, 3) and the symmetric (3, 3)."""
    for i in range(A.shape[0]):
        for j in range(3):
            out[i, j] = A[i, 0] * H[j, 0] + A[i, 1] * H[j, 1] + A[i, 2] * H[j, 2]


@njit(cache=True, nogil=True)
def _subtract_product(A: F64, B: F64, out: F64) -> None:
    """Take A B^T, of (n, 3) and (m, 3), from ``out`` (n, m)."""
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            out[i, j] -= A[i, 0] * B[j, 0] + A[i, 1] * B[j, 1] + A[i, 2] * B[j, 2]


@njit(cache=True, nogil=True)
def _eliminate(A: F64, B: F64, b: F64, H: F64, g: F64) -> None:
    """Take what a point adds, A B^T and A b, from ``H`` (n, m) and ``g`` (n,)."""
    _subtract_product(A, B, H)
    for i in range(A.shape[0]):
        g[i] -= A[i, 0] * b[0] + A[i, 1] * b[1] + A[i, 2] * b[2]


@njit(cache=True, nogil=True)
def _weighed(at: F64, uv: F64, sigma: float, huber: float, r: F64) -> tuple[float, float]:
    """Length of the error over ``sigma``, and its weight by Huber; ``r`` (2,) becomes the error."""
    r[0], r[1] = uv[0] - at[0], uv[1] - at[1]
    length = np.sqrt(r[0] * r[0] + r[1] * r[1]) / sigma
    return length, min(1.0, huber / max(length, 1e-12)) / sigma**2


@njit(cache=True, nogil=True)
def reduce_points(
    first: int, end: int, T: F64, pose: I64, share: F64, X: F64, k: F64, k3: float, view: I64,
    start: I64, uv: F64, sigma: F64, huber: float, Hp: F64, bp: F64, damping: float, pair: I64,
    W: F64, Wk: F64, S: F64, g: F64, B: F64, Hk: F64, gk: F64,
) -> None:  # fmt: skip
    """Eliminate the points from ``first`` to before ``end``.

    ``T`` are the poses numbered by ``pose`` (M,). ``Hp`` (P, 3, 3) and ``bp`` (P, 3) hold what is
    known of the points and receive the inverses and right-hand sides. A view has ``n`` unknowns:
    its pose, and with nine its turn. ``S`` (Q, n, n) are the blocks of the views numbered by
    ``pair`` (N, N), the upper half only; ``B`` (N, n, 8) and ``Hk`` (8, 8) the border. From ``S``
    on all are added to, so that points reduced at the same time need sums of their own.
    """
    n_view = g.shape[1]
    at, Jc, Jp, Jk = np.zeros(7), np.zeros((2, n_view)), np.zeros((2, 3)), np.zeros((2, 8))
    r, A, Ak = np.zeros(2), np.zeros((n_view, 3)), np.zeros((CAMERA, 3))
    for p in range(first, end):
        for m in range(start[p], start[p + 1]):
            v = view[m]
            W[m] = 0.0
            P = T[pose[m]]
            if not _pixel(P, X[p], k, k3, at):
                continue
            _linearise(P, X[p], k, k3, at, Jc, Jp, Jk)
            for i in range(2):
                for a in range(6, n_view):  # the turn across the image, to first order
                    Jc[i, a] = share[m] * Jc[i, a - 6]
            _, w = _weighed(at, uv[m], sigma[m], huber, r)
            q = pair[v, v]
            for i in range(2):
                for a in range(n_view):
                    wa = w * Jc[i, a]
                    g[v, a] += wa * r[i]
                    for c in range(n_view):
                        S[q, a, c] += wa * Jc[i, c]
                    for c in range(8):
                        B[v, a, c] += wa * Jk[i, c]
                    for c in range(3):
                        W[m, a, c] += wa * Jp[i, c]
                for a in range(8):
                    wa = w * Jk[i, a]
                    gk[a] += wa * r[i]
                    for c in range(8):
                        Hk[a, c] += wa * Jk[i, c]
                    for c in range(3):
                        Wk[p, a, c] += wa * Jp[i, c]
                for a in range(3):
                    wa = w * Jp[i, a]
                    bp[p, a] += wa * r[i]
                    for c in range(3):
                        Hp[p, a, c] += wa * Jp[i, c]
        ridge = 1e-9 * (Hp[p, 0, 0] + Hp[p, 1, 1] + Hp[p, 2, 2]) + 1e-12
        for a in range(3):
            Hp[p, a, a] += damping * Hp[p, a, a] + ridge
        invert_3x3(Hp[p], Hp[p])
        _product(Wk[p], Hp[p], Ak)
        _eliminate(Ak, Wk[p], bp[p], Hk, gk)
        for m in range(start[p], start[p + 1]):
            v = view[m]
            _product(W[m], Hp[p], A)
            _eliminate(A, Wk[p], bp[p], B[v], g[v])
            for n in range(m, start[p + 1]):  # views of a point are in order
                _subtract_product(A, W[n], S[pair[v, view[n]]])


@njit(cache=True, nogil=True)
def settle_points(
    first: int, end: int, T: F64, pose: I64, X: F64, k: F64, k3: float, start: I64, uv: F64,
    sigma: F64, huber: float, surveyed: F64, sure: F64,
) -> None:  # fmt: skip
    """Move each point of ``X`` (P, 3), from ``first`` to before ``end``, by Gauss-Newton steps, as
    long as they lower its cost.

    ``T`` are the poses numbered by ``pose`` (M,); ``sure`` (P, 3) is one over the sigma of
    ``surveyed``, 0 where there is none.
    """
    at, Jc, Jp, Jk = np.zeros(7), np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, CAMERA))
    H, b, r, x = np.zeros((3, 3)), np.zeros(3), np.zeros(2), np.zeros(3)
    for p in range(first, end):
        x[:], before = X[p], np.inf
        for _ in range(POINT_STEPS + 1):
            cost = 0.0
            for i in range(3):
                off = sure[p, i] * (x[i] - surveyed[p, i])
                cost += 0.5 * off * off
                H[i], b[i] = 0.0, -sure[p, i] * off
                H[i, i] = sure[p, i] ** 2
            for m in range(start[p], start[p + 1]):
                if not _pixel(T[pose[m]], x, k, k3, at):
                    cost = np.inf
                    break
                _linearise(T[pose[m]], x, k, k3, at, Jc, Jp, Jk)
                length, w = _weighed(at, uv[m], sigma[m], huber, r)
                cost += 0.5 * length**2 if length <= huber else huber * (length - 0.5 * huber)
                for i in range(2):
                    for a in range(3):
                        b[a] += w * Jp[i, a] * r[i]
                        for c in range(3):
                            H[a, c] += w * Jp[i, a] * Jp[i, c]
            if not cost < before:
                break
            X[p], before = x, cost
            ridge = 1e-9 * (H[0, 0] + H[1, 1] + H[2, 2]) + 1e-12
            for a in range(3):
                H[a, a] += ridge
            invert_3x3(H, H)
            for a in range(3):
                x[a] += H[a, 0] * b[0] + H[a, 1] * b[1] + H[a, 2] * b[2]


@njit(cache=True, nogil=True)
def mark_pairs(view: I64, start: I64, met: npt.NDArray[np.bool_]) -> None:
    """Set ``met`` (N, N), upper half, for views that share a point."""
    for p in range(start.size - 1):
        for m in range(start[p], start[p + 1]):
            for n in range(m, start[p + 1]):
                met[view[m], view[n]] = True
