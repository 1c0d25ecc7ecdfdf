"""The geometry and the colours of the benchmark of the portal's screen."""

from __future__ import annotations

import numpy as np
import pytest
from bench_options import DataOptions
from bench_screen import as_recorded, run, to_camera

from recon import se3
from recon.types import Camera
from service.errors import InputError

CAMERA = Camera(np.array([[480.0, 0, 321], [0, 470, 178], [0, 0, 1]]), np.zeros(5), (640, 360))


def test_it_needs_a_scan_and_its_flight() -> None:
    with pytest.raises(InputError, match="--scan and --flight"):
        run(DataOptions())


def test_what_the_scene_shows_lies_where_the_turned_camera_sees_it() -> None:
    T = np.eye(4)
    T[:3, :3] = np.array([[0.8, 0.6, 0], [0.6, -0.8, 0], [0, 0, -1]])  # down, turned by 37 degrees
    T[:3, 3] = eye = np.array([3.0, -2, 50])
    aim, side = eye + np.array([0.0, 4.0, -40.0]), 764  # the scene looks a little to the north
    places = np.array([[3.0, -2, 0], [13, -6, 2], [-9, 4, -1], [4, 9, 12]])
    ahead = (aim - eye) / np.linalg.norm(aim - eye)
    up = np.cross([1.0, 0, 0], ahead)
    local = (places - eye) @ np.column_stack([[1.0, 0, 0], -up, ahead])
    f = side / 2 / np.tan(np.radians(77 / 2))
    on_scene = f * local[:, :2] / local[:, 2:] + side / 2 - 0.5
    found = np.column_stack([on_scene, np.ones(4)]) @ to_camera(CAMERA, T, eye, aim, 77, side).T
    seen = se3.transform(se3.inverse(T), places) @ CAMERA.K.T
    np.testing.assert_allclose(found[:, :2] / found[:, 2:], seen[:, :2] / seen[:, 2:], atol=1e-6)


def test_colours_lose_the_brightness_of_the_page() -> None:
    flat = np.full((2, 2, 3), 120, np.uint8)
    linear = ((120 / 255 + 0.055) / 1.055) ** 2.4
    shown = np.full((2, 2, 3), round(255 * (1.055 * (3 * linear) ** (1 / 2.4) - 0.055)), np.uint8)
    assert np.abs(as_recorded(shown, 3.0).astype(int) - flat).max() <= 1
