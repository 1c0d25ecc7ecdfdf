"""The step between two keyframes by vision and by ICP of their depths."""

from __future__ import annotations

from collections import Counter
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest
from some_views import view_at

from recon import se3
from recon.backends import Backend
from recon.pipeline.keyframe_map import KeyframeMap
from recon.pipeline.stages import untimed
from recon.posegraph.trajectory import Trajectory
from recon.types import DepthMap, Registration, Verdict

ONE = np.ones((2, 2), np.float32)
DEPTH = DepthMap(ONE, ONE, np.ones((2, 2), np.uint8), np.eye(3), np.eye(4))
STEP = se3.compose(np.eye(3), np.array([4.0, 0.0, 0.0]))


def step_with_icp(off_m: float) -> float:
    """m by which a step leaves vision's, when ICP as sure as vision is off by ``off_m``; it is no
    surer than by vision alone, whose motion gave the depth."""
    spread = np.diag([1e-3**2] * 3 + [0.02**2] * 3)
    T = se3.compose(np.eye(3), np.array([4.0 + off_m, 0.0, 0.0]))
    found = Registration(T, spread, Verdict.CONVERGED, 0.1, 0.9, 3)
    backend = cast(Any, Mock(Backend, **{"register.return_value": found}))
    keyframes = KeyframeMap(Trajectory(), None, backend, Counter(), untimed)
    for seq, T_odom_camera in enumerate((np.eye(4), STEP)):
        view = view_at(seq, T_odom_camera, covariance=spread, earlier={0: np.eye(4)})
        keyframes.add(view, DEPTH)
    assert keyframes.verdicts == {Verdict.CONVERGED: 1}
    sigma_m = np.sqrt(keyframes.graph.node(1).covariance[3, 3])
    assert sigma_m == pytest.approx(np.hypot(0.02, 0.005), rel=1e-6)
    return float(keyframes.trajectory.odom_pose(1)[0, 3] - STEP[0, 3])


@pytest.mark.parametrize(("off_m", "taken_m"), [(0.03, 0.015), (0.5, 0.0)])
def test_icp_that_contradicts_vision_does_not_move_the_step(off_m: float, taken_m: float) -> None:
    assert step_with_icp(off_m) == pytest.approx(taken_m, abs=0.002)
