"""Turns of a rolling shutter's rows that are not quite known: their sigma, and that of depth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon import se3
from recon.camera_model import project, rays
from recon.rolling_shutter import RowClock, Rows, RowTrack
from recon.row_errors import CELLS, turn_shares
from recon.types import F64, Camera, PosePrior, Shutter

K = np.array([[400.0, 0, 239.5], [0, 400.0, 179.5], [0, 0, 1]])
SIZE = 480, 360
CAMERA = Camera(K, np.zeros(5), SIZE, Shutter(0.03))
SWING = 2.0 * np.pi


def swinging(t: float) -> F64:
    """(4, 4) T_camera_world of a head that swings at 1 Hz and up to 30 degrees per second."""
    turn = 0.083 * np.array([np.sin(SWING * t), np.sin(5.6 * t + 1.0), 0.0])
    R = np.diag([1.0, -1, -1]) @ se3.so3_exp(turn)
    return se3.inverse(se3.compose(R, np.array([8.0 * t, 1.0 * t, 60.0])))


def rate_at(t: float) -> F64:
    """(6,) of T_camera_world per s."""
    return se3.log(swinging(t + 1e-4) @ se3.inverse(swinging(t - 1e-4))) / 2e-4


def flown(hz: float, noise: float, sigma_turn: float | None = None) -> tuple[F64, F64]:
    """(N, 6) errors of the rates of settled frames and their (N, 6) sigmas."""
    rng, track, frames = np.random.default_rng(2), RowTrack(CAMERA), []
    scale = noise * np.array([1, 1, 1, 60, 60, 60])
    for k in range(60):
        T, prior = se3.exp(scale * rng.normal(size=6)) @ swinging(k / hz), PosePrior()
        if sigma_turn is not None:
            turn = -rate_at(k / hz)[:3] + sigma_turn * rng.normal(size=3)
            prior = PosePrior(turn_rad_s=turn, sigma_turn_rad_s=sigma_turn)
        frames.append(track.expect(round(k * 1e9 / hz), prior, T))
        track.add(frames[-1], T)
    errors, sigmas = [], []
    for k, frame in enumerate(frames):
        if frame.is_settled and k > 2:
            assert frame.rows is not None
            errors.append(frame.rows.rate - rate_at(k / hz))
            sigmas.append(np.sqrt(np.diag(frame.rows.covariance)))
    return np.array(errors), np.array(sigmas)


@pytest.mark.parametrize(("hz", "noise"), [(5.0, 0.0), (5.0, 1e-3), (15.0, 1e-4)])
def test_a_further_neighbour_tells_how_well_a_rate_is_known(hz: float, noise: float) -> None:
    """By slow frames, whose path bends between them, and by noisy ones."""
    errors, sigmas = flown(hz, noise)
    ratio = np.sqrt(np.mean(errors[:, :2] ** 2) / np.mean(sigmas[:, :2] ** 2))
    assert 0.4 < ratio < 1.6


def test_telemetry_turns_the_rows_where_it_knows_better() -> None:
    by_frames, _ = flown(5.0, 0.0)
    errors, sigmas = flown(5.0, 0.0, sigma_turn=0.02)
    assert np.sqrt(np.mean(errors[:, :2] ** 2)) < 0.5 * np.sqrt(np.mean(by_frames[:, :2] ** 2))
    assert sigmas[:, :3].max() <= 0.02
    fast, _ = flown(15.0, 0.0, sigma_turn=0.02)
    assert np.sqrt(np.mean(fast[:, :2] ** 2)) < 0.005


def at_rows(points: F64, rate: F64) -> F64:
    """(N, 2) where the rows of a camera of this rate see points (N, 3) of its middle row."""
    out = project(K, points)
    for i, X in enumerate(points):
        for _ in range(6):
            T = se3.exp(0.03 * ((out[i, 1] + 0.5) / SIZE[1] - 0.5) * rate)
            out[i] = project(K, se3.transform(T, X[None]))[0]
    return out


def placed(points: F64, uv: F64, T: F64) -> F64:
    """(4, 4) pose near ``T`` (4, 4) that sees points (N, 3) at (N, 2)."""
    turn, move = se3.so3_log(T[:3, :3]), T[:3, 3].copy()
    found = cv2.solvePnP(points, uv, K, None, turn, move, useExtrinsicGuess=True)
    turn, move = (np.asarray(one, np.float64).ravel() for one in found[1:])
    return se3.compose(se3.so3_exp(turn), move)


@pytest.mark.parametrize("times", [(0.0, 0.75), (0.0, 0.75, -0.75)])
def test_the_share_of_depth_is_what_wrong_turns_do_to_each_pixel(times: tuple[float, ...]) -> None:
    rng = np.random.default_rng(1)
    poses, rates = [swinging(t) for t in times], [rate_at(t) for t in times]
    sigma = np.diag(np.array([0.06, 0.03, 0.09, 0.0, 0.0, 0.0]) ** 2)
    rows = [Rows(RowClock(CAMERA), rate, np.zeros(6), sigma) for rate in rates]
    steps = [T @ se3.inverse(poses[0]) for T in poses]
    corners = np.stack(np.meshgrid(*map(np.arange, CELLS)), -1).reshape(-1, 2) + 0.5
    corners = corners * np.array(SIZE) / CELLS - 0.5
    ray = rays(K, np.vstack([rng.uniform([20, 20], [460, 340], (150, 2)), corners]))
    points = ray * (-60.0 / (poses[0][:3, 2] @ ray.T))[:, None]
    share = turn_shares(rows[0], [*zip(rows[1:], steps[1:], strict=True)], points[:150], K, SIZE)
    here = [se3.transform(T, points) for T in steps]
    exposed = [at_rows(P, rate) for P, rate in zip(here, rates, strict=True)]
    squares = np.zeros(len(corners))
    for _ in range(40):
        off = [replace(r, rate=r.rate + np.sqrt(np.diag(sigma)) * rng.normal(size=6)) for r in rows]
        uv = [r.at_middle(K, e, 1 / P[:, 2]) for r, e, P in zip(off, exposed, here, strict=True)]
        T = [placed(points[:150], at[:150], step) for at, step in zip(uv, steps, strict=True)]
        squares += _depth_errors(T, [at[150:] for at in uv], -poses[0][:3, 2]) ** 2
    truth = np.sqrt(squares / 40).reshape(share.shape)
    assert np.sqrt(np.mean(share**2)) == pytest.approx(np.sqrt(np.mean(truth**2)), rel=0.2)
    assert np.corrcoef(share.ravel(), truth.ravel())[0, 1] > 0.85


def _depth_errors(T: list[F64], uv: list[F64], ground: F64) -> F64:
    """(N,) of the depth that the first image and each other one see, 60 m along ``ground`` (3,)."""
    ray = rays(K, uv[0])
    sums, power = np.zeros(len(ray)), np.zeros(len(ray))
    for other, at in zip(T[1:], uv[1:], strict=True):
        step = other @ se3.inverse(T[0])
        turned, right = ray @ step[:3, :3].T, rays(K, at)[:, :2]
        flow = step[:2, 3] - step[2, 3] * right  # times the inverse depth
        sums += (flow * (right * turned[:, 2:] - turned[:, :2])).sum(axis=1)
        power += (flow**2).sum(axis=1)
    from_first = se3.inverse(T[0])
    depth = (60.0 - ground @ from_first[:3, 3]) / (ray @ from_first[:3, :3].T @ ground)
    return np.asarray(power / sums / depth - 1.0)
