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
from recon.tracking.frame import NO_IMAGE, Frame
from recon.types import F64, PosePrior
from service.errors import OutsideError
from service.flight.recorder import FRAME, PublishedFrames

RNG = np.random.default_rng(4)


def some_pose() -> F64:
    return se3.exp(RNG.normal(size=6))


def before(limit: int) -> Any:
    """Keyframes before ``limit`` no longer change."""

    def is_settled(frame: Frame) -> bool:
        return frame.keyframe.seq < limit

    return is_settled


def published(seq: int, key: Any, agl_m: float = 41.5) -> tuple[Frame, Any]:
    row = np.zeros((), FRAME)
    row["time_ns"], row["crc"] = 10**18 + seq, 2**32 - 1 - seq
    row["agl_m"], row["is_view"] = agl_m, seq % 2 == 0
    prior = PosePrior(None if seq % 3 else np.eye(3), 0.01, 0.5, RNG.normal(size=3))
    frame = Frame(NO_IMAGE, 0, seq, prior, segment=key.segment, reference=key)
    frame.T_keyframe_camera = some_pose()
    return frame, row


def test_frames_come_back_from_the_disk_as_they_were(tmp_path: Path) -> None:
    keys = [keyframe_at(n, some_pose(), n // 20) for n in range(0, 40, 10)]
    frames = [published(seq, keys[seq // 10], np.nan if seq == 3 else 41.5) for seq in range(40)]
    kept = PublishedFrames(tmp_path)
    for one in frames:
        kept.add(*one, before(20))
    keys[2].T_camera_odom = some_pose()  # still in the window: the newest pose counts
    found = list(kept.rows())
    assert not list(tmp_path.iterdir())  # no name: nothing is left behind
    for (frame, one), other in zip(frames, found, strict=True):
        for name in ("time_ns", "is_view", "crc"):
            assert np.array_equal(one[name], other[name])
        assert np.array_equal(one["agl_m"], other["agl_m"], equal_nan=True)
        assert np.array_equal(frame.prior.position_m, other["position_m"])
        assert np.isnan(other["sigma_position_m"]).all()
        assert (frame.prior.R_world_camera is None) == np.isnan(other["R_world_camera"]).all()
        assert other["sigma_turn_rad"].tolist() == [0.01, 0.5]
        assert np.array_equal(frame.T_odom_camera, other["T_odom_camera"])
        assert (frame.seq, frame.segment) == (other["seq"], other["segment"])
    kept.close()


def test_only_frames_of_keyframes_that_change_stay_in_memory(tmp_path: Path) -> None:
    kept, places = PublishedFrames(tmp_path), []
    for seq in range(500):
        frame, row = published(seq, keyframe_at(seq, some_pose()))
        kept.add(frame, row, before(seq - 9))
        places.append(weakref.ref(row))
        del frame, row
    assert sum(place() is not None for place in places) <= 11
    assert len(list(kept.rows())) == 500
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
