"""A scan keeps the poses of its frames exactly, in memory that stays small."""

from __future__ import annotations

import resource
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from some_views import keyframe_at

from recon import se3
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.types import F64, PosePrior
from service.errors import OutsideError
from service.flight.recorder import PublishedFrames

RNG = np.random.default_rng(4)


def some_pose() -> F64:
    return se3.exp(RNG.normal(size=6))


def before(limit: int) -> Any:
    """Keyframes before ``limit`` no longer change."""

    def is_settled(frame: Frame) -> bool:
        return frame.reference is None or frame.reference.seq < limit

    return is_settled


def published(seq: int, key: Any, agl_m: float | None = 41.5) -> tuple[Frame, Any]:
    prior = PosePrior(None if seq % 3 else np.eye(3), 0.01, 0.5, RNG.normal(size=3))
    frame = Frame(NO_IMAGE, 10**18 + seq, seq, prior, segment=key.segment, reference=key)
    frame.T_keyframe_camera = some_pose()
    return frame, (seq % 2 == 0, agl_m, 2**32 - 1 - seq)


def test_frames_come_back_from_the_disk_as_they_were(tmp_path: Path) -> None:
    keys = [keyframe_at(n, some_pose(), n // 20) for n in range(0, 40, 10)]
    frames = [published(seq, keys[seq // 10], None if seq == 3 else 41.5) for seq in range(40)]
    kept = PublishedFrames(tmp_path)
    for one in frames:
        kept.add(*one, before(20))
    keys[2].T_camera_odom = some_pose()  # still in the window: the newest pose counts
    found = list(kept.all())
    assert not list(tmp_path.iterdir())  # no name: nothing is left behind
    for (frame, written), (again, read) in zip(frames, found, strict=True):
        assert read == written
        assert np.array_equal(frame.T_odom_camera, again.T_odom_camera)
        for name in ("seq", "segment", "time_ns", "state"):
            assert getattr(frame, name) == getattr(again, name)
        for name in ("R_world_camera", "position_m", "sigma_position_m"):
            one, other = (getattr(each.prior, name) for each in (frame, again))
            assert (one is None) == (other is None)
            assert one is None or np.array_equal(one, other)
        assert (again.prior.sigma_tilt_rad, again.prior.sigma_yaw_rad) == (0.01, 0.5)
    kept.close()


def test_a_frame_that_is_placed_late_takes_the_place_of_the_lost_one(tmp_path: Path) -> None:
    kept = PublishedFrames(tmp_path)
    key = keyframe_at(0, some_pose())
    for seq in range(3):
        frame, written = published(seq, key)
        lost = Frame(NO_IMAGE, frame.time_ns, seq, frame.prior, state=Tracking.LOST)
        kept.add(lost, (False, None, 0), before(20))
        if seq < 2:
            kept.add(frame, written, before(20))
    found = [(frame.seq, frame.is_placed) for frame, _ in kept.all()]
    assert found == [(0, True), (1, True), (2, False)]
    kept.close()


def test_only_frames_of_keyframes_that_change_stay_in_memory(tmp_path: Path) -> None:
    kept, places = PublishedFrames(tmp_path), []
    for seq in range(500):
        frame, written = published(seq, keyframe_at(seq, some_pose()))
        kept.add(frame, written, before(seq - 9))
        places.append(weakref.ref(frame.T_keyframe_camera))
        del frame, written
    assert sum(place() is not None for place in places) <= 11
    assert len(list(kept.all())) == 500
    kept.close()


def test_a_full_disk_is_the_outside_worlds_fault(tmp_path: Path) -> None:
    kept = PublishedFrames(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OutsideError):
            for seq in range(1000):
                kept.add(*published(seq, keyframe_at(seq, some_pose())), before(seq))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    kept.close()
