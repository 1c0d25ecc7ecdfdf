"""Pairs flown along the line of sight, against plain projection of points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon import se3
from recon.stereo.polar import reproject_polar
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.reprojection import LABEL_SIGMA_PX
from recon.stereo.virtual_stereo import rectify
from recon.types import F64, U8, DisparityMap, PolarPair, StereoPair

W, H = 640, 360
K = np.array([[480.0, 0, 321.0], [0, 480.0, 178.0], [0, 0, 1]])
SIZE = (160, 90)
GRID_K = np.array([[120.0, 0, 80.0], [0, 120.0, 44.2], [0, 0, 1]])
CONFIG = VirtualStereoConfig(width_px=160, guided=False)
LEVEL = np.array(
    [[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]
)  # looks east; columns are right, down, ahead
HEIGHT_M = 40.0


def camera(place: F64, pitch_deg: float, turn: F64 | None = None) -> F64:
    """Pose of a camera that looks east and down."""
    tilt = se3.so3_exp(np.array([np.radians(pitch_deg), 0.0, 0.0]))
    return se3.compose(se3.so3_exp(np.zeros(3) if turn is None else turn) @ LEVEL @ tilt, place)


def ramp(axis: int) -> U8:
    """Gray levels that say how far along an axis a pixel is."""
    u, v = np.meshgrid(np.linspace(0, 255, W), np.linspace(0, 255, H))
    return np.asarray((v, u)[axis].round(), np.uint8)


def view(T: F64, axis: int = 1) -> PosedImage:
    return PosedImage(None, ramp(axis), K, T)


def on_ground(T: F64, uv: F64, K: F64, height: F64 | float = 0.0) -> F64:
    """(N, 3) where the rays of pixels meet the level ``height``, in the camera; NaN: nowhere."""
    rays = np.column_stack([uv, np.ones(len(uv))]) @ np.linalg.inv(K).T
    down = rays @ T[2, :3]
    depth = np.where(down < -1e-3, (height - T[2, 3]) / np.minimum(down, -1e-3), np.nan)
    return np.asarray(rays * depth[:, None])


def landmarks(T: F64, rng: np.random.Generator) -> F64:
    """Points of ground with relief that the camera sees within 300 m."""
    uv = rng.uniform([0, 0], [W, H], (600, 2))
    points = on_ground(T, uv, K, rng.uniform(0.0, 6.0, len(uv)))
    return points[np.isfinite(points[:, 2]) & (points[:, 2] < 300.0)]


def projected(T: F64, points: F64, K: F64 = K) -> F64:
    """(N, 2) pixels of world points."""
    P = se3.transform(se3.inverse(T), points) @ K.T
    return np.asarray(P[:, :2] / P[:, 2:])


def flown(
    motion: F64, pitch_deg: float, turn: F64, axis: int = 1
) -> tuple[PosedImage, PosedImage, F64]:
    left = view(camera(np.array([0.0, 0.0, HEIGHT_M]), pitch_deg), axis)
    right = view(camera(np.array([0.0, 0.0, HEIGHT_M]) + motion, pitch_deg, turn), axis)
    return left, right, landmarks(left.T_odom_camera, np.random.default_rng(0))


def angles(ray: F64) -> tuple[float, float]:
    """Away from z and about it."""
    return float(np.arccos(ray[2] / np.linalg.norm(ray))), float(np.arctan2(ray[1], ray[0]))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.slow
def test_pair_and_depth_agree_with_projection(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A point lies on one row of both images, and its label gives its depth."""
    monkeypatch.setattr("recon.stereo.polar.stretch", lambda gray, seen: gray)
    rng, axis = np.random.default_rng(seed), seed % 2
    motion = rng.uniform([5.0, -3.0, -2.0], [15.0, 3.0, 2.0]) * (1.0 if seed < 5 else -1.0)
    turn = rng.uniform(-0.04, 0.04, 3)
    left, right, points = flown(motion, rng.uniform(-28.0, -8.0), turn, axis)
    pair = rectify(left, right, points, CONFIG)
    assert isinstance(pair, PolarPair)
    uv = rng.integers([0, SIZE[1] // 2], SIZE, (80, 2)).astype(np.float64)
    points = on_ground(left.T_odom_camera, uv, GRID_K, rng.uniform(0.0, 6.0, len(uv)))
    in_world = se3.transform(left.T_odom_camera, points)
    here, there = projected(left.T_odom_camera, in_world), projected(right.T_odom_camera, in_world)
    sure, checked = np.ones_like(pair.left, np.float32), 0
    for (u, v), point, at_left, at in zip(uv.astype(int), points, here, there, strict=True):
        away, about = angles(pair.R_left_keyframe @ point)
        column = (pair.first_rad - away) * pair.px_per_rad
        row = ((about - pair.first_row_rad) % (2 * np.pi)) * pair.rows_per_rad
        label = label_of(pair, left, right, away, about, at)
        h, w = pair.left.shape
        inside = (at_left > 4).all() and (at > 4).all() and (at < [W - 5, H - 5]).all()
        if not (inside and 2 < row < h - 3 and column < w - 3 and column - label > 2):
            continue
        assert 0 < label < pair.labels - 1
        found = reproject_polar(DisparityMap(sure * label, sure), pair, GRID_K, SIZE)
        assert found.depth_m[v, u] == pytest.approx(point[2], rel=1e-3)
        other = DisparityMap(sure * (label + LABEL_SIGMA_PX), sure)
        moved = abs(reproject_polar(other, pair, GRID_K, SIZE).depth_m[v, u] - found.depth_m[v, u])
        assert found.sigma_m[v, u] == pytest.approx(moved, rel=0.1)
        for image, x, place in ((pair.left, column, at_left), (pair.right, column - label, at)):
            level = 255.0 * place[1 - axis] / ((W, H)[1 - axis] - 1)
            assert abs(float(image[round(row), round(x)]) - level) < 6.0
        checked += 1
    assert checked > 10


def label_of(
    pair: PolarPair, left: PosedImage, right: PosedImage, away: float, about: float, at: F64
) -> float:
    """The label whose place on the plane the right view sees at the pixel ``at``, by search."""

    def off(label: F64) -> F64:
        a = away + (pair.first_label + label) / pair.px_per_rad
        rays = np.stack([np.sin(a) * np.cos(about), np.sin(a) * np.sin(about), np.cos(a)], axis=1)
        on_plane = rays / np.maximum(rays @ pair.plane, 1e-9)[:, None]
        world = se3.transform(left.T_odom_camera, on_plane @ pair.R_left_keyframe)
        return np.asarray(np.linalg.norm(projected(right.T_odom_camera, world) - at, axis=1))

    best, reach = 0.5 * pair.labels, 0.5 * pair.labels + 4.0
    for _ in range(5):
        tried = best + np.linspace(-reach, reach, 401)
        best, reach = float(tried[np.argmin(off(tried))]), reach / 50.0
    return best


def test_only_motion_along_the_view_makes_a_polar_pair() -> None:
    """A camera that looks down takes the ordinary way."""
    down = camera(np.array([0.0, 0.0, HEIGHT_M]), -90.0)
    nearby = camera(np.array([5.0, 0.0, HEIGHT_M]), -90.0)
    points = landmarks(down, np.random.default_rng(0))
    assert isinstance(rectify(view(down), view(nearby), points, CONFIG), StereoPair)
    ahead = flown(np.array([8.0, 0.0, 0.0]), -20.0, np.zeros(3))
    assert isinstance(rectify(*ahead, CONFIG), PolarPair)


def test_a_pair_that_promises_too_large_a_sigma_is_refused() -> None:
    """Straight down, sigma falls with the step and with the distance from the epipole."""
    strict = replace(CONFIG, max_sigma_share=0.02)
    left, right, points = flown(np.array([0.0, 0.0, -1.5]), -90.0, np.zeros(3))
    found = rectify(left, right, points, strict)
    assert found == "flying along the line of sight"
    left, right, points = flown(np.array([0.0, 0.0, -6.0]), -90.0, np.zeros(3))
    assert isinstance(rectify(left, right, points, strict), PolarPair)


def depth_everywhere(pair: PolarPair) -> F64:
    """Depth that the pair gives, whatever its label: the nearest of all labels."""
    layers = []
    for label in range(pair.labels):
        px = np.full(pair.left.shape, label, np.float32)
        found = reproject_polar(DisparityMap(px, np.ones_like(px)), pair, GRID_K, SIZE)
        layers.append(np.where(np.isnan(found.depth_m), np.inf, found.depth_m))
    return np.asarray(np.min(layers, axis=0), np.float64)


def test_nothing_inside_the_mask_and_nothing_above_the_horizon() -> None:
    """Level flight: about the epipole, and in the sky, no label becomes surface."""
    left, right, points = flown(np.array([12.0, 0.0, 0.0]), 0.0, np.zeros(3))
    pair = rectify(left, right, points, CONFIG)
    assert isinstance(pair, PolarPair)
    depth = depth_everywhere(pair)
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    x, y = (u - GRID_K[0, 2]) / GRID_K[0, 0], (v - GRID_K[1, 2]) / GRID_K[1, 1]
    away = np.arctan(np.hypot(x, y))  # the epipole is the principal point
    median = float(np.median(np.linalg.norm(points, axis=1)))
    masked = np.sin(away) < 0.9 * LABEL_SIGMA_PX * median / (
        CONFIG.max_sigma_share * 12.0 * pair.px_per_rad
    )
    assert masked.sum() > 30 and np.isinf(depth[masked]).all()
    assert np.isinf(depth[y < -0.02]).all()
    assert np.isfinite(depth[y > 0.25]).mean() > 0.9
