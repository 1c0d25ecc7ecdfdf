"""Rigid motions: SO(3) and SE(3) exponentials, inverses, quaternions, averages.

A twist is (6,): rotation in rad first, translation in m second. Perturbations act on the
left: ``exp(twist) @ T``. Formulas: Barfoot, State Estimation for Robotics (2017), ch. 7.
"""

from __future__ import annotations

import math

import numpy as np

from recon.types import F64


def hat(w: F64) -> F64:
    """(..., 3, 3) cross-product matrices of (..., 3) ``w``."""
    out = np.zeros((*w.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return out


def so3_exp(w: F64) -> F64:
    """(3, 3) rotation of the (3,) rotation vector ``w`` in rad (Rodrigues)."""
    angle = float(np.linalg.norm(w))
    W = hat(w)
    if angle < 1e-7:
        return np.asarray(np.eye(3) + W + 0.5 * W @ W)
    return np.asarray(
        np.eye(3) + np.sin(angle) / angle * W + (1 - np.cos(angle)) / angle**2 * W @ W
    )


def so3_log(R: F64) -> F64:
    """(3,) rotation vector in rad, of length at most pi, of the (3, 3) rotation ``R``."""
    return np.array(_so3_log(R))


def _so3_log(R: F64) -> tuple[float, float, float]:
    """The same as plain numbers: for three of them arrays take ten times as long."""
    w, x, y, z = _quaternion(R)
    n = math.hypot(x, y, z)
    grown = 2.0 if n < 1e-12 else 2.0 * math.atan2(n, w) / n
    return grown * x, grown * y, grown * z


def each_so3_exp(w: F64) -> F64:
    """(N, 3, 3) rotations of the (N, 3) rotation vectors ``w`` in rad."""
    half = np.linalg.norm(w, axis=1)[:, None, None] / (2.0 * np.pi)
    W = hat(w)  # sinc has no pole where nothing turns
    return np.asarray(np.eye(3) + np.sinc(2.0 * half) * W + 0.5 * np.sinc(half) ** 2 * (W @ W))


def each_so3_log(R: F64) -> F64:
    """(N, 3) rotation vectors in rad, of length at most pi, of the (N, 3, 3) rotations ``R``."""
    axis = 0.5 * (R - R.transpose(0, 2, 1))[:, [2, 0, 1], [1, 2, 0]]
    sine, cosine = np.linalg.norm(axis, axis=1), 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)
    grown = np.where(sine > 1e-9, np.arctan2(sine, cosine) / np.maximum(sine, 1e-9), 1.0)
    out = axis * grown[:, None]
    for i in np.flatnonzero((sine < 1e-3) & (cosine < 0.0)):  # half a turn hides its axis
        out[i] = so3_log(R[i])
    return np.asarray(out)


def _left_jacobian(w: F64) -> F64:
    angle = float(np.linalg.norm(w))
    W = hat(w)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * W + W @ W / 6.0)
    return np.asarray(
        np.eye(3) + (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W
    )


def exp(twist: F64) -> F64:
    """(4, 4) motion of the (6,) ``twist``."""
    T = np.eye(4)
    T[:3, :3] = so3_exp(twist[:3])
    T[:3, 3] = _left_jacobian(twist[:3]) @ twist[3:]
    return T


def log(T: F64) -> F64:
    """(6,) twist of the (4, 4) motion ``T``."""
    x, y, z = _so3_log(T[:3, :3])
    a, b, c = T[:3, 3].tolist()
    half = 0.5 * math.hypot(x, y, z)
    # (1 - h cot h) / 4 h^2 of half the angle h, the factor of w x (w x t)
    turned = 1.0 / 12.0 if half < 1e-4 else (1.0 - half / math.tan(half)) / (4.0 * half * half)
    i, j, k = y * c - z * b, z * a - x * c, x * b - y * a  # w x t
    return np.array(
        [
            x,
            y,
            z,
            a - 0.5 * i + turned * (y * k - z * j),
            b - 0.5 * j + turned * (z * i - x * k),
            c - 0.5 * k + turned * (x * j - y * i),
        ]
    )


def inverse(T: F64) -> F64:
    """(4, 4) inverse of the motion ``T``: T_b_a of T_a_b."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def each_inverse(T: F64) -> F64:
    """(N, 4, 4) inverses of the motions (N, 4, 4)."""
    out = np.zeros_like(T)
    out[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    out[:, :3, 3] = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    out[:, 3, 3] = 1.0
    return out


def project_to_so3(T: F64) -> F64:
    """(4, 4) ``T`` with its rotation replaced by the nearest one, which removes rounding errors
    (polar decomposition; Higham 1986, doi:10.1137/0907079).

    Where a pose is made of the one before it and of its inverse, they would double each time.
    """
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return compose(U @ Vt, T[:3, 3])


def nearest_rotation(M: F64) -> F64:
    """(3, 3) rotation R that makes trace(R^T M) largest. With the sum of b a^T over pairs of
    vectors for M it takes each a closest to its b (Kabsch 1976, doi:10.1107/S0567739476001873)."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)


def compose(R: F64, t: F64) -> F64:
    """(4, 4) motion with rotation ``R`` (3, 3) and translation ``t`` (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def adjoint(T: F64) -> F64:
    """(6, 6) matrix that takes a twist in b to the same motion's twist in a, for T_a_b."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = T[:3, :3]
    out[3:, :3] = hat(T[:3, 3]) @ T[:3, :3]
    return out


def left_covariance(T: F64, covariance: F64) -> F64:
    """(6, 6) covariance of the left perturbation of ``T`` from that of the right: one in b's frame
    as one in a's, for T_a_b."""
    A = adjoint(T)
    return np.asarray(A @ covariance @ A.T)


def in_units(covariance: F64, unit: float) -> F64:
    """(6, 6) covariance of a motion whose lengths are multiplied by ``unit``."""
    factor = np.array([1.0] * 3 + [unit] * 3)
    return np.asarray(covariance * np.outer(factor, factor))


def about(place: F64, covariance: F64) -> F64:
    """(6, 6) covariance of a perturbation about the (3,) place, from one about the origin.

    About a pose's own place, the last three are the place itself; a left perturbation's are those
    of the origin, which a turn moves by its distance. ``about(-place, ...)`` is the inverse.
    """
    lever = np.eye(6)
    lever[3:, :3] = -hat(place)
    return np.asarray(lever @ covariance @ lever.T)


def sigma_at(place: F64, covariance: F64) -> float:
    """Sigma in m, in all three directions together, of a (3,) place that a (6, 6) covariance of a
    perturbation about the origin moves."""
    return float(np.sqrt(np.trace(about(place, covariance)[3:, 3:])))


def transform(T: F64, points: F64) -> F64:
    """(N, 3) ``points`` of frame b in frame a, for T_a_b."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def rotation_from_quaternion(q_wxyz: F64) -> F64:
    """(3, 3) rotation of the quaternion (w, x, y, z), normalised first. Raises ValueError when the
    quaternion has no length or is not finite."""
    n = float(np.linalg.norm(q_wxyz))
    if not np.isfinite(n) or n < 1e-9:
        raise ValueError(f"quaternion has no direction: {q_wxyz}")
    w, x, y, z = np.asarray(q_wxyz, dtype=np.float64) / n
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(R: F64) -> F64:
    """(4,) quaternion w, x, y, z with w >= 0 of the (3, 3) rotation ``R`` (Shepperd)."""
    return np.array(_quaternion(R))


def _quaternion(R: F64) -> tuple[float, ...]:
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    trace = a + e + i
    most = max(trace, a, e, i)
    if most == trace:
        q = (1 + trace, h - f, c - g, d - b)
    elif most == a:
        q = (h - f, 1 + 2 * a - trace, b + d, c + g)
    elif most == e:
        q = (c - g, b + d, 1 + 2 * e - trace, f + h)
    else:
        q = (d - b, c + g, f + h, 1 + 2 * i - trace)
    length = -math.hypot(*q) if q[0] < 0 else math.hypot(*q)
    return tuple(part / length for part in q)


def each_quaternion(R: F64) -> F64:
    """(N, 4) unit quaternions w, x, y, z of the (N, 3, 3) rotations ``R``, of either sign."""
    (a, b, c), (d, e, f), (g, h, i) = R.transpose(1, 2, 0)
    # Each row is the quaternion by one of its own parts (Shepperd); the largest part is sure.
    rows = np.array(
        [
            [1.0 + a + e + i, h - f, c - g, d - b],
            [h - f, 1.0 + a - e - i, b + d, c + g],
            [c - g, b + d, 1.0 - a + e - i, f + h],
            [d - b, c + g, f + h, 1.0 - a - e + i],
        ]
    )
    q = rows[rows[range(4), range(4)].argmax(axis=0), :, np.arange(len(R))]
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def disagreement(T_a: F64, covariance_a: F64, T_b: F64, covariance_b: F64) -> float:
    """Chi-square per degree of freedom of the difference of two estimates of one motion. Both
    covariances are of left perturbations in the same frame."""
    difference = log(T_b @ inverse(T_a))
    return float(difference @ np.linalg.solve(covariance_a + covariance_b, difference)) / 6.0


def average(T_a: F64, covariance_a: F64, T_b: F64, covariance_b: F64) -> tuple[F64, F64]:
    """Weighted mean of two estimates of one motion, and its (6, 6) covariance.

    Both covariances are of left perturbations in the same frame. First-order (one
    Gauss-Newton step about ``T_a``), exact for small differences.
    """
    info_a, info_b = np.linalg.inv(covariance_a), np.linalg.inv(covariance_b)
    covariance = np.linalg.inv(info_a + info_b)
    step = covariance @ info_b @ log(T_b @ inverse(T_a))
    return np.asarray(exp(step) @ T_a), np.asarray(covariance)
