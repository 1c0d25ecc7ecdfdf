"""The odometry's last keyframes and their landmarks: triangulated, and adjusted together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon import se3
from recon.rolling_shutter import FrameRows
from recon.tracking import bundle
from recon.tracking.frame import Frame
from recon.types import F64, I64, Bool


def landmark_points(key: Frame) -> F64:
    """(N, 3) points in front of the keyframe's camera, in odometry units."""
    _, P = key.known_points()
    return P[P[:, 2] > 0]


def median_depth(key: Frame) -> float:
    """Median depth of the keyframe's landmarks, in odometry units; NaN without any."""
    depth = landmark_points(key)[:, 2]
    return float(np.median(depth)) if depth.size else float("nan")


def triangulate(
    key: Frame,
    T_camera_odom: F64,
    row_motion: FrameRows,
    uv: F64,
    ok: Bool,
    K: F64,
    min_parallax_rad: float,
    loose_px: float,
) -> None:
    """Landmarks for the keyframe's corners that were matched (``ok``) at ``uv`` and have none.

    The rows that saw them count as level ground; the window's adjustment knows their depths.

    Matches whose rays miss each other are taken out of ``ok``.
    """
    rows = np.flatnonzero(ok & (key.landmark < 0))
    if rows.size == 0:
        return
    far = np.full(rows.size, np.nan_to_num(1.0 / median_depth(key)))
    uv_a = key.row_motion.at_middle(K, key.uv[rows], far)
    uv_b = row_motion.at_middle(K, uv[rows], far)
    points, angle, error = bundle.triangulate(key.T_camera_odom, T_camera_odom, K, uv_a, uv_b)
    gate_px = max(1.5, 2.0 * float(np.median(error)))
    good = (error < min(gate_px, loose_px)) & (angle > min_parallax_rad)
    key.landmark[rows[good]] = key.landmarks.add(points[good])
    ok[rows[error >= gate_px]] = False


def observations(
    window: list[Frame], K: F64, views: int, readout_s: float | None = None
) -> tuple[I64, I64, I64, F64]:
    """(N,) landmarks that so many ``views`` or more show, and of each of M sightings: which of
    them, in which keyframe, and at which pixel (M, 2) at the middle row's time.

    ``readout_s`` is that of the rows; None: as known.
    """
    cam, pt, uv = [], [], []
    for c, key in enumerate(window):
        known, P = key.known_points()
        cam.append(np.full(len(P), c, np.int64))
        pt.append(key.landmark[known])
        uv.append(key.row_motion.at_middle(K, key.uv[known], 1.0 / P[:, 2], readout_s))
    point = np.concatenate(pt)
    _, index, counts = np.unique(point, return_inverse=True, return_counts=True)
    use = counts[index] >= views
    ids, index = np.unique(point[use], return_inverse=True)
    return ids, index.astype(np.int64), np.concatenate(cam)[use], np.concatenate(uv)[use]


AdjustedWindow = tuple[bundle.BundleResult, I64, I64, F64]
"""Adjusted keyframes; of each of M sightings the keyframe, the landmark and the pixel (M, 2)."""


def adjust_window(window: list[Frame], K: F64) -> AdjustedWindow:
    """Bundle-adjust the keyframes; the two oldest of them hold the frame and scale."""
    fixed = 1 if len(window) == 2 else 2
    ids, index, camera, uv_px = observations(window, K, 2)
    base, table = _baseline(window), window[0].landmarks
    free = np.arange(len(window)) >= fixed
    T_camera_odom = np.stack([k.T_camera_odom for k in window])
    result = bundle.adjust(T_camera_odom, table[ids], camera, index, uv_px, K, free, sigma_px=None)
    for c in np.flatnonzero(free):
        window[c].T_camera_odom = result.T_camera_world[c]
        window[c].covariance = result.step_covariance(c - 1, c)
    table[ids] = result.points_m
    _drop_outliers(window, ids, index, camera, result.residual_px)
    if len(window) == 2:
        _restore_baseline(window, base)
    return result, camera, index, uv_px


def step_covariance(keys: Sequence[Frame], T_camera_odom: F64) -> F64:
    """(6, 6) of a motion over consecutive keyframes, left perturbation at a camera."""
    out = np.zeros((6, 6))
    for key in keys:
        out += se3.left_covariance(T_camera_odom @ key.T_odom_camera, key.covariance)
    return out


def _baseline(window: list[Frame]) -> float:
    moved = window[1].T_camera_odom @ window[0].T_odom_camera
    return float(np.linalg.norm(moved[:3, 3]))


def _restore_baseline(window: list[Frame], base: float) -> None:
    """Two views leave the scale open; put it back to where it was."""
    factor = base / max(_baseline(window), 1e-9)
    origin = window[0].T_odom_camera[:3, 3]
    window[0].landmarks.scale_about(origin, factor)
    T = window[1].T_odom_camera
    T[:3, 3] = origin + (T[:3, 3] - origin) * factor
    window[1].T_camera_odom = se3.inverse(T)
    along = window[1].T_camera_odom[:3, :3] @ (T[:3, 3] - origin)
    across = np.eye(6)
    across[3:, 3:] -= np.outer(along, along) / max(float(along @ along), 1e-18)
    window[1].covariance = across @ window[1].covariance @ across.T  # the baseline is the unit


def _drop_outliers(window: list[Frame], ids: I64, index: I64, cam: I64, residual_px: F64) -> None:
    """Remove observations far off; a landmark left with one view is dropped."""
    bad = residual_px > max(2.5, 4.0 * float(np.median(residual_px)))
    for c in np.unique(cam[bad]):
        gone = ids[index[bad & (cam == c)]]
        key = window[c]
        key.landmark[np.isin(key.landmark, gone)] = -1
    good = np.bincount(index[~bad], minlength=len(ids))
    window[0].landmarks[ids[good < 2]] = np.nan
