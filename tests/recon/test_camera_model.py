"""The pinhole model against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon import camera_model as cm
from recon.types import U8, Camera

K = np.array([[700.0, 0, 321.5], [0, 710.0, 236.0], [0, 0, 1.0]])
DISTORTION = np.array([-0.25, 0.08, 0.001, -0.0005, -0.01])
CAMERA = Camera(K, DISTORTION, (640, 480))


def chart() -> U8:
    """(480, 640) image of dots and gradients."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (480, 640)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 3), np.uint8)


@given(st.floats(0, 639), st.floats(0, 479), st.floats(1.0, 200.0))
def test_rays_and_projection_are_inverse(u: float, v: float, depth: float) -> None:
    uv = np.array([[u, v]])
    points = cm.rays(K, uv) * depth
    assert points[0, 2] == pytest.approx(depth)
    np.testing.assert_allclose(cm.project(K, points), uv, atol=1e-9)


def test_projection_is_opencvs() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-20, -20, 5], [20, 20, 90], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, None)
    np.testing.assert_allclose(cm.project(K, points), expected[:, 0], atol=1e-9)


def test_points_behind_the_camera_have_no_pixel() -> None:
    uv = cm.project(K, np.array([[1.0, 2.0, -3.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    assert np.isnan(uv[:2]).all()
    np.testing.assert_allclose(uv[2], [321.5, 236.0])


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (320, 180)])
def test_scaling_follows_pixel_centres(size: tuple[int, int]) -> None:
    """A point at a pixel's corner stays at the matching corner of the resized grid."""
    small = cm.scaled(CAMERA, size)
    sx, sy = size[0] / 640, size[1] / 480
    points = np.array([[3.0, -2.0, 10.0], [-1.0, 4.0, 20.0]])
    corners = cm.project(K, points) + 0.5
    np.testing.assert_allclose(cm.project(small.K, points) + 0.5, corners * [sx, sy], atol=1e-9)
    assert small.size_px == size
    np.testing.assert_array_equal(small.distortion, DISTORTION)


def test_scaling_agrees_with_opencvs_resize() -> None:
    """A blob's centre of mass moves as the scaled camera says."""
    point = np.array([[1.3, -0.7, 10.0]])
    u, v = cm.project(K, point)[0]
    y, x = np.mgrid[0:480, 0:640]
    blob = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 6.0**2))
    small = cv2.resize(blob, (320, 240), interpolation=cv2.INTER_AREA)
    y, x = np.mgrid[0:240, 0:320]
    mass = np.array([(small * x).sum(), (small * y).sum()]) / small.sum()
    expected = cm.project(cm.scaled_K(K, 0.5, 0.5), point)[0]
    np.testing.assert_allclose(mass, expected, atol=1e-3)


def test_undistortion_is_opencvs() -> None:
    image = chart()
    ours = cm.Undistorter(CAMERA).image(image)
    theirs = cv2.undistort(image, K, DISTORTION)
    inner = np.abs(ours.astype(int) - theirs.astype(int))[5:-5, 5:-5]
    assert inner.max() <= 2
    assert inner.mean() < 0.2


def test_straight_lines_come_out_straight() -> None:
    """Points of a straight line, drawn as the lens bends them, lie on their pinhole pixels."""
    undistorter = cm.Undistorter(CAMERA)
    truth = np.column_stack([np.linspace(80, 560, 13), np.linspace(60, 420, 13)])
    bent, _ = cv2.projectPoints(cm.rays(K, truth), np.zeros(3), np.zeros(3), K, DISTORTION)
    y, x = np.mgrid[0:480, 0:640]
    for (u, v), (bu, bv) in zip(truth, bent[:, 0], strict=True):
        dot = 255 * np.exp(-((x - bu) ** 2 + (y - bv) ** 2) / (2 * 2.0**2))
        image = undistorter.image(np.asarray(np.round(dot), np.uint8)).astype(np.float64)
        mass = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
        np.testing.assert_allclose(mass, [u, v], atol=0.15)


def test_pixels_that_the_lens_never_saw_are_marked() -> None:
    pincushion = Camera(K, np.array([0.4, 0.2, 0.0, 0.0, 0.0]), (640, 480))
    undistorter = cm.Undistorter(pincushion)
    white = undistorter.image(np.full((480, 640), 255, np.uint8))
    assert undistorter.valid[0, 0] == 0 and undistorter.valid[240, 320] == 255
    assert (white[undistorter.valid == 0] < 255).all()
    barrel = cm.Undistorter(Camera(K, np.array([-0.2, 0, 0, 0, 0.0]), (640, 480)))
    assert barrel.valid.all()


def test_without_distortion_the_image_is_untouched() -> None:
    undistorter = cm.Undistorter(Camera(K, np.zeros(5), (640, 480)))
    image = chart()
    assert undistorter.image(image) is image
    assert undistorter.valid.all()
    with pytest.raises(ValueError, match="size"):
        undistorter.image(image[:100])


@pytest.mark.parametrize(
    ("camera", "fault"),
    [
        (Camera(K, DISTORTION, (8, 480)), "small"),
        (Camera(np.eye(4), DISTORTION, (640, 480)), "shape|must be"),
        (Camera(K, np.zeros(4), (640, 480)), "must be"),
        (Camera(K * np.nan, DISTORTION, (640, 480)), "finite"),
        (Camera(np.diag([-1.0, 1, 1]) @ K, DISTORTION, (640, 480)), "positive"),
        (Camera(np.diag([9.0, 1, 1]) @ K, DISTORTION, (640, 480)), "differ"),
        (Camera(K + 5e3 * np.outer([1, 0, 0], [0, 0, 1]), DISTORTION, (640, 480)), "outside"),
    ],
)  # fmt: skip
def test_a_camera_that_cannot_be_is_refused(camera: Camera, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        cm.check_camera(camera)
    with pytest.raises(ValueError, match=fault):
        cm.Undistorter(camera)
