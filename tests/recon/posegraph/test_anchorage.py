"""A scan keeps the poses of its frames exactly, in memory that stays small."""

from __future__ import annotations

import resource
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import se3
from recon.posegraph.alignment import Similarity
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, PosePrior
from service.errors import OutsideError
from service.flight.anchorage import Anchorage, Carriers, Key, PublishedFrame, PublishedFrames
from service.flight.chain import Chain, KeyframeStep, Uncarried
from service.progress import Stopwatch

RNG = np.random.default_rng(4)


def refined(seq: int, segment: int, T_odom_camera: F64) -> Any:
    """A keyframe of the odometry that is still adjusted."""
    return SimpleNamespace(seq=seq, segment=segment, T_odom_camera=T_odom_camera)


def some_pose() -> F64:
    return se3.exp(RNG.normal(size=6))


def before(limit: int) -> Any:
    """Keyframes before ``limit`` no longer change."""

    def is_settled(key: Key) -> bool:
        return key.seq < limit

    return is_settled


def published(seq: int, key: Key, agl_m: float | None = 41.5) -> PublishedFrame:
    anchor = Anchorage(seq, key, some_pose())
    return PublishedFrame(10**18 + seq, anchor, RNG.normal(size=3), 0.5 + seq, agl_m, seq % 2 == 0)


def test_frames_come_back_from_the_disk_as_they_were(tmp_path: Path) -> None:
    keys = [refined(n, n // 20, some_pose()) for n in range(0, 40, 10)]
    frames = [published(seq, keys[seq // 10], None if seq == 3 else 41.5) for seq in range(40)]
    kept = PublishedFrames(tmp_path)
    for frame in frames:
        kept.add(frame, before(20))
    keys[2].T_odom_camera = some_pose()  # still in the window: the newest pose counts
    found = list(kept.corrigible())
    assert not list(tmp_path.iterdir())  # no name: nothing is left behind
    for one, other in zip(frames, found, strict=True):
        assert one.anchor is not None
        assert other.anchor is not None
        assert (one.time_ns, one.agl_m, one.is_view) == (other.time_ns, other.agl_m, other.is_view)
        assert one.sigma_m == other.sigma_m
        assert np.array_equal(one.position_m, other.position_m)
        assert np.array_equal(one.anchor.T_odom_camera, other.anchor.T_odom_camera)
        assert (one.anchor.seq, one.anchor.key.seq) == (other.anchor.seq, other.anchor.key.seq)
        assert one.anchor.key.segment == other.anchor.key.segment
    kept.close()


def test_only_frames_of_keyframes_that_change_stay_in_memory(tmp_path: Path) -> None:
    kept = PublishedFrames(tmp_path)
    for seq in range(500):
        key = refined(seq, 0, some_pose())
        kept.add(published(seq, key), before(seq - 9))
        kept.add(PublishedFrame(10**18 + seq, None, np.zeros(3), 0.0, None, False), before(seq - 9))
    assert len(kept._fresh) <= 22
    assert len(list(kept.corrigible())) == 500
    kept.close()


def test_a_full_disk_is_the_outside_worlds_fault(tmp_path: Path) -> None:
    kept = PublishedFrames(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OutsideError):
            for seq in range(1000):
                kept.add(published(seq, refined(seq, 0, some_pose())), before(seq))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    kept.close()


def test_carriers_keep_their_places_when_they_settle() -> None:
    keys = [refined(n, n // 50, some_pose()) for n in range(0, 100, 10)]
    carriers = Carriers()
    for key in keys:
        carriers.add(Anchorage(key.seq, key, some_pose()))
    frames = [Anchorage(seq, keys[seq // 10], some_pose()) for seq in range(100)]
    found = [carriers.of(frame) for frame in frames]
    carriers.settle(before(70))
    for frame, old in zip(frames, found, strict=True):
        new = carriers.of(frame)
        assert new is not None
        assert old is not None
        assert new.seq == old.seq == frame.seq // 10 * 10
        assert np.array_equal(new.T_odom_camera, old.T_odom_camera)
        assert isinstance(new.key, SimpleNamespace) == (new.seq >= 70)
    assert carriers.of(Anchorage(0, refined(0, 7, np.eye(4)), np.eye(4))) is None


def test_in_flight_a_frame_is_placed_by_what_came_with_the_newest_view() -> None:
    """The graph is at work then on another thread: nothing asks it, nothing waits for it."""
    chain: Any = Chain(Trajectory(), None, before(0), Counter(), Stopwatch())
    key = refined(3, 0, some_pose())
    frame, anchor = Anchorage(7, key, some_pose()), Anchorage(5, key, some_pose())
    image = SimpleNamespace(prior=PosePrior())
    assert chain.follow(image, frame).sources == ("vision",)  # nothing is reconstructed yet
    view = SimpleNamespace(
        seq=5, segment=0, time_ns=0, prior=PosePrior(), points=np.zeros((0, 3)), anchor=anchor,
        view=SimpleNamespace(T_odom_camera=anchor.T_odom_camera),
    )  # fmt: skip
    assert chain.add(view, KeyframeStep(None, np.eye(6)), None) is None
    trajectory, known = chain.trajectory, chain.trajectory.place(5)
    chain.trajectory = None
    alone = Uncarried(np.zeros(3), np.ones(3))
    assert chain.place(frame, alone).seq == 3  # the view is not done
    chain.reconstructed(view, None)
    step = se3.inverse(anchor.T_odom_camera) @ frame.T_odom_camera
    step[:3, 3] *= known.scale
    found = chain.place(frame, alone)
    np.testing.assert_allclose(found.T_world_camera, known.T_world_camera @ step, atol=1e-12)
    chain.trajectory = trajectory
    assert chain.corrections(final=True) == ()
    again = chain.place(frame, alone)
    np.testing.assert_allclose(again.T_world_camera, found.T_world_camera, atol=1e-9)


def test_frames_of_a_segment_too_short_to_be_aligned_stand_at_their_fixes() -> None:
    """Its keyframe carries them by a scale and a heading that nothing shows."""
    chain: Any = Chain(Trajectory(), None, before(0), Counter(), Stopwatch())
    key, fix = refined(3, 0, np.eye(4)), np.array([20.0, -10.0, 50.0])
    prior = PosePrior(position_m=fix, sigma_position_m=np.full(3, 5.0))
    view = SimpleNamespace(
        seq=5, segment=0, time_ns=0, prior=prior, points=np.zeros((0, 3)),
        anchor=Anchorage(5, key, some_pose()), view=SimpleNamespace(T_odom_camera=some_pose()),
    )  # fmt: skip
    chain.add(view, KeyframeStep(None, np.eye(6)), None)
    chain.reconstructed(view, None)
    frame = Anchorage(7, key, some_pose())
    in_flight = chain.follow(SimpleNamespace(prior=prior), frame)
    chain.corrections(final=True)
    again = chain.place(frame, Uncarried(fix, np.full(3, 5.0)))
    for placed in (in_flight, again):
        np.testing.assert_allclose(placed.T_world_camera[:3, 3], fix)
        assert placed.sigma_m == pytest.approx(5.0 * 3**0.5)
    known = Similarity(1.0, np.eye(3), np.zeros(3), np.eye(7))
    chain.graph.segments.known = lambda segment: known
    carried = chain.place(frame, Uncarried(fix, np.full(3, 5.0)))
    assert np.linalg.norm(carried.T_world_camera[:3, 3] - fix) > 1.0
