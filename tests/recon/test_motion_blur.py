"""Blur by motion: its length in images, the exposure behind it, and what the operator reads."""

from __future__ import annotations

from collections import Counter
from unittest.mock import Mock

import cv2
import numpy as np
import painted_ground as painted
import pytest
from painted_ground import painted_ground
from tracked_frame import undistorted

from recon import se3
from recon.camera_model import Undistorter
from recon.image_quality import ExposureTimeWatch, streak_px
from recon.pipeline.views import ViewSelection, VirtualStereoCamera
from recon.stereo.belief_propagation import BeliefPropagationConfig, belief_propagation
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.reprojection import reproject
from recon.stereo.virtual_stereo import drop_unseen, rectify
from recon.tracking.odometry import Odometry
from recon.types import F64, U8, Camera, PosePrior, StereoPair
from service.flight.reports import blur_note, blur_warning, motion_blur
from service.flight.scan import Scan, ScanInputs

K = np.array([[400.0, 0, 239.5], [0, 400.0, 179.5], [0, 0, 1]])
CAMERA = Camera(K, np.zeros(5), (480, 360))
FPS = 15.0


def blurred(image: U8, length: float, angle_deg: float) -> U8:
    """``image`` (H, W) smeared by ``length`` px in a direction."""
    d = np.radians(angle_deg)
    H, W = image.shape
    total = np.zeros(image.shape, np.float32)
    steps = np.linspace(-0.5, 0.5, 2 * int(length) + 3) * length
    for s in steps:
        M = np.array([[1.0, 0.0, s * np.cos(d)], [0.0, 1.0, s * np.sin(d)]])
        total += cv2.warpAffine(image, M, (W, H), borderMode=cv2.BORDER_REFLECT)
    return np.asarray(np.rint(total / len(steps)), np.uint8)


@pytest.fixture(scope="module")
def image() -> U8:
    return painted_ground()[600:960, 500:980]


@pytest.mark.parametrize("length", [6.0, 10.0, 18.0])
@pytest.mark.parametrize("angle_deg", [0.0, 35.0, -110.0])
def test_the_streak_is_as_long_as_the_motion(image: U8, length: float, angle_deg: float) -> None:
    d = np.radians(angle_deg)
    along = np.array([np.cos(d), np.sin(d)])
    smeared = blurred(image, length, angle_deg)
    assert streak_px(smeared, along) == pytest.approx(length, rel=0.25)
    assert streak_px(smeared, np.array([-along[1], along[0]])) < 3.0
    soft = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.5), np.uint8)  # out of focus
    assert streak_px(soft, along) < 3.0


def test_an_image_without_texture_has_no_streak() -> None:
    assert np.isnan(streak_px(np.full((90, 120), 7, np.uint8), np.array([1.0, 0.0])))
    ramp = np.tile(np.arange(120, dtype=np.uint8), (90, 1))
    assert np.isnan(streak_px(ramp, np.array([1.0, 0.0])))


def watch_of(
    image: U8, exposure_s: float, speeds: list[float], image_gap_s: float = 1.0 / FPS
) -> ExposureTimeWatch:
    watch = ExposureTimeWatch()
    for speed in speeds:
        shot = blurred(image, speed * exposure_s, 20.0) if exposure_s else image
        d = np.radians(20.0)
        watch.add(shot, speed * np.array([np.cos(d), np.sin(d)]), 1.0 / FPS, image_gap_s)
    return watch


def test_the_exposure_follows_from_streaks_and_speeds(image: U8) -> None:
    speeds = [300.0, 450.0, 600.0, 350.0, 500.0]
    watch = watch_of(image, 0.02, speeds)
    assert watch.exposure_s == pytest.approx(0.02, rel=0.2)
    assert watch.blur_px == pytest.approx(9.0, rel=0.25)
    assert watch_of(image, 0.0, speeds).blur_px == 0.0
    assert watch_of(image, 0.02, speeds[:4]).exposure_s is None, "too few"
    slow = watch_of(image, 0.02, [20.0] * 9)  # 1.3 px from frame to frame
    assert slow.exposure_s is None


def test_a_smear_longer_than_the_motion_between_images_is_not_blamed_on_the_shutter(
    image: U8,
) -> None:
    """Frames are 67 ms apart for those that are tracked; of those that come, 10 or 33."""
    speeds = [300.0, 450.0, 600.0, 350.0, 500.0]
    motion = motion_blur(watch_of(image, 0.03, speeds, 0.033), 1.0)
    assert motion is not None and motion["exposure_ms"] == pytest.approx(30.0, rel=0.2)
    assert "shutter" in blur_note(motion) and "Shutter" in blur_warning(motion)
    smear = motion_blur(watch_of(image, 0.03, speeds, 0.010), 1.0)
    assert smear is not None and smear["exposure_ms"] is None
    assert smear["blur_px"] == motion["blur_px"]
    assert "compressed" in blur_note(smear) and "shutter" not in blur_note(smear)
    assert "bitrate" in blur_warning(smear) and len(blur_warning(smear)) <= 50


def photograph(ground: U8, T_world_camera: F64) -> U8:
    """The image of the plane z = 0, 240 m across."""
    side = 240.0 / len(ground)
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    plane = np.array([[side, 0, -120.0], [0, side, -120.0], [0, 0, 1]])
    H = K @ R.T @ (np.c_[np.eye(3)[:, :2], -t] @ plane)
    return np.asarray(cv2.warpPerspective(ground, H, (480, 360), flags=cv2.INTER_AREA), np.uint8)


def pose(t_s: float) -> F64:
    """16 m/s at 60 m, nodding by 2.3 degrees at 1 Hz: 107 px/s and up to 100 px/s."""
    nod = 0.04 * np.sin(2.0 * np.pi * t_s)
    R = se3.so3_exp(np.array([0.0, nod, 0.0])) @ np.diag([1.0, -1.0, -1.0])
    return se3.compose(R, np.array([16.0 * t_s - 60.0, 0.0, 60.0]))


@pytest.mark.slow
def test_a_shutter_too_slow_for_the_speed_is_seen_in_the_images() -> None:
    ground, exposure_s = painted_ground(), 0.05
    odometry = Odometry(CAMERA)
    views = VirtualStereoCamera(ViewSelection(), odometry, Undistorter(CAMERA), Counter())
    assert motion_blur(views.exposure_time, 2.0) is None
    for i in range(int(5 * FPS)):
        t = i / FPS
        moments = t + exposure_s * np.linspace(-0.5, 0.5, 7)
        shots = [photograph(ground, pose(m)).astype(np.float32) for m in moments]
        gray = np.asarray(np.rint(np.mean(shots, axis=0)), np.uint8)
        T = pose(t)
        prior = PosePrior(T[:3, :3], 0.01, 0.03, T[:3, 3], np.full(3, 0.5), 60.0, 2.0)
        for tracked in odometry.track(undistorted(gray, i, round(1e9 * t), prior)):
            views.take(tracked)
    blur = motion_blur(views.exposure_time, 2.0)
    assert blur is not None and blur["exposure_ms"] == pytest.approx(50.0, rel=0.3)
    assert blur["blur_px"] > 10.0, "px of the recording, twice as fine"
    assert f"images by {blur['blur_px']:.0f} px" in blur_note(blur)


def test_the_operator_hears_once_that_the_shutter_is_too_slow() -> None:
    warnings = list[str]()
    scan = Mock(Scan, inputs=Mock(ScanInputs, warn=warnings.append), _is_blur_reported=False)
    for blur_px in (None, 9.4, 12.1):
        scan.motion_blur = blur_px and {"blur_px": blur_px, "exposure_ms": 20.0}
        Scan.report_blur(scan)
    assert warnings == ["Shutter too slow: images blur by 9 px"]
    assert len(warnings[0]) <= 50, "characters that a ground station shows"


def shot(T_world_camera: F64, blur_px: F64) -> U8:
    """The painted ground, smeared by a motion of the camera (2,) px."""
    moments = np.linspace(-0.5, 0.5, 2 * int(np.abs(blur_px).max()) + 3)
    total = np.zeros(painted.SIZE[::-1])
    for s in moments:
        T = T_world_camera.copy()
        T[:3, 3] += T[:3, :3] @ np.r_[s * blur_px / painted.K[0, 0] * painted.HEIGHT_M, 0.0]
        total += painted.still(T)
    noise = 2.0 * np.random.default_rng(0).normal(size=total.shape)
    return np.asarray(np.clip(np.rint(total / len(moments) + noise), 0, 255), np.uint8)


@pytest.mark.parametrize(
    ("left_px", "right_px"),
    [
        ((0.0, 0.0), (0.0, 0.0)),
        ((8.0, 0.0), (8.0, 0.0)),
        ((12.0, 0.0), (12.0, 0.0)),
        ((8.0, 0.0), (4.0, 0.0)),
        ((4.0, 0.0), (0.0, 4.0)),
    ],
)
def test_the_sigma_of_stereo_covers_motion_blur(
    left_px: tuple[float, float], right_px: tuple[float, float]
) -> None:
    """A known plane at the images' own resolution: share of depths within one sigma."""
    views = []
    for east_m, seed, blur in ((0.0, 1, left_px), (6.0, 2, right_px)):
        T = painted.pose(east_m, seed=seed)
        image, blur_px = shot(T, np.array(blur)), -np.array(blur)
        views.append(PosedImage(None, image, painted.K, T, blur_px=blur_px))
    left, right = views
    on_plane = painted.on_plane(painted.K, painted.SIZE, left.T_odom_camera)
    config = VirtualStereoConfig(width_px=painted.SIZE[0], guided=False)
    pair = rectify(left, right, on_plane[::97], config)
    assert isinstance(pair, StereoPair)
    labels = belief_propagation(pair.left, pair.right, pair.labels, BeliefPropagationConfig())
    found = reproject(drop_unseen(labels, pair), pair, painted.K, painted.SIZE)
    off = np.abs(found.depth_m - on_plane[:, 2].reshape(found.depth_m.shape))
    known = np.isfinite(off)
    share = float(np.mean(off[known] < found.sigma_m[known]))
    assert 0.58 < share < 0.92
    is_blurred = any(left_px)
    assert (pair.noise == 1.0) != is_blurred
    if is_blurred and share < 0.8:  # which would be too few
        assert np.mean(off[known] < found.sigma_m[known] / pair.noise) < 0.58
