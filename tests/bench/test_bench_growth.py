"""The endless plane of the benchmark of growth, seen by its camera."""

from __future__ import annotations

from itertools import islice, pairwise

import cv2
import numpy as np
import pytest
from bench_growth import APART_M, HEIGHT_M, LEG_M, LongFlight, photograph, place

from recon.types import F64
from service.bench.pipeline import K


def pose(east: float, north: float) -> F64:
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = east, north, HEIGHT_M
    return T


def test_the_way_has_no_gap_and_comes_to_new_ground() -> None:
    places = np.array([place(float(way)) for way in range(round(4 * (LEG_M + APART_M)))])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1) == pytest.approx(1.0, abs=0.5)
    assert places[-1, 1] == pytest.approx(4 * APART_M, abs=1.0)


@pytest.mark.parametrize("start", [(0.0, 0.0), (-40.0, 211.0)])
def test_images_move_as_the_camera_does(start: tuple[float, float]) -> None:
    first = photograph(pose(*start))[..., 0].astype(np.float32)
    second = photograph(pose(start[0] + 6.0, start[1]))[..., 0].astype(np.float32)
    (right, down), _ = cv2.phaseCorrelate(first, second)
    assert right == pytest.approx(-6.0 * K[0, 0] / HEIGHT_M, abs=0.5)
    assert down == pytest.approx(0.0, abs=0.5)


def test_each_image_has_a_time_and_a_fix() -> None:
    camera = LongFlight()
    frames = list(islice(camera, 4))
    assert all(b.time_ns > a.time_ns for a, b in pairwise(frames))
    assert all(f.geotag is not None and f.geotag.sigma_h_m == 1.0 for f in frames)
    assert camera.own_s > 0.0
