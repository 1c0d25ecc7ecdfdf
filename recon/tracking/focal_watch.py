"""Whether the images fit the focal length of their camera model.

A wrong focal length leaves errors in the odometry's window that no pose or landmark takes up. The
remainder of the derivative by the focal length, once poses, landmarks and radial distortion have
taken up their part, times these errors gives one Gauss-Newton step of it (Frisch and Waugh,
doi:10.2307/1907330). Views that never turn give next to none, so that their sigma is large. It
follows from how cells of the image and windows scatter (Liang and Zeger,
doi:10.1093/biomet/73.1.13), as errors of neighbouring landmarks are alike.
"""

from __future__ import annotations

import numpy as np

from recon.tracking.bundle import BundleResult, linearise_all
from recon.types import F64, I64

HUBER_PX = 1.0
"""Longer errors lose weight: corners err by some tenths of a pixel, mismatches by more."""

CELLS = 4
"""Rows and columns of cells of the landmarks."""


class FocalWatch:
    """Collects adjusted windows that share no keyframe."""

    def __init__(self, K: F64) -> None:
        self._K = K
        self._cells: list[F64] = []  # (CELLS**2, 2, 3) information and score, of each window

    def add(self, window: BundleResult, camera: I64, point: I64, uv_px: F64) -> None:
        """Add an adjusted window, whose (M,) cameras saw (M,) of its points at (M, 2) undistorted
        pixels; one without finite sightings says nothing."""
        every = window.T_camera_world, window.points_m, uv_px
        if len(uv_px) and all(np.isfinite(one).all() for one in every):
            self._cells.append(_evidence(window, camera, point, uv_px, self._K))

    @property
    def estimate(self) -> tuple[float, float, int] | None:
        """How much the images would change the focal length, and the sigma of that, in shares of
        it, and from how many windows; None where they show nothing."""
        if not self._cells:
            return None
        cells = np.stack(self._cells)
        information, score = cells[..., :2], cells[..., 2]
        try:
            covariance = np.linalg.inv(information.sum(axis=(0, 1)))
        except np.linalg.LinAlgError:
            return None
        step, count = covariance @ score.sum(axis=(0, 1)), len(cells)
        # Of each cell, by how much the change of the focal length would differ without it.
        rest = (score - information @ step) @ covariance[0]
        squares = float(np.square(rest).sum())
        if count > 1:
            of_windows = float(np.square(rest.sum(axis=1)).sum()) * count / (count - 1)
            squares = max(squares, of_windows)
        return float(step[0]), float(np.sqrt(squares)), count


def _evidence(window: BundleResult, cam: I64, point: I64, uv_px: F64, K: F64) -> F64:
    """(CELLS**2, 2, 3) information and score by cells: of the logarithm of the focal length, and of
    radial distortion in shares at the image's corner."""
    M, C, N = len(uv_px), len(window.T_camera_world), len(window.points_m)
    by_pose, by_point = np.zeros((M, 2, 6)), np.zeros((M, 2, 3))
    error, weight = np.zeros((M, 2)), np.zeros(M)
    linearise_all(
        window.T_camera_world, window.points_m, cam, point, uv_px,
        np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), HUBER_PX, by_pose, by_point, error, weight,
    )  # fmt: skip
    by_focal = error + uv_px - K[:2, 2]
    square = np.sum(by_focal**2, axis=1, keepdims=True)
    corner = float(K[0, 2] ** 2 + K[1, 2] ** 2)  # one unit in all windows, as their sums share it
    by_lens = np.stack([by_focal, by_focal * square / corner], axis=-1)
    root = np.sqrt(weight)[:, None]
    left = _not_taken_up(
        by_lens * root[..., None], by_pose * root[..., None], by_point * root[..., None],
        cam, point, C, N,
    )  # fmt: skip
    seen_by = np.concatenate([left, -(error * root)[..., None]], axis=-1)
    out = np.zeros((CELLS**2, 2, 3))
    np.add.at(out, _cells(by_focal, point, N), np.einsum("mki,mkj->mij", left, seen_by))
    return out


def _not_taken_up(
    values: F64, by_pose: F64, by_point: F64, cam: I64, point: I64, C: int, N: int
) -> F64:
    """The remainder of ``values`` (M, 2, V) after the best change of poses and points.

    ``by_pose`` (M, 2, 6) and ``by_point`` (M, 2, 3) are the derivatives.
    """
    H = np.zeros((N, 3, 3))
    np.add.at(H, point, np.einsum("mki,mkj->mij", by_point, by_point))
    ridge = 1e-9 * np.trace(H, axis1=1, axis2=2) + 1e-9  # far points have no depth
    H_inv = np.linalg.inv(H + ridge[:, None, None] * np.eye(3))
    W = np.zeros((C, N, 6, 3))
    np.add.at(W, (cam, point), np.einsum("mki,mkj->mij", by_pose, by_point))
    of_pose = np.zeros((C, 6, 6))
    np.add.at(of_pose, cam, np.einsum("mki,mkj->mij", by_pose, by_pose))
    S = np.zeros((C, 6, C, 6))
    S[np.arange(C), :, np.arange(C)] = of_pose
    wide = W.transpose(0, 2, 1, 3).reshape(6 * C, 3 * N)
    eliminated = np.einsum("cnij,njk->cnik", W, H_inv).transpose(0, 2, 1, 3).reshape(6 * C, 3 * N)
    V = values.shape[2]
    of_points, of_poses = np.zeros((N, 3, V)), np.zeros((C, 6, V))
    np.add.at(of_points, point, np.einsum("mki,mkv->miv", by_point, values))
    np.add.at(of_poses, cam, np.einsum("mki,mkv->miv", by_pose, values))
    reduced = S.reshape(6 * C, 6 * C) - eliminated @ wide.T
    inverse = np.linalg.pinv(reduced, rcond=1e-9, hermitian=True)  # place, turn and scale are open
    rows_of_points, rows_of_poses = of_points.reshape(3 * N, V), of_poses.reshape(6 * C, V)
    poses = inverse @ (rows_of_poses - eliminated @ rows_of_points)
    points = H_inv @ (rows_of_points - wide.T @ poses).reshape(N, 3, V)
    taken = by_pose @ poses.reshape(C, 6, V)[cam]
    return np.asarray(values - taken - by_point @ points[point])


def _cells(at: F64, point: I64, N: int) -> I64:
    """(M,) cell of each sighting by the mean place (M, 2) of its point in the images."""
    mean = np.zeros((N, 2))
    np.add.at(mean, point, at)
    mean /= np.maximum(np.bincount(point, minlength=N), 1)[:, None]
    low, high = mean.min(axis=0), mean.max(axis=0)
    grid = np.minimum(CELLS * (mean - low) / np.maximum(high - low, 1e-9), CELLS - 1)
    row = grid.astype(np.int64)
    return np.asarray((CELLS * row[:, 1] + row[:, 0])[point])
