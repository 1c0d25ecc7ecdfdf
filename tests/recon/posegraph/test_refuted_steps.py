"""Steps of vision that both attitude and positions contradict."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from bench_graph import legs
from flown_track import SPREAD, sensed

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Node
from recon.types import F64, PosePrior
from service.flight.reports import GraphWatch

COUNT, SMEARED, SCALE = 40, range(30, 34), 1.3
TILT = se3.so3_exp(np.array([np.radians(8.0), 0.0, 0.0]))


def flown(smears: bool, tilts: bool = False, jumps: bool = False) -> tuple[list[F64], PoseGraph]:
    """A flight in which vision explains four steps of 6 m by turns of 8 degrees, or attitudes or
    positions fail instead; and its truth."""
    rng, graph = np.random.default_rng(2), PoseGraph()
    truth = legs(rng, COUNT, 20, 6.0)
    odom, priors = sensed(rng, truth, SPREAD, SCALE)
    T = odom[0]
    for i, prior in enumerate(priors):
        prior = replace(prior, position_m=truth[i][:3, 3] + 0.1 * rng.normal(size=3))
        if i:
            step = se3.inverse(odom[i - 1]) @ odom[i]
            T = T @ (se3.compose(TILT, 0.2 * step[:3, 3]) if smears and i in SMEARED else step)
        prior = faulty(prior, i - SMEARED[0] + 1, tilts, jumps) if i in SMEARED else prior
        units = np.array([1.0] * 3 + [1.0 / SCALE] * 3)
        graph.add_keyframe(Node(i, i * 10**9, 0, T, SPREAD * np.outer(units, units), prior))
    graph.solve()
    return truth, graph


def faulty(prior: PosePrior, steps: int, tilts: bool, jumps: bool) -> PosePrior:
    R, place = prior.R_world_camera, prior.position_m
    assert R is not None and place is not None
    turn = se3.so3_exp(np.array([np.radians(8.0 * steps), 0.0, 0.0]))
    out = replace(prior, R_world_camera=turn @ R) if tilts else prior
    return replace(out, position_m=place + np.array([0.0, 30.0, 0.0])) if jumps else out


def test_a_smeared_stretch_is_placed_by_telemetry_and_reported() -> None:
    truth, graph = flown(smears=True)
    assert graph.refuted == dict(pairwise(range(29, 34)))
    assert all(graph.sources(i) == ("attitude", "gnss", "dead reckoning") for i in SMEARED)
    poses = np.array([graph.pose(i).T_world_camera for i in range(COUNT)])
    off_m = np.linalg.norm((poses - np.array(truth))[:, :3, 3], axis=1)
    assert off_m.max() < 4.0
    assert GraphWatch(graph).sentences() == [
        "4 steps of the track contradict both attitude and positions and were left out: are images "
        "smeared by compression?"
    ]


@pytest.mark.parametrize("fault", ["tilts", "jumps"])
def test_one_sensor_alone_refutes_no_vision(fault: str) -> None:
    _, graph = flown(smears=False, **{fault: True})
    assert not graph.refuted


def test_sound_vision_stands() -> None:
    _, graph = flown(smears=False)
    assert not graph.refuted and "vision" in graph.sources(COUNT - 1)
