"""Walls get their surface where oblique views show them: a simulated house, from images on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapper_events import keyframes_of
from scipy.spatial import cKDTree
from simulated_place import simulated_place

from recon import se3
from recon.backends import load_backend
from recon.camera_model import rays
from recon.tracking.frame import Frame
from recon.types import F64, Keyframe, PosePrior
from service.config import load_config
from service.flight.pipeline import Pipeline
from service.sim import shapes
from service.sim.recording import Simulation

STEP_M, FRAMES, AWAY_M = 1.5, 20, 28.0


@pytest.fixture(scope="module")
def site() -> Simulation:
    return simulated_place((480, 270))


def house_of(site: Simulation) -> F64:
    """The house nearest to the middle of the site."""
    houses = [b for b in site.scene.blocks if b[shapes.KIND] < shapes.VEHICLE]
    return min(houses, key=lambda b: float(np.hypot(b[shapes.X], b[shapes.Y])))


def wall_of(house: F64) -> tuple[F64, F64, F64]:
    """(N, 3) places on a long wall, half a metre off its borders, and its normal and direction."""
    along = np.array([house[shapes.COS], house[shapes.SIN], 0.0])
    out = np.array([-house[shapes.SIN], house[shapes.COS], 0.0])
    x, z = np.meshgrid(
        np.arange(0.5 - house[shapes.HALF_L], house[shapes.HALF_L] - 0.5, 0.25),
        np.arange(house[shapes.BASE] + 0.5, house[shapes.EAVE] - 0.5, 0.25),
    )
    middle = np.array([house[shapes.X], house[shapes.Y], 0.0]) + house[shapes.HALF_W] * out
    return middle + x.ravel()[:, None] * along + z.ravel()[:, None] * [0, 0, 1], out, along


def view(eye: F64, ahead: F64, along: F64) -> F64:
    """T_world_camera that looks ``ahead``, with ``along`` to the right."""
    right = along - (along @ ahead) * ahead
    right /= np.linalg.norm(right)
    return se3.compose(np.column_stack([right, np.cross(ahead, right), ahead]), eye)


def flown(site: Simulation, down_deg: float) -> F64:
    """(N, 3) points of a flight along the wall that looks at it, ``down_deg`` below the horizon."""
    wall, out, along = wall_of(house_of(site))
    down = np.radians(down_deg)
    ahead = -np.cos(down) * out - np.sin(down) * np.array([0.0, 0.0, 1.0])
    config = load_config(None, ["compute.upsample=false", "camera.readout_ms=0"])
    pipeline = Pipeline(site.options.camera, config, load_backend("cpu"), Path("/dev/null/pages"))
    keyframes: list[Keyframe] = []
    for i in range(FRAMES):
        place = wall.mean(axis=0) + STEP_M * (i - FRAMES / 2) * along
        T = view(place - AWAY_M * ahead, ahead, along)
        image = site.renderer.frame(T, i, site.options.look)
        height = float(T[2, 3] - house_of(site)[shapes.BASE])
        prior = PosePrior(T[:3, :3], 0.01, 0.02, T[:3, 3], np.full(3, 0.05), height, 1.0)
        keyframes += keyframes_of(pipeline.mapper.track(Frame(image, 400_000_000 * i, i, prior)))
    keyframes += keyframes_of(pipeline.mapper.finish())
    return np.vstack([points(keyframe) for keyframe in keyframes])


def points(keyframe: Keyframe) -> F64:
    depth = keyframe.depth
    v, u = np.nonzero(np.isfinite(depth.depth_m))
    z = depth.depth_m[v, u].astype(np.float64)
    seen = rays(depth.K, np.stack([u, v], axis=1).astype(np.float64)) * z[:, None]
    return se3.transform(depth.T_world_camera, seen)


@pytest.mark.slow
def test_a_wall_has_its_surface_where_oblique_views_show_it(site: Simulation) -> None:
    """From straight above the same flight has a fifth of it."""
    apart, _ = cKDTree(flown(site, 40.0)).query(wall_of(house_of(site))[0])
    assert np.mean(apart < 0.3) > 0.8
