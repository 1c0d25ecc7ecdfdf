"""Pose of a camera from known points that it sees (paper section 2.3, Eq. 6-7).

EPnP (Lepetit et al. 2009, doi:10.1007/s11263-008-0152-6) inside RANSAC, through OpenCV, then
Gauss-Newton on the inliers. The covariance comes from the Jacobian of the reprojection and the
residuals that remain.

DEVIATION: where a prior explains most points, Gauss-Newton starts there and EPnP is not asked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.tracking import robust_geometry
from recon.tracking.bundle import cost_of, linearise_all
from recon.types import F64, Bool

THRESHOLD_PX = 2.0
"""Largest reprojection error of an inlier: a corner errs by some tenths, and a
landmark by as much as the views that gave it."""

MIN_INLIERS, MIN_INLIER_SHARE = 15, 0.3  # of a pose, at least, and of the points given

DRAWS, CONFIDENCE = 200, 0.9999
"""RANSAC's draws, at most, and the chance of a clean draw at which it stops early. Where half of
the points are wrong, one draw of five points in 32 is clean: 200 draws hold one at 99.8 %."""

MAX_SIGMA_SHARE = 0.03  # of the position over the median depth: as much as the shortest baseline
FLOOR_PX = 0.1  # least error assumed of a match, 1 sigma
PRIOR_SHARE = 0.7  # of the points near the prior's pixels, from which on there is no random draw
MAX_PRIOR_TURN_RAD, MOST = 0.35, 0.6  # a pose that far from the prior needs so many of the points


@dataclass(frozen=True, slots=True, eq=False)
class PnpResult:
    """A camera pose that explains most of the matches."""

    T_camera_points: F64  # (4, 4) m
    covariance: F64  # (6, 6) left perturbation in the camera frame: rotation rad, translation m
    inliers: Bool  # (N,)


STEPS, SETTLED = 10, 1e-8
"""Gauss-Newton steps, at most; one that lowers the squared error by less, in px^2, ends them."""


def solve(
    points_m: F64,
    uv_px: F64,
    K: F64,
    prior_T_camera_points: F64 | None = None,
    threshold_px: float = THRESHOLD_PX,
    min_inliers: int = MIN_INLIERS,
) -> PnpResult | None:
    """The pose that projects ``points_m`` (N, 3) to ``uv_px`` (N, 2), or None without trust.

    ``K`` (3, 3) is of the undistorted image. ``prior_T_camera_points`` (4, 4) competes with
    EPnP's answer as a start, and a result that turns far away from it must explain most of
    the points. Points or pixels that are not finite are
    outliers. None: too few inliers, too loose a fit, or points so placed that the position
    stays open.
    """
    points, uv = np.asarray(points_m, np.float64), np.asarray(uv_px, np.float64)
    finite = np.isfinite(points).all(axis=1) & np.isfinite(uv).all(axis=1)
    if np.count_nonzero(finite) < min_inliers:
        return None
    # The origin moves to the points' middle: far origins cost digits and stall the refinement.
    middle = np.median(points[finite], axis=0)
    local, pixels = points[finite] - middle, uv[finite]
    shift = se3.compose(np.eye(3), middle)
    prior = None if prior_T_camera_points is None else prior_T_camera_points @ shift
    k = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    starts = _starts(local, pixels, K, k, prior, threshold_px)
    T = _best(starts, local, pixels, k, threshold_px, min_inliers)
    if T is None:
        return None
    error = np.full(len(points), np.inf)
    error[finite] = _errors(T, local, pixels, k)
    inliers = error <= threshold_px
    if np.count_nonzero(inliers) < min_inliers:
        return None
    return _judge(T @ se3.inverse(shift), error, inliers, points, uv, k, prior_T_camera_points)


def _starts(
    points: F64, uv: F64, K: F64, k: F64, prior: F64 | None, threshold_px: float
) -> list[F64]:
    """Poses to start from: the prior where it explains most points to a few pixels, else also
    EPnP's on the largest consensus of RANSAC. Eq. (6), (7)."""
    if prior is not None:
        near = _errors(prior, points, uv, k) <= 3.0 * threshold_px
        if np.mean(near) >= PRIOR_SHARE:
            return [prior]
    drawn = robust_geometry.consensus_pose(points, uv, K, threshold_px, DRAWS, CONFIDENCE)
    return [T for T in (prior, drawn) if T is not None]


def _errors(T: F64, points: F64, uv: F64, k: F64) -> F64:
    """(N,) reprojection errors in px; infinite behind the camera."""
    error, each = np.empty(len(points)), np.arange(len(points))
    cost_of(T[None], points, np.zeros_like(each), each, uv, k, np.inf, error)
    return error


def _normal_equations(T: F64, points: F64, uv: F64, k: F64) -> tuple[F64, F64]:
    """(6, 6) matrix and (6,) right side of the reprojection errors of points at a pose (4, 4)."""
    each = np.arange(len(points))
    by_pose, by_point = np.zeros((len(points), 2, 6)), np.zeros((len(points), 2, 3))
    error, weight = np.zeros((len(points), 2)), np.zeros(len(points))
    linearise_all(
        T[None], points, np.zeros_like(each), each, uv, k, np.inf, by_pose, by_point, error, weight
    )
    in_front = weight > 0.0
    J = by_pose[in_front].reshape(-1, 6)
    return J.T @ J, -J.T @ error[in_front].ravel()


def _descended(T: F64, points: F64, uv: F64, k: F64) -> F64 | None:
    """The pose (4, 4) of the least squared error, from ``T`` on; None where it is open."""
    for _ in range(STEPS):
        H, g = _normal_equations(T, points, uv, k)
        try:
            step = np.asarray(np.linalg.solve(H, g), np.float64)
        except np.linalg.LinAlgError:
            return None
        T = se3.exp(step) @ T
        if step @ g < SETTLED:
            break
    return T if np.isfinite(T).all() else None


def _best(
    starts: list[F64], points: F64, uv: F64, k: F64, threshold_px: float, min_inliers: int
) -> F64 | None:
    """The start with the lowest truncated error, refined on its inliers."""
    best, lowest = None, np.inf
    for T in starts:
        cost = float(np.minimum(_errors(T, points, uv, k), 2 * threshold_px).sum())
        if cost < lowest:
            best, lowest = T, cost
    if best is None:
        return None
    # A start is rougher than the answer: its inliers are gathered with wider gates first.
    for gate in (3.0, 1.5, 1.0):
        used = _errors(best, points, uv, k) <= gate * threshold_px
        if np.count_nonzero(used) < min_inliers:
            return None
        best = _descended(best, points[used], uv[used], k)
        if best is None:
            return None
    return best


def _judge(
    T: F64, error: F64, inliers: Bool, points: F64, uv: F64, k: F64, prior: F64 | None
) -> PnpResult | None:
    """The result with its covariance, or None when it cannot be trusted; ``error`` (N,) px."""
    count = int(np.count_nonzero(inliers))
    share = count / len(points)
    if share < MIN_INLIER_SHARE:
        return None
    if prior is not None and share < MOST:
        turn = float(np.linalg.norm(se3.so3_log(T[:3, :3] @ prior[:3, :3].T)))
        if turn > MAX_PRIOR_TURN_RAD:
            return None
    error = error[inliers]
    variance = max(float(error @ error) / (2 * count - 6), FLOOR_PX**2)
    H, _ = _normal_equations(T, points[inliers], uv[inliers], k)
    covariance = _inverse(H)
    if covariance is None:
        return None
    covariance = covariance * variance
    # Uncertainty of where the camera is, seen from the points.
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    depth = points[inliers] @ T[2, :3] + T[2, 3]
    if not sigma <= MAX_SIGMA_SHARE * float(np.median(depth)):
        return None
    return PnpResult(T, covariance, inliers)


def _inverse(H: F64) -> F64 | None:
    """(6, 6) inverse of a normal matrix, None where a direction is open."""
    scale = np.sqrt(np.diag(H))
    if not np.all(scale > 0):
        return None
    normal = H / np.outer(scale, scale)
    if np.linalg.eigvalsh(normal)[0] < 1e-10:
        return None
    return np.asarray(np.linalg.inv(normal) / np.outer(scale, scale))
