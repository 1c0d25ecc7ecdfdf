"""What is left in the depth of each pixel where a rolling shutter's turns are not quite known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.rolling_shutter import Rows
from recon.tracking.prediction import inverse_depth_plane
from recon.types import F32, F64

CELLS = 16, 9  # columns and rows in which an image is divided


def turn_shares(
    view: Rows, partners: Sequence[tuple[Rows, F64]], points: F64, K: F64, size_px: tuple[int, int]
) -> F32:
    """(n, m) sigma of depth over depth by the covariances of the rows' motions.

    It is that of the mean of all pairs, in which an error of the view itself cancels out where
    partners lie on both sides.

    Args:
        partners: rows, and T_partner_view (4, 4) of the middle rows.
        points: (N, 3) of the view's camera, the ground that they see.
        K: (3, 3) of the view's undistorted image of ``size_px`` (W, H).
    """
    columns, lines = (
        (np.arange(n) + 0.5) * size / n - 0.5 for n, size in zip(CELLS, size_px, strict=True)
    )
    ray = rays(K, np.stack(np.meshgrid(columns, lines), axis=-1).reshape(-1, 2))
    inverse_depth = np.maximum(ray @ inverse_depth_plane(points), 1e-9)
    own = _shifts(view, points, ray, inverse_depth)
    of_view, variance, power = np.zeros((len(ray), 6)), np.zeros(len(ray)), np.zeros(len(ray))
    for rows, T in partners:
        turned = ray @ T[:3, :3].T
        there = turned + T[:3, 3] * inverse_depth[:, None]
        parallax = there[:, :2] / there[:, 2:] - turned[:, :2] / turned[:, 2:]
        shifts = _shifts(
            rows, se3.transform(T, points), there / there[:, 2:], inverse_depth / there[:, 2]
        )
        of_view += np.einsum("ni,ij,njk->nk", parallax, T[:2, :2], own)
        variance += _variance(np.einsum("ni,nik->nk", parallax, shifts), rows.covariance)
        power += (parallax**2).sum(axis=1)
    sigma = np.sqrt(variance + _variance(of_view, view.covariance))
    share = np.minimum(sigma, power) / np.maximum(power, 1e-18)  # no parallax at an epipole
    return np.asarray(share.reshape(CELLS[::-1]), np.float32)


def _shifts(rows: Rows, points: F64, ray: F64, inverse_depth: F64) -> F64:
    """(N, 2, 6) by which rays (N, 3) with z = 1 shift per unit of an error of the rows' rate. The
    pose follows that error as far as the ``points`` (M, 3) by which it is found allow."""
    seen = points[points[:, 2] > 0]
    at = seen / seen[:, 2:]
    J, t = _by_twist(at, 1.0 / seen[:, 2]), rows.clock.seconds(at)
    normal, moved = (np.einsum("n,nij,nik->jk", w, J, J) for w in (np.ones(len(at)), t))
    pose = np.linalg.lstsq(normal, moved, rcond=None)[0]
    each = rows.clock.seconds(ray)[:, None, None] * np.eye(6) - pose
    return np.asarray(_by_twist(ray, inverse_depth) @ each)


def _by_twist(ray: F64, inverse_depth: F64) -> F64:
    """(N, 2, 6) by which rays (N, 3) with z = 1 shift with a twist, rotation first."""
    moved = np.zeros((len(ray), 3, 6))
    moved[:, :, :3] = -se3.hat(ray)
    moved[:, [0, 1, 2], [3, 4, 5]] = inverse_depth[:, None]
    return np.asarray(moved[:, :2] - ray[:, :2, None] * moved[:, 2:])


def _variance(rows: F64, covariance: F64) -> F64:
    return np.asarray(np.einsum("ni,ij,nj->n", rows, covariance, rows))
