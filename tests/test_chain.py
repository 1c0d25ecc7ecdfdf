"""Frames of segments that no keyframe places in the world."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import se3
from recon.posegraph.trajectory import Trajectory
from recon.types import PosePrior
from service.flight.anchorage import Anchorage, SettledKey
from service.flight.chain import Chain
from service.progress import Stopwatch


def anchor(seq: int, north_m: float) -> Anchorage:
    T = se3.compose(np.eye(3), np.array([0.0, north_m, 50.0]))
    return Anchorage(seq, SettledKey(0, 3, T), np.eye(4))


@pytest.mark.parametrize("heading", ["known", "opposite"])
def test_sigma_covers_a_segment_that_nothing_places(heading: str) -> None:
    """Stills fly south from their first fix; without attitude the odometry has them fly north."""
    chain: Any = Chain(Trajectory(), lambda key: True, Counter(), Stopwatch())
    sign = 1.0 if heading == "known" else -1.0
    for seq, north_m in enumerate((28.0, 56.0, 84.0), 1):
        fix = np.array([0.0, sign * north_m, 50.0])
        prior = PosePrior(position_m=fix, sigma_position_m=np.full(3, 5.0))
        placed = chain.follow(SimpleNamespace(prior=prior), anchor(seq, north_m))
        off_m = float(np.linalg.norm(placed.T_world_camera[:3, 3] - fix))
        assert off_m < 2.0 * placed.sigma_m
        assert placed.sigma_m == chain.place(anchor(seq, north_m)).sigma_m
    assert placed.sigma_m > 50.0
