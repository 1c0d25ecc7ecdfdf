"""Corrections travel: what the graph moves is published once, and both ends of the link agree."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from recon import se3
from recon.posegraph.records import Loop, Node
from recon.posegraph.trajectory import REPOSE_M, REPOSE_SIGMAS, Trajectory, carried, sigma_m
from recon.types import F64, DepthMap, Keyframe, Pose, PosePrior
from service.scans.fused_cloud import fused_cloud
from service.stream import codec
from service.stream.records import Repose, ScanHeader
from service.stream.store import ScanStore

NADIR = np.diag([1.0, -1.0, -1.0])
HEIGHT_M = 40.0
K = np.array([[80.0, 0, 47.5], [0, 80.0, 26.5], [0, 0, 1]])
HEADER = ScanHeader("scan-1", "drone-a", 1_700_000_000_000_000_000, camera={"width": 96})
LEG = 14


def legs() -> list[F64]:
    """There and back over the same ground, looking straight down."""
    out = [se3.compose(NADIR, np.array([4.0 * i, 0.0, HEIGHT_M])) for i in range(LEG)]
    turn = se3.so3_exp(np.array([0.0, 0.0, np.pi])) @ NADIR
    back = [np.array([4.0 * (LEG - 1 - i), 3.0, HEIGHT_M]) for i in range(LEG)]
    return out + [se3.compose(turn, place) for place in back]


def drifted(truth: list[F64], climb: float = 0.02) -> list[F64]:
    """The chain of an odometry that climbs a little with each metre."""
    chain = [truth[0]]
    for a, b in pairwise(truth):
        step = se3.inverse(a) @ b
        step[2, 3] -= climb * float(np.linalg.norm(step[:3, 3]))
        chain.append(chain[-1] @ step)
    return chain


def prior(T: F64) -> PosePrior:
    return PosePrior(T[:3, :3], 0.01, 0.05, None, None, HEIGHT_M, 2.0)


COVARIANCE = np.diag([2e-4**2] * 3 + [0.06**2] * 3)
LOOP = np.diag([3e-4**2] * 3 + [0.02**2] * 3)


def flown(truth: list[F64], chain: list[F64], height: float = HEIGHT_M) -> Trajectory:
    out = Trajectory()
    for i, (T, odom) in enumerate(zip(truth, chain, strict=True)):
        out.add(Node(10 * i, i * 10**9, 0, odom, COVARIANCE, prior(T), height))
    return out


def close_loops(trajectory: Trajectory, truth: list[F64]) -> list[bool]:
    pairs = ((2, 2 * LEG - 3), (5, 2 * LEG - 6), (9, 2 * LEG - 10))
    return [
        trajectory.graph.add_loop(Loop(10 * a, 10 * b, se3.inverse(truth[a]) @ truth[b], LOOP))
        for a, b in pairs
    ]


def flat(seq: int, T: F64) -> Keyframe:
    """A keyframe that sees level ground from its height."""
    h, w = 54, 96
    rng = np.random.default_rng(seq)
    depth = DepthMap(
        np.full((h, w), HEIGHT_M, np.float32), np.full((h, w), 0.05, np.float32),
        np.full((h, w), 3, np.uint8), K, T,
    )  # fmt: skip
    bgr = rng.integers(0, 255, (h, w, 3), np.uint8)
    pose = Pose(T, np.eye(6) * 1e-4, ("vision",))
    return Keyframe(seq, 5 + seq, depth, bgr, pose, np.ones((h, w), np.bool_))


@pytest.mark.slow
def test_a_loop_closure_reaches_store_and_ground_alike(tmp_path: Path) -> None:
    truth = legs()
    chain = drifted(truth)
    trajectory = Trajectory()
    scales: dict[int, float] = {}
    with (
        ScanStore.create(tmp_path / "drone.db", HEADER) as drone,
        ScanStore.create(tmp_path / "ground.db", HEADER) as ground,
    ):
        for i, (T, odom) in enumerate(zip(truth, chain, strict=True)):
            trajectory.add(Node(10 * i, i * 10**9, 0, odom, COVARIANCE, prior(T), HEIGHT_M))
            placed = trajectory.pose(10 * i)
            trajectory.publish(10 * i, placed)
            scales[10 * i] = placed.scale
            keyframe = flat(10 * i, placed.T_world_camera)
            layers = codec.encode(keyframe, keyframe.time_ns)
            drone.add_keyframe(10 * i, layers)
        before = fused_cloud(drone).cloud.xyz_m[:, 2]
        assert any(close_loops(trajectory, truth))
        moved = trajectory.moved()
        assert moved
        drone.add_reposes(
            [
                Repose(seq, 1, p.T_world_camera, p.scale / scales[seq], p.covariance)
                for seq, p in moved.items()
            ]
        )
        for kind, numbers in drone.numbers().items():
            if kind not in ("header", "summary"):
                for number in numbers:
                    data = drone.record(kind, number)
                    assert data is not None and ground.put_record(kind, number, data)
        for keyframe in drone.keyframes():
            there = ground.keyframe(keyframe.seq)
            placed = trajectory.pose(keyframe.seq)
            assert there is not None
            np.testing.assert_array_equal(there.depth.depth_m, keyframe.depth.depth_m)
            for T in (keyframe.pose.T_world_camera, there.pose.T_world_camera):
                held_back_m = max(REPOSE_M, REPOSE_SIGMAS * sigma_m(placed))
                assert np.linalg.norm(T[:3, 3] - placed.T_world_camera[:3, 3]) < 1.2 * held_back_m
        here, there_cloud = fused_cloud(drone).cloud, fused_cloud(ground).cloud
        np.testing.assert_array_equal(here.xyz_m, there_cloud.xyz_m)
    # The second leg's ground lay up to 2 m above the first's.
    assert np.ptp(before) > 1.5
    first, last = trajectory.pose(20), trajectory.pose(10 * (2 * LEG - 3))
    step = first.T_world_camera[2, 3] - last.T_world_camera[2, 3]
    assert abs(step) < 0.1


def test_a_correction_is_published_once_and_small_ones_only_at_the_end() -> None:
    truth = legs()
    trajectory = flown(truth, drifted(truth, 0.0))
    for i in range(len(truth)):
        trajectory.publish(10 * i, trajectory.pose(10 * i))
    assert trajectory.moved() == {}
    wrong = legs()
    for T in wrong[LEG:]:
        T[2, 3] += 0.3
    assert close_loops(trajectory, wrong)[1:] == [True, True]
    moved = trajectory.moved()
    assert moved and all(p.scale == pytest.approx(1.0, abs=0.02) for p in moved.values())
    assert all("loop" not in p.sources or seq >= 10 * LEG for seq, p in moved.items())
    assert trajectory.moved() == {}
    assert trajectory.moved(final=True)
    assert trajectory.moved(final=True) == {}


def test_a_frame_rides_on_its_keyframe() -> None:
    truth = legs()
    halved = [se3.compose(T[:3, :3], 0.5 * T[:3, 3]) for T in truth]
    trajectory = flown(truth, halved, 0.5 * HEIGHT_M)
    step = se3.compose(np.eye(3), np.array([0.5, 0.0, 0.0]))
    key = trajectory.pose(50)
    frame = carried(key, step)
    assert key.scale == pytest.approx(2.0, rel=0.03)
    here = se3.inverse(key.T_world_camera) @ frame.T_world_camera
    assert here[0, 3] == pytest.approx(0.5 * key.scale)
    ahead = np.array([[1.0, 2.0, 0.5 * HEIGHT_M]])  # in units of the odometry
    (T,) = trajectory.similarities([50])
    there = se3.transform(key.T_world_camera, key.scale * ahead)
    np.testing.assert_allclose(se3.transform(T, ahead), there, atol=1e-9)


def test_the_end_publishes_each_sigma_as_it_is() -> None:
    """The first keyframes are published before their segment is placed, with sigmas of 1 m."""
    truth = legs()
    trajectory, published = Trajectory(), {}
    for i, T in enumerate(truth):
        trajectory.add(Node(10 * i, i * 10**9, 0, T, COVARIANCE, prior(T), HEIGHT_M))
        published[10 * i] = trajectory.pose(10 * i)
        trajectory.publish(10 * i, published[10 * i])
    assert sigma_m(published[0]) == pytest.approx(np.sqrt(3.0), rel=1e-3)
    for seq, p in trajectory.moved(final=True).items():  # they settle, as published in flight
        trajectory.publish(seq, replace(p, covariance=published[seq].covariance))
    published |= trajectory.moved(final=True)
    for seq, p in published.items():
        assert sigma_m(p) == pytest.approx(sigma_m(trajectory.pose(seq)), rel=0.02), seq


def test_a_keyframe_that_nothing_aligns_is_no_surer_than_the_way_without_vision() -> None:
    trajectory = Trajectory()
    for i, T in enumerate(legs()[:8]):
        trajectory.add(Node(i, i * 10**9, 0 if i < 7 else 1, T, COVARIANCE, PosePrior()))
    assert sigma_m(trajectory.pose(6)) < 2.0
    assert sigma_m(trajectory.pose(7)) > 5.0


def test_a_scan_far_from_its_origin_is_as_sure_of_its_places() -> None:
    sigmas = []
    for away_m in (0.0, 3000.0):
        out = Trajectory()
        for i, T in enumerate(legs()):
            fix = T[:3, 3] + [away_m, 0.0, 0.0]
            known = replace(prior(T), position_m=fix, sigma_position_m=np.full(3, 1.0))
            out.add(Node(i, i * 10**9, 0, T, COVARIANCE, known, HEIGHT_M))
        sigmas.append(sigma_m(out.pose(5)))
    assert sigmas[1] == pytest.approx(sigmas[0], rel=1e-3)
    assert 1.0 < sigmas[0] < 2.0
