"""Errors of a reconstruction against the truth: surface, completeness, trajectory, honesty.

Everything here compares arrays in one frame; bringing a scan into the truth's frame through
geodetic coordinates is the caller's part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from recon import se3
from recon.surface.triangle_grid import TriangleGrid
from recon.types import F64, Array, Bool

STEEPEST_COSINE = 0.25
"""A surface seen at a flatter angle than this (75 degrees off its normal) was not seen."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """``x_truth = scale * R @ x_scan + t``; scale 1 for a rigid fit."""

    scale: float
    R: F64  # (3, 3)
    t: F64  # (3,) m

    @staticmethod
    def identity() -> Fit:
        return Fit(1.0, np.eye(3), np.zeros(3))

    def points(self, xyz_m: F64) -> F64:
        """(N, 3) points of the scan in the truth's frame."""
        return np.asarray(self.scale * xyz_m @ self.R.T + self.t)

    def poses(self, T: F64) -> F64:
        """(N, 4, 4) poses of the scan in the truth's frame."""
        out = np.array(T, dtype=np.float64)
        out[:, :3, :3] = self.R @ T[:, :3, :3]
        out[:, :3, 3] = self.points(T[:, :3, 3])
        return out


@dataclass(frozen=True, slots=True)
class SurfaceErrors:
    """Distances of points to the true surface, in metres."""

    median_m: float
    rms_m: float
    p90_m: float
    bias_m: float  # median signed distance; positive lies outside, above the ground
    share_10cm: float
    share_25cm: float
    share_50cm: float
    far_share: float  # beyond the search radius; they count with that radius


@dataclass(frozen=True, slots=True)
class Honesty:
    """How well the stated sigmas cover the errors; a Gaussian has 0.68 and 0.95."""

    within_1_sigma: float
    within_2_sigma: float
    median_sigma_m: float


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Differences of poses at the same times."""

    rms_m: float
    median_m: float
    max_m: float
    median_deg: float
    drift_percent: float  # of the path: error of the displacement from first to last pose


def fit_trajectory(scan: F64, truth: F64, with_scale: bool) -> Fit:
    """The motion that best brings poses (N, 4, 4) of a scan onto those of the truth.

    Rotation from orientations and positions together (orthogonal Procrustes; 0.01 rad weigh as much
    as 0.5 m), so that a straight flight determines the rotation fully.
    """
    a = scan[:, :3, 3] - scan[:, :3, 3].mean(axis=0)
    b = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    weight = (0.01 / 0.5) ** 2
    if with_scale:
        a_size, b_size = np.sqrt((a**2).sum()), np.sqrt((b**2).sum())
        weight *= b_size / max(a_size, 1e-12)
    M = np.einsum("nij,nkj->ik", truth[:, :3, :3], scan[:, :3, :3]) + weight * b.T @ a
    R = se3.nearest_rotation(M)
    turned = a @ R.T
    scale = 1.0
    if with_scale and (turned**2).sum() > 1e-12:
        scale = float((turned * b).sum() / (turned**2).sum())
    t = truth[:, :3, 3].mean(axis=0) - scale * R @ scan[:, :3, 3].mean(axis=0)
    return Fit(scale, R, np.asarray(t))


def fit_surface(
    points: F64, surface: TriangleGrid, start: Fit, with_scale: bool, reach_m: float = 5.0
) -> Fit:
    """The motion near ``start`` that best moves (N, 3) points onto the true surface.

    Point-to-plane ICP against the mesh with Tukey's weights; at most 20 000 points are used. The
    reach shrinks with the residuals, so that distant points have no effect.
    """
    step = max(1, len(points) // 20_000)
    points = np.asarray(points[::step], np.float64)
    normals = surface.normals()
    fit = start
    for _ in range(40):
        moved = fit.points(points)
        _, nearest, hit = surface.closest(moved, reach_m)
        found = hit >= 0
        if found.sum() < 50:
            return fit
        p, n = moved[found], normals[hit[found]]
        r = np.einsum("ni,ni->n", p - nearest[found], n)
        cut = max(4.685 * 1.4826 * float(np.median(np.abs(r))), 0.02)
        w = np.clip(1.0 - (r / cut) ** 2, 0.0, None) ** 2
        centre = p.mean(axis=0)
        twist = _plane_step(p - centre, n, r, w, with_scale)
        dR, dt, ds = se3.so3_exp(twist[:3]), twist[3:6], float(np.exp(twist[6]))
        t = ds * dR @ (fit.t - centre) + centre + dt
        fit = Fit(fit.scale * ds, np.asarray(dR @ fit.R), np.asarray(t))
        reach_m = max(min(reach_m, 3.0 * cut), 0.5)
        if np.abs(twist).max() < 1e-6:
            break
    return fit


def _plane_step(p: F64, n: F64, r: F64, w: F64, with_scale: bool) -> F64:
    """(7,) rotation rad, translation m, log scale that lessen point-to-plane residuals ``r``.

    Scale stretches the true surface's height along the normal, which the points' own holds with
    their noise: by that the scale would be pulled down (Fuller, Measurement Error Models, 1987).
    """
    J = np.hstack([np.cross(p, n), n, (np.einsum("ni,ni->n", p, n) - r)[:, None]])
    if not with_scale:
        J = J[:, :6]
    H = (J * w[:, None]).T @ J
    H += 1e-6 * np.diag(np.maximum(np.diag(H), 1e-9))
    x = np.linalg.solve(H, -(J * w[:, None]).T @ r)
    out = np.zeros(7)
    out[: len(x)] = x
    return out


def distances(points: F64, surface: TriangleGrid, reach_m: float) -> tuple[F64, F64]:
    """(distance (N,), signed distance (N,)) to the surface; NaN beyond ``reach_m``.

    The sign is that of the nearest triangle's outer side.
    """
    distance, nearest, hit = surface.closest(np.asarray(points, np.float64), reach_m)
    normals = surface.normals()[np.maximum(hit, 0)]
    side = np.sign(np.einsum("ni,ni->n", np.asarray(points) - nearest, normals))
    return distance, np.asarray(np.where(side < 0, -distance, distance))


def surface_errors(distance: F64, signed: F64, reach_m: float) -> SurfaceErrors:
    """Figures of the distances that :func:`distances` gave; raises ValueError without points."""
    if len(distance) == 0:
        raise ValueError("there are no points to measure")
    far = ~np.isfinite(distance)
    d = np.where(far, reach_m, distance)
    near = signed[~far]
    return SurfaceErrors(
        median_m=float(np.median(d)),
        rms_m=float(np.sqrt(np.mean(d**2))),
        p90_m=float(np.percentile(d, 90)),
        bias_m=float(np.median(near)) if len(near) else float("nan"),
        share_10cm=float((d < 0.10).mean()),
        share_25cm=float((d < 0.25).mean()),
        share_50cm=float((d < 0.50).mean()),
        far_share=float(far.mean()),
    )


def honesty(distance: F64, sigma_m: Array) -> Honesty | None:
    """How the sigmas cover the distances; None without any finite sigma."""
    ok = np.isfinite(sigma_m) & (np.asarray(sigma_m) > 0)
    if not ok.any():
        return None
    d = np.where(np.isfinite(distance), distance, np.inf)[ok]
    sigma = np.asarray(sigma_m, np.float64)[ok]
    return Honesty(
        float((d <= sigma).mean()), float((d <= 2 * sigma).mean()), float(np.median(sigma))
    )


def sample_surface(surface: TriangleGrid, spacing_m: float, seed: int = 0) -> tuple[F64, F64]:
    """(points (S, 3), normals (S, 3)) spread evenly by area, about one per spacing squared.

    At most 600 000; a larger surface is sampled more thinly.
    """
    areas = surface.areas()
    total = float(areas.sum())
    count = int(min(max(total / spacing_m**2, 1.0), 600_000))
    rng = np.random.default_rng(seed)
    at = (np.arange(count) + rng.uniform(size=count)) / count * total
    which = np.minimum(np.searchsorted(np.cumsum(areas), at), len(areas) - 1)
    u, v = rng.uniform(size=(2, count))
    flip = u + v > 1.0
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    c = surface.corners[which]
    points = c[:, :3] + u[:, None] * c[:, 3:6] + v[:, None] * c[:, 6:9]
    return np.asarray(points), surface.normals()[which]


def seen_from(
    points: F64, normals: F64, surface: TriangleGrid, T_world_camera: F64, K: F64, size: Array
) -> Bool:
    """(S,) True where a camera sees surface points: in the image, not hidden, not too oblique."""
    W, H = int(size[0]), int(size[1])
    eye = T_world_camera[:3, 3]
    local = (points - eye) @ T_world_camera[:3, :3]
    z = np.where(local[:, 2] > 0.1, local[:, 2], np.nan)
    u = K[0, 0] * local[:, 0] / z + K[0, 2]
    v = K[1, 1] * local[:, 1] / z + K[1, 2]
    index = np.flatnonzero((u >= 0) & (u <= W - 1) & (v >= 0) & (v <= H - 1))
    away = eye - points[index]
    facing = np.einsum("ni,ni->n", away, normals[index]) / np.linalg.norm(away, axis=1)
    index, away = index[facing > STEEPEST_COSINE], away[facing > STEEPEST_COSINE]
    t, _ = surface.cast(eye, -away)
    seen = np.zeros(len(points), np.bool_)
    seen[index] = ~(t < 1.0 - 1e-4)
    return seen


def share_covered(samples: F64, points: F64, within_m: float) -> F64:
    """(S,) 1.0 where a point of the cloud lies within ``within_m`` of the sample, else 0.0."""
    if len(points) == 0:
        return np.zeros(len(samples))
    cells = np.floor(np.asarray(points) / (0.2 * within_m)).astype(np.int64)
    _, keep = np.unique(cells, axis=0, return_index=True)
    gap, _ = cKDTree(points[keep]).query(samples, distance_upper_bound=within_m)
    return np.asarray(np.isfinite(gap), np.float64)


def poses_at(times_s: F64, poses: F64, at_s: F64) -> tuple[F64, Bool]:
    """(poses (M, 4, 4), known (M,)) interpolated at times; unknown outside the range or in gaps.

    Linear in position, slerp in orientation; a gap is over five times the median step.
    """
    right = np.clip(np.searchsorted(times_s, at_s, "left"), 1, len(times_s) - 1)
    left = right - 1
    step = times_s[right] - times_s[left]
    known = (at_s >= times_s[0] - 1e-6) & (at_s <= times_s[-1] + 1e-6)
    known &= step <= 5.0 * max(float(np.median(np.diff(times_s))), 1e-6)
    share = np.clip((at_s - times_s[left]) / np.maximum(step, 1e-9), 0.0, 1.0)
    out = np.tile(np.eye(4), (len(at_s), 1, 1))
    a, b, part = poses[left[known]], poses[right[known]], share[known, None]
    R = a[:, :3, :3]
    turn = se3.each_so3_log(R.transpose(0, 2, 1) @ b[:, :3, :3])
    out[known, :3, :3] = R @ se3.each_so3_exp(part * turn)
    out[known, :3, 3] = (1 - part) * a[:, :3, 3] + part * b[:, :3, 3]
    return out, np.asarray(known)


def trajectory_errors(scan: F64, truth: F64) -> TrajectoryErrors:
    """Errors of poses (N, 4, 4) against the truth at the same times, in the truth's frame."""
    gap = np.linalg.norm(scan[:, :3, 3] - truth[:, :3, 3], axis=1)
    turn = np.einsum("nji,njk->nik", scan[:, :3, :3], truth[:, :3, :3])
    cosine = np.clip((np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    path = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    moved = (scan[-1] - scan[0])[:3, 3] - (truth[-1] - truth[0])[:3, 3]
    return TrajectoryErrors(
        rms_m=float(np.sqrt(np.mean(gap**2))),
        median_m=float(np.median(gap)),
        max_m=float(gap.max()),
        median_deg=float(np.degrees(np.median(np.arccos(cosine)))),
        drift_percent=100.0 * float(np.linalg.norm(moved)) / max(path, 1e-9),
    )
