"""Rectification, disparity window and refusals, against plain projection of points."""

from __future__ import annotations

import numpy as np
import pytest

from recon import se3
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.reprojection import reproject
from recon.stereo.virtual_stereo import (
    check_pair,
    drop_unseen,
    homography,
    plane_relief,
    rectify,
)
from recon.types import F64, U8, DepthMap, DisparityMap, StereoPair

W, H = 640, 360
K = np.array([[500.0, 0, 319.5], [0, 500.0, 179.5], [0, 0, 1]])
CONFIG = VirtualStereoConfig(width_px=160)


def view(
    seq: int, centre: tuple[float, float, float], turn: tuple[float, float, float]
) -> PosedImage:
    R = se3.so3_exp(np.array(turn)) @ np.diag([1.0, -1, -1])
    rng = np.random.default_rng(seq)
    image: U8 = rng.integers(0, 255, (H, W, 3), dtype=np.uint8)
    return PosedImage(image, image[..., 0].copy(), K, se3.compose(R, np.array(centre)))


def ground(rng: np.random.Generator, n: int = 500, relief: float = 6.0) -> F64:
    return np.asarray(np.c_[rng.uniform(-30, 30, (n, 2)), rng.uniform(0, relief, n)])


DIRECTIONS = [(5.0, 0.0, 0.0), (-5.0, 0.0, 0.0), (0.0, 5.0, 0.3), (3.0, -4.0, -0.5)]


@pytest.mark.parametrize("motion", DIRECTIONS)
def test_every_point_has_its_partner_on_the_same_row(motion: tuple[float, float, float]) -> None:
    """Label, plane and slope lead from a left pixel to where the right view sees the point."""
    left = view(0, (0.0, 0.0, 60.0), (0.03, -0.02, 0.4))
    right = view(1, (motion[0], motion[1], 60.0 + motion[2]), (-0.04, 0.03, 0.5))
    X = ground(np.random.default_rng(3))
    in_left = se3.transform(se3.inverse(left.T_odom_camera), X)
    pair = rectify(left, right, in_left, CONFIG)
    assert isinstance(pair, StereoPair)
    P = in_left @ pair.R_left_keyframe.T
    u = pair.K[0, 0] * P[:, 0] / P[:, 2] + pair.K[0, 2]
    v = pair.K[1, 1] * P[:, 1] / P[:, 2] + pair.K[1, 2]
    d = pair.K[0, 0] * pair.baseline_m / P[:, 2]
    label = (d - pair.plane @ np.stack([u, v, np.ones_like(u)])) / pair.slope
    assert (label > 0).all() and (label < pair.labels - 1).all()
    T_left_right = se3.inverse(left.T_odom_camera) @ right.T_odom_camera
    R_rect_right = pair.R_left_keyframe @ T_left_right[:3, :3]
    h, w = pair.left.shape
    M = homography(right, R_rect_right, pair.K, 1.0, pair.plane)
    x, y = u - label, v
    inside = (x > 1) & (x < w - 2) & (y > 1) & (y < h - 2)
    assert inside.sum() > 100
    found = np.stack([x, y, np.ones_like(x)], axis=1) @ M.T
    found = found[:, :2] / found[:, 2:]
    seen = se3.transform(se3.inverse(right.T_odom_camera), X)
    true = seen[:, :2] / seen[:, 2:] * 500 + [319.5, 179.5]
    assert np.linalg.norm(found - true, axis=1)[inside].max() < 1e-6


def test_true_labels_give_the_true_depth_on_the_keyframe_grid() -> None:
    left = view(0, (0.0, 0.0, 60.0), (0.1, 0.05, 0.0))
    right = view(1, (4.0, 4.0, 60.0), (0.05, 0.0, 0.1))
    X = ground(np.random.default_rng(4), relief=0.0)
    in_left = se3.transform(se3.inverse(left.T_odom_camera), X)
    pair = rectify(left, right, in_left, CONFIG)
    assert isinstance(pair, StereoPair)
    h, w = pair.left.shape
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    ray = np.stack([(u - pair.K[0, 2]) / pair.K[0, 0], (v - pair.K[1, 2]) / pair.K[1, 1]], -1)
    ray = np.concatenate([ray, np.ones((h, w, 1))], -1)
    T_world = left.T_odom_camera[:3, :3] @ pair.R_left_keyframe.T
    z = 60.0 / -(ray @ T_world[2])
    d = pair.K[0, 0] * pair.baseline_m / z
    label = (d - (pair.plane[0] * u + pair.plane[1] * v + pair.plane[2])) / pair.slope
    disparity = DisparityMap(label.astype(np.float32), np.ones((h, w), np.float32))
    size = (160, 90)
    grid_K = np.array([[125.0, 0, 79.5], [0, 125.0, 44.5], [0, 0, 1]])
    got = reproject(disparity, pair, grid_K, size)
    gu, gv = np.meshgrid(np.arange(160), np.arange(90))
    rays = np.stack([(gu - 79.5) / 125, (gv - 44.5) / 125, np.ones((90, 160))], -1)
    truth = 60.0 / -(rays @ left.T_odom_camera[2, :3])
    known = np.isfinite(got.depth_m)
    assert known.mean() > 0.9
    assert np.abs(got.depth_m - truth)[known].max() < 1e-3


def test_the_guide_lies_on_the_grid_of_the_pair() -> None:
    """The keyframe has no finer pixels, so Eq. 2 is evaluated at none."""
    left = view(0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    right = view(1, (4.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    points = se3.transform(se3.inverse(left.T_odom_camera), ground(np.random.default_rng(5)))
    pair = rectify(left, right, points, CONFIG)
    assert isinstance(pair, StereoPair) and pair.guide is not None
    assert pair.guide.shape == (*pair.left.shape, 3)
    of_guide = pair.guide[..., 0][10:-10, 10:-10].astype(float)
    assert np.corrcoef(of_guide.ravel(), pair.left[10:-10, 10:-10].ravel())[0, 1] > 0.5


def test_refusals_name_their_reason() -> None:
    a = view(0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    cases = {
        "baseline too short": view(1, (0.5, 0.0, 60.0), (0.0, 0.0, 0.0)),
        "baseline too long": view(1, (50.0, 0.0, 60.0), (0.0, 0.0, 0.0)),
        "too little overlap": view(1, (5.0, 0.0, 60.0), (0.9, 0.0, 0.0)),
    }
    for reason, b in cases.items():
        found = check_pair(a, b, 60.0, CONFIG)
        assert found == reason
    good = view(1, (5.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    assert check_pair(a, good, 60.0, CONFIG) is None
    assert isinstance(rectify(a, good, np.zeros((3, 3)), CONFIG), str)


def test_relief_widens_the_window() -> None:
    a = view(0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    b = view(1, (6.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    X = se3.transform(se3.inverse(a.T_odom_camera), ground(np.random.default_rng(5), relief=1.0))
    flat = rectify(a, b, X, CONFIG)
    tall = rectify(a, b, X, CONFIG, (0.0, 30.0))
    assert isinstance(flat, StereoPair) and isinstance(tall, StereoPair)
    assert flat.labels == CONFIG.labels < tall.labels
    roof_d = tall.K[0, 0] * 6.0 / 30.0
    assert roof_d < tall.plane[2] + tall.slope * (tall.labels - 1)


def test_no_more_labels_than_the_relief_needs() -> None:
    config = VirtualStereoConfig(labels=16)
    for need in np.linspace(0.0, 90.0, 181):
        labels = config.labels_for(float(need))
        assert labels >= max(16, need) and (labels == 16 or labels < need + 4)


def test_labels_on_nothing_are_dropped() -> None:
    a = view(0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    b = view(1, (6.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    X = se3.transform(se3.inverse(a.T_odom_camera), ground(np.random.default_rng(6)))
    pair = rectify(a, b, X, CONFIG)
    assert isinstance(pair, StereoPair) and pair.right_seen is not None
    h, w = pair.left.shape
    middle = np.full((h, w), pair.labels / 2, np.float32)
    kept = drop_unseen(DisparityMap(middle, np.ones((h, w), np.float32)), pair)
    lost = np.isnan(kept.px)
    assert 0.02 < lost.mean() < 0.4
    assert (kept.confidence[lost] == 0).all()
    # A camera further right does not see the left rim of the left view.
    assert lost[:, :4].all() and not lost[h // 2, w // 2]


def test_relief_is_measured_towards_the_camera() -> None:
    depth = np.full((90, 160), 60.0, np.float32)
    depth[30:40, 50:70] = 50.0
    views = np.full((90, 160), 3, np.uint8)
    found = plane_relief(
        DepthMap(depth, np.full_like(depth, 0.1), views, K, np.eye(4)), (-1.0, 2.0)
    )
    assert found[1] == pytest.approx(10.0, abs=0.5)
    assert found[0] == pytest.approx(-0.9)
