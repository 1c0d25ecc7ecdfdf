"""Frames of segments that no keyframe places in the world."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import se3
from recon.posegraph.trajectory import Placed, Trajectory
from recon.types import F64, PosePrior
from service.flight.anchorage import Anchorage, SettledKey
from service.flight.chain import Chain, Uncarried
from service.progress import Stopwatch


def anchor(seq: int, north_m: float) -> Anchorage:
    T = se3.compose(np.eye(3), np.array([0.0, north_m, 50.0]))
    return Anchorage(seq, SettledKey(0, 3, T), np.eye(4))


def following() -> Any:
    chain = Chain(Trajectory(), None, lambda key: True, Counter(), Stopwatch())

    def follow(seq: int, north_m: float, fix: F64 | None = None) -> Placed:
        sigma = None if fix is None else np.full(3, 5.0)
        image: Any = SimpleNamespace(prior=PosePrior(position_m=fix, sigma_position_m=sigma))
        placed = chain.follow(image, anchor(seq, north_m))
        published = Uncarried(placed.T_world_camera[:3, 3], np.full(3, placed.sigma_m / 3**0.5))
        again = chain.place(anchor(seq, north_m), published)
        np.testing.assert_allclose(again.T_world_camera, placed.T_world_camera)
        assert again.sigma_m == pytest.approx(placed.sigma_m)
        return placed

    return follow


def test_a_frame_that_no_keyframe_carries_stands_at_its_fix() -> None:
    """Stills fly south; without attitude the odometry has them fly north."""
    follow = following()
    for seq, north_m in enumerate((28.0, 56.0, 84.0), 1):
        fix = np.array([3.0, -north_m, 50.0])
        placed = follow(seq, north_m, fix)
        np.testing.assert_allclose(placed.T_world_camera[:3, 3], fix)
        np.testing.assert_allclose(placed.T_world_camera[:3, :3], np.eye(3))
        assert placed.sigma_m == pytest.approx(5.0 * 3**0.5)
        assert placed.sources == ("gnss",)


def test_sigma_covers_the_way_from_the_last_fix() -> None:
    follow = following()
    follow(1, 28.0, np.array([3.0, -28.0, 50.0]))
    for seq, north_m in enumerate((56.0, 84.0), 2):
        placed = follow(seq, north_m)
        off_m = np.linalg.norm(placed.T_world_camera[:3, 3] - [3.0, -north_m, 50.0])
        assert off_m == pytest.approx(2.0 * (north_m - 28.0))
        assert off_m < 2.0 * placed.sigma_m
        assert placed.sigma_m == pytest.approx(3**0.5 * np.hypot(5.0, north_m - 28.0))


def test_frames_of_a_flight_without_fixes_stand_where_the_odometry_has_them() -> None:
    follow = following()
    for seq, north_m in enumerate((28.0, 56.0), 1):
        placed = follow(seq, north_m)
        np.testing.assert_allclose(placed.T_world_camera, anchor(seq, north_m).T_odom_camera)
        assert placed.sigma_m == pytest.approx(3**0.5 * np.hypot(1.0, north_m - 28.0))
        assert placed.sources == ("vision",)
