"""A camera 20 degrees below the horizon that flies where it looks, from images to depth.

The flight is exact: 40 m above a level, textured plane under a plain sky.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mapper_events import keyframes_of

from recon import se3
from recon.backends import load_backend
from recon.pipeline import stages
from recon.stereo.belief_propagation import BeliefPropagationConfig, belief_propagation
from recon.stereo.polar import reproject_polar
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.virtual_stereo import (
    drop_unseen,
    rectify,
)
from recon.tracking.frame import Frame
from recon.types import F64, U8, Camera, Keyframe, PolarPair, PosePrior, RectifiedPair
from service.config import load_config
from service.flight.pipeline import Pipeline

K: F64 = np.array([[360.0, 0, 239.5], [0, 360.0, 134.5], [0, 0, 1]])
CAMERA = Camera(K, np.zeros(5), (480, 270))
M_PER_PX, HEIGHT_M, STEP_M, FRAMES, PITCH_DEG = 0.2, 40.0, 1.5, 40, -20.0
LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks east
FAR_M = 400.0


def ground() -> list[U8]:
    """A texture about the world's origin, 800 m by 600 m, and the same at half its size, twice."""
    rng = np.random.default_rng(0)
    size = (4000, 3000)
    out = np.zeros(size[::-1], np.float32)
    for cell in (2, 5, 12, 30, 80, 300):
        layer = rng.normal(0, 1, (size[1] // cell + 2, size[0] // cell + 2)).astype(np.float32)
        out += cv2.resize(layer, size, interpolation=cv2.INTER_LINEAR)
    levels = [np.asarray(np.clip(out / out.std() * 40 + 110, 0, 255), np.uint8)]
    for _ in range(3):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.uint8))
    return levels


def pose(i: int) -> F64:
    rng = np.random.default_rng(i)
    tilt = se3.so3_exp(np.array([np.radians(PITCH_DEG), 0.0, 0.0]) + rng.normal(0, 0.004, 3))
    return se3.compose(LEVEL @ tilt, np.array([STEP_M * i, 0.3 * np.sin(0.2 * i), HEIGHT_M]))


def ground_depth(T: F64, K: F64, size: tuple[int, int]) -> F64:
    """(h, w) depth of the plane; NaN in the sky and far off."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
    down = -(rays @ T[2, :3])
    depth = T[2, 3] / np.maximum(down, 1e-6)
    return np.where(depth < FAR_M, depth, np.nan)


def photograph(levels: list[U8], T: F64) -> U8:
    """(H, W, 3) image with as much detail as its pixels hold."""
    W, H = CAMERA.size_px
    depth = ground_depth(T, K, CAMERA.size_px)
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones((H, W))], -1)
    places = np.nan_to_num(depth)[..., None] * rays @ T[:3, :3].T + T[:3, 3]
    gray = np.full((H, W), 210, np.uint8)
    for k, level in enumerate(levels):
        texel = M_PER_PX * 2**k
        x = ((places[..., 0] + 100.0) / texel).astype(np.float32)
        y = ((places[..., 1] + 300.0) / texel).astype(np.float32)
        found = cv2.remap(level, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        fits = depth / K[0, 0] >= 0.7 * texel if k else np.isfinite(depth)
        gray[fits] = found[fits]
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8)


@pytest.fixture(scope="module")
def rectified() -> list[tuple[int, int]]:
    """Numbers of the images that made pairs."""
    return []


@pytest.fixture(scope="module")
def keyframes(rectified: list[tuple[int, int]]) -> Iterator[list[Keyframe]]:
    def noted(left: PosedImage, right: PosedImage, *rest: Any) -> RectifiedPair | str:
        found = rectify(left, right, *rest)
        if not isinstance(found, str):
            rectified.append((left.seq, right.seq))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "rectify", noted)
        yield fly()


def fly() -> list[Keyframe]:
    levels = ground()
    config = load_config(None, ["compute.upsample=false", "camera.readout_ms=0"])
    pipeline = Pipeline(CAMERA, config, load_backend("cpu"), Path("/dev/null/pages"))
    out: list[Keyframe] = []
    for i in range(FRAMES):
        T = pose(i)
        prior = PosePrior(T[:3, :3], 0.005, 0.01, T[:3, 3], np.full(3, 0.1), HEIGHT_M, 0.1)
        frame = Frame(photograph(levels, T), i * 100_000_000, i, prior)
        out += keyframes_of(pipeline.mapper.track(frame))
    return out + keyframes_of(pipeline.mapper.finish())


@pytest.mark.slow
def test_the_ground_ahead_is_measured(keyframes: list[Keyframe]) -> None:
    """Of what lies within 150 m nearly all, to a hundredth of the distance once scale is known."""
    assert len(keyframes) >= 3
    for keyframe in keyframes[1:]:
        depth = keyframe.depth
        h, w = depth.depth_m.shape
        truth = ground_depth(pose(keyframe.seq), depth.K, (w, h))
        near = truth < 150.0
        known = near & np.isfinite(depth.depth_m)
        ratio = depth.depth_m[known] / truth[known]
        scale = float(np.median(ratio))  # of so short a track the fixes leave it open
        error = np.abs(ratio / scale - 1.0)
        assert known.sum() > 0.9 * near.sum()
        assert abs(scale - 1.0) < 0.04
        assert np.median(error) < 0.01
        assert np.mean(error > 0.05) < 0.02


@pytest.mark.slow
def test_two_images_are_matched_once(
    keyframes: list[Keyframe], rectified: list[tuple[int, int]]
) -> None:
    """The other one takes its depth over; the depth of all keyframes is tested above."""
    assert len(rectified) > len(keyframes)
    assert len({frozenset(pair) for pair in rectified}) == len(rectified)


@pytest.mark.slow
def test_sigma_grows_with_the_distance(keyframes: list[Keyframe]) -> None:
    """On a plane that fills with the distance: once for it, once for the angle to the epipole."""
    depth = keyframes[1].depth
    h, w = depth.depth_m.shape
    truth = ground_depth(pose(keyframes[1].seq), depth.K, (w, h))
    near, far = (
        float(np.nanmedian((depth.sigma_m / truth)[(truth > a) & (truth < b)]))
        for a, b in ((60.0, 75.0), (140.0, 170.0))
    )
    assert 2.0 < far / near < 12.0


def test_the_sky_has_no_surface(keyframes: list[Keyframe]) -> None:
    for keyframe in keyframes:
        depth = keyframe.depth
        h, w = depth.depth_m.shape
        T = pose(keyframe.seq)
        sky = ~np.isfinite(ground_depth(T, depth.K, (w, h)))
        assert np.isfinite(depth.depth_m[sky]).mean() < 0.02


def shot(levels: list[U8], T: F64, blur_px: float) -> U8:
    """(H, W) while the camera turns upwards by ``blur_px``, with noise of 2 levels."""
    angles = np.linspace(-0.5, 0.5, 2 * int(abs(blur_px)) + 1) * blur_px / K[0, 0]
    total = np.zeros(CAMERA.size_px[::-1])
    for angle in angles:
        turned = T.copy()
        turned[:3, :3] = T[:3, :3] @ se3.so3_exp(np.array([angle, 0.0, 0.0]))
        total += photograph(levels, turned)[..., 0]
    noise = 2.0 * np.random.default_rng(0).normal(size=total.shape)
    return np.asarray(np.clip(np.rint(total / len(angles) + noise), 0, 255), np.uint8)


@pytest.mark.parametrize("blurs_px", [(0.0, 0.0), (8.0, 8.0), (8.0, 3.0)])
@pytest.mark.slow
def test_sigma_covers_motion_blur(blurs_px: tuple[float, float]) -> None:
    """Of a pair with exact poses, at the images' own resolution."""
    levels, views = ground(), []
    for i, blur in zip((0, 7), blurs_px, strict=True):
        blurred = np.array([0.0, blur])
        views.append(PosedImage(None, shot(levels, pose(i), blur), K, pose(i), blur_px=blurred))
    left, right = views
    truth = ground_depth(left.T_odom_camera, K, CAMERA.size_px)
    v, u = np.nonzero(truth < 200.0)
    ahead = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.size)], 1)
    config = VirtualStereoConfig(width_px=CAMERA.size_px[0], guided=False)
    pair = rectify(left, right, (ahead * truth[v, u, None])[::97], config)
    assert isinstance(pair, PolarPair)
    labels = belief_propagation(pair.left, pair.right, pair.labels, BeliefPropagationConfig())
    found = reproject_polar(drop_unseen(labels, pair), pair, K, CAMERA.size_px)
    off = np.abs(found.depth_m - truth)
    known = np.isfinite(off) & (truth < 150.0)
    share = float(np.mean(off[known] < found.sigma_m[known]))
    without = float(np.mean(off[known] < found.sigma_m[known] / pair.noise))
    assert 0.48 < share < 0.92
    assert without < 0.8 * share if any(blurs_px) else pair.noise == 1.0
