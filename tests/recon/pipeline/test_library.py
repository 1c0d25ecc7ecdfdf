"""recon is a library: the example in docs/design.md runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from paths import DEMO, ROOT
from some_views import view_at

import recon
from recon import se3
from recon.calibration.adjusted_track import AdjustedTrack
from recon.pipeline.mapper import (
    FramePosed,
    KeyframeReady,
    Mapper,
    PosesChanged,
    Reconstructed,
    moved,
)
from recon.pipeline.views import StereoView, ViewSelection
from recon.tracking.frame import Frame, Tracking
from recon.types import Camera, DepthMap, Keyframe, Pose, PosePrior

CAMERA = Camera(np.array([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]]), np.zeros(5), (80, 60))
TEXT = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")


def example() -> str:
    found = re.findall(r"```python\n(from pathlib.*?)```", TEXT, re.DOTALL)
    assert len(found) == 1
    return str(found[0])


@pytest.mark.slow
def test_the_example_makes_a_cloud(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(DEMO.parents[1])
    names: dict[str, Any] = {}
    exec(example(), names)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("keyframe ") and lines[-1].endswith(" points")
    cloud = names["cloud"]
    assert len(cloud) > 50_000
    height_m = 80.0 + cloud.xyz_m[:, 2]  # the first camera is the origin
    assert abs(float(height_m.mean())) < 25.0  # the height above ground is assumed


def keyframe(seq: int) -> Keyframe:
    depth = DepthMap(
        np.full((2, 3), 10.0, np.float32), np.full((2, 3), 0.5, np.float32),
        np.full((2, 3), 2, np.uint8), np.eye(3), np.eye(4),
    )  # fmt: skip
    bgr, fresh = np.zeros((2, 3, 3), np.uint8), np.ones((2, 3), np.bool_)
    return Keyframe(seq, 0, depth, bgr, Pose(np.eye(4), np.eye(6), scale=2.0), fresh)


def test_a_cloud_follows_the_corrections_of_its_keyframes() -> None:
    there = se3.compose(np.eye(3), np.array([0.0, 5.0, 0.0]))
    found = moved(keyframe(0), Pose(there, np.eye(6), scale=3.0))
    assert found.depth.depth_m[0, 0] == 15.0 and found.depth.sigma_m[0, 0] == 0.75
    np.testing.assert_array_equal(found.depth.T_world_camera, there)
    again = moved(found, Pose(there, np.eye(6), scale=2.0))
    assert again.depth.depth_m[0, 0] == 10.0


def test_a_mapper_without_its_keyframes_has_no_cloud() -> None:
    mapper = Mapper(CAMERA, keeps_cloud=False)
    with pytest.raises(ValueError, match="keeps_cloud"):
        mapper.cloud()
    assert mapper.finish() == () and len(Mapper(CAMERA).finish()) == 0


IMAGE = np.zeros((60, 80, 3), np.uint8)
LOOKS_DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.mark.parametrize(
    ("frame", "fault"),
    [
        (Frame(IMAGE[:, :, 0], 9, 9), r"\(60, 80, 3\) uint8 by the camera model, not \(60, 80\) "),
        (Frame(IMAGE.astype(np.float32), 9, 9), "not .* float32"),
        (Frame(np.zeros((80, 60, 3), np.uint8), 9, 9), r"not \(80, 60, 3\)"),
        (Frame(np.zeros((120, 160, 3), np.uint8), 9, 9), r"not \(120, 160, 3\)"),
        (Frame(None, 9, 9), "not None"),  # type: ignore[arg-type]
        (Frame(IMAGE, 9, 0), "frame 0 at 9 ns is not after frame 0 at 5 ns"),
        (Frame(IMAGE, 5, 9), "frame 9 at 5 ns is not after"),
        (Frame(IMAGE, 0.5, 9), "no whole number of ns"),  # type: ignore[arg-type]
        (Frame(IMAGE, 9, 9, None), "must be a PosePrior"),  # type: ignore[arg-type]
        (Frame(IMAGE, 9, 9, PosePrior(2.0 * LOOKS_DOWN)), "R_world_camera must be"),
        (Frame(IMAGE, 9, 9, PosePrior(-LOOKS_DOWN)), "R_world_camera must be"),
        (Frame(IMAGE, 9, 9, PosePrior(np.array([1.0, 0, 0, 0]))), "R_world_camera must be"),
        (Frame(IMAGE, 9, 9, PosePrior(position_m=np.full(3, np.nan))), "position_m must be"),
        (Frame(IMAGE, 9, 9, PosePrior(position_m=np.array([None] * 3))), "position_m must be"),
        (Frame(IMAGE, 9, 9, PosePrior(position_m=[1, 2, 3])), "array"),  # type: ignore[arg-type]
    ],
)
def test_a_frame_that_cannot_be_used_is_refused_by_name(frame: Frame, fault: str) -> None:
    mapper = Mapper(CAMERA)
    mapper.add(Frame(IMAGE, 5, 0, PosePrior(LOOKS_DOWN, position_m=np.zeros(3))))
    with pytest.raises(ValueError, match=fault):
        mapper.add(frame)
    assert mapper.add(Frame(IMAGE, 9, 9))  # it changed nothing


def test_lists_are_no_camera_model() -> None:
    with pytest.raises(ValueError, match="arrays of NumPy"):
        Mapper(Camera(CAMERA.K.tolist(), CAMERA.distortion, CAMERA.size_px))


def test_no_frame_comes_between_the_two_numbers_of_a_spacing() -> None:
    """Another thread sets them: every fifth frame follows every two metres."""
    mapper, steps = Mapper(CAMERA), list[float]()

    class Watched(ViewSelection):
        def __setattr__(self, name: str, value: object) -> None:
            super().__setattr__(name, value)
            if self is mapper.views.selection:
                steps.append(self.frames_per_step)

    mapper.views.selection = Watched((2.0, 0))
    mapper.set_spacing((0.0, 5))
    assert steps == [np.inf]  # no moment at which base to height decides


class BrokenOff:
    """Gives one view, which corrects a keyframe whose own work was broken off, and itself."""

    def __init__(self, _: object) -> None:
        self.views = 0

    def offer(self, item: StereoView) -> None: ...

    def finished(self, everything: bool = False) -> list[tuple[StereoView, Reconstructed]]:
        self.views += 1
        view = view_at(self.views, np.eye(4))
        poses = dict.fromkeys((7, self.views), Pose(np.eye(4), np.eye(6), scale=3.0))
        ready = KeyframeReady(keyframe(self.views))
        return [(view, (poses[7], (ready, PosesChanged(poses))))]

    is_free = True

    def close(self) -> None: ...


def test_only_keyframes_that_came_are_corrected() -> None:
    mapper = Mapper(CAMERA, worker=BrokenOff)
    first, changed = mapper.drain()
    assert isinstance(first, KeyframeReady) and isinstance(changed, PosesChanged)
    assert list(changed.poses) == [1] and len(mapper.cloud()) > 0


class Hovering(AdjustedTrack):
    """No frame need be looked at."""

    def can_skip(self, time_ns: int, prior: PosePrior, frames_per_step: float) -> bool:
        return True


def test_a_keyframe_does_not_wait_for_the_next_frame_that_is_looked_at() -> None:
    mapper = Mapper(CAMERA, known=Hovering({}, CAMERA, 0.0), worker=BrokenOff)
    ready, changed, skipped = mapper.skip(5, 0, PosePrior())
    assert isinstance(ready, KeyframeReady) and isinstance(changed, PosesChanged)
    assert isinstance(skipped, FramePosed) and skipped.frame.seq == 5


def test_a_keyframe_does_not_wait_until_the_track_is_found_again() -> None:
    mapper = Mapper(CAMERA, worker=BrokenOff)
    ready, changed, lost = mapper.track(Frame(IMAGE, 0, 5, PosePrior()))
    assert isinstance(ready, KeyframeReady) and isinstance(changed, PosesChanged)
    assert isinstance(lost, FramePosed) and lost.frame.seq == 5
    assert lost.frame.state is Tracking.LOST


def test_a_cloud_leaves_out_keyframes_between_which_vision_is_wrong() -> None:
    mapper = Mapper(CAMERA, worker=BrokenOff)
    mapper.drain()
    mapper.keyframe_map.graph.refuted[1] = 2
    assert len(mapper.cloud()) == 0


def test_every_name_of_the_library_is_there() -> None:
    assert all(getattr(recon, name) is not None for name in recon.__all__)
    with pytest.raises(AttributeError, match="nothing"):
        recon.nothing  # type: ignore[attr-defined]  # noqa: B018


def test_the_library_needs_nothing_of_the_service() -> None:
    code = "import sys; from recon import Mapper; print(*sys.modules)"
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert not [name for name in ran.stdout.split() if name.startswith(("service", "mavlink"))]


class FirstOnly(BrokenOff):
    """Gives one first depth."""

    def finished(self, everything: bool = False) -> list[tuple[StereoView, Reconstructed]]:
        self.views += 1
        view = view_at(self.views, np.eye(4))
        first = KeyframeReady(keyframe(self.views), is_first_depth=True)
        return [(replace(view, is_first_depth=True), (None, (first,)))]


def test_a_first_depth_is_said_and_becomes_no_part_of_the_map() -> None:
    mapper = Mapper(CAMERA, worker=FirstOnly)
    (event,) = mapper.drain()
    assert isinstance(event, KeyframeReady) and event.is_first_depth
    assert len(mapper.cloud()) == 0
    frame = view_at(9, np.eye(4)).frame
    pose = mapper.frame_poses.place(frame)
    assert pose is not None and pose.sources == ("vision",) and not pose.is_aligned
