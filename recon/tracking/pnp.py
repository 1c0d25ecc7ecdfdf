"""Pose of a camera from known points that it sees (paper section 2.3, Eq. 6-7).

EPnP (Lepetit et al. 2009, doi:10.1007/s11263-008-0152-6) inside RANSAC, then
Levenberg-Marquardt on the inliers, through OpenCV. The covariance comes from the Jacobian of
the reprojection and the residuals that remain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from recon import se3
from recon.tracking import robust_geometry
from recon.types import F64, Bool


@dataclass(frozen=True, slots=True)
class PnpConfig:
    """Parameters of the pose from points."""

    threshold_px: float = 2.0  # largest reprojection error of an inlier
    iterations: int = 200  # RANSAC draws, at most
    confidence: float = 0.9999  # RANSAC stops early at this chance of a clean draw
    min_inliers: int = 15
    min_inlier_share: float = 0.3  # of the points given
    max_sigma_share: float = 0.03  # sigma of the position over the median depth, at most
    floor_px: float = 0.1  # least error assumed of a match, 1 sigma
    prior_share: float = 0.7  # of the points near the prior's pixels: no random draw needed
    max_prior_rotation_rad: float = 0.35  # a pose this far from the prior needs most points

    def __post_init__(self) -> None:
        """Raise ValueError when a parameter makes no sense."""
        if not (self.threshold_px > 0 and self.floor_px > 0 and self.max_sigma_share > 0):
            raise ValueError("threshold_px, floor_px and max_sigma_share must be positive")
        if self.min_inliers < 6 or self.iterations < 1:
            raise ValueError("min_inliers must be at least 6 and iterations at least 1")
        if not (0 < self.min_inlier_share <= 1 and 0 < self.confidence < 1):
            raise ValueError("min_inlier_share must be in (0, 1], confidence in (0, 1)")


@dataclass(frozen=True, slots=True, eq=False)
class PnpResult:
    """A camera pose that explains most of the matches."""

    T_camera_points: F64  # (4, 4) m
    covariance: F64  # (6, 6) left perturbation in the camera frame: rotation rad, translation m
    inliers: Bool  # (N,)
    rms_px: float  # of both coordinates together, inliers

    @property
    def inlier_share(self) -> float:
        """Share of the points given that the pose explains."""
        return float(np.mean(self.inliers))


def solve(
    points_m: F64,
    uv_px: F64,
    K: F64,
    config: PnpConfig | None = None,
    prior_T_camera_points: F64 | None = None,
) -> PnpResult | None:
    """The pose that projects ``points_m`` (N, 3) to ``uv_px`` (N, 2), or None without trust.

    ``K`` (3, 3) is of the undistorted image. ``prior_T_camera_points`` (4, 4) competes with
    EPnP's answer as a start, and a result that turns far away from it must explain most of
    the points. Points or pixels that are not finite are outliers. None: too few inliers, too
    loose a fit, or points so placed that the position stays open. Raises ValueError on wrong
    shapes.
    """
    config = config or PnpConfig()
    points, uv = np.asarray(points_m, np.float64), np.asarray(uv_px, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or uv.shape != (len(points), 2):
        raise ValueError(f"points must be (N, 3) and pixels (N, 2), got {points.shape}, {uv.shape}")
    if K.shape != (3, 3):
        raise ValueError(f"K must be (3, 3), got {K.shape}")
    finite = np.isfinite(points).all(axis=1) & np.isfinite(uv).all(axis=1)
    if np.count_nonzero(finite) < config.min_inliers:
        return None
    # The origin moves to the points' middle: far origins cost digits and stall the refinement.
    middle = np.median(points[finite], axis=0)
    local, pixels = points[finite] - middle, uv[finite]
    shift = se3.compose(np.eye(3), middle)
    prior = None if prior_T_camera_points is None else prior_T_camera_points @ shift
    starts = _starts(local, pixels, K, prior, config)
    T = _best(starts, local, pixels, K, config)
    if T is None:
        return None
    error = _errors(T, local, pixels, K)
    inliers = np.zeros(len(points), bool)
    inliers[finite] = error <= config.threshold_px
    return _judge(T @ se3.inverse(shift), points, uv, K, inliers, prior_T_camera_points, config)


def _starts(points: F64, uv: F64, K: F64, prior: F64 | None, config: PnpConfig) -> list[F64]:
    """Poses to start from: the prior, and EPnP's.

    Where the prior already explains most points to a few pixels, EPnP takes those; a random
    draw could find nothing larger. Else RANSAC draws. Eq. (6), (7).
    """
    if prior is not None:
        near = _errors(prior, points, uv, K) <= 3.0 * config.threshold_px
        if np.mean(near) >= config.prior_share:
            direct = robust_geometry.pose_from_points(points[near], uv[near], K, cv2.SOLVEPNP_EPNP)
            return [prior] if direct is None else [prior, direct]
    drawn = robust_geometry.consensus_pose(
        points, uv, K, config.threshold_px, config.iterations, config.confidence
    )
    return [T for T in (prior, drawn) if T is not None]


def _errors(T: F64, points: F64, uv: F64, K: F64) -> F64:
    """(N,) reprojection errors in px; infinite behind the camera."""
    p = se3.transform(T, points)
    z = np.where(p[:, 2] > 1e-6, p[:, 2], np.nan)
    u = K[0, 0] * p[:, 0] / z + K[0, 2] - uv[:, 0]
    v = K[1, 1] * p[:, 1] / z + K[1, 2] - uv[:, 1]
    return np.asarray(np.nan_to_num(np.hypot(u, v), nan=np.inf), np.float64)


def _best(starts: list[F64], points: F64, uv: F64, K: F64, config: PnpConfig) -> F64 | None:
    """The start with the lowest truncated error, refined on its inliers."""
    best, lowest = None, np.inf
    for T in starts:
        cost = float(np.minimum(_errors(T, points, uv, K), 2 * config.threshold_px).sum())
        if cost < lowest:
            best, lowest = T, cost
    if best is None:
        return None
    # A start is rougher than the answer: its inliers are gathered with a wider gate first.
    for gate in (1.5, 1.0):
        error = _errors(best, points, uv, K)
        inliers = error <= gate * config.threshold_px
        if np.count_nonzero(inliers) < config.min_inliers:
            return None
        refined = robust_geometry.refined_pose(best, points[inliers], uv[inliers], K)
        if refined is None:
            return None
        best = refined
    return best


def _judge(
    T: F64, points: F64, uv: F64, K: F64, inliers: Bool, prior: F64 | None, config: PnpConfig
) -> PnpResult | None:
    """The result with its covariance, or None when it cannot be trusted."""
    count = int(np.count_nonzero(inliers))
    share = count / len(points)
    if count < config.min_inliers or share < config.min_inlier_share:
        return None
    if prior is not None and share < 0.6:
        turn = float(np.linalg.norm(se3.so3_log(T[:3, :3] @ prior[:3, :3].T)))
        if turn > config.max_prior_rotation_rad:
            return None
    error = _errors(T, points[inliers], uv[inliers], K)
    variance = max(float(error @ error) / (2 * count - 6), config.floor_px**2)
    p = se3.transform(T, points[inliers])
    covariance = reprojection_covariance(p, K, variance)
    if covariance is None:
        return None
    # Uncertainty of where the camera is, seen from the points.
    position = se3.adjoint(se3.inverse(T)) @ covariance @ se3.adjoint(se3.inverse(T)).T
    centre = -T[:3, :3].T @ T[:3, 3]
    lever = np.hstack([-se3.hat(centre), np.eye(3)])
    sigma = float(np.sqrt(np.linalg.eigvalsh(lever @ position @ lever.T)[-1]))
    if not sigma <= config.max_sigma_share * float(np.median(p[:, 2])):
        return None
    return PnpResult(T, covariance, inliers, float(np.sqrt(np.mean(error**2))))


def reprojection_covariance(xyz_m: F64, K: F64, variance_px2: float) -> F64 | None:
    """(6, 6) covariance of a left perturbation in the camera frame, None when open.

    ``xyz_m`` (N, 3) are the points in the camera frame; ``variance_px2`` is of one coordinate.
    """
    x, y, z = xyz_m.T
    J = np.zeros((len(x), 2, 6))
    fx, fy = K[0, 0], K[1, 1]
    # d(u, v) / d(point) times [-hat(point), I]
    J[:, 0, 0], J[:, 0, 1], J[:, 0, 2] = -fx * x * y / z**2, fx * (1 + (x / z) ** 2), -fx * y / z
    J[:, 1, 0], J[:, 1, 1], J[:, 1, 2] = -fy * (1 + (y / z) ** 2), fy * x * y / z**2, fy * x / z
    J[:, 0, 3], J[:, 0, 5] = fx / z, -fx * x / z**2
    J[:, 1, 4], J[:, 1, 5] = fy / z, -fy * y / z**2
    rows = J.reshape(-1, 6)
    H = rows.T @ rows
    scale = np.sqrt(np.diag(H))
    if not np.all(scale > 0):
        return None
    normal = H / np.outer(scale, scale)
    if np.linalg.eigvalsh(normal)[0] < 1e-10:
        return None
    return np.asarray(np.linalg.inv(normal) / np.outer(scale, scale) * variance_px2)


def average_left_right(left: PnpResult, right: PnpResult) -> PnpResult:
    """The right result with its pose averaged with the left's (paper: they are averaged).

    Both are poses of one image by the points of another view each. When the two disagree by
    more than their covariances allow, the covariance of the mean grows with the disagreement.
    """
    T, covariance = se3.average(
        left.T_camera_points, left.covariance, right.T_camera_points, right.covariance
    )
    difference = se3.log(right.T_camera_points @ se3.inverse(left.T_camera_points))
    spread = left.covariance + right.covariance
    disagreement = float(difference @ np.linalg.solve(spread, difference)) / 6.0
    return replace(right, T_camera_points=T, covariance=covariance * max(1.0, disagreement))
