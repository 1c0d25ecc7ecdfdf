"""Stereo of a plane that is known exactly lies neither above nor below it, at any width."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from painted_ground import CAMERA, FOOTPRINT_M, HEIGHT_M, SIZE, K, on_plane, pose, still

from recon import se3
from recon.camera_model import scaled_K
from recon.stereo.belief_propagation import BeliefPropagationConfig, belief_propagation
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.reprojection import reproject
from recon.stereo.upsampling import upsample
from recon.stereo.virtual_stereo import drop_unseen, rectify
from recon.types import F64, StereoPair

LARGEST_BIAS = 2e-4
"""Of the height."""


def heights(width_px: int, upsampled: bool, east_m: float, min_known: float = 0.5) -> F64:
    """Heights above the plane of a tilted view paired with one ``east_m`` further on, where more
    than ``min_known`` of the view has one."""
    views = []
    for T in (pose(0.0, 10.0, seed=1), pose(east_m, 10.0, seed=2)):
        T[:3, :3] = se3.so3_exp(np.array([0.1, 0.15, 0.0])) @ T[:3, :3]
        image = still(T)
        views.append(PosedImage(np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)), image, K, T))
    left, right = views
    w, h = width_px, round(width_px * SIZE[1] / SIZE[0])
    K_grid = scaled_K(CAMERA.K, w / SIZE[0], h / SIZE[1])
    config = VirtualStereoConfig(width_px=w, guided=upsampled)
    pair = rectify(left, right, on_plane(K_grid, (w, h), left.T_odom_camera)[::97], config)
    assert isinstance(pair, StereoPair)
    labels = belief_propagation(pair.left, pair.right, pair.labels, BeliefPropagationConfig())
    labels = drop_unseen(labels, pair)
    if pair.guide is not None:
        labels = upsample(labels, pair.guide)
    depth = reproject(labels, pair, K_grid, (w, h)).depth_m
    truth = on_plane(K_grid, (w, h), left.T_odom_camera)[:, 2].reshape(h, w)
    off = HEIGHT_M * (1.0 - depth / truth)
    assert np.isfinite(off).mean() > min_known
    return np.asarray(off[np.isfinite(off)], np.float64)


@pytest.mark.parametrize("east_m", [4.0, -4.0])
@pytest.mark.parametrize(("width_px", "upsampled"), [(240, False), (240, True), (480, False)])
def test_a_known_plane_is_found_without_bias(width_px: int, upsampled: bool, east_m: float) -> None:
    assert abs(np.median(heights(width_px, upsampled, east_m))) < LARGEST_BIAS * HEIGHT_M


def test_a_grid_finer_than_the_image_has_no_bias_either() -> None:
    assert abs(np.median(heights(960, False, 4.0))) < LARGEST_BIAS * HEIGHT_M


@pytest.mark.parametrize("overlap", [0.6, 0.5, 0.4])
def test_views_of_a_survey_with_little_overlap_make_surface(overlap: float) -> None:
    """Baselines of 0.48 to 0.72 of the height, by this lens."""
    off = heights(240, False, (1.0 - overlap) * FOOTPRINT_M, overlap - 0.2)
    assert np.percentile(np.abs(off), 90) < 2e-3 * HEIGHT_M
