"""The portal's figures by themselves, on points of bodies whose volume is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from web_module import NEEDS_NODE, web_module

from recon.types import F64

RESULT = """given.map(({ corners, points }) => page.volume(
  corners.map((c) => new three.Vector3(...c)), (use) => points.forEach((p) => use(...p))))"""

pytestmark = NEEDS_NODE

Volumes = Callable[[list[dict[str, Any]]], list[dict[str, float]]]
LENGTH_M, WIDTH_M, HEIGHT_M, APART_M, NOISE_M = 10.0, 8.0, 5.0, 0.125, 0.05


@pytest.fixture(scope="module")
def volumes(tmp_path_factory: pytest.TempPathFactory) -> Volumes:
    """``volume`` of figures.ts for scenes of corners and points, as node computes it."""
    return web_module(tmp_path_factory.mktemp("figures"), "figures", RESULT)


def house(seed: int) -> dict[str, Any]:
    """Points of a box on level ground, seen from one side as stereo sees it, and picked corners.

    A pixel's points are APART_M apart, noisy, and missing where the box hides the ground.
    """
    rng = np.random.default_rng(seed)
    steps = np.arange(-13.0, 13.0, APART_M)
    grid = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) + rng.uniform(0, APART_M, 2)
    angle = rng.uniform(0.0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    xy = grid @ turn + rng.normal(0.0, 0.2 * APART_M, grid.shape)
    half, shade = np.array([LENGTH_M, WIDTH_M]) / 2.0, np.array([0.4, 0.2])
    is_roof = (np.abs(xy) < half).all(axis=1)
    is_hidden = ~is_roof & (np.abs(xy - shade) < half + shade).all(axis=1)
    z = np.where(is_roof, HEIGHT_M, 0.0) + rng.normal(0.0, NOISE_M, len(xy))
    points = np.column_stack([xy, z])[~is_hidden]
    ring = (half + 1.5) * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return {"corners": picked(points, ring).tolist(), "points": points.round(4).tolist()}


def picked(points: F64, ring: F64) -> F64:
    """The points that clicks at (N, 2) places find."""
    off = np.linalg.norm(points[:, None, :2] - ring, axis=2)
    return np.asarray(points[np.argmin(off, axis=0)])


def test_the_volume_of_a_house_by_noisy_points_and_clicks(volumes: Volumes) -> None:
    found = volumes([house(seed) for seed in range(12)])
    errors = np.array([v["above_m3"] for v in found]) / (LENGTH_M * WIDTH_M * HEIGHT_M) - 1.0
    assert np.abs(errors).max() < 0.018 and abs(errors.mean()) < 0.01, errors
    assert max(v["unseen"] for v in found) < 0.1
