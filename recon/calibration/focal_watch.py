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
from scipy import sparse

from recon.tracking.bundle import HUBER_PX, BundleResult, linearise_all
from recon.tracking.keyframe_window import AdjustedWindow
from recon.types import F64, I64

CELLS = 4  # rows and columns of cells of the landmarks


class FocalWatch:
    """Collects adjusted windows that share no keyframe."""

    def __init__(self, K: F64) -> None:
        self._K = K
        self._cells: list[F64] = []  # (CELLS**2, 2, 3) information and score, of each window

    def add(self, window: AdjustedWindow) -> None:
        """Add an adjusted window; one without finite sightings says nothing."""
        result, camera, point, uv_px = window
        every = result.T_camera_world, result.points_m, uv_px
        if len(uv_px) and all(np.isfinite(one).all() for one in every):
            self._cells.append(_evidence(result, camera, point, uv_px, self._K))

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
    """The remainder of ``values`` (M, 2, V) after the best change of poses and points. ``by_pose``
    (M, 2, 6) and ``by_point`` (M, 2, 3) are the derivatives."""
    rows, flat = np.arange(len(cam) + 1), values.reshape(-1, values.shape[2])
    P = sparse.bsr_array((by_pose, cam, rows), (len(flat), 6 * C))
    X = sparse.bsr_array((by_point, point, rows), (len(flat), 3 * N))
    of_point = np.zeros((N, 3, 3))
    np.add.at(of_point, point, np.einsum("mki,mkj->mij", by_point, by_point))
    ridge = 1e-9 * np.trace(of_point, axis1=1, axis2=2) + 1e-9  # far points have no depth
    inverse = np.linalg.inv(of_point + ridge[:, None, None] * np.eye(3))
    # Points are eliminated: to factor all unknowns at once takes 40 MB.
    both = (X.T @ P).toarray()
    eliminated = sparse.bsr_array((inverse, np.arange(N), np.arange(N + 1))) @ both
    reduced = (P.T @ P).toarray() - both.T @ eliminated
    of_points = X.T @ flat
    poses = np.linalg.pinv(reduced, rcond=1e-9, hermitian=True) @ (  # place, turn, scale are open
        P.T @ flat - eliminated.T @ of_points
    )
    rest = (of_points - both @ poses).reshape(N, 3, -1)
    taken = P @ poses + X @ (inverse @ rest).reshape(3 * N, -1)
    return np.asarray(values - taken.reshape(values.shape))


def _cells(at: F64, point: I64, N: int) -> I64:
    """(M,) cell of each sighting by the mean place (M, 2) of its point in the images."""
    mean = np.zeros((N, 2))
    np.add.at(mean, point, at)
    mean /= np.maximum(np.bincount(point, minlength=N), 1)[:, None]
    low, high = mean.min(axis=0), mean.max(axis=0)
    grid = np.minimum(CELLS * (mean - low) / np.maximum(high - low, 1e-9), CELLS - 1)
    row = grid.astype(np.int64)
    return np.asarray((CELLS * row[:, 1] + row[:, 0])[point])
