"""Poses of frames: by the view at or before them, or at their fixes where none carries them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from some_views import keyframe_at, view_at

from recon import se3
from recon.backends.cpu import CpuBackend
from recon.pipeline.keyframe_map import FramePoses, KeyframeMap
from recon.pipeline.stages import untimed
from recon.posegraph.alignment_readings import Alignment
from recon.posegraph.trajectory import Trajectory, sigma_m
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.types import F64, Pose, PosePrior

RNG = np.random.default_rng(4)


def relative(seq: int, segment: int, T_keyframe_camera: F64, key: Frame | None = None) -> Frame:
    return Frame(
        NO_IMAGE, 0, seq, segment=segment, T_keyframe_camera=T_keyframe_camera, reference=key
    )


def frame_at(seq: int, north_m: float) -> Frame:
    return relative(seq, 3, se3.compose(np.eye(3), np.array([0.0, north_m, 50.0])))


def placed(frames: FramePoses, prior: PosePrior, frame: Frame) -> Pose:
    pose = frames.place(replace(frame, prior=prior))
    assert pose is not None
    return pose


def empty() -> KeyframeMap:
    return KeyframeMap(Trajectory(), None, CpuBackend(), Counter(), untimed)


def following() -> Any:
    frames = FramePoses(empty(), lambda frame: True)

    def follow(seq: int, north_m: float, fix: F64 | None = None) -> Pose:
        sigma = None if fix is None else np.full(3, 5.0)
        prior = PosePrior(position_m=fix, sigma_position_m=sigma)
        pose = placed(frames, prior, frame_at(seq, north_m))
        again = placed(frames, prior, frame_at(seq, north_m))
        np.testing.assert_allclose(again.T_world_camera, pose.T_world_camera)
        assert sigma_m(again) == pytest.approx(sigma_m(pose))
        return pose

    return follow


def test_a_frame_that_no_keyframe_carries_stands_at_its_fix() -> None:
    """Stills fly south; without attitude the odometry has them fly north."""
    follow = following()
    for seq, north_m in enumerate((28.0, 56.0, 84.0), 1):
        fix = np.array([3.0, -north_m, 50.0])
        pose = follow(seq, north_m, fix)
        np.testing.assert_allclose(pose.T_world_camera[:3, 3], fix)
        np.testing.assert_allclose(pose.T_world_camera[:3, :3], np.eye(3))
        assert sigma_m(pose) == pytest.approx(5.0 * 3**0.5)
        assert pose.sources == ("gnss",)


def test_sigma_covers_the_way_from_the_last_fix() -> None:
    follow = following()
    follow(1, 28.0, np.array([3.0, -28.0, 50.0]))
    for seq, north_m in enumerate((56.0, 84.0), 2):
        pose = follow(seq, north_m)
        off_m = np.linalg.norm(pose.T_world_camera[:3, 3] - [3.0, -north_m, 50.0])
        assert off_m == pytest.approx(2.0 * (north_m - 28.0))
        assert off_m < 2.0 * sigma_m(pose)
        assert sigma_m(pose) == pytest.approx(3**0.5 * np.hypot(5.0, north_m - 28.0))


def test_frames_of_a_flight_without_fixes_stand_where_the_odometry_has_them() -> None:
    follow = following()
    for seq, north_m in enumerate((28.0, 56.0), 1):
        pose = follow(seq, north_m)
        np.testing.assert_allclose(pose.T_world_camera, frame_at(seq, north_m).T_odom_camera)
        assert sigma_m(pose) == pytest.approx(3**0.5 * np.hypot(1.0, north_m - 28.0))
        assert pose.sources == ("vision",)


def lost(prior: PosePrior) -> Pose | None:
    frames = FramePoses(empty(), lambda frame: True)
    return frames.place(Frame(NO_IMAGE, 0, 1, prior, segment=3, state=Tracking.LOST))


def test_a_lost_frame_is_placed_by_telemetry_that_knows_its_heading() -> None:
    """An attitude without compass turns freely about the vertical: no pose is better."""
    place_m, turn = np.array([3.0, -28.0, 50.0]), se3.so3_exp(np.array([0.1, 0.2, 1.5]))
    known = PosePrior(turn, 0.02, 0.1, place_m, np.array([2.0, 2.0, 4.0]))
    pose = lost(known)
    assert pose is not None
    np.testing.assert_allclose(pose.T_world_camera, se3.compose(turn, place_m))
    assert pose.sources == ("attitude", "gnss", "dead reckoning")
    assert sigma_m(pose) == pytest.approx(24.0**0.5)
    assert lost(replace(known, sigma_yaw_rad=3.0)) is None
    assert lost(replace(known, R_world_camera=None)) is None
    assert lost(replace(known, position_m=None, sigma_position_m=None)) is None


def test_a_lost_frame_is_not_reckoned_on_from_a_pose_that_had_no_scale() -> None:
    """Its segment is aligned by the time it is lost, and the last frame's pose is not."""
    frames, place_m = FramePoses(empty(), lambda frame: False), np.array([3.0, -28.0, 50.0])
    known = PosePrior(np.eye(3), 0.02, 0.1, place_m, np.array([2.0, 2.0, 4.0]))
    placed(frames, replace(known, position_m=None, sigma_position_m=None), frame_at(1, 28.0))
    frames.add_view(frame_at(0, 0.0), Pose(np.eye(4), np.eye(6)))
    pose = frames.place(Frame(NO_IMAGE, 0, 2, known, segment=3, state=Tracking.LOST))
    assert pose is not None
    np.testing.assert_allclose(pose.T_world_camera[:3, 3], place_m)


def test_a_frame_that_is_not_tracked_has_no_place_in_the_odometry() -> None:
    with pytest.raises(AssertionError, match="not tracked"):
        _ = Frame(NO_IMAGE, 0, 1).T_odom_camera


def some_pose() -> F64:
    return se3.exp(RNG.normal(size=6))


def test_views_keep_their_places_when_they_settle() -> None:
    keys = [keyframe_at(n, some_pose(), n // 50) for n in range(0, 100, 10)]
    frames = FramePoses(empty(), lambda view: view.reference is None or view.reference.seq < 70)
    pose = Pose(np.eye(4), np.eye(6))
    for key in keys:
        frames.add_view(relative(key.seq, key.segment, some_pose(), key), pose)
    taken = [relative(n, n // 50, some_pose(), keys[n // 10]) for n in range(100)]
    before = [placed(frames, PosePrior(), frame) for frame in taken]
    frames.settle()
    after = [placed(frames, PosePrior(), frame) for frame in taken]
    for one, other in zip(before, after, strict=True):
        assert np.array_equal(one.T_world_camera, other.T_world_camera)
    fixed = [relative(n, n // 50, taken[n].T_odom_camera) for n in (55, 85)]
    keys[5].T_camera_odom = keys[8].T_camera_odom = some_pose()
    settled, open_ = (placed(frames, PosePrior(), frame).T_world_camera for frame in fixed)
    np.testing.assert_array_equal(settled, after[55].T_world_camera)
    assert not np.allclose(open_, after[85].T_world_camera)  # its view is still adjusted
    alone = placed(frames, PosePrior(), relative(0, 7, np.eye(4)))
    np.testing.assert_array_equal(alone.T_world_camera[:3, 3], np.zeros(3))


def test_in_flight_a_frame_is_placed_by_what_came_with_the_newest_view() -> None:
    """The graph is at work then on another thread: nothing asks it, nothing waits for it."""
    keyframes: Any = empty()
    frames = FramePoses(keyframes, lambda frame: False)
    key = keyframe_at(3, some_pose())
    frame, view = (relative(seq, 0, some_pose(), key) for seq in (7, 5))
    assert placed(frames, PosePrior(), frame).sources == ("vision",)  # nothing is reconstructed yet
    known, trajectory = keyframes.add(view_at(5, view.T_odom_camera), None), keyframes.trajectory
    keyframes.trajectory = None
    waiting = placed(frames, PosePrior(), frame)
    np.testing.assert_allclose(waiting.T_world_camera, frame.T_odom_camera)
    frames.add_view(view, known)  # the view is done
    step = se3.inverse(view.T_odom_camera) @ frame.T_odom_camera
    step[:3, 3] *= known.scale
    found = placed(frames, PosePrior(), frame)
    np.testing.assert_allclose(found.T_world_camera, known.T_world_camera @ step, atol=1e-12)
    keyframes.trajectory = trajectory
    assert keyframes.trajectory.moved(final=True) == {}
    frames.finish()
    again = placed(frames, PosePrior(), frame)
    np.testing.assert_allclose(again.T_world_camera, found.T_world_camera, atol=1e-9)


def test_frames_of_a_segment_too_short_to_be_aligned_stand_at_their_fixes() -> None:
    """Its keyframe carries them by a scale and a heading that nothing shows."""
    keyframes: Any = empty()
    frames = FramePoses(keyframes, lambda frame: False)
    key, fix = keyframe_at(3, np.eye(4)), np.array([20.0, -10.0, 50.0])
    prior = PosePrior(position_m=fix, sigma_position_m=np.full(3, 5.0))
    view, frame = (relative(seq, 0, some_pose(), key) for seq in (5, 7))
    frames.add_view(view, keyframes.add(view_at(5, view.T_odom_camera, prior=prior), None))
    in_flight = placed(frames, prior, frame)
    keyframes.trajectory.moved(final=True)
    frames.finish()
    again = placed(frames, prior, frame)
    for pose in (in_flight, again):
        np.testing.assert_allclose(pose.T_world_camera[:3, 3], fix)
        assert sigma_m(pose) == pytest.approx(5.0 * 3**0.5)
    known = Alignment(1.0, np.eye(3), np.zeros(3), np.eye(7))
    keyframes.graph.segments[0].similarity = known
    carried = placed(frames, prior, frame)
    assert np.linalg.norm(carried.T_world_camera[:3, 3] - fix) > 1.0
